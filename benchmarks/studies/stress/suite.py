"""Scenes of numerical stress, read from `benchmarks/suites/stress.toml` or a file of the user's; limits of errors.

The simulator and the methods take the same scenes. `docs/how-to/test-stability.md` lists the keys. Lengths are in mm.
Simulates nothing.
"""

import hashlib
import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ctsim.beam.spectrum import Tube
from ctsim.benchmarks.methods import TABLE
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Count, Geometry, Pair, Triple
from ctsim.materials import material
from ctsim.phantoms.shapes import cylinder
from ctsim.phantoms.suites import read_toml, scenes_of
from ctsim.scatter import Scatter
from ctsim.solids import Solid
from ctsim.types import Phantom, Scanner

FULL, SHORT = 24, 16  # voxels along a side
P_SURE = 1.2e-4  # |ΔP| where P ≤ 14.6: the energies' 1e-4, a tenth more between the lengths tried, float32's 1e-5
CLAMP = 81.0  # of P: exponents end at 80; 1 more for the weight of one node
MASS = 0.01  # of a rod on the grid: 1/250 of every voxel that its surface crosses, of 216 cm³ for its 94 at worst
FLOAT32 = 2e-5  # |ΔP|: exp is good to 4e-7·max(1, P/4) and so are the sums; lengths of 50 mm to 8e-6 mm, by 0.5/mm
NEAR = 0.7  # of an empty volume's error
SAME = 1e-3  # of the greatest value: float32
SAME_BY_DESCENT = 0.03
BOUNDS = {"ibhc": 10.0}  # it adds to P the hardening computed from its own volume, streaks included
PROJECTED, VOXELISED, RESPONDED = 1e-5, 1e-5, 2e-6  # splats: of the peak, of the greatest voxel, of the response

SPLATS = ("splat", "splat-paper", "splat-r2")
FIELDS = ("naf", "polyner", "park", "field")
GROUPS: dict[str, tuple[str, ...]] = {
    "by-mask": ("limar", "nmar", "bhc-poly", "fusion", "dicdnet-lite", "acdnet-lite", "oscnet-lite"),
    # their steps have one length for any gradient, of TV or by Adam, also where that is rounding
    "descent": ("asd-pocs", "awpcsd", *FIELDS),
    "ordered": ("sart", "os-sart", "asd-pocs", "awpcsd", *SPLATS, *FIELDS),  # a repeated view updates them twice
    "sampled": ("bhc-poly",),  # fits in 64 views, other ones where the scan has twice the views
    "physical": (*SPLATS, "ibhc", "field"),  # take materials from tables in 1/mm, so lengths must be true
}
"""Groups of methods that a scene's `unlike` may name."""

METALS = ("Ti", "Fe", "Sn", "W", "Au")
TAKEN = ("threads", "float64")  # cases of methods without a scene
AIR = np.zeros((2, 2, 2), np.uint8)
Positive = Annotated[float, msgspec.Meta(gt=0)]


def same_of(method: str) -> float:
    """Return how much a method's volumes of two forms of one scan may differ, relative to the greatest value."""
    return SAME_BY_DESCENT if method in GROUPS["descent"] else SAME


