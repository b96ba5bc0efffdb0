"""`run-benchmark pareto RESULTS`: error against run time, of the simulator's choices and of every method's effort.

Every timed run is a record. Tasks are timed in turns, once each a round, so that a drift of the machine meets all
alike; times are medians over the rounds. The tables and the figure show the points, their Pareto front and its knee.
All runs share one process, which is replaced where a run exceeds its time limit.
"""

import contextlib
import pkgutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import msgspec
import tyro

from ctsim.benchmarks import suites
from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import Record, Task
from ctsim.benchmarks.engine.table import Table
from ctsim.benchmarks.methods import code_version, find
from ctsim.benchmarks.studies.pareto import suite, tables
from ctsim.benchmarks.studies.pareto.choices import Choice, Effort, choices, efforts
from ctsim.benchmarks.studies.pareto.finding import Part, Run, Timed, points
from ctsim.errors import InputError
from ctsim.human import human_choice
from ctsim.manifest import read_manifest

if TYPE_CHECKING:
    from ctsim.phantoms.scene import Scene

HERE = "ctsim.benchmarks.studies.pareto"
RODS = "rods"
VERSION = 2  # of what is measured
RAY = 6.2e-7  # seconds of the simulator for a pixel of a view by default, on two cores (docs/pareto.md)


