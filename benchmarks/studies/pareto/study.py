"""`run-benchmark pareto RESULTS`: error against run time, over the simulator's settings and every method's effort.

Every timed run is a record. Each round times every task once, so that a drift of the machine affects all tasks alike;
times are medians over the rounds. The tables and the figure show the points, their Pareto front and its knee. All runs
share one process, which is replaced where a run exceeds its time limit.
"""

import contextlib
import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

import msgspec

from ctsim.benchmarks import suites
from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import Record, Task
from ctsim.benchmarks.engine.table import Table
from ctsim.benchmarks.engine.terminal import Bar
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.scores import score
from ctsim.benchmarks.studies.methods import run
from ctsim.benchmarks.studies.pareto import Flags, results, suite
from ctsim.benchmarks.studies.pareto.finding import Part, Timed, TimedRun, points
from ctsim.benchmarks.studies.pareto.suite import Choice, Effort
from ctsim.dataset.folder import is_complete
from ctsim.dataset.manifest import read_manifest
from ctsim.dataset.versions import code_version
from ctsim.errors import InputError
from ctsim.human import human_choice
from ctsim.phantoms.dataset import make_scene
from ctsim.phantoms.scene import Scene, scene_id

RODS = "rods"
T = TypeVar("T")
VERSION = 2  # of the measurement
RAY = 6.2e-7  # seconds per pixel and view of the simulator's defaults, on two cores (docs/measured/pareto.md)


class Pareto(study.Study[Record[TimedRun], Flags]):
    """The study."""

    name = file = "pareto"
    unit = "run"
    kind, record, flags = TimedRun, Timed, Flags
    work = "ctsim.benchmarks.studies.pareto.measure:measure"
    isolated = rounds = True
    estimate = "without compiling, planning and the reference"

    def check(self, given: Flags) -> None:
        """Require at least one thread; set the kernels' threads."""
        if given.threads < 1:
            raise InputError(f"--threads must be at least 1, got {given.threads}")
        host.use_threads(given.threads)

    def prepare(self, given: Flags) -> None:
        """Make the missing scans, after checking scenes and methods."""
        data, scenes = given.results / "data", scenes_of(given)
        for scene in scenes if efforts_of(given) else ():
            if not is_complete(data, scene.name, scene_id(scene)):
                make_scene(scene, data, watch=functools.partial(_watched, scene.name))

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each setting of the simulator, and for each run of a method on each scene."""
        asked, scenes, runs = suite.load(given.suite), scenes_of(given), efforts_of(given)
        size = f"{asked.simulator.side}² pixels, {asked.simulator.views} views"
        simulated = "simulator" in given.parts and (not given.scene or RODS in given.scene)
        found = [(RODS, size, choice) for choice in (suite.choices(asked.simulator) if simulated else ())]
        scored = f"protocol {score.VERSION}" + ", aligned" * asked.dataset.aligned
        for scene in scenes:
            folder = given.results / "data" / scene.name
            known = f"{read_manifest(folder).content_hash}, {scored}" if folder.exists() else ""
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

    def pending(self, tasks: Sequence[Task], records: Sequence[Record[TimedRun]], given: Flags) -> list[Task]:
        """Return the runs without a record, scene by scene, so that each scene is opened once."""
        return sorted(super().pending(tasks, records, given), key=lambda task: task.place[:1])

    def expected(self, task: Task, given: Flags) -> float:
        """Estimate a run's seconds: of a method from FDK's time on this machine, of the simulator from `RAY`."""
        asked = suite.load(given.suite)
        if task.part == "simulator":
            return RAY * asked.simulator.side**2 * asked.simulator.views
        (scene,) = suites.select(suites.load(asked.dataset.suite), (task.case,), ())
        effort, geometry = msgspec.convert(task.settings, Effort), scene.resolve().geometry
        fdks = run.in_fdks(find(effort.method, effort.changes), geometry) or run.UNKNOWN
        return fdks * run.fdk_seconds(geometry)

    def took(self, record: Record[TimedRun], given: Flags) -> float:
        """Return the seconds of a run: those of its last mark."""
        return max((mark.seconds for found in record.found for mark in found.marks), default=0.0)

    def line(self, task: Task) -> tuple[str, str]:
        """Return a scene and a curve."""
        return f"{task.part} {task.case}", task.settings["curve"]

    def tables(self, records: Sequence[Record[TimedRun]], given: Flags) -> list[Table]:
        """Return the fronts, the defaults and each curve's knee."""
        return results.summary(records)

    def details(self, records: Sequence[Record[TimedRun]], given: Flags) -> list[Table]:
        """Return every point."""
        return results.every_point(records)

    def code(self, tasks: Sequence[Task], records: Sequence[Record[TimedRun]], given: Flags) -> int:
        """Return 1 if a run that was asked for failed, else 0; always 0 with --table."""
        return super().code(tasks, records, given) if tasks else 0

    def write(self, records: Sequence[Record[TimedRun]], given: Flags) -> str:
        """Write the tables and draw the figure."""
        text = super().write(records, given)
        if drawn := points(self.shown(records)):
            picture = given.results / "pareto.png"
            results.save_figure(drawn, picture)
            text += f"Figure: {picture}\n"
        return text


def _watched(name: str, views: Iterable[T], first: int, n_views: int) -> Iterator[T]:
    """Yield the views of a scan, with a progress bar."""
    with Bar(n_views, "view", first) as bar:
        yield from bar.over(views, name)


def scenes_of(given: Flags) -> list[Scene]:
    """Return the scenes for the methods. Raises InputError for an unknown scene."""
    dataset = suite.load(given.suite).dataset
    with _where(f"{given.suite}: dataset.suite: "):
        scenes = {scene.name: scene for scene in suites.load(dataset.suite)}
    for name in dataset.scenes:
        if name not in scenes:
            expected = human_choice(scenes, name)
            raise InputError(f"{given.suite}: dataset.scenes: there is no {name!r}, expected one of {expected}")
    known: dict[Part, list[str]] = {"simulator": [RODS], "methods": list(scenes)}
    for name in given.scene:
        if not any(name in known[part] for part in given.parts):
            expected = "; ".join(f"{part}: {human_choice(known[part], name)}" for part in given.parts)
            raise InputError(f"--scene {name!r}: there is no such scene, expected one of {expected}")
    chosen = given.scene or dataset.scenes or scenes
    return [scene for name, scene in scenes.items() if name in chosen and "methods" in given.parts]


def efforts_of(given: Flags) -> list[Effort]:
    """Return the runs of methods on a scene. Raises InputError for an unknown method or parameter."""
    asked, runs = suite.load(given.suite), []
    for name in given.method or [listed.name for listed in asked.method]:
        with _where(f"{given.suite}: " if given.suite and asked.listed(name) else ""):
            runs += suite.efforts(asked, name) if "methods" in given.parts else []
    return runs


@contextlib.contextmanager
def _where(text: str) -> Iterator[None]:
    """Put `text`, the place of the fault, before the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{text}{error}") from None


def main(arguments: list[str]) -> int:
    """Run the command; return 0 if every setting was measured or skipped with a reason, 1 if one failed."""
    return study.main(Pareto(), arguments)
