"""`run-benchmark DATA RESULTS --method fdk`: reconstruction methods over a dataset, scored, timed and tabulated."""

import contextlib
import logging
import pkgutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro

from ctsim.benchmarks import methods
from ctsim.benchmarks.engine import study
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.engine.terminal import announced
from ctsim.benchmarks.studies.methods import overview, plan, tables
from ctsim.benchmarks.studies.methods.records import FILE, METAL, Result, RunRecord, RunTask
from ctsim.dataset.folder import mixture, other_code
from ctsim.dataset.manifest import read_index
from ctsim.dataset.sources import source_hash
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.human import human_choice
from ctsim.reconstruct.watch import Progress, listen

log = logging.getLogger(__name__)
RUN = "ctsim.benchmarks.studies.methods.run"  # by name: it loads torch
DEFAULT = ("fdk", "zero", "hull", "twin-fdk", "limar", "nmar", "splat")
FEW = 20  # scenes that a warning names


@dataclass(frozen=True, kw_only=True)
class Flags(study.Options):
    """Run reconstruction methods over a dataset, score them, and write tables and pictures.

    A method that needs the spectrum is told the tube and the detector of the scan's scene, unless --set states one.
    A run that RESULTS already holds is not repeated, unless it failed or the data, the method's parameters or its code
    have changed. A method with a parameter `seconds`, such as splat, gets the time limit and returns what it has by
    then, at most 120 s late; other methods are stopped at the limit, start included, with the status timeout.
    """

    data: tyro.conf.Positional[Path]
    """The folder that make-dataset wrote."""
    results: tyro.conf.Positional[Path]
    """Folder for records, tables, volumes and pictures; created if missing."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """A method's name, such as fdk, or module:function of your own; may be given several times (default: fdk, limar,
    nmar, splat, and the controls zero, hull and twin-fdk)."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="METHOD.PARAMETER=VALUE")] = ()
    """A method's parameter, one of those that `run-benchmark methods` lists; may be given several times."""
    scene: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times (default: all)."""
    isolate: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run each method in a process of its own: exact peak memory, and a crash ends only that run. Implied by
    --seconds."""
    keep_volumes: bool = True
    """Keep reconstructions as TIFF stacks; pictures are drawn from them."""
    anchor: bool = True
    """Reconstruct the metal-free twins too, by every method: for the protocol artefact and the anchored score."""


