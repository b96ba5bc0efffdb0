"""`run-benchmark stress OUT`: what is hard on the numbers, each case with an expected outcome."""

import pkgutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import Found, Record, Task, latest
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.stress.limits import FULL, SHORT
from ctsim.errors import InputError
from ctsim.human import human_choice

CATALOGUE = "ctsim.benchmarks.studies.stress.rows:catalogue"
# seconds of a row on one idle core, short and full, from runs on a busy machine
SECONDS = {"simulator": (0.3, 0.6), "splat kernels": (0.1, 0.1)}
SECONDS_OF_METHOD = (0.2, 0.5)


class Outcome(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a row ended: `found` says in words what was found; the seconds are those of "row"."""

    found: str = ""

    @property
    def words(self) -> str:
        """What was found, or how the row ended that found nothing."""
        return self.found or f"NOT EXPECTED: {self.reason}"

    @property
    def took(self) -> float:
        """The seconds that it took, 0 where it did not end."""
        return sum(self.seconds.get("row", ()))


class StressRecord(Record[Outcome], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a row: one outcome."""

    @property
    def finished(self) -> bool:
        """Always true: that a row crashes or does not end is a finding, too, and the last one counts."""
        return True


@dataclass(frozen=True, kw_only=True)
class Flags(study.Options):
    """Put simulator, methods and splat kernels under numerical stress; exit code 1 if anything is not as expected.

    A row fails where it misses its oracle, is not finite, raises, warns, crashes or does not end.
    """

    results: tyro.conf.Positional[Path]
    """The folder for stress.jsonl and stress.md; made if it is not there."""
    short: tyro.conf.FlagCreatePairsOff[bool] = False
    """Small grids; every case, in about two minutes on two cores."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only this case; may be given several times (default: all)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Scenes for the methods in place of the bundled ones; docs/how-to/test-stability.md lists its keys."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only the rows of this method, such as fdk, or of module:function of your own; may be given several times
    (default: all methods, simulator and splat kernels)."""
    seconds: float | None = 120.0
    """Time limit of one row, compilation and the start of its process included."""


class Stress(study.Study[Record[Outcome], Flags]):
    """The study."""

    name = file = "stress"
    unit = "row"
    kind, record, flags = Outcome, StressRecord, Flags
    work = "ctsim.benchmarks.studies.stress.worker:judge"
    apart = True
    estimate = "on one idle core, without compiling (a minute)"

    def __init__(self) -> None:
        self.threads = host.threads()  # a row has them; the process can have two, to compare them with one

    def environment(self, given: Flags) -> Mapping[str, str]:
        """Let the process have two threads at least."""
        return {"NUMBA_NUM_THREADS": str(max(2, self.threads))}

    def measure(self, task: Task, given: Flags) -> Sequence[Outcome]:
        """Judge a row on the threads that there are."""
        return pkgutil.resolve_name(self.work)(task, given, self.threads)

    def check(self, given: Flags) -> None:
        """Refuse names of cases that are none."""
        known = list(dict.fromkeys(case for case, _ in self.rows(given)))
        for name in given.case:
            if name not in known:
                raise InputError(f"--case {name!r}: expected one of {human_choice(known, name)}")

    def rows(self, given: Flags) -> dict[tuple[str, str], Any]:
        """Return the rows by (case, subject); what lists them is loaded here, so that --help does without."""
        return pkgutil.resolve_name(CATALOGUE)(given.suite, given.method)

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each row."""
        side = SHORT if given.short else FULL
        rows = [row for row in self.rows(given).values() if not given.case or row.case in given.case]
        return [
            Task(
                study=self.name, part=part(given), case=row.case, subject=row.subject, code=row.code, place=(place,),
                settings={"side": side, "expected": row.expected}, hints={"what": row.what},
            )
            for place, row in enumerate(rows)
        ]  # fmt: skip

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a row is among those that were asked for."""
        asked = not given.case or task.case in given.case
        return asked and task.part == part(given) and (task.case, task.subject) in self.rows(given)

    def pending(self, tasks: Sequence[Task], records: Sequence[Record[Outcome]], given: Flags) -> list[Task]:
        """Return the rows that were not as expected when they last ran, or never ran."""
        last = {} if given.force else {r.task.identity: r.found[0].ok for r in records}
        return [task for task in tasks if not last.get(task.identity)]

    def expected(self, task: Task, given: Flags) -> float:
        """Return the seconds that rows of a subject take."""
        return SECONDS.get(task.subject, SECONDS_OF_METHOD)[0 if given.short else 1]

    def took(self, record: Record[Outcome], given: Flags) -> float | None:
        """Return the seconds that the row took, if it ended."""
        return record.found[0].took or None

    def line(self, task: Task) -> tuple[str, str]:
        """Return a line for each case."""
        return task.case, task.hints["what"]

    def tables(self, records: Sequence[Record[Outcome]], given: Flags) -> list[Table]:
        """Return what is not as expected, the cases, and every row."""
        wrong = [r for r in records if not r.found[0].ok]
        side = records[0].task.settings["side"]
        caption = f"{side} voxels a side; {_how_many(records)}; {_seconds(records):.0f} s in all."
        rows = [[r.task.case, r.task.subject, r.found[0].words] for r in wrong]
        named = [simple(["case", "subject", "found"], rows, title="Not as expected", caption=caption)] * bool(wrong)
        return [*named, by_case(records, "" if wrong else caption), _every_row(records)]

    def write(self, records: Sequence[Record[Outcome]], given: Flags) -> str:
        """Write the tables; return what is not as expected. Warns of rows that other sources gave."""
        super().write(records, given)
        shown, path = latest(records), self.folder(given) / f"{self.file}.md"
        here = {task.identity for task in self.tasks(given)}
        if old := sum(r.task.identity not in here for r in shown):
            sys.stderr.write(f"{path}: {old} of {len(shown)} rows are of other sources than those that are here\n")
        wrong = (r for r in shown if not r.found[0].ok)
        named = "".join(f"NOT AS EXPECTED: {r.task.case}, {r.task.subject}: {r.found[0].words}\n" for r in wrong)
        return f"{named}{_how_many(shown)}. Written: {path}\n"


def part(given: Flags) -> str:
    """Return the name of the grids' size."""
    return "short" if given.short else "full"


def by_case(records: Sequence[Record[Outcome]], caption: str = "") -> Table:
    """Return a table of the cases, with how many of their rows are as expected."""
    cases: dict[str, list[Record[Outcome]]] = {}
    for record in records:
        cases.setdefault(record.task.case, []).append(record)
    rows = [
        [name, rows[-1].task.hints["what"], len(rows), sum(r.found[0].ok for r in rows), f"{_seconds(rows):.1f}"]
        for name, rows in cases.items()
    ]
    numbers = ("rows", "as expected", "s")
    return simple(["case", "what", *numbers], rows, numbers=numbers, title="Cases", caption=caption)


def _every_row(records: Sequence[Record[Outcome]]) -> Table:
    rows = [
        [r.task.case, r.task.subject, r.task.settings["expected"], r.found[0].words, "yes" if r.found[0].ok else "NO"]
        for r in records
    ]
    return simple(["case", "subject", "expected", "found", "ok"], rows, title="Rows")


def _seconds(records: Sequence[Record[Outcome]]) -> float:
    return sum(r.found[0].took for r in records)


def _how_many(records: Sequence[Record[Outcome]]) -> str:
    return f"{sum(r.found[0].ok for r in records)} of {len(records)} rows are as expected"


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every row is as expected, 1 if one is not."""
    return study.main(Stress(), arguments)
