"""Timed runs of `run-benchmark pareto`, of the simulator and of methods, all in one process.

The process keeps what runs share: compiled kernels, the opened scene, the reference. A process that replaces it makes
them again before the next run's clock starts.
"""

import contextlib
import functools
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim import settings
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.known_beam import with_beam
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.oracles import measured_pixel, poly_scene, relative, scanner_of, voxelised
from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.protocol import Truth, aligned_score, tissue_range, truth_of
from ctsim.benchmarks.studies.methods.attempt import describe, run_here, scan_for, skip, warm_up
from ctsim.benchmarks.studies.pareto import Flags, suite
from ctsim.benchmarks.studies.pareto.finding import Mark, TimedRun
from ctsim.benchmarks.studies.pareto.suite import EXACT, SCATTER, Choice, Effort
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.detector.noise import Noise
from ctsim.montecarlo.series import scatter_series
from ctsim.montecarlo.transport import Source
from ctsim.plan import Plan, make_plan
from ctsim.reconstruct.watch import watch
from ctsim.scatter import Scatter
from ctsim.simulate import simulate_views
from ctsim.types import Phantom, Scanner, Status

CHECKED = 2  # views that are compared with the reference
FINER, FINEST = 16, 64
"""Of the reference: finer pixels along the side of a pixel, and rays in each of them."""
LONG = 0.01  # RMS error of the reference's scatter: half of level 3's own
CALM = 1e-4  # a pixel has no edge where |ΔP| of the central ray alone is smaller
USUALLY = Choice(curve=EXACT, label="default")
_WARM: set[tuple[Hashable, ...]] = set()


def measure(task: Task, given: Flags) -> list[TimedRun]:
    """Take one timed run of a task."""
    host.use_threads(given.threads)
    asked = suite.load(given.suite)
    if task.part == "simulator":
        of = (asked.simulator.side, asked.simulator.views)
        return [timed(SimulatorBench, of, msgspec.convert(task.settings, Choice), task.case)]
    of = (given.results / "data" / task.case, asked.dataset.aligned)
    # other parameter values may need other kernels
    return [timed(MethodBench, of, msgspec.convert(task.settings, Effort), task.subject)]


def timed(make: Callable[..., Any], of: tuple[Hashable, ...], choice: Any, kind: str) -> TimedRun:
    """Time a choice on the bench `make(*of)`, after a warm-up if it is the first of its `kind` there."""
    first, key = None, (make, *of, kind)
    try:
        bench = _bench(make, of)
        if key not in _WARM:
            first = bench.warm_up(choice)
            _WARM.add(key)
        return msgspec.structs.replace(bench.run(choice), warm_up=first)
    except Exception as error:  # a method's failure is a result
        status = "out_of_memory" if isinstance(error, MemoryError) else "error"
        return TimedRun(ok=False, status=status, reason=describe(error), warm_up=first)


@functools.lru_cache(maxsize=1)  # a scene's tasks follow each other
def _bench(make: Callable[..., Any], of: tuple[Hashable, ...]) -> Any:
    return make(*of)


# --- the simulator -----------------------------------------------------------------------------------


