"""Every method of the table over its own effort, on the clock, scored under protocol `tissue`.

The suite says what that effort is. Iterative methods run once, past their default iterations, and are scored as they
pass each of the stops (`watch`); the clock stands still meanwhile. A run of k iterations takes what it took to get
there, and what the method took after its last: its closing residual. Methods whose effort is not a count of iterations
that can be watched run once for each value; methods without any are single points.
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

from ctsim.benchmarks.methods import find
from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.protocol import Truth, tissue_range, truth_of
from ctsim.benchmarks.studies.methods.attempt import scan_for, warm_up
from ctsim.benchmarks.studies.pareto.choices import Effort
from ctsim.benchmarks.studies.pareto.finding import Ended, Mark
from ctsim.reconstruct.watch import watch
from ctsim.store import StoredScan, open_scan
from ctsim.types import Status


class Bench:
    """One stored scene, ready to score volumes."""

    def __init__(self, folder: Path) -> None:
        self.stored: StoredScan = open_scan(folder)

    @functools.cached_property
    def truth(self) -> Truth:
        """What volumes are compared with."""
        return truth_of(self.stored)

    def warm_up(self, effort: Effort) -> float:
        """Run the method on a few views and slices, so that compiling is not timed; return its seconds."""
        method = find(effort.method, effort.changes)
        return warm_up(method, scan_for(method, self.stored, "metal"))

    def run(self, effort: Effort) -> tuple[Mark, ...]:
        """Time one run; return a mark at each stop, the default and the end, or one if the method cannot be watched.

        Raises Ended where the method is skipped or there is no finite volume.
        """
        method, usual = find(effort.method, effort.changes), find(effort.method).params.get("iterations")
        scan = scan_for(method, self.stored, "metal")
        if reason := method.skip(scan):
            raise Ended(str(Status.SKIPPED), reason)
        stops = frozenset({*effort.stops, usual, method.params.get("iterations")})
        marks = Marks(began=time.perf_counter(), score=self.values, stops=stops)
        with watch(marks) if effort.watched else contextlib.nullcontext():
            volume = method.reconstruct(scan)
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
