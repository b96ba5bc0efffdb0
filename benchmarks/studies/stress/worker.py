"""Carry out a row of the stress suite, in a process of its own: a hang or a crash costs one row."""

import functools
import pkgutil

import numba

from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.stress.findings import carry_out
from ctsim.benchmarks.studies.stress.rows import catalogue
from ctsim.benchmarks.studies.stress.study import Flags, Outcome


def judge(task: Task, given: Flags, threads: int) -> list[Outcome]:
    """Judge a row on so many threads."""
    numba.set_num_threads(threads)
    row = catalogue(given.suite, given.method)[task.case, task.subject]
    run = functools.partial(pkgutil.resolve_name(row.run), *row.given, task.settings["side"])
    found, seconds = carry_out(run)
    return [Outcome(ok=not found.wrong, found=str(found), seconds={"row": (round(seconds, 3),)})]
