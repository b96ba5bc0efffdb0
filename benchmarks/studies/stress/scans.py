"""Scans of the stress suite's scenes: simulated, and what is known of them in closed form."""

import functools
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import msgspec
import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.morphology import dilate
from ctsim.benchmarks.studies.stress.changes import Example, Twice
from ctsim.benchmarks.studies.stress.suite import Circle, Machine, Rod, Scene
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.quadrature import full_rule
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views, truth_volumes
from ctsim.spectrum import spectrum
from ctsim.types import Phantom, Scan, Scanner

FEW = 6  # views of the simulator's rows where the scene has as many as its grid asks for
Lengths = Mapping[str, NDArray[np.float64]]
"""Length (mm) of every central ray in each material, times its relative density: [view, v, u]."""


def simulated(
    phantom: Phantom, scanner: Scanner, truth: Truth, *, subrays: int = 1
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return the stacks [view, v, u] by output name, and the volumes [z, y, x] by name."""
    plan = make_plan(phantom, scanner, Simulation(subrays=subrays), truth, "stress")
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    stacks = {name: np.stack([v[name] for v in views]) for name in views[0]}
    stacks["flat"] = flat_image(plan, scanner)
    return stacks, dict(truth_volumes(plan, phantom, scanner))


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


def example(scene: Scene, side: int) -> Example:
    """Return a scene's scan for methods on grids of so many voxels a side, sub-rays and noise included."""
    return scene.change.of(_example(_unchanged(scene), side))


def other_example(scene: Scene, side: int) -> Example | None:
    """Return the other form of the scan, if there is one."""
    return None if scene.like is None else scene.like.of(_example(_unchanged(scene), side))


def _unchanged(scene: Scene) -> Scene:
    return Scene(name="", what="", rods=scene.rods, block=scene.block, scanner=scene.scanner)


@functools.lru_cache(maxsize=4)
def _example(scene: Scene, side: int) -> Example:
    """Simulate a scan that all methods share."""
    scanner = scene.scanner.resolve(side)
    stacks, volumes = simulated(scene.phantom(), scanner, Truth(twin=False), subrays=34)
    reference, metal = volumes["reference_effective"], volumes["metal"] != 0
    _, y, x = scanner.geometry.voxel_centres()
    seen = np.hypot(y[:, None], x) <= ray_weights(scanner.geometry).radius
    inside = ~dilate(reference < 0.5 * np.median(reference[reference > 0]), 1, corners=True)
    region = inside & ~dilate(metal, 2, corners=True) & seen
    return Example(scan=scan_from(stacks, volumes, scanner), reference=reference, region=region)


def few_views(scene: Scene, side: int) -> Scanner:
    """Return the scanner of a scene for the simulator's rows; a number of views that the scene states stays."""
    of = scene.scanner.geometry
    if not isinstance(of.n_views, int):
        of = msgspec.structs.replace(of, n_views=FEW)
    scanner = msgspec.structs.replace(scene.scanner, geometry=of).resolve(side)
    if isinstance(scene.change, Twice):
        where = msgspec.structs.replace(scanner.geometry, **scene.change.where(scanner.geometry))
        scanner = msgspec.structs.replace(scanner, geometry=where)
    return scanner


def usual(side: int, **geometry: Any) -> tuple[Phantom, Scanner]:
    """Return water with a rod of bone and one of titanium, on a circle that differs from the usual one as given."""
    return Scene(name="usual", what="usual").phantom(), Machine(geometry=Circle(**geometry)).resolve(side)


# --- closed forms, float64 ----------------------------------------------------------------------------


def lengths(scene: Scene, of: Geometry) -> dict[str, NDArray[np.float64]]:
    """Return the length of every central ray in each material of a scene."""
    if scene.block is not None:
        half, density = scene.block.edge / 2, scene.block.density
        enter, leave = _slabs(_rays(of), (half, half, half))
        return {"water": (1.0 if density is None else density) * np.maximum(leave - enter, 0.0)}
    found = {rod.material: np.zeros(of.shape) for rod in scene.all_rods}
    spans = [_span(_rays(of), rod) for rod in scene.all_rods]
    ends = np.sort(np.concatenate(spans), axis=0)
    for low, high in pairwise(ends):  # nothing changes along a ray between two ends
        middle, owner = (low + high) / 2, np.full(of.shape, -1)
        for k, (enter, leave) in enumerate(spans):
            owner[(enter < middle) & (middle < leave)] = k  # a later rod takes the place of an earlier one
        for k, rod in enumerate(scene.all_rods):
            found[rod.material] += np.where(owner == k, high - low, 0.0)
    return found


def _rays(of: Geometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sources [view, 1, 1, xyz] and the unit vectors of all central rays [view, v, u, xyz]."""
    poses, (n_v, n_u) = of.pose_array()[:, None, None], of.n_detector
    u, v = np.arange(n_u) - (n_u - 1) / 2, np.arange(n_v) - (n_v - 1) / 2
    source, centre, e_u, e_v = np.split(poses, 4, axis=-1)
    ray = centre + u[:, None] * e_u + v[:, None, None] * e_v - source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    return source, np.where(np.abs(ray) < 1e-12, 1e-12, ray)  # along a plane: enters and leaves far away


def _slabs(rays: tuple[NDArray, NDArray], half: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Return where rays enter and leave what lies between planes at ±half of the first or of all axes from the end."""
    source, ray = (part[..., -len(half) :] for part in rays)
    ends = np.sort(np.stack([(sign * np.array(half) - source) / ray for sign in (-1, 1)]), axis=0)
    return ends[0].max(-1), ends[1].min(-1)


def _span(rays: tuple[NDArray, NDArray], rod: Rod) -> NDArray[np.float64]:
    """Return where rays enter and leave an upright rod, the same for rays that miss it: [2, view, v, u]."""
    source, ray = rays
    low, high = _slabs(rays, (rod.height / 2,))
    start, across = source[..., :2] - np.array(rod.at), ray[..., :2]
    a, b, c = (across**2).sum(-1), (across * start).sum(-1), (start**2).sum(-1) - rod.radius**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
    enter = np.maximum((-b - root) / a, low)
    leave = np.minimum((-b + root) / a, high)
    return np.stack([enter, np.where(root > 0, np.maximum(leave, enter), enter)])


def exact_p(scanner: Scanner, lengths: Lengths) -> NDArray[np.float64]:
    """Return P = −ln(signal/open) of the whole fine spectrum: [view, v, u]."""
    fine = full_rule(spectrum(scanner.tube), scanner.detector)
    depth = sum(length[..., None] * attenuation(m, fine.energies) for m, length in lengths.items() if m != "air")
    least = np.asarray(depth).min(-1)
    return least - np.log(np.exp(least[..., None] - depth) @ fine.w1)


# --- threads ------------------------------------------------------------------------------------------


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
