"""`run-benchmark skipping RESULTS`: what is left out, what that saves, and how far the results are apart.

Records go to RESULTS/skipping.jsonl case by case; the table, RESULTS/skipping.md, shows the newest of each case, so
that cases can be measured one by one. What this commit recorded on this machine is not measured again.
"""

import dataclasses
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from ctsim.errors import InputError

Case = Literal[
    "materials", "bricks", "rays", "energies", "edges", "scatter", "twin", "truth",
    "metal-free", "rows", "scan", "record",
]  # fmt: skip
CASES: tuple[Case, ...] = get_args(Case)
NAME = "skipping.jsonl"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure everything that is left out: the time with and without it, and the largest difference of the result.

    Exit code 1 where a difference exceeds what is stated of it. The machine should have nothing else to do.
    """

    results: tyro.conf.Positional[Path]
    """The folder for skipping.jsonl and skipping.md; made if it is not there."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[Case, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case, such as energies or metal-free; may be given several times (default: all)."""
    repeats: int = 5
    """Counted runs with and without each skip; the table shows medians."""
    size: Literal["core", "small"] = "core"
    """The scene lung-Fe of the suite core, or tiny grids that prove the command and say nothing about speed."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure again what is recorded of this commit on this machine."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every difference is within what is stated, 1 if one is not."""
    given = tyro.cli(Arguments, prog="run-benchmark skipping", args=argv)
    if given.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {given.repeats}")
    given.results.mkdir(parents=True, exist_ok=True)
    from benchmarks import skipping_tables

    wanted = tuple(dict.fromkeys(given.case)) or CASES
    with tempfile.TemporaryDirectory(prefix="ctsim-skipping-") as folder:
        _measure(given, wanted, Path(folder))
    stored = skipping_tables.latest(skipping_tables.read(given.results / NAME), given.size, CASES)
    text = skipping_tables.render(stored)
    (given.results / "skipping.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text + f"\nWritten: {given.results}/skipping.md; records in {NAME}\n")
    return 0 if all(r.measured.held for r in stored if r.measured.case in wanted) else 1


def _measure(given: Arguments, wanted: tuple[Case, ...], folder: Path) -> None:
    """Measure the wanted cases that are not recorded; a case is stored as soon as it is measured."""
    from benchmarks import host, skipping_cases, skipping_methods, skipping_tables

    path = given.results / NAME
    here, now = host.host(), host.commit()  # of the code that is loaded, whatever is committed meanwhile
    known = set() if given.force else skipping_tables.known(path, given.size, given.repeats, (here, now))
    setup = skipping_cases.Setup(size=given.size, repeats=given.repeats, folder=folder)
    cases = skipping_cases.CASES | skipping_methods.CASES
    began = datetime.now(UTC).isoformat(timespec="microseconds")
    for case in wanted:
        if case in known:
            sys.stderr.write(f"{case}: recorded already\n")
            continue
        sys.stderr.write(f"{case} …\n")
        measured = [pair.measure(given.repeats) for pair in cases[case](setup)]
        time = datetime.now(UTC).isoformat(timespec="seconds")
        for one in measured:
            record = skipping_tables.SkipRecord(
                measured=one, size=given.size, host=here, commit=now, time=time, run=began
            )
            skipping_tables.append(path, record)
