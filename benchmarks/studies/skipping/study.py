"""`run-benchmark skipping RESULTS`: what is left out, what that saves, and how far the results are apart.

Records go to RESULTS/skipping.jsonl case by case; the table, RESULTS/skipping.md, shows the newest of each case, so
that cases can be measured one by one. What this commit recorded on this machine is not measured again. All cases are
those of one process, which is replaced where a case overstays.
"""

import dataclasses
import importlib
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.benchmarks.engine.host import Host
    from ctsim.benchmarks.engine.limited import Limited
    from ctsim.benchmarks.studies.skipping.simulator import Setup
    from ctsim.benchmarks.studies.skipping.tables import Measured

Case = Literal[
    "materials", "bricks", "rays", "energies", "edges", "refining", "scatter", "twin",
    "truth", "metal-free", "rows", "scan", "record",
]  # fmt: skip
CASES: tuple[Case, ...] = get_args(Case)
NAME = "skipping.jsonl"
# seconds of one run both ways at size core, on two idle cores (docs/skipping.md)
SECONDS: dict[Case, float] = {
    "materials": 0.46, "bricks": 1.1, "rays": 10.3, "energies": 0.63, "edges": 2.0, "refining": 1.6, "scatter": 0.45,
    "twin": 2.6, "truth": 0.49, "metal-free": 4.4, "rows": 2.0, "scan": 6.7, "record": 4.8,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure everything that is left out: the time with and without it, and the largest difference of the result.

    Exit code 1 where a difference exceeds what is stated of it or a case did not end. The machine should have nothing
    else to do.
    """

    results: tyro.conf.Positional[Path]
    """The folder for skipping.jsonl and skipping.md; made if it is not there."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[Case, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case, such as energies or metal-free; may be given several times (default: all)."""
    repeats: int = 5
    """Counted runs with and without each skip; the table shows medians."""
    size: Literal["core", "small"] = "core"
    """The scene lung-Fe of the suite core, or tiny grids that prove the command and say nothing about speed."""
    seconds: float | None = None
    """Time limit of one case, all of its runs together, with the start of its process where that is due."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure again what is recorded of this commit on this machine."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print what is left to measure and about how long it takes; measure nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the table from the records, computing nothing."""
    collect: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")] = ()
    """Take over what these results folders of other machines have and RESULTS lacks, then only render the table."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every difference is within what is stated, 1 if one is not or was not measured."""
    from ctsim.benchmarks.engine.limited import refuse_unless_positive

    given = tyro.cli(Arguments, prog="run-benchmark skipping", args=argv)
    if given.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {given.repeats}")
    refuse_unless_positive(given.seconds)
    wanted = tuple(dict.fromkeys(given.case)) or CASES
    if given.collect:
        _collect(given)
    if given.dry_run:
        sys.stdout.write(_planned(given, wanted))
        return 0
    if not given.table and not given.collect:
        _measure(given, wanted)
    return _report(given, wanted)


def _collect(given: Arguments) -> None:
    from ctsim.benchmarks.engine import lines
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    kind, what = skipping_tables.SkipRecord, skipping_tables.WHAT
    lines.take_over(given.results / NAME, given.collect, kind, what, dry_run=given.dry_run)


def _report(given: Arguments, wanted: tuple[Case, ...]) -> int:
    """Write and print the table of all records; return 1 if a wanted case has a difference beyond what is stated."""
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    path = given.results / NAME
    stored = skipping_tables.latest(skipping_tables.read(path), given.size, CASES)
    if not stored:
        raise InputError(f"{path}: there are no records of size {given.size}; run without --table first")
    text = skipping_tables.render(stored)
    (given.results / "skipping.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text + f"\nWritten: {given.results}/skipping.md; records in {NAME}\n")
    return 0 if all(r.measured.held for r in stored if r.measured.case in wanted) else 1


def _left(given: Arguments, wanted: tuple[Case, ...]) -> "tuple[list[Case], tuple[Host, str]]":
    """Return the wanted cases that are not recorded, and where and by what code: (host, commit)."""
    importlib.import_module("numba")  # so that `host` counts the kernels' threads
    from ctsim.benchmarks.engine import host
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    at = host.host(), host.commit()  # of the code that is loaded, whatever is committed meanwhile
    path = given.results / NAME
    known = set() if given.force else skipping_tables.known(path, given.size, given.repeats, at)
    return [case for case in wanted if case not in known], at


def _planned(given: Arguments, wanted: tuple[Case, ...]) -> str:
    """Return what --dry-run prints; seconds are from records of this size, else those measured once at core's."""
    from ctsim.benchmarks.engine import costs
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    stored = skipping_tables.latest(skipping_tables.read(given.results / NAME), given.size, CASES)
    usual: dict[Case, float] = SECONDS if given.size == "core" else {}
    once = usual | skipping_tables.seconds(stored)
    n_runs = given.repeats + 1  # the first does not count
    left, _ = _left(given, wanted)
    rows = [(case, f"{n_runs} runs both ways", n_runs * once[case] if case in once else None) for case in left]
    return costs.listing(rows, len(wanted), "cases", "without compiling and preparing (a minute for all cases)")


def _measure(given: Arguments, wanted: tuple[Case, ...]) -> None:
    """Measure the wanted cases that are not recorded; a case is stored as soon as it is measured."""
    from ctsim.benchmarks.engine import lines
    from ctsim.benchmarks.engine.limited import Limited
    from ctsim.benchmarks.studies.skipping import simulator as skipping_cases
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    left, (here, now) = _left(given, wanted)
    began = datetime.now(UTC).isoformat(timespec="microseconds")
    with tempfile.TemporaryDirectory(prefix="ctsim-skipping-") as folder, Limited(given.seconds) as process:
        given.results.mkdir(parents=True, exist_ok=True)
        setup = skipping_cases.Setup(size=given.size, repeats=given.repeats, folder=Path(folder))
        for case in wanted:
            if case not in left:
                sys.stderr.write(f"{case}: recorded already\n")
                continue
            sys.stderr.write(f"{case} …\n")
            measured = _within(process, case, setup)
            time = datetime.now(UTC).isoformat(timespec="seconds")
            records = [
                skipping_tables.SkipRecord(measured=one, size=given.size, host=here, commit=now, time=time, run=began)
                for one in measured
            ]
            lines.append(given.results / NAME, *records)


def _within(process: "Limited", case: Case, setup: "Setup") -> "list[Measured]":
    """Measure a case in the process; what does not end in time, or with which the process dies, has failed."""
    from ctsim.benchmarks.engine.limited import Stopped
    from ctsim.benchmarks.studies.skipping import methods as skipping_methods
    from ctsim.benchmarks.studies.skipping import tables as skipping_tables

    try:
        return process.run(skipping_methods.measured, case, setup)
    except Stopped as end:
        return [skipping_tables.failed(case, end.status, str(end))]
