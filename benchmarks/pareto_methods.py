"""Every method of the table over its own effort, on the clock, scored under protocol `tissue`.

Iterative methods run once to twice their default iterations and are scored as they pass each of `STOPS`
(`watch`); the clock stands still while they are. A run of k iterations is said to take what it took to get there, and
what the method took after its last: its closing residual. Methods whose effort is not a count of iterations that can be
watched run once for each value; those without are single points.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import metrics
from benchmarks.methods import Method, find
from benchmarks.pareto_records import Mark, Setting
from benchmarks.protocol import VERSION, Truth, tissue_range, truth_of
from benchmarks.run import scan_for, warm_up
from ctsim.store import StoredScan, open_scan
from ctsim.types import Status
from reconstruct.watch import watch

STOPS = frozenset((1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 200))
BY_VALUE: dict[str, tuple[str, tuple[Any, ...]]] = {
    "ibhc": ("iterations", (1, 2, 3, 4, 6)),
    "splat": ("passes", ((1, 0), (1, 1), (2, 1), (3, 1), (3, 2), (3, 4), (3, 12))),
}
"""Methods that run once for each of these values of a parameter; the default is added."""
PUBLISHED, STEPS = ("paper", "r2"), 6000
"""Presets of `splat` that run once, for so many steps of the published schedule, watched after each pass."""
LAST = 2  # times the default: how far iterations go


class Ended(RuntimeError):
    """A method ended without a volume to score: its status and the reason."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(f"{status}: {reason}")
        self.status, self.reason = status, reason


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """One run to time: a method with its parameters, what the run and its curve are called.

    A run that is `watched` has a mark at each of `STOPS`, if the method shows its volume.
    """

    method: Method
    label: str
    curve: str
    default: bool = True
    watched: bool = False


def efforts(name: str) -> list[Effort]:
    """List the runs of a method of the table."""
    usual = find(name)
    if name in BY_VALUE:
        key, values = BY_VALUE[name]
        default = usual.params[key]
        runs = {f"{key} {_words(v)}": find(name, {key: v}) for v in values}
        usually = "defaults" if default is None else f"{key} {_words(default)}"
        runs = {usually: usual} | runs
        found = [Effort(method=m, label=label, curve=name, default=label == usually) for label, m in runs.items()]
        return found + [_published(preset) for preset in PUBLISHED if name == "splat"]
    count = usual.params.get("iterations")
    if not isinstance(count, int):
        return [Effort(method=usual, label="defaults", curve=name)]
    method = find(name, {"iterations": LAST * count})
    return [Effort(method=method, label=f"{LAST * count} iterations", curve=name, watched=True)]


def _published(preset: str) -> Effort:
    method = find("splat", {"preset": preset, "steps": STEPS, "readout": "hardened"})
    return Effort(method=method, label=f"{STEPS} steps", curve=f"splat {preset}", watched=True)


def _words(value: Any) -> str:
    return " + ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


class Bench:
    """One stored scene, ready to score volumes."""

    def __init__(self, folder: Path) -> None:
        self.stored: StoredScan = open_scan(folder)
        self.truth: Truth = truth_of(self.stored)

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

    def warm_up(self, method: Method) -> float:
        """Run the method on a few views and slices, so that compiling is not timed; return its seconds."""
        return warm_up(method, scan_for(method, self.stored, "metal"), "cpu")

    def run(self, effort: Effort) -> tuple[Mark, ...]:
        """Time one run; return a mark at each stop, or one if the method cannot be watched.

        Raises Ended where the method is skipped or there is no finite volume.
        """
        method, usual = effort.method, find(effort.method.name).params.get("iterations")
        scan = scan_for(method, self.stored, "metal")
        if reason := method.skip(scan):
            raise Ended(str(Status.SKIPPED), reason)
        stops = STOPS | {usual, method.params.get("iterations")}
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
                default=k == min(usual or marks.count, marks.count),
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
