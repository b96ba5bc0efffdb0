"""`run-benchmark detect RESULTS`: how well a model observer detects lesions near metal, by method."""

import sys
from collections.abc import Sequence

from ctsim.benchmarks.engine import study
from ctsim.benchmarks.engine.record import Record, Task
from ctsim.benchmarks.engine.table import Table
from ctsim.benchmarks.methods import Method, chosen
from ctsim.benchmarks.scores.observer import LEAST
from ctsim.benchmarks.studies.detect import DEFAULT, PAIRS, Flags, tables
from ctsim.benchmarks.studies.detect.records import Pair
from ctsim.benchmarks.studies.detect.suite import load, named
from ctsim.dataset.versions import code_version
from ctsim.errors import InputError

MEASURE = "ctsim.benchmarks.studies.detect.measure"  # by name: it loads torch
# seconds of both reconstructions of a bundled scene and the drawing of their counts, on two cores
SECONDS = {"fdk": 0.5, "zero": 0.4, "hull": 0.7, "twin-fdk": 0.5, "limar": 0.8, "nmar": 1.2, "splat": 12.0}


def _rank(method: Method) -> int:
    """Return where tables have a method's rows: those with other settings, by a later command, follow the default's."""
    at = DEFAULT.index(method.name) if method.name in DEFAULT else len(DEFAULT)
    return 2 * at + (method.label != method.name)


class Detect(study.Study[Record[Pair], Flags]):
    """The study: a task is one pair of scans, with and without lesions, by one method."""

    name = file = "detect"
    unit = "pair"
    kind, record, flags = Pair, Record[Pair], Flags
    work = f"{MEASURE}:measure"
    follows = True
    estimate = "without compiling and simulating the signal (some minutes)"

    def check(self, given: Flags) -> None:
        """Refuse too few pairs, unknown scenes and methods; warn of few pairs."""
        if given.repeats < LEAST:
            raise InputError(f"--repeats must be at least {LEAST}, to train and to test the observer: {given.repeats}")
        named(load(given.suite), given.scene)
        methods(given)
        if given.repeats < PAIRS and not (given.table or given.collect):
            sys.stderr.write(f"--repeats {given.repeats}: fewer than {PAIRS} pairs give wide intervals\n")

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each pair, scene and method; pair by pair, so that all methods get on alike."""
        scenes, used, code = named(load(given.suite), given.scene), methods(given), code_version(MEASURE)
        return [
            Task(
                study=self.name,
                part=scene.name,
                case=f"pair {pair}",
                subject=method.label,
                settings={"pair": pair, "params": method.params},
                data=scene.digest,
                code=f"{code}{method.code}",
                place=(k, _rank(method), j, pair),
            )
            for pair in range(given.repeats)
            for k, scene in enumerate(scenes)
            for j, method in enumerate(used)
        ]

    def runs(self, task: Task, given: Flags) -> int:
        """Return 1: every pair is a run."""
        return 1

    def expected(self, task: Task, given: Flags) -> float | None:
        """Return the seconds of `SECONDS`."""
        return SECONDS.get(task.subject)

    def took(self, record: Record[Pair], given: Flags) -> float | None:
        """Return the seconds of both reconstructions."""
        return sum(s for one in record.found for s in sum(one.seconds.values(), ())) or None

    def line(self, task: Task) -> tuple[str, str]:
        """Return the scene and the method."""
        return task.part, task.subject

    def title(self, task: Task) -> str:
        """Return scene, pair and method."""
        return f"{task.part} {task.case} {task.subject}"

    def tables(self, records: Sequence[Record[Pair]], given: Flags) -> list[Table]:
        """Return the table of detection near metal and far from it."""
        return tables.summary(tables.series_of(records))

    def details(self, records: Sequence[Record[Pair]], given: Flags) -> list[Table]:
        """Return the controls, the observer in a slice, and each location."""
        return tables.details(tables.series_of(records))


def methods(given: Flags) -> list[Method]:
    """Return the methods that the flags ask for."""
    return chosen(given.method or DEFAULT, given.set)


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every pair was reconstructed, else 1."""
    return study.main(Detect(), arguments)
