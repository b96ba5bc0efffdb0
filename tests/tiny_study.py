"""A study that takes no time, on which test_engine.py tries what every study has from the engine."""

import os
import signal
import tempfile
import time
from dataclasses import dataclass
from typing import Annotated

import tyro

from ctsim.benchmarks.engine import study
from ctsim.benchmarks.engine.record import Found, Record, Task
from ctsim.benchmarks.engine.table import simple
from ctsim.errors import InputError


class Value(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    value: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Flags(study.Flags):
    """Find a value for every case."""

    repeats: int = 2
    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="CASE")] = ()


class Tiny(study.Study):
    """Its flags, tasks and tables; each task appends its case to the file `LOG` of the results folder."""

    name = file = "tiny"
    kind, record, flags = Value, Record[Value], Flags
    work = "tiny_study:work"

    def tasks(self, given):
        code = os.environ.get("CTSIM_TEST_CODE", "a" * 40)
        return [
            Task(study="tiny", case=case, code=code, place=(place,))
            for place, case in enumerate(given.case or ("good", "better"))
        ]

    def shows(self, task, given):
        return not given.case or task.case in given.case

    def expected(self, task, given):
        return {"good": 60.0}.get(task.case)

    def limit(self, task, given):
        # other tasks have the time to start on a busy machine
        return 60.0 if given.seconds and given.seconds >= 1 and task.case != "slow" else given.seconds

    def tables(self, records, given):
        rows = [[r.task.case, f.status, f.reason, f.value] for r in records for f in r.found]
        return [simple(["case", "status", "reason", "value"], rows, title="Tiny")]


class Isolated(Tiny):
    """Measures in a process of its own."""

    isolated = True


@dataclass(frozen=True, kw_only=True)
class RoundFlags(Flags):
    """Its repeats are rounds."""


class Rounds(Tiny):
    """Measures each task once a round."""

    flags = RoundFlags
    rounds = True


class Follows(Tiny):
    """Writes its tables while it measures."""

    follows = True


def work(task, given):
    """Be a task; the first word of its case says how it ends, until the results folder has a file `mended`."""
    with (given.results / "log").open("a") as log:
        log.write(f"{task.case}\n")
    way = "good" if (given.results / "mended").exists() else task.case.partition("-")[0]
    if way == "slow":
        (given.results / "temporary").write_text(tempfile.mkdtemp())
        (given.results / "waiting").touch()
        time.sleep(60)
    if way == "raises":
        raise ValueError("what is ours")
    if way == "refuses":
        raise InputError("not this one")
    if way == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if way == "interrupted":
        raise KeyboardInterrupt
    if way == "fails":
        return [Value(ok=False, status="error", reason="not yet")]
    runs = 1 if isinstance(given, RoundFlags) else given.repeats
    return [Value(ok=way != "bad", value=len(task.case), seconds={"all": (0.5,) * runs})]


def main(arguments: list[str]) -> int:
    return study.main(Tiny(), arguments)