class SimulatorBench:
    """The simulator's scene, its reference, and what is prepared for each choice; `side` is of detector and grid.

    The scene is analytic: a water cylinder with a bone rod and two iron rods. The reference has closed-form chords, 16²
    finer pixels per pixel with up to 64 rays each, averaged in intensity, and the whole fine spectrum. Errors are of
    P = −ln(signal/open) without noise in a few views. The scatter levels form their own group: there the reference has
    level 1's constant signal added, so that the error of that constant does not show.
    """

    def __init__(self, side: int, views: int) -> None:
        self.side = side
        self.scanner = msgspec.structs.replace(scanner_of(side, views), noise=Noise(model="none"))
        self.phantom = poly_scene(side)
        self.checked = tuple(sorted({round((k + 0.5) * views / CHECKED) % views for k in range(CHECKED)}))
        self._plans: dict[Choice, tuple[Plan, Phantom, Scanner]] = {}

    def warm_up(self, _: Choice) -> float:
        """Run the defaults, so that no timed run compiles or makes the reference; return the seconds."""
        return sum(mark.seconds for mark in self.run(USUALLY).marks)

    def run(self, choice: Choice) -> TimedRun:
        """Time all views of a choice and return its errors."""
        plan, phantom, scanner = self._plan(choice)
        start = time.perf_counter()
        views = [images["noise_free"] for _, images in simulate_views(plan, phantom, scanner)]
        seconds = time.perf_counter() - start
        found = np.stack([views[k] for k in self.checked])
        s = self.scatter if choice.curve == SCATTER else 0.0
        label = f"{choice.label}, {len(plan.rule.energies)} energies"
        mark = Mark(label=label, seconds=seconds, values=self.errors(found, s), default=choice.default)
        return TimedRun(marks=(mark,))

    def errors(self, p: NDArray[np.float32], scatter: NDArray[np.float32] | float = 0.0) -> dict[str, float]:
        """Compare P of the checked views with the reference, to which `scatter` (S/I0) is added.

        `rms` is relative; `worst` is the greatest |ΔP|, `off_edges` the greatest in pixels without an edge.
        """
        exact, calm = self.reference
        exact = -np.log(np.exp(-exact) + scatter)
        off = np.abs(p - exact)
        return {"rms": relative(p, exact), "worst": float(off.max()), "off_edges": float(off[calm].max())}

    @functools.cached_property
    def reference(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """P of the checked views, and the pixels where the central ray alone gives the same."""
        exact, central = (
            measured_pixel(self.phantom, self.scanner, self.checked, finer=finer, subrays=rays)
            for finer, rays in ((FINER, FINEST), (1, 1))
        )
        return exact, np.abs(central - exact) < CALM

    @functools.cached_property
    def scatter(self) -> NDArray[np.float32]:
        """S/I0 of the checked views, by a Monte Carlo of a stream of its own."""
        plan, phantom, scanner = self._plan(USUALLY)
        source = Source(spectrum=plan.spectrum, detector=scanner.detector, n_detector=scanner.geometry.n_detector)
        series = scatter_series(phantom, source, scanner.geometry, tolerance=LONG, stream="reference")
        return np.stack([series.view(k)[0] for k in self.checked])

    def _plan(self, choice: Choice) -> tuple[Plan, Phantom, Scanner]:
        """Plan a choice once, untimed. With a `grid` the body, and with `metal` the metal too, are voxels."""
        if choice not in self._plans:
            scanner, phantom = msgspec.structs.replace(self.scanner, scatter=Scatter(level=choice.level)), self.phantom
            if choice.grid is not None:
                cubes = scanner_of(max(round(choice.grid * self.side), 1), 1).geometry
                metal = tuple(s for s in phantom.solids if s.metal and not choice.metal)
                phantom = voxelised(phantom, cubes, metal)
            plan = make_plan(phantom, scanner, choice.simulation, settings.Truth(twin=False, noise_free=True), "pareto")
            self._plans[choice] = plan, phantom, scanner
        return self._plans[choice]


# --- methods -----------------------------------------------------------------------------------------


class MethodBench:
    """A stored scene, on which every method of the table is timed over its own effort and scored under `tissue`.

    Iterative methods run once, past their default iterations, and are scored at each stop (`watch`) with the clock
    stopped. The time of k iterations is the time to reach them plus the time the method takes after its last iteration,
    such as for its closing residual. Methods without watchable iterations run once for each value of their effort;
    methods without effort are single points.
    """

    def __init__(self, folder: Path, aligned: bool = False) -> None:
        self.stored: StoredScan = open_scan(folder)
        self.aligned = aligned

    @functools.cached_property
    def truth(self) -> Truth:
        """The truth that volumes are compared with."""
        return truth_of(self.stored)

    def warm_up(self, effort: Effort) -> float:
        """Run the method on a few views and slices, so that no timed run compiles; return the seconds."""
        method = with_beam(find(effort.method, effort.changes), self.stored)
        return warm_up(method, scan_for(method, self.stored, "metal"))

    def run(self, effort: Effort) -> TimedRun:
        """Time one run, with a mark at each stop, the default and the end, or one if the method cannot be watched."""
        method = with_beam(find(effort.method, effort.changes), self.stored)
        usual = find(effort.method).params.get("iterations")
        marks = Marks(score=self.values, stops={*effort.stops, usual, method.params.get("iterations")})
        with watch(marks) if effort.watched else contextlib.nullcontext():
            outcome = skip(method, self.stored, "metal") or run_here(self.stored, "metal", method, 0.0)
        if outcome.status != Status.OK or outcome.values is None or outcome.cost is None:
            return TimedRun(ok=outcome.status == Status.SKIPPED, status=outcome.status, reason=outcome.reason)
        end, around, count = self.values(outcome.values), outcome.cost.wall - marks.watched, len(marks.seen)
        if not count:
            return TimedRun(marks=(Mark(label=effort.label, seconds=around, values=end, default=effort.default),))
        # the method may change its volume after the last iteration, such as cut it at 0
        marks.seen[-1] = marks.seen[-1][0], end
        default = min(usual or count, count) if effort.default else None
        passed = [
            Mark(label=f"{k} iteration{'s' * (k > 1)}", seconds=seconds + around, values=values, default=k == default)
            for k, (seconds, values) in enumerate(marks.seen, 1)
            if values
        ]
        return TimedRun(marks=tuple(passed))

    def values(self, volume: NDArray[np.float32]) -> dict[str, float]:
        """Return RMSE (1/mm) and PSNR3D (dB) of `tissue`, and PSNR3D of `aligned` where it is asked for.

        Empty for a volume with values that are not finite.
        """
        truth = self.truth
        if not np.isfinite(volume).all():
            return {}
        mse = metrics.mse3d(volume, truth.references["effective"], truth.tissue)
        scores = {"rmse": mse**0.5, "psnr3d": metrics.psnr(mse, tissue_range(truth, "effective"))}
        if self.aligned:
            scores["aligned"] = aligned_score(volume, truth, "effective").values["psnr3d"]
        return {name: score for name, score in scores.items() if score is not None}


@dataclass(slots=True, kw_only=True)
class Marks:
    """Watches a method: scores its volume at the stops.

    `seen` has the method's seconds after each iteration, scoring excluded, and the scores at a stop. `watched` has the
    seconds from the start of its clock to the end of the last scoring.
    """

    score: Callable[[NDArray[np.float32]], dict[str, float]]
    stops: set[Any]
    seen: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    began: float = 0.0
    watched: float = 0.0

    def __call__(self, _view_updates: int, seconds: float, volume: torch.Tensor) -> None:
        """Note an iteration that ended at `seconds` of the method's clock."""
        if not self.seen:
            self.began = time.perf_counter() - seconds
        self.seen.append((seconds, self.score(volume.numpy()) if len(self.seen) + 1 in self.stops else {}))
        self.watched = time.perf_counter() - self.began
