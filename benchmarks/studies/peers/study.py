"""`run-benchmark peers RESULTS`: time and error of ctsim and of other libraries, and whether ctsim meets its targets.

All contenders of a case run in one process, in turns.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, NamedTuple

import tyro

from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import OK, Record, Task, provenance
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.peers import finding
from ctsim.benchmarks.studies.peers.finding import FULL, OURS, SIDES, SMALL, Measurement, versions
from ctsim.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Flags(study.Flags):
    """Measure speed and error against itk-rtk and XCIST (pip install 'ctsim[peers]'), in one process, in turns.

    A peer that is not installed, or that this command has no code for, has a row that says so. Run nothing else on the
    machine meanwhile.
    """

    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case (paths, exact, paper, fdk, poly, row); may be given several times (default: all)."""
    threads: int = 2
    """Threads of every contender; XCIST's voxelised projector has one."""
    small: tyro.conf.FlagCreatePairsOff[bool] = False
    """Tiny grids that prove the command and say nothing about speed; leaves out the cases paper and row."""

    @property
    def part(self) -> str:
        """The size of the grids."""
        return SMALL if self.small else FULL


class Peers(study.Study[Record[Measurement], Flags]):
    """The study. A task is a case, whose contenders run in turns."""

    name = file = "peers"
    unit = "case"
    kind, record, flags = Measurement, Record[Measurement], Flags
    work = "ctsim.benchmarks.studies.peers.cases:measure"
    estimate = "with what is prepared and checked, next to both peers"

    def check(self, given: Flags) -> None:
        """Set the threads of this process and of those it starts. Raises InputError for fewer than one."""
        if given.threads < 1:
            raise InputError(f"--threads must be at least 1, got {given.threads}")
        host.use_threads(given.threads)

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each --case; without --case, for every case that has grids of this size."""
        asked = {finding.case(name) for name in given.case}
        return [
            Task(
                study=self.name,
                part=given.part,
                case=case.name,
                settings={"threads": given.threads, **finding.installed()},
                code=host.commit(),
                machine=host.machine(),
                place=(place,),
            )
            for place, case in enumerate(finding.load().case)
            if case in asked or (not asked and (case.small or not given.small))
        ]

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a task has the grid size asked for."""
        return task.part == given.part

    def runs(self, task: Task, given: Flags) -> int:
        """Return --repeats for a case that is measured in turns, else 1."""
        return given.repeats if finding.case(task.case).turn else 1

    def expected(self, task: Task, given: Flags) -> float | None:
        """Return the catalogue's estimate for full grids."""
        case = finding.case(task.case)
        return None if given.small else case.turn * (given.repeats + 1) + case.rest

    def took(self, record: Record[Measurement], given: Flags) -> float | None:
        """Return the seconds of the recorded turns; on full grids plus the catalogue's estimate of the rest."""
        case = finding.case(record.task.case)
        turns = super().took(record, given) if case.turn else 0.0
        return turns if given.small or turns is None else turns + case.rest

    def tables(self, records: Sequence[Record[Measurement]], given: Flags) -> list[Table]:
        """Return the measurements; on full grids the targets too."""
        found = [measurement_table(records, given.part)]
        return found if given.small else found + target_tables(records)


# --- targets and tables --------------------------------------------------------------------------------

TARGETS: dict[str, dict[str, float]] = {
    "paths": {"time ratio": 0.25},
    "exact": {"relative RMS": 1e-4},
    "paper": {"seconds": 60.0, "peak GB": 2.0},
    "fdk": {"time ratio": 1 / 3, "error ratio": 1.02},  # 2 %: interpolation of the filtered rows may differ
    "poly": {"peak GB": 0.5, "time ratio": 0.2, "error ratio": 0.2},
    "row": {"seconds": 1.0},
}
"""Upper limits of our quantities by case; ratios are to the best peer."""
EXACT = f"{OURS}, exact solids"  # of our contenders in the case `exact`, only this one has a target


class Verdict(NamedTuple):
    """A target: scene, quantity, the value reached, the peer it is relative to (empty: none), and the limit."""

    scene: str
    quantity: str
    value: float
    peer: str
    limit: float

    @property
    def met(self) -> bool:
        """Whether the target is met."""
        return self.value <= self.limit


