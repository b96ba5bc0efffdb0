"""The scenes of the stress suite: solids in air, the scanner, and what is known of the scan in closed form.

Lengths mm; a scene fits a cube of 60 mm unless its case says otherwise.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.morphology import dilate
from ctsim.benchmarks.oracles import upright_chord
from ctsim.benchmarks.studies.stress.cases import FULL, SHORT
from ctsim.errors import InputError
from ctsim.geometry import Count, Geometry, Pair, Triple
from ctsim.materials import attenuation
from ctsim.phantoms.shapes import cylinder
from ctsim.plan import make_plan
from ctsim.quadrature import full_rule
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views, truth_volumes
from ctsim.solids import Solid
from ctsim.spectrum import spectrum
from ctsim.types import Phantom, Scan, Scanner

SIZE = 60.0
BODY, HEIGHT = 24.0, 52.0  # radius and height of the water
METALS = ("Ti", "Fe", "Sn", "W", "Au")
Positive = Annotated[float, msgspec.Meta(gt=0)]
Chords = Mapping[str, NDArray[np.float64]]
"""Length (mm) of every central ray in each material, [view, v, u]."""


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
    field_mm: Positive = SIZE
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
        return Geometry(
            dso=self.dso,
            dsd=self.dsd,
            n_voxel=(z, y, x),
            d_voxel=(self.field_mm / z, self.field_mm / y, self.field_mm / x),
            n_detector=(v, u),
            d_detector=(high / v, wide / u),
            n_views=n_views,
            off_origin=self.off_origin,
            off_detector=self.off_detector,
            start_deg=self.start_deg,
            arc_deg=self.arc_deg,
            angles_deg=None if self.crowding == 1 else uneven(n_views, self.crowding, self.arc_deg, self.start_deg),
        )


def _count(n: Number, side: int) -> int:
    return n if isinstance(n, int) else math.floor(n.times * side) + n.plus


def uneven(n: int, crowding: float = 1.5, arc: float = 360.0, start: float = 0.0) -> tuple[float, ...]:
    """Return n angles (degrees) that crowd where an arc begins."""
    return tuple((start + arc * (np.arange(n) / n) ** crowding).tolist())


def geometry(side: int, **changes: Any) -> Geometry:
    """Return a desktop scanner's circle on side³ voxels, with changes of what `Geometry` says."""
    return msgspec.structs.replace(Circle().resolve(side), **changes)


def scaled_by(of: Geometry, factor: float) -> Geometry:
    """Return the geometry of a machine and a grid of so many times the size."""
    (z, y, x), (v, u) = of.d_voxel, of.d_detector
    return msgspec.structs.replace(
        of,
        dso=of.dso * factor,
        dsd=of.dsd * factor,
        d_voxel=(z * factor, y * factor, x * factor),
        d_detector=(v * factor, u * factor),
    )


def rod(
    material: str, radius: float, *, at: Pair = (0.0, 0.0), height: float = HEIGHT, metal: bool | None = None
) -> Solid:
    """Return an upright rod through (x, y) = `at`, a metal insert if it is of `METALS` or `metal` says so."""
    metal = material in METALS if metal is None else metal
    return cylinder(f"{material} at {at}", material, (radius, height), centre=(*at, 0.0), metal=metal)


WATER = rod("water", BODY)
BONE = rod("cortical_bone", 4.0, at=(-9.0, 6.0))
TITANIUM = rod("Ti", 3.0, at=(9.0, 2.0))
USUAL = (WATER, BONE, TITANIUM)


def in_air(solids: Sequence[Solid]) -> Phantom:
    """Return a phantom of solids alone."""
    materials = tuple(dict.fromkeys(["air", *(s.material for s in solids)]))
    return Phantom(
        labels=np.zeros((2, 2, 2), np.uint8), materials=materials, d_voxel=(1.0, 1.0, 1.0), solids=tuple(solids)
    )


def block_phantom(density: float | None, edge: float) -> Phantom:
    """Return a centred cube of water voxels with a map of relative density, or without one."""
    n = 8
    return Phantom(
        labels=np.ones((n, n, n), np.uint8),
        materials=("air", "water"),
        d_voxel=(edge / n, edge / n, edge / n),
        density=None if density is None else np.full((n, n, n), density, np.float32),
    )