class OfSide(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A count that grows with the grid: floor(`times` · side) + `plus`."""

    times: Positive = 1.0
    plus: int = 0


Number = Count | OfSide


class Circle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A circular scan and its grid, for any grid side; by default a desktop scanner whose detector covers the cube.

    Tuples are (z, y, x) or (v, u), as in `Geometry`. `field_mm` is the edge of the reconstructed cube, `detector_mm`
    the detector's extent. Views lie at start + arc·(k/n)^crowding.
    """

    n_voxel: tuple[Number, Number, Number] = (OfSide(), OfSide(), OfSide())
    field_mm: Positive = 60.0
    n_detector: tuple[Number, Number] = (OfSide(times=1.5), OfSide(times=1.5))
    detector_mm: tuple[Positive, Positive] = (150.0, 150.0)
    n_views: Number = OfSide(times=2)
    dso: float = 250.0
    dsd: float = 500.0
    off_origin: Triple = (0.0, 0.0, 0.0)
    off_detector: Pair = (0.0, 0.0)
    start_deg: float = 0.0
    arc_deg: float = 360.0
    crowding: Positive = 1.0

    def __post_init__(self) -> None:
        for side in (SHORT, FULL):
            self.resolve(side)

    def resolve(self, side: int) -> Geometry:
        """Return the geometry for a grid of `side` voxels along an axis; raises InputError if that is impossible."""
        n_views, *rest = (_count(n, side) for n in (self.n_views, *self.n_voxel, *self.n_detector))
        if min(n_views, *rest) < 1:
            raise InputError(f"counts must be at least 1, got {rest[:3]} voxels, {rest[3:]} pixels and {n_views} views")
        (z, y, x), (v, u) = rest[:3], rest[3:]
        high, wide = self.detector_mm
        crowded = self.start_deg + self.arc_deg * (np.arange(n_views) / n_views) ** self.crowding
        alike = ("dso", "dsd", "off_origin", "off_detector", "start_deg", "arc_deg")
        return Geometry(
            n_voxel=(z, y, x),
            d_voxel=(self.field_mm / z, self.field_mm / y, self.field_mm / x),
            n_detector=(v, u),
            d_detector=(high / v, wide / u),
            n_views=n_views,
            angles_deg=None if self.crowding == 1 else tuple(crowded.tolist()),
            **{name: getattr(self, name) for name in alike},
        )


def _count(n: Number, side: int) -> int:
    return n if isinstance(n, int) else math.floor(n.times * side) + n.plus


class Rod(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An upright rod through (x, y) = `at`. `metal` need not be given for the elements in `METALS`."""

    material: str
    radius: float
    at: Pair = (0.0, 0.0)
    height: float = 52.0
    metal: bool | None = None

    def __post_init__(self) -> None:
        material(self.material)
        self.solid()

    def solid(self) -> Solid:
        """Return the rod as a solid."""
        metal = self.material in METALS if self.metal is None else self.metal
        size = (self.radius, self.height)
        return cylinder(f"{self.material} at {self.at}", self.material, size, centre=(*self.at, 0.0), metal=metal)


RODS = {
    "water": Rod(material="water", radius=24.0),
    "bone": Rod(material="cortical_bone", radius=4.0, at=(-9.0, 6.0)),
    "titanium": Rod(material="Ti", radius=3.0, at=(9.0, 2.0)),
}


def in_air(*solids: Solid) -> Phantom:
    """Return a phantom of solids alone."""
    materials = tuple(dict.fromkeys(["air", *(s.material for s in solids)]))
    return Phantom(labels=AIR, materials=materials, d_voxel=(1.0, 1.0, 1.0), solids=solids)


class Block(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A centred cube of water in voxels; `density` is relative to water's."""

    edge: float
    density: float | None = None

    def __post_init__(self) -> None:
        self.phantom()

    def phantom(self) -> Phantom:
        """Return the block as a phantom, with a density map if `density` is given."""
        labels, d = np.ones((8, 8, 8), np.uint8), self.edge / 8
        density = None if self.density is None else np.full(labels.shape, self.density, np.float32)
        return Phantom(labels=labels, materials=("air", "water"), d_voxel=(d, d, d), density=density)


class Machine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scanner of `ctsim.types`, with a geometry for any grid side."""

    geometry: Circle = Circle()
    tube: Tube = Tube()
    detector: Detector = Detector()
    i0: Annotated[float, msgspec.Meta(ge=1, le=1e12)] = 1e5
    noise: Noise = Noise()
    scatter: Scatter = Scatter()

    def __post_init__(self) -> None:
        self.resolve(FULL)

    def resolve(self, side: int) -> Scanner:
        """Return the scanner for a grid of `side` voxels along an axis."""
        parts = {name: getattr(self, name) for name in self.__struct_fields__ if name != "geometry"}
        return Scanner(geometry=self.geometry.resolve(side), **parts)


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag=str.lower):
    """A change that `scans.changed` makes to a simulated scan."""


class Unchanged(Change, frozen=True):
    """The scan as simulated."""


class Twice(Change, frozen=True):
    """Every view given twice."""


class Filled(Change, frozen=True, kw_only=True):
    """The same reading everywhere, in counts."""

    value: Annotated[int, msgspec.Meta(ge=0, le=65535)]


class Rounded(Change, frozen=True):
    """The counts as float32, each moved by a unit in its last place or less."""


class Turned(Change, frozen=True, kw_only=True):
    """The same counts, with a start angle that is `deg` larger."""

    deg: float


class Magnified(Change, frozen=True, kw_only=True):
    """The same counts, with scanner and object scaled so that a voxel's edge along x is `voxel_mm`."""

    voxel_mm: Positive


AnyChange = Unchanged | Twice | Filled | Rounded | Turned | Magnified


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scan of numerical stress: rods in air, by default the usual ones, or a block.

    `near`: whether the data determine the object. `methods`: whether methods run on it, not the simulator only.
    `like`: another change of the simulated scan, of which methods must give the same volume as of `change`, up to a
    factor in length. `unlike`: methods or groups that need not.
    """

    name: str
    what: str
    near: bool = True
    methods: bool = True
    rods: Annotated[tuple[Literal["water", "bone", "titanium"] | Rod, ...], msgspec.Meta(min_length=1)] | None = None
    block: Block | None = None
    scanner: Machine = Machine()
    change: AnyChange = Unchanged()
    like: AnyChange | None = None
    unlike: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.name in TAKEN:
            raise InputError(f"name must not be {self.name!r}, which is a case of its own")
        if self.block is not None and self.rods is not None:
            raise InputError("rods and block exclude each other: expected one of them")
        known = (*GROUPS, *TABLE)
        if unknown := [name for name in self.unlike if name not in known and ":" not in name]:
            raise InputError(f"unlike must name methods or groups, of {', '.join(known)}; got {unknown[0]!r}")

    @property
    def all_rods(self) -> tuple[Rod, ...]:
        """The rods; later ones replace earlier ones where they overlap."""
        if self.block is not None:
            return ()
        return tuple(RODS[rod] if isinstance(rod, str) else rod for rod in self.rods or RODS.values())

    def phantom(self) -> Phantom:
        """Return the phantom."""
        return in_air(*(rod.solid() for rod in self.all_rods)) if self.block is None else self.block.phantom()

    @property
    def lone(self) -> Rod | None:
        """The only rod, if the grid holds all of it, so that its mass on the grid is known; else None."""
        if len(self.all_rods) != 1:
            return None
        (rod,), of = self.all_rods, self.scanner.geometry
        reach = max(abs(rod.at[0]) + rod.radius, abs(rod.at[1]) + rod.radius, rod.height / 2)
        return rod if 2 * reach <= of.field_mm and not any(of.off_origin) else None

    @property
    def simulated(self) -> bool:
        """Whether the simulator makes the scan without a later change of the counts or of the stated geometry."""
        return isinstance(self.change, Unchanged | Twice)

    def has_other(self, method: str) -> bool:
        """Whether a method must give the same volume of the other form, `like`."""
        return self.like is not None and not any(method in GROUPS.get(name, (name,)) for name in self.unlike)

    @property
    def unlit(self) -> bool:
        """Whether every reading is at the pedestal or below, so that there is nothing to reconstruct."""
        return isinstance(self.change, Filled) and self.change.value <= self.scanner.noise.dark

    @property
    def digest(self) -> str:
        """A hash of the scene's keys."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]


def load(path: Path | None = None) -> tuple[Scene, ...]:
    """Read a file of scenes, by default the bundled one; raises InputError with file, key and expectation."""
    if path is not None:
        return scenes_of(read_toml(path), Scene, str(path))
    with resources.as_file(resources.files("ctsim.benchmarks.suites") / "stress.toml") as bundled:
        return load(bundled)
