"""Which runs are to be done, in what order, what they will take; and doing them, here or on workers."""

import functools
import math
import pkgutil
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from ctsim.benchmarks import methods
from ctsim.benchmarks.engine.costs import listing
from ctsim.benchmarks.engine.devices import check_device
from ctsim.benchmarks.engine.workers import Lost, Pool
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.methods.isolate import Outcome
from ctsim.benchmarks.studies.methods.records import OK, Record
from ctsim.benchmarks.studies.methods.run import Options, Runner, Task, describe_run, run_all, tasks_on
from ctsim.errors import InputError

Group = tuple[Task, ...]
"""The runs of one method on one scan: on its twin without metal first, which the second is judged by."""


class Costs:
    """Seconds that runs took, from records of the past; of runs that ended well, without warm-up and scoring."""

    def __init__(self, found: list[Record]) -> None:
        self._runs: dict[tuple[str, int, str, str], float] = {}
        self._methods: dict[str, list[float]] = {}
        for record in found:
            if record.status == OK and record.cost is not None:
                run = record.run
                self._runs[run.scene, run.seed, run.variant, record.label] = record.cost.wall
                self._methods.setdefault(record.label, []).append(record.cost.wall)

    def method(self, label: str) -> float | None:
        """Return the median of a method's seconds, None where it has never run."""
        return statistics.median(self._methods[label]) if label in self._methods else None

    def task(self, task: Task) -> float | None:
        """Return what the same scan took the last time, else the method's median, else None."""
        run, label = task.run, task.method.label
        return self._runs.get((run.scene, run.seed, run.variant, label), self.method(label))


def ordered(left: list[Task], costs: Costs) -> list[Group]:
    """Order runs so that a table soon has whole rows: the cheapest method on all scans first, the dearest last.

    A method that has never run counts as dear as those before it in the methods table, which lists the cheap first.
    """
    labels = sorted(dict.fromkeys(task.method.label for task in left), key=records.rank)
    expected: dict[str, float] = {}
    for label in labels:
        known = costs.method(label)
        expected[label] = max(expected.values(), default=0.0) if known is None else known
    groups = [tuple(tasks) for _, tasks in groupby(left, key=lambda task: task.place)]
    return sorted(groups, key=lambda g: (expected[g[0].method.label], labels.index(g[0].method.label), g[0].place))


def text(
    groups: list[Group], n_listed: int, costs: Costs, guess: Callable[[Task], float | None] = lambda _: None
) -> str:
    """Return what --dry-run prints: the runs in their order with the seconds expected of each, and their sum.

    `guess` is for runs of methods that have no records.
    """
    left = [task for group in groups for task in group]
    names = [task.stored.name + ("" if task.variant == "metal" else " (metal-free)") for task in left]
    known = [costs.task(task) for task in left]
    guessed = dict.fromkeys(task.method.label for task, seconds in zip(left, known, strict=True) if seconds is None)
    rows = [
        (task.method.label, name, guess(task) if seconds is None else seconds)
        for task, name, seconds in zip(left, names, known, strict=True)
    ]
    how = "without warm-up and scoring, by the records of earlier runs"
    if found := [label for label, _, seconds in rows if label in guessed and seconds is not None]:
        how += f"; guessed from FDK's time: {', '.join(dict.fromkeys(found))}"
    return listing(rows, n_listed, "runs", how)


def estimated(task: Task) -> float | None:
    """Guess the seconds of a run from FDK's time on this machine, None for a method of the user's own."""
    from ctsim.benchmarks.studies.methods.estimates import fdk_seconds, in_fdks

    geometry = task.stored.geometry
    fdks = in_fdks(task.method, geometry)
    told = task.method.params.get("seconds")
    limit = told if isinstance(told, int | float) else math.inf
    return None if fdks is None else min(fdks * fdk_seconds(geometry), limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A group as it travels to a worker: names and paths, by which it finds data and method itself."""

    folder: Path
    place: tuple[int, int]
    variants: tuple[str, ...]
    method: str
    overrides: dict[str, Any]
    results: Path
    options: Options


def work(groups: list[Group], results: Path, options: Options, pool: Pool | None) -> Iterator[tuple[Task, Record]]:
    """Do the runs, in this process without a pool; each record is on the disk before it is yielded.

    Raises OSError where results cannot be written, InputError where a worker has other data or code than this process.
    """
    if pool is None:
        left = [task for group in groups for task in group]
        yield from zip(left, run_all(left, results, options), strict=True)
        return
    for answer in pool.answers(do, [_job(group, results.resolve(), options) for group in groups]):
        if answer is not None:
            group = groups[answer[0]]
            for task, record in zip(group, _records(group, answer[1]), strict=True):
                records.append(results / records.NAME, record)
                yield task, record


def _job(group: Group, results: Path, options: Options) -> Job:
    first = group[0]
    return Job(
        folder=first.stored.folder.resolve(),
        place=first.place,
        variants=tuple(task.variant for task in group),
        method=first.method.name,
        overrides=first.method.overrides,
        results=results,
        options=options,
    )


def do(job: Job) -> list[bytes]:
    """Be the worker: run a group, keep its volumes, and return its records as JSON."""
    check_device(job.options.device)
    stored = pkgutil.resolve_name(job.options.store)(job.folder)
    method = methods.find(job.method, job.overrides)
    runner = _runner(job.results, job.options)
    return [msgspec.json.encode(runner.run(task)) for task in tasks_on(stored, job.variants, [(method, job.place)])]


@functools.lru_cache(maxsize=1)
def _runner(results: Path, options: Options) -> Runner:
    """Return this process's runner, which knows from earlier jobs what is compiled."""
    return Runner(results, options)


def _records(group: Group, answer: list[bytes] | Lost) -> list[Record]:
    """Return the records of a group, those of a failure where its process died."""
    if isinstance(answer, Lost):
        return [describe_run(task, Outcome(status="error", reason=answer.reason), {}, None) for task in group]
    found = [msgspec.json.decode(line, type=Record) for line in answer]
    for task, record in zip(group, found, strict=True):
        if record.identity != task.run.identity:
            raise InputError(
                f"{task.method.label} on {task.stored.name}: a worker has another version of the data or of the "
                "method's code than this command; expected the same files and the same installation"
            )
    return found
