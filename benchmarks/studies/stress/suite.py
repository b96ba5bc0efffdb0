"""Scenes that are hard on the numbers, as a TOML file says them: `benchmarks/suites/stress.toml`, or one of the user's.

Simulator and methods take the same scenes. `docs/how-to/test-stability.md` lists the keys. Lengths mm. The limits of
what is found on them stand here too. Simulates nothing.
"""

import hashlib
import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ctsim.benchmarks.methods import TABLE
from ctsim.detector import Detector
from ctsim.errors import InputError
from ctsim.geometry import Count, Geometry, Pair, Triple
from ctsim.materials import material
from ctsim.noise import Noise
from ctsim.phantoms.shapes import cylinder
from ctsim.phantoms.suites import read_toml, scenes_of
from ctsim.scatter import Scatter
from ctsim.solids import Solid
from ctsim.spectrum import Tube
from ctsim.types import Phantom, Scanner

FULL, SHORT = 24, 16  # voxels along a side
P_SURE = 1.2e-4  # |ΔP|: 1e-4 of the energies where P ≤ 14.6, a tenth more between the paths tried, float32's 1e-5
CLAMP = 81.0  # of P: exponents end at 80, and the weight of one node
MASS = 0.01  # of a rod on the grid: 1/250 of every voxel that its surface crosses, of 216 cm³ for its 94 at worst
FLOAT32 = 2e-5  # |ΔP|: exp is good to 4e-7·max(1, P/4) and so are the sums; lengths of 50 mm to 8e-6 mm, by 0.5/mm
NEAR = 0.7  # of an empty volume's error
SAME = 1e-3  # of the greatest value: float32
SAME_BY_DESCENT = 0.03
BOUNDS = {"ibhc": 10.0}  # adds to P what its own volume says of hardening, streaks included
PROJECTED, VOXELISED, RESPONDED = 1e-5, 1e-5, 2e-6  # splats: of the peak, of the greatest voxel, of the response

SPLATS = ("splat", "splat-paper", "splat-r2")
GROUPS: dict[str, tuple[str, ...]] = {
    "by-mask": ("limar", "nmar", "bhc-poly"),
    # their steps are of one length whatever the gradient of TV, in flat regions rounding
    "descent": ("asd-pocs", "awpcsd"),
    "ordered": ("sart", "os-sart", "asd-pocs", "awpcsd", *SPLATS),  # a view that comes twice moves them twice
    "sampled": ("bhc-poly",),  # fits in 64 views, other ones where there are twice as many
    "physical": (*SPLATS, "ibhc"),  # take materials from tables in 1/mm
}
"""Methods that have something in common, by the names that a scene's `unlike` may give."""

METALS = ("Ti", "Fe", "Sn", "W", "Au")
TAKEN = ("threads", "float64")  # names of cases of methods that are no scenes
AIR = np.zeros((2, 2, 2), np.uint8)
Positive = Annotated[float, msgspec.Meta(gt=0)]


def same_of(method: str) -> float:
    """Return how far two forms of one scan may be from each other, of the greatest value."""
    return SAME_BY_DESCENT if method in GROUPS["descent"] else SAME


