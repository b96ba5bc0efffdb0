"""`run-benchmark validate RESULTS`: the physics of ctsim against published numbers, closed forms and Monte Carlo."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import OK, Record, Task
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.validate.finding import Check

Case = Literal[
    "attenuation", "absorption", "spectra", "energies", "chords", "primary", "noise", "tg195-1", "tg195-2", "tg195-4",
    "lung-Fe", "teeth-Ti", "head", "recovered", "paper",
]  # fmt: skip
GROUPS: dict[str, tuple[str, ...]] = {
    "materials": ("attenuation", "absorption"),
    "tube": ("spectra",),
    "projector": ("energies", "chords", "primary"),
    "noise": ("noise",),
    "transport": ("tg195-1", "tg195-2", "tg195-4"),
    "scatter": ("lung-Fe", "teeth-Ti", "head"),
    "recovered": ("recovered",),
    "paper": ("paper",),
}
ABOUT = {
    "materials": "Attenuation and energy absorption against NIST's tables; the worst of eight energies, 10 to 150 keV.",
    "tube": "Spectra against SpekPy; the half-value layers of SpekPy itself depend on the width of its bins.",
    "projector": "Gauss nodes against the fine spectrum, chords against closed forms, primary photons of the Monte "
    "Carlo against the projector.",
    "noise": "One draw a pixel against a compound Poisson draw: photons of every energy, each absorbed or not.",
    "transport": "Photon transport against AAPM TG-195: absorbed energy and half-value layers.",
    "scatter": "Constant (level 1) and series of Monte Carlo images (level 3) against long runs of other streams, on "
    "scenes that nobody fitted. The reference's own noise is subtracted in quadrature; the source column states it.",
    "recovered": "Attenuation at 50 keV that reconstructions give back, against NIST.",
    "paper": "−log projections of three aluminium rods in water, against Monte Carlo scatter, the analytic primary and "
    "the noise of 1e9 photons. What the number without scatter measures is the scatter that is missing.",
}


@dataclass(frozen=True, kw_only=True)
class Flags(study.Options):
    """Compare the physics of ctsim with published tables, closed forms and long Monte Carlo runs.

    Exit code 1 where a difference exceeds its tolerance. Minutes on two cores.
    """

    results: tyro.conf.Positional[Path]
    """Folder for records, table and figures; created if missing."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[Case, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case, such as spectra or tg195-2; may be given several times (default: all)."""
    short: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fewer photons, views and pixels; tolerances that follow from the number of photons are wider."""


# seconds of a case on two cores
SECONDS: dict[str, float] = {
    "attenuation": 0.1, "absorption": 0.1, "spectra": 0.1, "energies": 1.0, "chords": 0.5, "primary": 20.0,
    "noise": 7.0, "tg195-1": 0.1, "tg195-2": 7.0, "tg195-4": 10.0, "lung-Fe": 45.0, "teeth-Ti": 60.0, "head": 60.0,
    "recovered": 40.0, "paper": 60.0,
}  # fmt: skip


class Validate(study.Study[Record[Check], Flags]):
    """The study."""

    name = file = "validate"
    unit = "case"
    kind, record, flags = Check, Record[Check], Flags
    work = "ctsim.benchmarks.studies.validate.cases:measure"
    isolated = True

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each case, group by group."""
        code, size = host.commit(), "short" if given.short else "full"
        wanted = dict.fromkeys(given.case) or get_args(Case)
        every = [(group, case) for group, cases in GROUPS.items() for case in cases]
        return [
            Task(study=self.name, part=size, case=case, subject=group, code=code, place=(place,))
            for place, (group, case) in enumerate(every)
            if case in wanted
        ]

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a task has the size asked for."""
        return task.part == ("short" if given.short else "full")

    def expected(self, task: Task, given: Flags) -> float | None:
        """Return the seconds of a case, from `SECONDS`."""
        return None if given.short else SECONDS.get(task.case)

    def took(self, record: Record[Check], given: Flags) -> float | None:
        """Return the seconds that the case took."""
        return sum(second for f in record.found for seconds in f.seconds.values() for second in seconds) or None

    def tables(self, records: Sequence[Record[Check]], given: Flags) -> list[Table]:
        """Return a table for each group, with a row for each check."""
        return [
            simple(
                list(COLUMNS),
                [[cell(r.task.case, f) for cell in COLUMNS.values()] for r in of for f in r.found],
                numbers=("ours", "reference", "difference"),
                title=group,
                caption=ABOUT.get(group, ""),
            )
            for group, of in by_group(records).items()
        ]

    def draw(self, records: Sequence[Record[Check]], given: Flags) -> None:
        """Draw one figure for each group."""
        from ctsim.benchmarks.studies.validate.figure import save_figure

        for group, of in by_group(records).items():
            save_figure([f for r in of for f in r.found], group, self.folder(given) / f"{self.file}-{group}.png")


def by_group(records: Sequence[Record[Check]]) -> dict[str, list[Record[Check]]]:
    """Return the records of each group, in their order."""
    found: dict[str, list[Record[Check]]] = {}
    for record in records:
        found.setdefault(record.task.subject, []).append(record)
    return found


COLUMNS: dict[str, Callable[[str, Check], str]] = {
    "case": lambda case, _: case,
    "quantity": lambda _, f: f"{f.quantity} ({f.unit})" if f.unit else f.quantity or "–",
    "ours": lambda _, f: _number(f.ours) if f.status == OK else f"{f.status}: {f.reason}",
    "reference": lambda _, f: _number(f.reference),
    "difference": lambda _, f: _amount(f.difference, f.relative, signed=True),
    "tolerance": lambda _, f: _amount(f.tolerance, f.relative) + (f" ({f.why})" if f.why else ""),
    "held": lambda _, f: f.verdict,
    "source": lambda _, f: f.source or "–",
}


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.5g}"


def _amount(value: float | None, relative: bool, *, signed: bool = False) -> str:
    """Return a difference or tolerance as text: in percent where it is relative."""
    if value is None:
        return "–"
    sign = "+" if signed else ""
    if not relative:
        return f"{value:{sign}.3g}"
    return f"{100 * value:{sign}.2g} %"


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every difference is within its tolerance, 1 if one is not or was not measured."""
    return study.main(Validate(), arguments)