class Methods(study.Study[RunRecord, Flags]):
    """The study."""

    name, file, unit = "", FILE, "run"
    kind, record, flags = Result, RunRecord, Flags
    work = f"{RUN}:measure"
    follows = True
    estimate = "without warm-up and scoring"

    def __init__(self) -> None:
        self._jobs: dict[str, plan.Job] = {}
        self._costs = plan.Costs([])

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return Methods, ()  # a worker opens scans itself

    def tasks(self, given: Flags) -> list[RunTask]:
        """List all methods on the chosen scans, each on the metal-free twin first."""
        self._jobs = {job.task.identity: job for job in self.jobs(given)}
        return [job.task for job in self._jobs.values()]

    def jobs(self, given: Flags) -> list[plan.Job]:
        """List the runs with their scans and methods; log the scans' notes as warnings."""
        chosen, scans = _methods(given), _scans(given)
        names = frozenset(given.scene or (s.name for s in scans))
        _warn([s for s in scans if s.name in names])
        return [job for job in plan.jobs(scans, chosen, anchor=given.anchor) if job.stored.name in names]

    def pending(self, tasks: Sequence[RunTask], records: Sequence[RunRecord], given: Flags) -> list[RunTask]:
        """Return the runs without a record, and twins without a kept volume."""
        self._costs = plan.Costs(records)
        return list(tasks if given.force else plan.pending(tasks, records, given.results))

    def groups(self, left: Sequence[RunTask], records: Sequence[RunRecord]) -> list[tuple[RunTask, ...]]:
        """Run the cheapest method on all scans first; a scan after its twin, which its scores need."""
        return list(plan.ordered(left, plan.Costs(records)))

    def measure(self, task: RunTask, given: Flags) -> Sequence[Result]:
        """Run a task in this process, on the scan opened for it; a worker opens its own."""
        return pkgutil.resolve_name(self.work)(task, given, self._jobs.get(task.identity))

    def limit(self, task: RunTask, given: Flags) -> float | None:
        """Return None: runs stop their own processes, and a method that knows its limit gets time to end."""
        return None

    def recorded(self, task: RunTask) -> RunTask:
        """Leave out the scan's path on this machine."""
        return msgspec.structs.replace(task, hints={})

    def took(self, record: RunRecord, given: Flags) -> float | None:
        """Return the seconds of a run."""
        return None if record.cost is None else record.cost.wall

    def expected(self, task: RunTask, given: Flags) -> float | None:
        """Return the median of the method's runs, else an estimate from FDK's time on this machine."""
        known = self._costs.method(task.subject)
        return pkgutil.resolve_name(f"{RUN}:estimated")(plan.job_of(task)) if known is None else known

    def title(self, task: RunTask) -> str:
        """Return the method and the scan."""
        return f"{task.subject} on {task.case}" + ("" if task.part == METAL else ", without metal")

    @contextlib.contextmanager
    def watched(self, say: Callable[[str], None]) -> Iterator[None]:
        """Show the progress of methods that report it."""

        def told(now: Progress) -> None:
            say(f"now {now.share:.0%}, loss {now.loss:.3g}, {now.remaining:.0f} s to go")

        with announced(lambda text: sys.stderr.write(f"{text}\n")), listen(told):
            yield

    def write(self, records: Sequence[RunRecord], given: Flags) -> str:
        """Write table.md, .csv and .tex; return a table that fits a terminal."""
        tables.write(records, given.results)
        return overview.text(records, given.results, given.data)

    def draw(self, records: Sequence[RunRecord], given: Flags) -> None:
        """Draw a picture of every scene."""
        from ctsim.benchmarks.studies.methods import panels  # loads matplotlib, which nothing before needs

        scans = {job.stored.name: job.stored for job in self._jobs.values()}
        panels.write_panels(records, list(scans.values()), given.results)

    def code(self, tasks: Sequence[Task], records: Sequence[RunRecord], given: Flags) -> int:
        """Return 0 if every run ended well or was skipped with a reason, 1 if one failed."""
        return super().code(tasks, records, given) if tasks else 0


def main(arguments: list[str]) -> int:
    """Run the command."""
    return study.main(Methods(), arguments)


def _methods(given: Flags) -> list[methods.Method]:
    names = tuple(dict.fromkeys(given.method)) or DEFAULT
    return methods.chosen(names, given.set, given.seconds)


def _scans(given: Flags) -> list[StoredScan]:
    """Open the dataset's scans, in its order; check --scene, and warn of scans by different code."""
    scans: list[StoredScan] = [open_scan(folder) for folder in list_scans(given.data)]
    if not scans:
        raise InputError(f"{given.data}: the dataset has no scenes")
    names = {s.name: None for s in scans}
    for wanted in given.scene:
        if wanted not in names:
            raise InputError(f"--scene {wanted!r}: {given.data} has {human_choice(names, wanted)}")
    simulated = frozenset(s.name for s in scans if s.has_truth)  # the simulator's code made no measured scan
    _warn_of_other_code(given.data, frozenset(given.scene or names) & simulated)
    return scans


def _warn(scans: Sequence[StoredScan]) -> None:
    """Log each note of the scans once, with the scans that have it."""
    found: dict[str, list[str]] = {}
    for stored in scans:
        for note in stored.info.notes:
            found.setdefault(note, []).append(stored.name)
    for note, names in found.items():
        more = f" and {len(names) - FEW} more" if len(names) > FEW else ""
        log.warning("%s%s: %s", ", ".join(names[:FEW]), more, note)


def _warn_of_other_code(data: Path, names: frozenset[str]) -> None:
    """Warn where scans were made by different code, or by other code than this."""
    lines = [line for line in read_index(data).values() if line.name in names]
    other = [line for line in lines if line.code != source_hash()]
    if text := mixture((line.name, line.code) for line in lines) or other_code(other, len(lines)):
        log.warning("%s: %s", data, text)
