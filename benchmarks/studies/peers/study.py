"""`run-benchmark peers RESULTS`: speed and error side by side with other libraries, in one process, in turns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import Record, Task
from ctsim.benchmarks.engine.table import Table
from ctsim.benchmarks.studies.peers import finding, tables
from ctsim.benchmarks.studies.peers.finding import FULL, SMALL, Measurement
from ctsim.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Flags(study.Flags):
    """Measure speed and error against itk-rtk and XCIST (pip install 'ctsim[peers]'), in one process, in turns.

    Peers that are not installed, or that there is no code for, have a row that says so. The machine should have
    nothing else to do.
    """

    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case (paths, exact, paper, fdk, poly); may be given several times (default: all)."""
    threads: int = 2
    """Threads of every contender; XCIST's voxelised projector has one."""
    small: tyro.conf.FlagCreatePairsOff[bool] = False
    """Tiny grids that prove the command and say nothing about speed; leaves out the case paper."""

    @property
    def part(self) -> str:
        """The size of the grids."""
        return SMALL if self.small else FULL


class Peers(study.Study[Record[Measurement], Flags]):
    """The study. A task is a case: its contenders run in turns, so all are measured together."""

    name = file = "peers"
    unit = "case"
    kind, record, flags = Measurement, Record[Measurement], Flags
    work = "ctsim.benchmarks.studies.peers.cases:measure"
    estimate = "with what is prepared and checked, next to both peers"

    def check(self, given: Flags) -> None:
        """Set the threads, here and for processes started from here. Raises InputError for less than one."""
        if given.threads < 1:
            raise InputError(f"--threads must be at least 1, got {given.threads}")
        host.use_threads(given.threads)

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each case asked for, all that have grids of this size where none is named."""
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
        """Whether a task has grids of the size that was asked for."""
        return task.part == given.part

    def runs(self, task: Task, given: Flags) -> int:
        """Return --repeats for cases that are measured in turns, else 1."""
        return given.repeats if finding.case(task.case).turn else 1

    def expected(self, task: Task, given: Flags) -> float | None:
        """Return what the catalogue expects on full grids."""
        case = finding.case(task.case)
        return None if given.small else case.turn * (given.repeats + 1) + case.rest

    def took(self, record: Record[Measurement], given: Flags) -> float | None:
        """Return the seconds of the recorded turns, and on full grids what the catalogue expects of the rest."""
        case = finding.case(record.task.case)
        turns = super().took(record, given) if case.turn else 0.0
        return turns if given.small or turns is None else turns + case.rest

    def tables(self, records: Sequence[Record[Measurement]], given: Flags) -> list[Table]:
        """Return the measurements, and on full grids what they say about the targets."""
        found = [tables.measured(records, given.part)]
        return found if given.small else found + tables.judged(records)


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every case was measured, 1 if one failed."""
    return study.main(Peers(), arguments)
