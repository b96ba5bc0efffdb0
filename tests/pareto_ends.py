"""Methods and a scene that end in every way, for the tests of pareto; imports little, since processes load it again."""

import time
from dataclasses import dataclass

from ctsim.benchmarks.studies.pareto.finding import Mark, TimedRun

CALLS = []


def fails(scan, *, device):
    raise ValueError("no such luck")


def hangs(scan, *, device):
    time.sleep(60)


@dataclass(frozen=True)
class Tried:
    label: str
    kind: str


class Scene:
    """Opened, warmed up and run, it says so in CALLS; choices c to e do not end well."""

    def __init__(self, name):
        CALLS.append(f"open {name}")

    def warm_up(self, choice):
        CALLS.append(f"warm {choice.kind}")
        return 0.5

    def run(self, choice):
        import numba

        CALLS.append(choice.label)
        if choice.label == "c":
            return TimedRun(ok=False, status="diverged", reason="so")
        if choice.label == "d":
            raise MemoryError("no room")
        if choice.label == "e":
            time.sleep(60)
        values = {"rmse": 1.0, "threads": numba.get_num_threads()}
        return TimedRun(marks=(Mark(label=choice.label, seconds=1.0, values=values),))
