"""Every method of the table over its own effort, on the clock, scored under protocol `tissue`.

What that is says the suite. Iterative methods run once, past their default iterations, and are scored as they pass each
of the stops (`watch`); the clock stands still while they are. A run of k iterations is said to take what it took to get
there, and what the method took after its last: its closing residual. Methods whose effort is not a count of iterations
that can be watched run once for each value; those without are single points.
"""

import contextlib
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.protocol import VERSION, Truth, tissue_range, truth_of
from ctsim.benchmarks.studies.methods.attempt import scan_for, warm_up
from ctsim.benchmarks.studies.pareto.jobs import Ended
from ctsim.benchmarks.studies.pareto.records import Mark, Setting
from ctsim.benchmarks.studies.pareto.suite import Listed, Suite
from ctsim.errors import InputError
from ctsim.reconstruct.watch import watch
from ctsim.store import StoredScan, open_scan
from ctsim.types import Status


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """One run to time: a method with its parameters, what the run and its curve are called.

    A run that is `watched` has a mark at each stop, if the method shows its volume. With `default` the run, or one mark
    of it if it is watched, is what the method does when it is told nothing.
    """

    method: Method
    label: str
    curve: str
    default: bool = True
    watched: bool = False

    @property
    def kind(self) -> str:
        """Its own: other values of a parameter may take other kernels, as presets do."""
        return f"{self.curve}, {self.label}"


def efforts(suite: Suite, name: str) -> list[Effort]:
    """List the runs of a method as the suite says, or by its iterations, if it has them, where it is not listed.

    Raises InputError for a method or a parameter that there is not.
    """
    usual, listed = find(name), suite.listed(name) or Listed(name=name)
    main = _by_value(usual, listed) if listed.parameter else [_whole(usual, listed.times, suite.iterations.times)]
    return main + [
        Effort(method=find(name, run.set), label=run.label, curve=run.curve, default=False, watched=True)
        for run in listed.run
    ]


def _by_value(usual: Method, listed: Listed) -> list[Effort]:
    """Return a run for the default of the listed parameter, and one for each other value."""
    key = listed.parameter
    runs = {f"{key} {_words(v)}": find(usual.name, {key: v}) for v in listed.values}
    default = usual.params[key]
    usually = "defaults" if default is None else f"{key} {_words(default)}"
    runs = {usually: usual} | runs
    return [Effort(method=m, label=label, curve=usual.name, default=label == usually) for label, m in runs.items()]


def _whole(usual: Method, times: int | None, otherwise: int) -> Effort:
    """Return one watched run, to so many times the default iterations; a plain one of a method that has none."""
    count = usual.params.get("iterations")
    if isinstance(count, int):
        count *= times or otherwise
        method = find(usual.name, {"iterations": count})
        return Effort(method=method, label=f"{count} iterations", curve=usual.name, watched=True)
    if times is not None:
        raise InputError(f"method {usual.name!r} has no default iterations to go {times} times as far as")
    return Effort(method=usual, label="defaults", curve=usual.name)


def _words(value: Any) -> str:
    return " + ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


class Bench:
    """One stored scene, ready to score volumes; runs that are watched have marks at the stops among others."""

    def __init__(self, folder: Path, stops: tuple[int, ...]) -> None:
        self.stored: StoredScan = open_scan(folder)
        self.stops = frozenset(stops)

    @functools.cached_property
    def truth(self) -> Truth:
        """What volumes are held against."""
        return truth_of(self.stored)

    def setting(self, effort: Effort, machine: str) -> Setting:
        """Return what determines a run."""
        method = effort.method
        return Setting(
            part="methods",
            scene=self.stored.name,
            data=f"{self.stored.content_hash}, protocol {VERSION}",
            group=method.inputs,
            curve=effort.curve,
            label=effort.label,
            params=method.params,
            code=method.code,
            machine=machine,
        )

    def warm_up(self, effort: Effort) -> float:
        """Run the method on a few views and slices, so that compiling is not timed; return its seconds."""
        return warm_up(effort.method, scan_for(effort.method, self.stored, "metal"), "cpu")

    def run(self, effort: Effort) -> tuple[Mark, ...]:
        """Time one run; return a mark at each stop, or one if the method cannot be watched.

        Raises Ended where the method is skipped or there is no finite volume.
        """
        method, usual = effort.method, find(effort.method.name).params.get("iterations")
        scan = scan_for(method, self.stored, "metal")
        if reason := method.skip(scan):
            raise Ended(str(Status.SKIPPED), reason)
        stops = self.stops | {usual, method.params.get("iterations")}
        marks = Marks(began=time.perf_counter(), score=self.values, stops=stops)
        with watch(marks) if effort.watched else contextlib.nullcontext():
            volume = method.reconstruct(scan, "cpu")
        ended = time.perf_counter()
        if volume.status is not Status.OK:
            raise Ended(str(volume.status), volume.reason)
        end = self.values(volume.values)
        if not marks.count:
            seconds = ended - marks.began
            return (Mark(label=effort.label, seconds=seconds, values=end, default=effort.default),)
        # the volume that is returned may be finished, such as by a last cut at 0
        passed = [m for m in marks.found if m[0] < marks.count] + [(marks.count, marks.seconds, end)]
        around = marks.before + ended - marks.left
        return tuple(
            Mark(
                label=f"{k} iteration{'s' * (k > 1)}",
                seconds=seconds + around,
                values=values,
                default=effort.default and k == min(usual or marks.count, marks.count),
            )
            for k, seconds, values in passed
        )

    def values(self, volume: torch.Tensor) -> dict[str, float]:
        """Return RMSE (1/mm) and PSNR3D (dB) of `tissue`."""
        found = volume.numpy()
        if not np.isfinite(found).all():
            raise Ended(str(Status.NONFINITE), "the volume holds values that are not finite")
        mse = metrics.mse3d(found, self.truth.references["effective"], self.truth.tissue)
        psnr = metrics.psnr(mse, tissue_range(self.truth, "effective"))
        return {"rmse": mse**0.5} | ({} if psnr is None else {"psnr3d": psnr})


@dataclass(slots=True, kw_only=True)
class Marks:
    """Watches a method: scores its volume at the stops.

    `seconds` are the method's own at its last iteration, without those of scoring; `before` is what passed until its
    clock was started, and `left` when the last iteration had been seen.
    """

    began: float
    score: Callable[[torch.Tensor], dict[str, float]]
    stops: frozenset[Any]
    found: list[tuple[int, float, dict[str, float]]] = field(default_factory=list)
    before: float = 0.0
    seconds: float = 0.0
    left: float = 0.0
    count: int = 0

    def __call__(self, _view_updates: int, seconds: float, volume: torch.Tensor) -> None:
        """Take note of an iteration that ended `seconds` after the method's clock was started."""
        if not self.count:
            self.before = time.perf_counter() - self.began - seconds
        self.count += 1
        self.seconds = seconds
        if self.count in self.stops:
            self.found.append((self.count, seconds, self.score(volume)))
        self.left = time.perf_counter()
