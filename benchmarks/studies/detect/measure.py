"""Reconstruct pairs of scans and read the observer's channels."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.beam.quadrature import effective_weights
from ctsim.benchmarks.engine.record import OK, Task
from ctsim.benchmarks.methods import Method, chosen
from ctsim.benchmarks.scores.channels import Channels, channels
from ctsim.benchmarks.studies.detect import DEFAULT, Flags
from ctsim.benchmarks.studies.detect.records import Pair, Rows, Seen, Site
from ctsim.benchmarks.studies.detect.suite import DetectScene, load
from ctsim.benchmarks.studies.methods.attempt import attempt, warm_up
from ctsim.materials import attenuation
from ctsim.phantoms.scene import stream_id
from ctsim.plan import make_plan
from ctsim.realisations import Expectation, expected
from ctsim.simulate import truth_volumes
from ctsim.types import Phantom, Scan, Scanner

DIGITS = 9  # of a response in a record: responses to float32 volumes have seven


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """What the scans of a scene share: their expected signal, the true metal, and where the observer looks.

    `lesions` are, for each location, the image t of its lesion in the voxels of `balls`, in 1/mm.
    """

    stream_id: str
    present: Expectation
    absent: Expectation
    metal: torch.Tensor
    sites: tuple[Site, ...]
    balls: tuple[Channels, ...]
    slices: tuple[Channels, ...]
    lesions: tuple[NDArray[np.float64], ...]

    def scan(self, method: Method, pair: int, *, lesion: bool) -> Scan:
        """Draw one scan of a pair; its noise is independent of all others and the same for all methods."""
        signal, stream = self.present if lesion else self.absent, self.stream(pair, lesion=lesion)
        scanner = signal.scanner
        return Scan(
            geometry=scanner.geometry,
            counts=torch.from_numpy(signal.counts(stream, twin=method.told_twin)),
            flat=torch.from_numpy(signal.flat(stream)),
            dark=scanner.noise.dark,
            i0=scanner.i0,
            e_max=float(signal.plan.spectrum.e_max),
            metal=self.metal.clone() if method.mask == "oracle" else None,
        )

    def stream(self, pair: int, *, lesion: bool) -> str:
        """Name the streams of a scan's noise."""
        return f"{self.stream_id}/{'lesions' if lesion else 'no lesions'}/{pair}"

    def seen(self, values: NDArray[np.float32]) -> Seen:
        """Return the responses to a volume [z, y, x]."""
        shares = [
            float(t @ values.reshape(-1)[ball.index] / (t @ t)) if t.any() else 0.0
            for t, ball in zip(self.lesions, self.balls, strict=True)
        ]
        return Seen(ball=_rows(self.balls, values), slice=_rows(self.slices, values), lesion=tuple(shares))


def _rows(listed: tuple[Channels, ...], values: NDArray[np.float32]) -> Rows:
    return tuple(tuple(float(f"{r:.{DIGITS}g}") for r in one.of(values)) for one in listed)


@functools.lru_cache(maxsize=4)
def setup(path: Path | None, name: str) -> Setup:
    """Simulate the expected scans of a scene of a suite, once in a process."""
    return prepared(next(scene for scene in load(path) if scene.name == name))


def prepared(scene: DetectScene) -> Setup:
    """Simulate the expected scans of a scene with and without lesions.

    Both follow one plan, so that their energies are the same, and share the scatter of the body without lesions: else
    the error of Monte Carlo would be a signal.
    """
    present, absent = scene.bodies()
    scanner = scene.scan.resolve()
    streams = stream_id(scene.scan)
    plan = make_plan(present, scanner, scene.simulation, scene.scan.truth, streams)
    without = expected(plan, absent, scanner)
    images = [dict(truth_volumes(plan, body, scanner)) for body in (present, absent)]
    lesion = images[0]["reference_effective"].astype(np.float64) - images[1]["reference_effective"]
    energies, omega = effective_weights(plan.spectrum, scanner.detector, plan.l0)
    water = float(attenuation("water", energies) @ omega)
    places = [place.at for place in scene.locations]
    balls, slices = (
        tuple(channels(scanner.geometry, at, scene.diameter, dimensions=n) for at in places) for n in (3, 2)
    )
    lesions = tuple(lesion.reshape(-1)[ball.index] for ball in balls)
    return Setup(
        stream_id=streams,
        present=expected(plan, present, scanner, without.scatter),
        absent=without,
        metal=torch.from_numpy(images[1]["metal"] != 0),
        sites=_sites(scene, absent, scanner, [float(t[np.abs(t).argmax()]) / water for t in lesions]),
        balls=balls,
        slices=slices,
        lesions=lesions,
    )


def _sites(scene: DetectScene, body: Phantom, scanner: Scanner, contrasts: list[float]) -> tuple[Site, ...]:
    distances = scene.distances(body, scanner.geometry)
    return tuple(
        Site(at=place.at, group=place.group, distance_mm=round(float(d), 2), contrast_hu=round(1000 * c, 1))
        for place, d, c in zip(scene.locations, distances, contrasts, strict=True)
    )


@functools.lru_cache(maxsize=8)
def methods(given: Flags) -> dict[str, Method]:
    """Return the methods that the flags ask for, by label."""
    return {method.label: method for method in chosen(given.method or DEFAULT, given.set)}


_warm: dict[str, float] = {}


def measure(task: Task, given: Flags) -> list[Pair]:
    """Reconstruct one pair of scans by one method; a failure is an outcome."""
    found, method = setup(given.suite, task.part), methods(given)[task.subject]
    if task.subject not in _warm:
        _warm[task.subject] = warm_up(method, found.scan(method, 0, lesion=True))
    seen, seconds = {}, {}
    for name, lesion in (("present", True), ("absent", False)):
        outcome = attempt(method, found.scan(method, task.settings["pair"], lesion=lesion), _warm[task.subject])
        if outcome.status != OK or outcome.values is None:
            reason = f"{name}: {outcome.reason}"
            return [Pair(ok=False, status=outcome.status, reason=reason, inputs=method.inputs, sites=found.sites)]
        assert outcome.cost is not None
        seen[name], seconds[name] = found.seen(outcome.values), (round(outcome.cost.wall, 4),)
    return [Pair(seconds=seconds, inputs=method.inputs, sites=found.sites, **seen)]
