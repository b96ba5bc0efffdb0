"""Rows that end in every way, for the tests of the stress suite; imports little, since its process loads it, too."""

import os
import time
import warnings

import numba
import numpy as np

from ctsim.benchmarks.studies.stress import worker
from ctsim.benchmarks.studies.stress.study import Judged, Stress, StressRow


def fine(side, found):
    found.at_most("side", side, 100)


def wrong(side, found):
    found.at_most("a number", float("nan"), 1.0)


def raising(side, found):
    raise ValueError("no such thing")


def warning(side, found):
    np.log(np.zeros(2))
    warnings.warn("by hand", UserWarning, stacklevel=1)


def hanging(side, found):
    time.sleep(60)


def crashing(side, found):
    os.abort()


def leaving(side, found):
    os._exit(3)


ENDS = {
    fine: (True, "side 12"),
    wrong: (False, "a number nan, limit 1"),
    raising: (False, "ValueError: no such thing"),
    warning: (False, "divide by zero"),
    crashing: (False, "died with signal SIGABRT"),
    leaving: (False, "died with exit code 3"),
    hanging: (False, "did not end within"),
}


def catalogue(*names, code="code"):
    rows = [StressRow(f.__name__, "test", "w", "e", code) for f in ENDS]
    return {(row.case, row.subject): row for row in rows if not names or row.case in names}


def judge(task, given):
    worker.catalogue = lambda *_: catalogue()
    worker.PROGRAMS.update({(f.__name__, "test"): f for f in ENDS})
    return worker.judge(task, given)


def threads(task, given):
    most = numba.config.NUMBA_NUM_THREADS
    numba.set_num_threads(task.hints["threads"])
    return [Judged(found=f"{numba.get_num_threads()} of {most} threads")]


class Ends(Stress):
    """The command on these rows."""

    work = "stress_ends:judge"

    def rows(self, given):
        return catalogue()

    def limit(self, task, given):
        return 1.0 if task.case == "hanging" else given.seconds


class Threads(Ends):
    """The command on rows that say how many threads they have."""

    work = "stress_ends:threads"
