"""`run-benchmark skipping RESULTS`: what ctsim leaves out, the time this saves, and the difference of the results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Literal, get_args

import tyro

from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import OK, Found, Record, Task
from ctsim.benchmarks.engine.table import Table, simple

CORE = "core"  # the size to measure speed at
Case = Literal[
    "materials", "bricks", "rays", "layers", "energies", "edges", "refining", "scatter", "blurs", "twin",
    "truth", "variants", "metal-free", "rows", "scan", "record",
]  # fmt: skip
# seconds of one run both ways at size core, on two idle cores (docs/measured/skipping.md)
SECONDS: dict[str, float] = {
    "materials": 0.46, "bricks": 1.1, "rays": 10.3, "layers": 1.7, "energies": 0.63, "edges": 2.0, "refining": 1.6,
    "scatter": 0.45, "blurs": 9.0, "twin": 2.6, "truth": 0.49, "variants": 250.0, "metal-free": 4.4,
    "rows": 2.0, "scan": 6.7, "record": 4.8,
}  # fmt: skip


class Skip(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One skip: seconds "skipping" and "whole", run by run in pairs, and the largest difference of the results.

    `difference` is in `unit`, None where it is not finite; `limit` is the largest allowed, as `stated` says, None where
    the results are meant to differ.
    """

    scene: str = ""
    what: str = ""
    difference: float | None = None
    unit: str = ""
    limit: float | None = None
    stated: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        pairs = [self.seconds.get(way, ()) for way in ("skipping", "whole")]
        if self.seconds and not (len(self.seconds) == 2 and len(pairs[0]) == len(pairs[1]) > 0):
            raise ValueError('seconds must be as many for "skipping" as for "whole", and for nothing else')
        if not all(second > 0 for seconds in pairs for second in seconds):
            raise ValueError("seconds must be positive")

    @property
    def gain(self) -> float:
        """Time without the skip over time with it: the median over pairs of neighbouring runs."""
        return median(b / a for a, b in zip(self.seconds["skipping"], self.seconds["whole"], strict=True))


@dataclass(frozen=True, kw_only=True)
class Flags(study.Flags):
    """Measure each thing that ctsim leaves out: the time with and without it, and the largest difference in the result.

    Exit code 1 where a difference exceeds its stated limit or a case did not end. Run nothing else on the machine
    meanwhile.
    """

    case: Annotated[tyro.conf.UseAppendAction[tuple[Case, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case, such as energies or metal-free; may be given several times (default: all)."""
    size: Literal["core", "small"] = CORE
    """Scene lung-Fe of the suite core, or tiny grids that prove the command and say nothing about speed."""


class Skipping(study.Study[Record[Skip], Flags]):
    """The study."""

    name = file = "skipping"
    unit = "case"
    kind, record, flags = Skip, Record[Skip], Flags
    work = "ctsim.benchmarks.studies.skipping.methods:measure"
    isolated = True
    estimate = "without compiling and preparing (a minute for all cases)"

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each case."""
        code, machine = host.commit(), self.machine(given)
        cases = dict.fromkeys(given.case) or get_args(Case)
        return [
            Task(study=self.name, part=given.size, case=case, code=code, machine=machine, place=(place,))
            for place, case in enumerate(get_args(Case))
            if case in cases
        ]

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a task has the size asked for."""
        return task.part == given.size

    def expected(self, task: Task, given: Flags) -> float | None:
        """Return the seconds at size core, from `SECONDS`."""
        return SECONDS[task.case] * (given.repeats + 1) if given.size == CORE else None

    def tables(self, records: Sequence[Record[Skip]], given: Flags) -> list[Table]:
        """Return one table with a row for each pair."""
        least = min((r.repeats for r in records if r.finished), default=0)
        caption = (
            f"Size {given.size}. Medians of {least} or more interleaved runs; the gain is the median over pairs of the "
            "time without the skip over that with it."
        )
        if given.size != CORE:
            caption += " Grids this small are all overhead: they prove the command, not what a skip is worth."
        rows = [[cell(r.task.case, f) for cell in COLUMNS.values()] for r in records for f in r.found]
        return [simple(list(COLUMNS), rows, numbers=("with (s)", "without (s)", "gain"), caption=caption)]


COLUMNS: dict[str, Callable[[str, Skip], str]] = {
    "case": lambda case, _: case,
    "what is left out": lambda _, f: f.what or "–",
    "scene": lambda _, f: f.scene or "–",
    "with (s)": lambda _, f: f"{median(f.seconds['skipping']):.4f}" if f.seconds else "–",
    "without (s)": lambda _, f: f"{median(f.seconds['whole']):.4f}" if f.seconds else "–",
    "gain": lambda _, f: f"{f.gain:.2f}" if f.seconds else "–",
    "largest difference": lambda _, f: _difference(f),
    "allowed": lambda _, f: f.stated or "–" if not f.limit else f"≤ {f.limit:.2g} ({f.stated})",
    "held": lambda _, f: "NO" if not f.ok else "–" if f.limit is None else "yes",
    "note": lambda _, f: f.note if f.status == OK else f"{f.status}: {f.reason}",
}


def _difference(f: Skip) -> str:
    if f.status != OK:
        return "–"
    return "not finite" if f.difference is None else f"{f.difference:.2g} {f.unit}" if f.difference else "0"


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every difference is within its limit, 1 if one is not or was not measured."""
    return study.main(Skipping(), arguments)
