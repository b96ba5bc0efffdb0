"""Cases that end in every way, for the tests of the stress suite; imports little, since processes load it anew."""

import os
import time
import warnings

import numpy as np

from ctsim.benchmarks.studies.stress.cases import Case


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


def catalogue(subject="test"):
    return [Case(name=f.__name__, subject=subject, what="w", expected="e", run=f) for f in ENDS]