class OfSide(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A count that grows with the grid: so many times its side, rounded down, and so many more."""

    times: Positive = 1.0
    plus: int = 0


Number = Count | OfSide


class Circle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A circular scan and its grid, for every side of grids; a desktop scanner whose pixels cover the cube.

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
        """Return the geometry on grids of so many voxels a side; raises InputError where there is none."""
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
    """An upright rod through (x, y) = `at`; whether it is `metal` is known of a few elements, and said of others."""

    material: str
    radius: float
    at: Pair = (0.0, 0.0)
    height: float = 52.0
    metal: bool | None = None

    def __post_init__(self) -> None:
        material(self.material)
        self.solid()

    def solid(self) -> Solid:
        """Return the rod as it is simulated."""
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
    """A centred cube of water in voxels, of so many times its density where that is given."""

    edge: float
    density: float | None = None

    def __post_init__(self) -> None:
        self.phantom()

    def phantom(self) -> Phantom:
        """Return the block as it is simulated, with a map of its density or without one."""
        labels, d = np.ones((8, 8, 8), np.uint8), self.edge / 8
        density = None if self.density is None else np.full(labels.shape, self.density, np.float32)
        return Phantom(labels=labels, materials=("air", "water"), d_voxel=(d, d, d), density=density)


class Machine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scanner: that of `ctsim.types`, with a geometry for every side of grids."""

    geometry: Circle = Circle()
    tube: Tube = Tube()
    detector: Detector = Detector()
    i0: Annotated[float, msgspec.Meta(ge=1, le=1e12)] = 1e5
    noise: Noise = Noise()
    scatter: Scatter = Scatter()

    def __post_init__(self) -> None:
        self.resolve(FULL)

    def resolve(self, side: int) -> Scanner:
        """Return the scanner for grids of so many voxels a side."""
        parts = {name: getattr(self, name) for name in self.__struct_fields__ if name != "geometry"}
        return Scanner(geometry=self.geometry.resolve(side), **parts)


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag=str.lower):
    """What `scans.changed` does to a simulated scan, by its name."""


class Unchanged(Change, frozen=True):
    """The scan as it was simulated."""


class Twice(Change, frozen=True):
    """Every view given twice."""


class Filled(Change, frozen=True, kw_only=True):
    """One reading everywhere, in counts."""

    value: Annotated[int, msgspec.Meta(ge=0, le=65535)]


class Rounded(Change, frozen=True):
    """The counts as float32, each moved by a unit in its last place or less."""


class Turned(Change, frozen=True, kw_only=True):
    """The same counts, said to begin so many degrees further on."""

    deg: float


class Magnified(Change, frozen=True, kw_only=True):
    """The counts as those of a machine and an object of such a size that voxels have this edge along x, in mm."""

    voxel_mm: Positive


AnyChange = Unchanged | Twice | Filled | Rounded | Turned | Magnified


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scan that is hard on the numbers: rods in air, by default the usual ones, or a block.

    `near` says whether the data determine the object, `methods` whether methods run on it or the simulator alone.
    `like` is how the simulated scan must be changed to give the same volume as the scene's own `change` of it, but for
    a factor in length; methods that need not are `unlike`.
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
        """The rods, later ones in place of earlier ones."""
        if self.block is not None:
            return ()
        return tuple(RODS[rod] if isinstance(rod, str) else rod for rod in self.rods or RODS.values())

    def phantom(self) -> Phantom:
        """Return what is scanned."""
        return in_air(*(rod.solid() for rod in self.all_rods)) if self.block is None else self.block.phantom()

    @property
    def lone(self) -> Rod | None:
        """The rod where there is one only and the grid holds all of it, so that its mass on the grid is known."""
        if len(self.all_rods) != 1:
            return None
        (rod,), of = self.all_rods, self.scanner.geometry
        reach = max(abs(rod.at[0]) + rod.radius, abs(rod.at[1]) + rod.radius, rod.height / 2)
        return rod if 2 * reach <= of.field_mm and not any(of.off_origin) else None

    @property
    def simulated(self) -> bool:
        """Whether the simulator can make the scan itself, not only one that is then changed."""
        return isinstance(self.change, Unchanged | Twice)

    def has_other(self, method: str) -> bool:
        """Say whether a method must give the same volume of the other form."""
        return self.like is not None and not any(method in GROUPS.get(name, (name,)) for name in self.unlike)

    @property
    def unlit(self) -> bool:
        """Whether every reading is at the pedestal or below, so that there is nothing to reconstruct."""
        return isinstance(self.change, Filled) and self.change.value <= self.scanner.noise.dark

    @property
    def digest(self) -> str:
        """A hash of what the scene says."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]


def load(path: Path | None = None) -> tuple[Scene, ...]:
    """Read a file of scenes, by default the bundled one; raises InputError with file, key and what was expected."""
    if path is not None:
        return scenes_of(read_toml(path), Scene, str(path))
    with resources.as_file(resources.files("ctsim.benchmarks.suites") / "stress.toml") as bundled:
        return load(bundled)
