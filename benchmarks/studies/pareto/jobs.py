"""Timed runs of `run-benchmark pareto`, as the process takes them that does all (`ctsim.benchmarks.engine.limited`).

What runs share stays in that process: compiled kernels, the opened scene, the reference. Where it was replaced, since a
run was ended, that is made again before the next one's clock starts.
"""

import functools
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ctsim.benchmarks.engine.host import use_threads
from ctsim.benchmarks.engine.limited import Limited, Stopped
from ctsim.benchmarks.studies.methods.records import OK
from ctsim.benchmarks.studies.pareto.records import Mark, Setting


class Choice(Protocol):
    """What a run tries; all of a `kind` are compiled by the warm-up of one."""

    @property
    def kind(self) -> str:
        """Its name."""
        ...


class Bench(Protocol):
    """A scene of one part, with what its runs share."""

    def setting(self, choice: Any, machine: str, /) -> Setting:
        """Return what determines a choice's runs."""
        ...

    def warm_up(self, choice: Any, /) -> float:
        """Compile what all choices of its kind share; return the seconds."""
        ...

    def run(self, choice: Any, /) -> tuple[Mark, ...]:
        """Time a run. Raises Ended where it has nothing to score."""
        ...


class Ended(RuntimeError):
    """A run ended without a result to score: its status and the reason."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(f"{status}: {reason}")
        self.status, self.reason = status, reason


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A setting to time, with a choice of the bench that `make(*given)` returns."""

    setting: Setting
    make: Callable[..., Bench]
    given: tuple[Hashable, ...]
    choice: Choice


@dataclass(frozen=True, slots=True, kw_only=True)
class Ran:
    """How a run ended; `warm_up` are the seconds of the call before it that compiled, if there was one."""

    marks: tuple[Mark, ...] = ()
    status: str = OK
    reason: str = ""
    warm_up: float | None = None


def jobs(make: Callable[..., Bench], given: tuple[Hashable, ...], choices: Sequence[Choice], machine: str) -> list[Job]:
    """Return a job for each choice of a bench."""
    bench = make(*given)
    return [Job(setting=bench.setting(c, machine), make=make, given=given, choice=c) for c in choices]


def within(process: Limited, threads: int, job: Job) -> Ran:
    """Do a job in the process; one that does not end in time, or with which the process dies, has failed."""
    try:
        return process.run(do, threads, job)
    except Stopped as end:
        return Ran(status=end.status, reason=str(end))


def do(threads: int, job: Job) -> Ran:
    """Be the process: run a job, after a warm-up if it is the first of its kind, and say whatever happens."""
    from ctsim.benchmarks.studies.methods.attempt import describe

    use_threads(threads)
    marks, status, reason, first = (), OK, "", None
    try:
        first = _warmed(job)
        marks = _bench(job.make, job.given).run(job.choice)
    except Ended as end:
        status, reason = end.status, end.reason
    except MemoryError as error:
        status, reason = "out_of_memory", describe(error)
    except Exception as error:  # a method's failure is a result
        status, reason = "error", describe(error)
    return Ran(marks=marks, status=status, reason=reason, warm_up=first)


@functools.lru_cache(maxsize=1)  # a scene's jobs come one after the other
def _bench(make: Callable[..., Bench], given: tuple[Hashable, ...]) -> Bench:
    return make(*given)


_WARM: set[tuple[Hashable, ...]] = set()


def _warmed(job: Job) -> float | None:
    """Warm up for a job and return the seconds, None where that was done."""
    key = (job.make, *job.given, job.choice.kind)
    if key in _WARM:
        return None
    seconds = _bench(job.make, job.given).warm_up(job.choice)
    _WARM.add(key)
    return seconds
