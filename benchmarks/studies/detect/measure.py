"""Reconstruct pairs of scans and read the observer's channels."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.morphology import dilate
from ctsim.beam.quadrature import effective_weights
from ctsim.benchmarks.engine.record import OK, Task
from ctsim.benchmarks.methods import Method, chosen
from ctsim.benchmarks.scores.channels import Channels, channels
from ctsim.benchmarks.studies.detect import DEFAULT, Flags
from ctsim.benchmarks.studies.detect.records import Pair, Rows, Seen, Site
from ctsim.benchmarks.studies.detect.suite import DetectScene, load
from ctsim.benchmarks.studies.methods.attempt import Outcome, attempt, warm_up
from ctsim.materials import attenuation
from ctsim.phantoms.scene import stream_id
from ctsim.plan import make_plan
from ctsim.realisations import Expectation, expected
from ctsim.tracer.voxelise import attenuation_volume, metal_mask
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
        counts = signal.counts(stream, twin=method.told_twin)
        return self._scan(method, counts, signal.flat(stream), self.metal)

    def anatomy(self, method: Method) -> Scan:
        """Return the scan without metal, lesions and noise."""
        silent = self.absent.noise_free()
        counts, flat = silent.counts(self.stream_id, twin=True), silent.flat(self.stream_id)
        return self._scan(method, counts, flat, torch.zeros_like(self.metal), silent.scanner)

    def _scan(
        self, method: Method, counts: NDArray, flat: NDArray, metal: torch.Tensor, scanner: Scanner | None = None
    ) -> Scan:
        scanner = scanner or self.absent.scanner
        return Scan(
            geometry=scanner.geometry,
            counts=torch.from_numpy(counts),
            flat=torch.from_numpy(flat),
            dark=scanner.noise.dark,
            i0=scanner.i0,
            e_max=float(self.absent.plan.spectrum.e_max),
            metal=metal.clone() if method.mask == "oracle" else None,
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
    energies, omega = effective_weights(plan.spectrum, scanner.detector, plan.l0)
    contrast = (scene.density - 1) * float(attenuation(scene.tissue, energies) @ omega)
    only = dict.fromkeys(present.materials, 0.0) | {scene.material: contrast}
    image = attenuation_volume(present, scanner.geometry, only).reshape(-1).astype(np.float64)
    places = [place.at for place in scene.locations]
    metal = metal_mask(absent, scanner.geometry) != 0
    seen = ~dilate(metal, 1, corners=True)
    balls, slices = (
        tuple(channels(scanner.geometry, at, scene.diameter, seen=seen, dimensions=n) for at in places) for n in (3, 2)
    )
    hounsfield = 1000 * contrast / float(attenuation("water", energies) @ omega)
    return Setup(
        stream_id=streams,
        present=expected(plan, present, scanner, without.scatter),
        absent=without,
        metal=torch.from_numpy(metal),
        sites=_sites(scene, absent, scanner, hounsfield),
        balls=balls,
        slices=slices,
        lesions=tuple(image[ball.index] for ball in balls),
    )


def _sites(scene: DetectScene, body: Phantom, scanner: Scanner, contrast: float) -> tuple[Site, ...]:
    distances, contrasts = scene.distances(body, scanner.geometry), {"none": 0.0}
    return tuple(
        Site(
            at=place.at,
            group=place.group,
            distance_mm=round(float(distance), 2),
            contrast_hu=round(contrasts.get(place.group, contrast), 2),
        )
        for place, distance in zip(scene.locations, distances, strict=True)
    )


@functools.lru_cache(maxsize=8)
def methods(given: Flags) -> dict[str, Method]:
    """Return the methods that the flags ask for, by label."""
    return {method.label: method for method in chosen(given.method or DEFAULT, given.set)}


_anatomies: dict[tuple[Flags, str, str], Seen] = {}


def _anatomy(given: Flags, scene: str, label: str) -> Seen | Outcome:
    """Return what is seen without metal, or how the method failed; the first call in a process compiles the method."""
    if (key := (given, scene, label)) in _anatomies:
        return _anatomies[key]
    found, method = setup(given.suite, scene), methods(given)[label]
    warm_up(method, found.scan(method, 0, lesion=True))
    seen, _ = _seen(found, method, found.anatomy(method))
    if isinstance(seen, Seen):
        _anatomies[key] = seen
    return seen


def _seen(found: Setup, method: Method, scan: Scan) -> tuple[Seen | Outcome, float]:
    """Return what is seen in the volume of a scan, or how the method failed, and the seconds that it took."""
    outcome = attempt(method, scan, 0.0)
    seconds = outcome.cost.wall if outcome.cost else 0.0
    return outcome if outcome.status != OK or outcome.values is None else found.seen(outcome.values), seconds


def measure(task: Task, given: Flags) -> list[Pair]:
    """Reconstruct one pair of scans by one method; a failure is an outcome."""
    found, method = setup(given.suite, task.part), methods(given)[task.subject]
    seen: dict[str, Seen | Outcome] = {"anatomy": _anatomy(given, task.part, task.subject)}
    seconds = {}
    for name in ("present", "absent"):
        scan = found.scan(method, task.settings["pair"], lesion=name == "present")
        seen[name], taken = _seen(found, method, scan)
        seconds[name] = (round(taken, 4),)
    for name, one in seen.items():
        if isinstance(one, Outcome):
            reason = f"{name}: {one.reason}"
            return [Pair(ok=False, status=one.status, reason=reason, inputs=method.inputs, sites=found.sites)]
    return [Pair(seconds=seconds, inputs=method.inputs, sites=found.sites, **seen)]  # pyright: ignore[reportArgumentType]  failures have returned
