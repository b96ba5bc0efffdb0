"""Timed runs of `run-benchmark pareto`, in the process that takes them all.

What runs share stays in that process: compiled kernels, the opened scene, the reference. In a process that replaces it
they are made again before the next run's clock starts.
"""

import functools
import sys
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import msgspec
from tqdm import tqdm

from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.methods import estimates
from ctsim.benchmarks.studies.methods.attempt import describe
from ctsim.benchmarks.studies.pareto import methods, simulator, suite
from ctsim.benchmarks.studies.pareto.choices import Choice, Effort
from ctsim.benchmarks.studies.pareto.finding import Ended, Run
from ctsim.benchmarks.studies.pareto.study import Flags
from ctsim.folder import is_complete
from ctsim.phantoms.dataset import make_scene
from ctsim.phantoms.scene import Scene, scene_id
from ctsim.types import Status

_WARM: set[tuple[Hashable, ...]] = set()


def measure(task: Task, given: Flags) -> list[Run]:
    """Take one timed run of a task."""
    if task.part == "simulator":
        asked = suite.load(given.suite).simulator
        return [timed(simulator.Bench, (asked.side, asked.views), msgspec.convert(task.settings, Choice))]
    return [timed(methods.Bench, (given.results / "data" / task.case,), msgspec.convert(task.settings, Effort))]


def timed(make: Callable[..., Any], of: tuple[Hashable, ...], choice: Any) -> Run:
    """Time a choice on the bench that `make(*of)` returns, after a warm-up if it is the first of its kind there."""
    warm_up, key = None, (make, *of, choice.kind)
    try:
        bench = _bench(make, of)
        if key not in _WARM:
            warm_up = bench.warm_up(choice)
            _WARM.add(key)
        return Run(marks=bench.run(choice), warm_up=warm_up)
    except Ended as end:
        return Run(ok=end.status == Status.SKIPPED, status=end.status, reason=end.reason, warm_up=warm_up)
    except Exception as error:  # a method's failure is a result
        status = "out_of_memory" if isinstance(error, MemoryError) else "error"
        return Run(ok=False, status=status, reason=describe(error), warm_up=warm_up)


@functools.lru_cache(maxsize=1)  # a scene's tasks come one after the other
def _bench(make: Callable[..., Any], of: tuple[Hashable, ...]) -> Any:
    return make(*of)


def make_scans(scenes: list[Scene], data: Path) -> None:
    """Make the scans that are missing in a data folder."""
    for scene in scenes:
        if not is_complete(data, scene.name, scene_id(scene)):
            bar = functools.partial(tqdm, desc=scene.name, unit="view", disable=None, file=sys.stderr)
            make_scene(scene, data, watch=lambda views, first, n, bar=bar: bar(views, initial=first, total=n))


def expected(effort: Effort, scene: Scene) -> float:
    """Return about how many seconds a run of a method takes, from an FDK timed here."""
    geometry = scene.resolve().geometry
    fdks = estimates.in_fdks(find(effort.method, effort.changes), geometry) or estimates.UNKNOWN
    return fdks * estimates.fdk_seconds(geometry)