def chords(of: Geometry, outer: Solid, *inner: Solid) -> dict[str, NDArray[np.float64]]:
    """Return the chords of upright rods that lie apart from each other within the `outer` one, in closed form."""
    lengths = {s.material: np.zeros(of.shape) for s in (outer, *inner)}
    for view in range(of.n_views):
        lengths[outer.material][view] += upright_chord(of, view, outer)
        for solid in inner:
            length = upright_chord(of, view, solid)
            lengths[outer.material][view] -= length
            lengths[solid.material][view] += length
    return lengths


def block_chord(of: Geometry, half: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the chord of every central ray through a centred block of half edges (x, y, z): [view, v, u]."""
    poses, (n_v, n_u) = of.pose_array(), of.n_detector
    u, v = np.arange(n_u) - (n_u - 1) / 2, np.arange(n_v) - (n_v - 1) / 2
    source = poses[:, None, None, :3]
    ray = poses[:, None, None, 3:6] + u[:, None] * poses[:, None, None, 6:9] - source
    ray = ray + v[:, None, None] * poses[:, None, None, 9:]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    ray = np.where(np.abs(ray) < 1e-12, 1e-12, ray)  # along a plane: enters and leaves far away
    ends = np.sort(np.stack([(sign * np.array(half) - source) / ray for sign in (-1, 1)]), axis=0)
    return np.maximum(ends[1].min(-1) - ends[0].max(-1), 0.0)


def exact_p(scanner: Scanner, lengths: Chords) -> NDArray[np.float64]:
    """Return P = −ln(signal/open) of the whole fine spectrum, float64 [view, v, u]."""
    fine = full_rule(spectrum(scanner.tube), scanner.detector)
    depth = sum(length[..., None] * attenuation(m, fine.energies) for m, length in lengths.items() if m != "air")
    least = np.asarray(depth).min(-1)
    return least - np.log(np.exp(least[..., None] - depth) @ fine.w1)


def simulated(
    phantom: Phantom, scanner: Scanner, truth: Truth, *, subrays: int = 1
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return the stacks [view, v, u] by output name, and the volumes [z, y, x] by name."""
    plan = make_plan(phantom, scanner, Simulation(subrays=subrays), truth, "stress")
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    stacks = {name: np.stack([v[name] for v in views]) for name in views[0]}
    stacks["flat"] = flat_image(plan, scanner)
    return stacks, dict(truth_volumes(plan, phantom, scanner))


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """A scan as a method gets it, with the true metal mask, and what it is judged by.

    `reference` [z, y, x] is the effective attenuation in 1/mm; errors are taken over `region`, voxels a voxel or more
    inside the body and more than two from metal, in the field of view.
    """

    scan: Scan
    reference: NDArray[np.float32]
    region: NDArray[np.bool_]

    def error(self, values: NDArray[np.float32]) -> float:
        """Return the RMSE over that of an empty volume; 0 where there is no region."""
        if not self.region.any():
            return 0.0
        there = self.reference[self.region].astype(np.float64)
        return float(np.sqrt(np.mean((values[self.region] - there) ** 2) / np.mean(there**2)))


def scan_from(stacks: Mapping[str, NDArray[Any]], volumes: Mapping[str, NDArray[Any]], scanner: Scanner) -> Scan:
    """Return what `simulated` gave as a method gets it."""
    return Scan(
        geometry=scanner.geometry,
        counts=torch.from_numpy(stacks["counts"]),
        flat=torch.from_numpy(stacks["flat"]),
        dark=scanner.noise.dark,
        i0=scanner.i0,
        e_max=spectrum(scanner.tube).e_max,
        metal=torch.from_numpy(volumes["metal"] != 0),
    )


def example(scanner: Scanner, phantom: Phantom) -> Example:
    """Simulate a scan, sub-rays and noise included."""
    stacks, volumes = simulated(phantom, scanner, Truth(twin=False), subrays=34)
    reference, metal = volumes["reference_effective"], volumes["metal"] != 0
    _, y, x = scanner.geometry.voxel_centres()
    seen = np.hypot(y[:, None], x) <= ray_weights(scanner.geometry).radius
    inside = ~dilate(reference < 0.5 * np.median(reference[reference > 0]), 1, corners=True)
    region = inside & ~dilate(metal, 2, corners=True) & seen
    return Example(scan=scan_from(stacks, volumes, scanner), reference=reference, region=region)


def on_threads(threads: int, call: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Call with so many threads of numba's."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        return call()
    finally:
        numba.set_num_threads(before)


def thread_counts() -> list[int]:
    """Return 1, 2 and as many threads as there are, each once."""
    most = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
    return sorted({1, min(2, most), most})
