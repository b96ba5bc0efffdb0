"""`run-benchmark skipping RESULTS`: what is left out, what that saves, and how far the results are apart.

Records go to RESULTS/skipping.jsonl, one line a pair as it is measured; the table, RESULTS/skipping.md, shows the
newest of each case, so that cases can be measured one by one.
"""

import dataclasses
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from ctsim.errors import InputError

if TYPE_CHECKING:
    from benchmarks.skipping_tables import SkipRecord

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


def main(argv: list[str]) -> int:
    """Run the command; 0 if every difference is within what is stated, 1 if one is not."""
    given = tyro.cli(Arguments, prog="run-benchmark skipping", args=argv)
    if given.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {given.repeats}")
    given.results.mkdir(parents=True, exist_ok=True)
    from benchmarks import skipping_tables

    with tempfile.TemporaryDirectory(prefix="ctsim-skipping-") as folder:
        found = _measure(given, Path(folder))
    stored = skipping_tables.latest(skipping_tables.read(given.results / NAME), given.size, CASES)
    text = skipping_tables.render(stored)
    (given.results / "skipping.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text + f"\nWritten: {given.results}/skipping.md; records in {NAME}\n")
    return 0 if all(record.measured.held for record in found) else 1


def _measure(given: Arguments, folder: Path) -> "list[SkipRecord]":
    """Measure case by case; what is measured is stored at once."""
    from benchmarks import host, skipping_cases, skipping_methods, skipping_tables

    setup = skipping_cases.Setup(size=given.size, repeats=given.repeats, folder=folder)
    cases = skipping_cases.CASES | skipping_methods.CASES
    found = []
    host.commit()  # remembered: the code that is loaded, whatever is committed meanwhile
    began = datetime.now(UTC).isoformat(timespec="microseconds")
    for case in tuple(dict.fromkeys(given.case)) or CASES:
        sys.stderr.write(f"{case} …\n")
        for pair in cases[case](setup):
            record = skipping_tables.SkipRecord(
                measured=pair.measure(given.repeats),
                size=given.size,
                host=host.host(),
                commit=host.commit(),
                time=datetime.now(UTC).isoformat(timespec="seconds"),
                run=began,
            )
            skipping_tables.append(given.results / NAME, record)
            found.append(record)
    return found
