"""The scenes of the stress suite: solids in air, the scanner, and what is known of the scan in closed form.

Lengths mm; a scene fits a cube of 60 mm unless its case says otherwise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numba
import numpy as np
import torch
from numpy.typing import NDArray

from baselines.morphology import dilate
from benchmarks.peer_cases import upright_chord
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.quadrature import full_rule
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views, truth_volumes
from ctsim.solids import Solid
from ctsim.spectrum import spectrum
from ctsim.types import Phantom, Scan, Scanner
from phantoms.shapes import cylinder
from reconstruct.redundancy import ray_weights

SIZE = 60.0
BODY, HEIGHT = 24.0, 52.0  # radius and height of the water
METALS = ("Ti", "Fe", "Sn", "W", "Au")
Chords = Mapping[str, NDArray[np.float64]]
"""Length (mm) of every central ray in each material, [view, v, u]."""


def geometry(side: int, **changes: Any) -> Geometry:
    """Return a desktop scanner's circle on side³ voxels; its pixels cover the cube."""
    edge = 150.0 / (1.5 * side)
    base = Geometry(
        dso=250.0,
        dsd=500.0,
        n_voxel=(side, side, side),
        d_voxel=(SIZE / side, SIZE / side, SIZE / side),
        n_detector=(side + side // 2, side + side // 2),
        d_detector=(edge, edge),
        n_views=2 * side,
    )
    return msgspec.structs.replace(base, **changes)


def scaled_by(of: Geometry, factor: float) -> Geometry:
    """Return the geometry of a machine and a grid of so many times the size."""
    names = ("dso", "dsd", "d_voxel", "d_detector")
    return msgspec.structs.replace(of, **{n: np.multiply(getattr(of, n), factor).tolist() for n in names})


def rod(material: str, radius: float, *, at: tuple[float, float] = (0.0, 0.0), height: float = HEIGHT) -> Solid:
    """Return an upright rod through (x, y) = `at`."""
    return cylinder(f"{material} at {at}", material, (radius, height), centre=(*at, 0.0), metal=material in METALS)


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


def uneven(n: int) -> tuple[float, ...]:
    """Return n angles (degrees) that crowd on one side of the turn."""
    return tuple((360.0 * (np.arange(n) / n) ** 1.5).tolist())


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