@dataclass(frozen=True, kw_only=True)
class Flags(study.Flags):
    """Measure error against run time: the simulator over its choices, every method over its own effort.

    Runs are measured again where code, data, machine or threads have changed. The machine should have nothing else to
    do.
    """

    part: Annotated[tuple[Part, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PART")] = ()
    """Only this part, simulator or methods (default: both)."""
    scene: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times. The simulator has rods, methods those of the dataset (lung-Fe)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """What to measure: a TOML file with tables of your own over those of benchmarks/suites/pareto.toml."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this method, or module:function of your own; may be given several times (default: all of --suite)."""
    repeats: int = 3
    """Rounds: timed runs of each setting; tables show medians."""
    threads: int = 2
    """Threads of the kernels."""


class Pareto(study.Study[Record[Run], Flags]):
    """The study."""

    name = file = "pareto"
    unit = "run"
    kind, record, flags = Run, Timed, Flags
    work = f"{HERE}.worker:measure"
    apart = rounds = True
    estimate = "without compiling, planning and the reference"

    def check(self, given: Flags) -> None:
        """Require threads, and let the kernels have them."""
        if given.threads < 1:
            raise InputError(f"--threads must be at least 1, got {given.threads}")
        host.use_threads(given.threads)

    def prepare(self, given: Flags) -> None:
        """Make the scans that are missing, if all that is asked for is there."""
        if scenes := asked(given)[2]:
            pkgutil.resolve_name(f"{HERE}.worker:make_scans")(scenes, given.results / "data")

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each choice of the simulator, and for each run of a method on each scene."""
        simulated, runs, scenes = asked(given)
        size = suite.load(given.suite).simulator
        protocol = pkgutil.resolve_name("ctsim.benchmarks.scores.protocol:VERSION")
        found = [(RODS, f"{size.side}² pixels, {size.views} views", choice) for choice in simulated]
        for scene in scenes:
            folder = given.results / "data" / scene.name
            known = f"{read_manifest(folder).content_hash}, protocol {protocol}" if folder.exists() else ""
            found += [(scene.name, known, effort) for effort in runs]
        machine, cases = self.machine(given), [RODS, *(scene.name for scene in scenes)]
        return [
            Task(
                study=self.name,
                part="simulator" if isinstance(choice, Choice) else "methods",
                case=case,
                subject=f"{choice.curve}, {choice.label}",
                settings=msgspec.to_builtins(choice),
                data=data,
                code=code_version("ctsim.simulate") if isinstance(choice, Choice) else find(choice.method).code,
                machine=machine,
                version=VERSION,
                place=(cases.index(case), number),
            )
            for number, (case, data, choice) in enumerate(found)
        ]

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a record is of this version."""
        return task.version == VERSION

    def pending(self, tasks: Sequence[Task], records: Sequence[Record[Run]], given: Flags) -> list[Task]:
        """Return the runs that are not recorded: all rounds of a scene before the next one's, which is opened once."""
        return sorted(super().pending(tasks, records, given), key=lambda task: task.place[:1])

    def expected(self, task: Task, given: Flags) -> float:
        """Return about how many seconds a run takes: each choice of the simulator about as many as the default."""
        asked = suite.load(given.suite)
        if task.part == "simulator":
            return RAY * asked.simulator.side**2 * asked.simulator.views
        (scene,) = suites.select(suites.load(asked.dataset.suite), (task.case,), ())
        effort = msgspec.convert(task.settings, Effort)
        return pkgutil.resolve_name(f"{HERE}.worker:expected")(effort, scene)

    def took(self, record: Record[Run], given: Flags) -> float:
        """Return the seconds of a run, which ended with its last mark."""
        return max((mark.seconds for run in record.found for mark in run.marks), default=0.0)

    def line(self, task: Task) -> tuple[str, str]:
        """Return a scene and a curve."""
        return f"{task.part} {task.case}", task.settings["curve"]

    def tables(self, records: Sequence[Record[Run]], given: Flags) -> list[Table]:
        """Return the fronts, the defaults and each curve's knee."""
        return tables.summary(records)

    def details(self, records: Sequence[Record[Run]], given: Flags) -> list[Table]:
        """Return every point."""
        return tables.every_point(records)

    def code(self, tasks: Sequence[Task], records: Sequence[Record[Run]], given: Flags) -> int:
        """Return the exit code: 1 if a run that was asked for failed, 0 with --table."""
        return super().code(tasks, records, given) if tasks else 0

    def write(self, records: Sequence[Record[Run]], given: Flags) -> str:
        """Write the tables and draw the figure."""
        text = super().write(records, given)
        if drawn := points(self.shown(records)):
            picture = given.results / "pareto.png"
            pkgutil.resolve_name(f"{HERE}.figure:save")(drawn, picture)
            text += f"Figure: {picture}\n"
        return text


def asked(given: Flags) -> "tuple[list[Choice], list[Effort], list[Scene]]":
    """Return the simulator's choices, the methods' runs and their scenes that the flags ask for.

    Raises InputError for a method, a parameter or a scene that there is not.
    """
    wanted, parts = suite.load(given.suite), given.part or get_args(Part)
    with _where(f"{given.suite}: dataset.suite: "):
        scenes = {scene.name: scene for scene in suites.load(wanted.dataset.suite)}
    for name in wanted.dataset.scenes:
        if name not in scenes:
            expected = human_choice(list(scenes), name)
            raise InputError(f"{given.suite}: dataset.scenes: there is no {name!r}, expected one of {expected}")
    known: dict[Part, list[str]] = {"simulator": [RODS], "methods": list(scenes)}
    for name in given.scene:
        if not any(name in known[part] for part in parts):
            expected = "; ".join(f"{part}: {human_choice(known[part], name)}" for part in parts)
            raise InputError(f"--scene {name!r}: there is no such scene, expected one of {expected}")
    chosen = given.scene or (RODS, *(wanted.dataset.scenes or scenes))
    simulated = choices(wanted.simulator) if "simulator" in parts and RODS in chosen else []
    runs: list[Effort] = []
    for name in given.method or [listed.name for listed in wanted.method]:
        with _where(f"{given.suite}: " if given.suite and wanted.listed(name) else ""):
            runs += efforts(wanted, name) if "methods" in parts else []
    return simulated, runs, [scene for name, scene in scenes.items() if name in chosen and runs]


@contextlib.contextmanager
def _where(text: str) -> Iterator[None]:
    """Say in an InputError first where that is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{text}{error}") from None


def main(arguments: list[str]) -> int:
    """Run the command; return 0 if every setting was measured or skipped with a reason, 1 if one failed."""
    return study.main(Pareto(), arguments)
