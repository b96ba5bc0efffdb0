"""`run-benchmark stress OUT`: what is hard on the numbers, each case with an expected outcome.

Rows go to OUT/stress.jsonl as they end, the table to OUT/stress.md. A row that was as expected is not run again while
its sources stay as they are.
"""

import dataclasses
import difflib
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.benchmarks.studies.stress.cases import Case
    from ctsim.benchmarks.studies.stress.tables import StressRecord

# estimates of a row on one idle core, short and full, from runs beside other work
SECONDS = {"simulator": (0.3, 0.6), "splat kernels": (0.1, 0.1)}
SECONDS_OF_METHOD = (0.2, 0.5)
CATALOGUE = "ctsim.benchmarks.studies.stress.study"
"""The module whose `catalogue` the process that carries out the cases asks, with suite and methods."""


@dataclasses.dataclass(frozen=True)
class Arguments:
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
    """Scenes for the methods in place of the bundled ones; docs/stability.md says what a file may hold."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only the rows of this method, such as fdk, or of module:function of your own; may be given several times
    (default: all methods, simulator and splat kernels)."""
    seconds: float = 120.0
    """Time limit of one row, compilation included."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run again what was as expected."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """List the rows and what they are expected to cost, running nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the table from the newest record of each row, running nothing."""
    collect: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")] = ()
    """Take over what these results folders of other machines have and RESULTS lacks, then only render the table."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every row is as expected, 1 if one is not."""
    from ctsim.benchmarks.engine.limited import refuse_unless_positive

    given = tyro.cli(Arguments, prog="run-benchmark stress", args=argv)
    refuse_unless_positive(given.seconds)
    from ctsim.benchmarks.engine import lines
    from ctsim.benchmarks.studies.stress import tables as stress_records
    from ctsim.benchmarks.studies.stress.cases import FULL, SHORT

    side = SHORT if given.short else FULL
    cases = _chosen(catalogue(given.suite, given.method), given.case)
    wanted = [stress_records.identity_of(c, side) for c in cases]
    path = given.results / stress_records.NAME
    lines.take_over(path, given.collect, stress_records.StressRecord, stress_records.A_ROW, dry_run=given.dry_run)
    stored = stress_records.read(path)
    found = stress_records.latest(stored, wanted)
    done = set() if given.force else {r.identity for r in found if r.ok}
    left = [c for c, identity in zip(cases, wanted, strict=True) if identity not in done]
    if given.dry_run:
        _list(left, len(cases), short=given.short)
        return 0
    if given.table or given.collect:
        shown = stress_records.newest(stored, [(c.name, c.subject) for c in cases], side)
        if old := sum(r.identity not in wanted for r in shown):
            sys.stderr.write(f"{path}: {old} of {len(shown)} rows are of other sources than those that are here\n")
        return _report(shown, given)
    given.results.mkdir(parents=True, exist_ok=True)
    _work(left, side, given)
    return _report(stress_records.latest(stress_records.read(path), wanted), given)


def catalogue(suite: Path | None = None, methods: tuple[str, ...] = ()) -> "list[Case]":
    """Return all cases, those of methods with the scenes of a file; only those of `methods` where any are named.

    Raises InputError for a file that is wrong and a method that does not exist.
    """
    from ctsim.benchmarks.studies.stress import chain as stress_chain
    from ctsim.benchmarks.studies.stress import methods as stress_methods
    from ctsim.benchmarks.studies.stress import simulator as stress_simulator
    from ctsim.benchmarks.studies.stress import splats as stress_splats

    own, of_methods = stress_simulator.cases() + stress_splats.cases(), stress_methods.cases(suite, methods)
    subjects = {c.subject for c in of_methods}
    chain = [c for c in stress_chain.cases() if c.subject in subjects]
    return chain + of_methods if methods else own + chain + of_methods


def _chosen(cases: "list[Case]", names: Sequence[str]) -> "list[Case]":
    known = list(dict.fromkeys(c.name for c in cases))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else f"expected one of {', '.join(known)}"
            raise InputError(f"--case {name!r}: {hint}")
    return [c for c in cases if not names or c.name in names]


def _work(left: "list[Case]", side: int, given: Arguments) -> None:
    """Carry out the rows that are left; each is stored as it ends."""
    from tqdm import tqdm

    from ctsim.benchmarks.engine import host, lines
    from ctsim.benchmarks.studies.stress import tables as stress_records
    from ctsim.benchmarks.studies.stress.worker import Worker

    commit, machine = host.commit(), host.host()  # of the code that is loaded, whatever is committed meanwhile
    asked = (given.suite, given.method)
    with Worker(CATALOGUE, given.seconds, *asked) as worker, tqdm(left, unit="row", disable=not left) as bar:
        for case in bar:
            bar.set_postfix_str(f"{case.name}, {case.subject}")
            outcome = worker.run(case, side)
            by = (machine, commit, datetime.now(UTC).isoformat(timespec="seconds"))
            lines.append(given.results / stress_records.NAME, stress_records.record_of(case, side, outcome, by))
            if not outcome.ok:
                tqdm.write(f"{case.name}, {case.subject}: {outcome.found}", file=sys.stderr)


def _report(found: "list[StressRecord]", given: Arguments) -> int:
    """Write the table and say what is not as expected; return the exit code."""
    from ctsim.benchmarks.studies.stress import tables as stress_records

    path = given.results / stress_records.TABLE_NAME
    if not found:
        raise InputError(f"{path.with_name(stress_records.NAME)}: there are no such records; run without --table first")
    path.write_text(stress_records.render(found), encoding="utf-8")
    wrong = [r for r in found if not r.ok]
    for r in wrong:
        sys.stdout.write(f"NOT AS EXPECTED: {r.case}, {r.subject}: {r.found}\n")
    sys.stdout.write(f"{len(found) - len(wrong)} of {len(found)} rows are as expected. Written: {path}\n")
    return 1 if wrong else 0


def _list(left: "list[Case]", n_all: int, *, short: bool) -> None:
    """Print the rows that would run, case by case, and their cost."""
    by_case: dict[str, list[Case]] = {}
    for case in left:
        by_case.setdefault(case.name, []).append(case)
    for name, rows in by_case.items():
        seconds = _cost(rows, short=short)
        subjects = ", ".join(c.subject for c in rows)
        sys.stdout.write(f"{name:20s} {len(rows):3d} rows {seconds:6.1f} s  {rows[-1].what}: {subjects}\n")
    total = _cost(left, short=short)
    sys.stdout.write(
        f"{len(left)} of {n_all} rows to run, about {total:.0f} s on one idle core; compiling takes a minute, once\n"
    )


def _cost(rows: "list[Case]", *, short: bool) -> float:
    """Return the seconds that rows took on one idle core, compilation apart."""
    return sum(SECONDS.get(c.subject, SECONDS_OF_METHOD)[0 if short else 1] for c in rows)