def verdicts(case: str, found: Sequence[Measurement]) -> list[Verdict]:
    """Compare our contenders with the targets of their case; leave out targets relative to a peer where none is."""
    out: list[Verdict] = []
    done = [m for m in found if m.status == OK]
    for m in done:
        who, _, how = m.contender.partition(", ")
        if who != OURS or (case == "exact" and m.contender != EXACT):
            continue
        peers = [p for p in done if p.scene == m.scene and p.contender.partition(",")[0] != OURS]
        reached, scene = _reached(m, peers), f"{m.scene} ({how})" if how else m.scene
        targets = TARGETS.get(case, {})
        out += [Verdict(scene, what, *reached[what], limit) for what, limit in targets.items() if what in reached]
    return out


def _reached(m: Measurement, peers: Sequence[Measurement]) -> dict[str, tuple[float, str]]:
    """Return our quantities, and the peer each is relative to: the fastest for time, the most accurate for error."""
    out: dict[str, tuple[float, str]] = {}
    if m.runs:
        out["seconds"] = median(m.runs), ""
        if timed := [p for p in peers if p.runs]:
            best = min(timed, key=lambda p: median(p.runs))
            # of neighbouring runs, which see the same drift of the machine
            out["time ratio"] = median(a / b for a, b in zip(m.runs, best.runs, strict=False)), best.contender
    if m.error is not None:
        out["relative RMS"] = m.error, ""
        if errors := {p.contender: p.error for p in peers if p.error}:
            best = min(errors, key=errors.__getitem__)
            out["error ratio"] = m.error / errors[best], best
    if m.peak_bytes is not None:
        out["peak GB"] = m.peak_bytes / 1e9, ""
    return out


def target_tables(records: Sequence[Record[Measurement]]) -> list[Table]:
    """Return the table of targets; no table where no case has a target."""
    rows = [
        (
            *(r.task.case, v.scene, v.quantity, v.peer or "–"),
            *(f"{v.value:.3g}", f"≤ {v.limit:.3g}", "yes" if v.met else "NO"),
        )
        for r in records
        for v in verdicts(r.task.case, r.found)
    ]
    columns = ("case", "scene", "quantity", "best peer", "reached", "target", "met")
    return [simple(columns, rows, numbers=("reached", "target"))] if rows else []


def measurement_table(records: Sequence[Record[Measurement]], part: str) -> Table:
    """Return the table of measurements on grids of one size."""
    caption = (
        f"Grids of side {SIDES[part]}. Medians of interleaved runs; ratios of time are medians over pairs, each to the "
        "peer that is best in that quantity."
    )
    if part != FULL:
        caption += " Grids this small are all overhead: they prove the command, not the speed, and meet no target."
    rows = [[cell(r.task.case, m) for cell in COLUMNS.values()] for r in records for m in r.found]
    return simple(
        list(COLUMNS), rows, numbers=("s", "ms/view", "error", "peak (MB)"), caption=caption, notes=_sources(records)
    )


def _sources(records: Sequence[Record[Measurement]]) -> list[str]:
    """Name the installed peers; where peers, machine or commit differ between cases, name the cases too."""
    groups: dict[str, list[Record[Measurement]]] = {}
    for record in records:
        groups.setdefault(repr((record.host, record.commit, record.task.settings)), []).append(record)
    notes = []
    for group in groups.values():
        peers = ", ".join(f"{name} {version}" for name, version in versions(group[0].task).items()) or "none"
        cases = ", ".join(r.task.case for r in group)
        notes.append(f"{cases}: {provenance(group)} " * (len(groups) > 1) + f"Installed peers: {peers}.")
    return notes


COLUMNS: dict[str, Callable[[str, Measurement], str]] = {
    "case": lambda case, _: case,
    "scene": lambda _, m: m.scene,
    "contender": lambda _, m: m.contender,
    "s": lambda _, m: f"{median(m.runs):.3f}" if m.runs else m.skipped or (m.status if m.status != OK else "–"),
    "ms/view": lambda _, m: f"{1e3 * median(m.runs) / m.views:.2f}" if m.runs else "–",
    "error": lambda _, m: "–" if m.error is None else f"{m.error:.2e} {m.error_kind}",
    "peak (MB)": lambda _, m: "–" if m.peak_bytes is None else f"{m.peak_bytes / 1e6:.0f}",
    "note": lambda _, m: _note(m),
}


def _note(m: Measurement) -> str:
    first = "" if m.warm_up is None else f"first run {m.warm_up:.2f} s"
    return "; ".join(text for text in (m.reason, m.note, first) if text)


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every case was measured, 1 if one failed."""
    return study.main(Peers(), arguments)
