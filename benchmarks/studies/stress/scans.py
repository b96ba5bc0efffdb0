"""What the rows of the stress suite share: findings, simulated scans, and closed forms of them.

A row fails where a number exceeds its limit, and where anything raises or warns.
"""

import dataclasses
import functools
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec
import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.morphology import dilate
from ctsim.beam.quadrature import full_rule
from ctsim.beam.spectrum import spectrum
from ctsim.benchmarks.oracles import central_rays, relative, slab_span, upright_span
from ctsim.benchmarks.studies.stress import suite
from ctsim.benchmarks.studies.stress.suite import AnyChange, Machine, Scene, Twice
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views, truth_volumes
from ctsim.types import Phantom, Scan, Scanner

FEW = 6  # views of simulator rows, unless the scene states a number
USUAL = Scene(name="usual", what="usual")
Stacks = Mapping[str, NDArray[Any]]


@dataclass(slots=True)
class Findings:
    """What a row found, in words: as expected in `said`, not as expected in `wrong`."""

    said: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "; ".join([*(f"NOT EXPECTED: {words}" for words in self.wrong), *self.said])

    def say(self, words: str, *, holds: bool = True) -> None:
        """Note a finding, and whether it was expected."""
        (self.said if holds else self.wrong).append(words)

    def at_most(self, what: str, value: float, limit: float) -> None:
        """Note a number that must not exceed its limit; NaN exceeds it."""
        holds = bool(value <= limit)
        self.say(f"{what} {value:.2g}" + ("" if holds else f", limit {limit:.2g}"), holds=holds)

    def finite(self, what: str, values: NDArray[Any]) -> None:
        """Note values that are not finite."""
        if not (fine := np.isfinite(values)).all():
            self.say(f"{int((~fine).sum())} of {fine.size} values of {what} are not finite", holds=False)

    def same(self, what: str, one: NDArray[Any], other: NDArray[Any]) -> None:
        """Note whether two arrays are bitwise equal."""
        equal = one.shape == other.shape and np.array_equal(one, other)
        self.say(f"{what} {'equal to the last bit' if equal else 'differ'}", holds=equal)

    def same_on_threads(self, what: str, call: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """Note whether `call` gives the same bits on 1, 2 and all numba threads; return the array of 1."""
        most = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
        before, found = numba.get_num_threads(), {}
        try:
            for n in sorted({1, min(2, most), most}):
                numba.set_num_threads(n)
                found[n] = call()
                if n > 1:
                    self.same(f"{what} of 1 and {n} threads are", found[1], found[n])
        finally:
            numba.set_num_threads(before)
        return found[1]

    def refused(self, words: str, call: Callable[[], object]) -> None:
        """Note whether `call` raises an InputError that contains `words`."""
        try:
            call()
        except InputError as error:
            self.say(f"refused: {error}", holds=words in str(error))
        else:
            self.say(f"not refused, expected an InputError with {words!r}", holds=False)


def carry_out(run: Callable[[Findings], None]) -> tuple[Findings, float]:
    """Return the findings and seconds of `run`; an exception or a warning, numpy's included, is a wrong finding."""
    found, began = Findings(), time.perf_counter()
    with warnings.catch_warnings(record=True) as caught, np.errstate(divide="warn", over="warn", invalid="warn"):
        warnings.simplefilter("always")
        try:
            run(found)
        except Exception as error:  # an exception of any kind is a finding
            found.say(" ".join(f"{type(error).__name__}: {error}".split()), holds=False)
    for text in dict.fromkeys(f"{w.category.__name__}: {w.message}" for w in caught):
        found.say(text, holds=False)
    return found, time.perf_counter() - began


# --- scans ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """A scan as a method gets it, with the true metal mask, and the truth it is judged by.

    `reference` [z, y, x] is the effective attenuation in 1/mm; errors are taken over `region`: the field of
    view inside the body, without its outermost voxel and two voxels around metal.
    """

    scan: Scan
    reference: NDArray[np.float32]
    region: NDArray[np.bool_]

    def error(self, values: NDArray[np.float32]) -> float:
        """Return the RMSE relative to an empty volume's; 0 for an empty region."""
        if not self.region.any():
            return 0.0
        return relative(values[self.region], self.reference[self.region].astype(np.float64))


def changed(given: Example, change: AnyChange) -> Example:
    """Return an example with other counts, or with the same counts under another geometry."""
    g, counts, factor = given.scan.geometry, given.scan.counts, 1.0
    match change:
        case suite.Twice():
            g, counts = doubled(g), counts.repeat_interleave(2, 0)
        case suite.Filled():
            counts = torch.full_like(counts, change.value)
        case suite.Rounded():
            ulps = np.random.Generator(np.random.Philox(key=5)).uniform(-1, 1, counts.shape)
            counts = counts.float() * torch.from_numpy((1 + ulps * 2.0**-24).astype(np.float32))
        case suite.Turned():
            angles = None if g.angles_deg is None else tuple(a + change.deg for a in g.angles_deg)
            g = msgspec.structs.replace(g, start_deg=g.start_deg + change.deg, angles_deg=angles)
        case suite.Magnified():
            factor = change.voxel_mm / g.d_voxel[2]
            sizes = {name: tuple(d * factor for d in getattr(g, name)) for name in ("d_voxel", "d_detector")}
            g = msgspec.structs.replace(g, dso=g.dso * factor, dsd=g.dsd * factor, **sizes)
    scan = dataclasses.replace(given.scan, geometry=g, counts=counts)
    return dataclasses.replace(given, scan=scan, reference=given.reference / np.float32(factor))


def doubled(geometry: Geometry) -> Geometry:
    """Return a geometry with each view followed by itself."""
    angles = np.degrees(geometry.angles).repeat(2)
    return msgspec.structs.replace(geometry, angles_deg=tuple(angles.tolist()), n_views=angles.size)


def simulated(
    phantom: Phantom, scanner: Scanner, truth: Truth, *, subrays: int = 1
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return the stacks [view, v, u] by output name, and the volumes [z, y, x] by name."""
    plan = make_plan(phantom, scanner, Simulation(subrays=subrays), truth, "stress")
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    stacks = {name: np.stack([v[name] for v in views]) for name in views[0]}
    stacks["flat"] = flat_image(plan, scanner)
    return stacks, dict(truth_volumes(plan, phantom, scanner))


def scan_from(stacks: Stacks, volumes: Stacks, scanner: Scanner) -> Scan:
    """Return the output of `simulated` as a method gets it."""
    return Scan(
        geometry=scanner.geometry,
        counts=torch.from_numpy(stacks["counts"]),
        flat=torch.from_numpy(stacks["flat"]),
        dark=scanner.noise.dark,
        i0=scanner.i0,
        e_max=spectrum(scanner.tube).e_max,
        metal=torch.from_numpy(volumes["metal"] != 0),
    )


def example(scene: Scene, side: int, change: AnyChange | None = None) -> Example:
    """Return a scene's scan for methods on side³ voxels, with sub-rays and noise, and the scene's change made.

    `change` replaces the scene's change.
    """
    bare = Scene(name="", what="", rods=scene.rods, block=scene.block, scanner=scene.scanner)
    return changed(_example(bare, side), change or scene.change)


@functools.lru_cache(maxsize=4)
def _example(scene: Scene, side: int) -> Example:
    """Simulate a scan, which all methods share."""
    scanner = scene.scanner.resolve(side)
    stacks, volumes = simulated(scene.phantom(), scanner, Truth(twin=False), subrays=34)
    reference, metal = volumes["reference_effective"], volumes["metal"] != 0
    _, y, x = scanner.geometry.voxel_centres()
    seen = np.hypot(y[:, None], x) <= ray_weights(scanner.geometry).radius
    inside = ~dilate(reference < 0.5 * np.median(reference[reference > 0]), 1, corners=True)
    region = inside & ~dilate(metal, 2, corners=True) & seen
    return Example(scan=scan_from(stacks, volumes, scanner), reference=reference, region=region)


def few_views(scene: Scene, side: int) -> Scanner:
    """Return a scene's scanner for simulator rows: `FEW` views, unless the scene states a number."""
    of = scene.scanner.geometry
    if not isinstance(of.n_views, int):
        of = msgspec.structs.replace(of, n_views=FEW)
    scanner = msgspec.structs.replace(scene.scanner, geometry=of).resolve(side)
    if isinstance(scene.change, Twice):
        scanner = msgspec.structs.replace(scanner, geometry=doubled(scanner.geometry))
    return scanner


def usual(side: int, **geometry: Any) -> tuple[Phantom, Scanner]:
    """Return water with a rod of bone and one of titanium, and a scanner whose circle has `geometry` changed."""
    return USUAL.phantom(), Machine(geometry=suite.Circle(**geometry)).resolve(side)


# --- closed forms, float64 ----------------------------------------------------------------------------


def lengths(scene: Scene, of: Geometry) -> dict[str, NDArray[np.float64]]:
    """Return the length (mm) of every central ray in each material, times its relative density: [view, v, u]."""
    rays = central_rays(of)
    if scene.block is not None:
        enter, leave = slab_span(rays, (scene.block.edge / 2,) * 3)
        density = 1.0 if scene.block.density is None else scene.block.density
        return {"water": density * np.maximum(leave - enter, 0.0)}
    found = {rod.material: np.zeros(of.shape) for rod in scene.all_rods}
    spans = [upright_span(rays, rod.solid()) for rod in scene.all_rods]
    ends = np.sort(np.concatenate(spans), axis=0)
    for low, high in pairwise(ends):  # between two ends one rod owns the ray
        middle, owner = (low + high) / 2, np.full(of.shape, -1)
        for k, (enter, leave) in enumerate(spans):
            owner[(enter < middle) & (middle < leave)] = k  # a later rod replaces an earlier one
        for k, rod in enumerate(scene.all_rods):
            found[rod.material] += np.where(owner == k, high - low, 0.0)
    return found


def exact_p(scanner: Scanner, lengths: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return P = −ln(signal/open) of the whole fine spectrum: [view, v, u]."""
    fine = full_rule(spectrum(scanner.tube), scanner.detector)
    depth = sum(length[..., None] * attenuation(m, fine.energies) for m, length in lengths.items() if m != "air")
    least = np.asarray(depth).min(-1)
    return least - np.log(np.exp(least[..., None] - depth) @ fine.w1)
