"""Scenes that are hard on methods, as a TOML file says them: `benchmarks/suites/stress.toml`, or one of the user's own.

`docs/how-to/test-stability.md` lists the keys. Lengths mm.
"""

import functools
import hashlib
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ctsim.benchmarks.methods import TABLE
from ctsim.benchmarks.studies.stress.cases import FULL
from ctsim.benchmarks.studies.stress.changes import AnyChange, Filled, Unchanged
from ctsim.benchmarks.studies.stress.scans import (
    BONE,
    HEIGHT,
    TITANIUM,
    USUAL,
    WATER,
    Circle,
    Example,
    block_phantom,
    example,
    in_air,
    rod,
)
from ctsim.detector import Detector
from ctsim.errors import InputError
from ctsim.geometry import Pair
from ctsim.materials import material
from ctsim.noise import Noise
from ctsim.phantoms.suites import read_toml, scenes_of
from ctsim.scatter import Scatter
from ctsim.solids import Solid
from ctsim.spectrum import Tube
from ctsim.types import Phantom, Scanner

RODS = {"water": WATER, "bone": BONE, "titanium": TITANIUM}
TAKEN = ("threads", "float64")  # names of cases of methods that are no scenes
GROUPS: dict[str, tuple[str, ...]] = {
    "by-mask": ("limar", "nmar", "bhc-poly"),
    # their steps are of one length whatever the gradient of TV, in flat regions rounding
    "descent": ("asd-pocs", "awpcsd"),
    "ordered": ("sart", "os-sart", "asd-pocs", "awpcsd", "splat"),  # a view that comes twice moves them twice
    "sampled": ("bhc-poly",),  # fits in 64 views, other ones where there are twice as many
    "physical": ("splat", "ibhc"),  # take materials from tables in 1/mm
}
"""Methods that have something in common, by the names that `unlike` may give."""


class Rod(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An upright rod through (x, y) = `at`; whether it is `metal` is known of a few elements, and said of others."""

    material: str
    radius: float
    at: Pair = (0.0, 0.0)
    height: float = HEIGHT
    metal: bool | None = None

    def __post_init__(self) -> None:
        material(self.material)
        self.solid()

    def solid(self) -> Solid:
        """Return the rod as it is simulated."""
        return rod(self.material, self.radius, at=self.at, height=self.height, metal=self.metal)


class Block(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A centred cube of water in voxels, of so many times its density."""

    edge: float
    density: float

    def __post_init__(self) -> None:
        self.phantom()

    def phantom(self) -> Phantom:
        """Return the block as it is simulated."""
        return block_phantom(self.density, self.edge)


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


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scan that is hard on methods: rods in air, by default the usual ones, or a block.

    `near` says whether the data determine the object. `like` is how the simulated scan must be changed to give the same
    volume as the scene's own `change` of it, but for a factor in length; methods that need not are `unlike`.
    """

    name: str
    what: str
    near: bool = True
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

    def scan(self, side: int) -> Example:
        """Return the scan on grids of so many voxels a side."""
        return self.change.of(_simulated(self.rods, self.block, self.scanner, side))

    def other(self, side: int) -> Example | None:
        """Return the other form of the scan, if there is one."""
        return None if self.like is None else self.like.of(_simulated(self.rods, self.block, self.scanner, side))

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


@functools.lru_cache(maxsize=4)
def _simulated(rods: tuple[str | Rod, ...] | None, block: Block | None, scanner: Machine, side: int) -> Example:
    """Simulate a scan that all methods share."""
    if block is not None:
        return example(scanner.resolve(side), block.phantom())
    solids = USUAL if rods is None else [RODS[rod] if isinstance(rod, str) else rod.solid() for rod in rods]
    return example(scanner.resolve(side), in_air(solids))


def load(path: Path | None = None) -> tuple[Scene, ...]:
    """Read a file of scenes, by default the bundled one; raises InputError with file, key and what was expected."""
    if path is not None:
        return scenes_of(read_toml(path), Scene, str(path))
    with resources.as_file(resources.files("ctsim.benchmarks.suites") / "stress.toml") as bundled:
        return load(bundled)
