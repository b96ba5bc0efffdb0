"""A process that carries out cases one after the other, so that a hang or a crash costs one case.

A process a case would start five hundred times.
"""

import functools
import importlib
import os
from collections.abc import Hashable
from typing import Self

from ctsim.benchmarks.engine.limited import Limited, Stopped
from ctsim.benchmarks.studies.stress.cases import Case, Outcome, carry_out

THREADS = "NUMBA_NUM_THREADS"


class Worker:
    """Carries out the cases of a catalogue, a module with `catalogue(*asked) -> list[Case]`, in a process of its own.

    A case takes at most `seconds`. The process can have two threads at least, so that one can be compared with two.
    """

    def __init__(self, catalogue: str, seconds: float, *asked: Hashable) -> None:
        self.seconds = seconds
        self._catalogue = (catalogue, *asked)
        self._threads = int(os.environ.get(THREADS, len(os.sched_getaffinity(0))))
        self._process = Limited(seconds, {THREADS: str(max(2, self._threads))})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.__exit__()

    def run(self, case: Case, side: int) -> Outcome:
        """Carry out a case; what does not end in time, the process's start included, or dies has failed."""
        self._process.seconds = self.seconds
        try:
            return self._process.run(_carry_out, self._catalogue, self._threads, case.name, case.subject, side)
        except Stopped as end:
            return Outcome(ok=False, found=f"NOT EXPECTED: {end}")


def _carry_out(
    catalogue: tuple[str, *tuple[Hashable, ...]], threads: int, name: str, subject: str, side: int
) -> Outcome:
    """Do, in the process, what `Worker.run` asks for, on so many threads."""
    import numba

    numba.set_num_threads(threads)
    return carry_out(_cases(*catalogue)[name, subject], side)


@functools.lru_cache
def _cases(catalogue: str, *asked: Hashable) -> dict[tuple[str, str], Case]:
    return {(c.name, c.subject): c for c in importlib.import_module(catalogue).catalogue(*asked)}
