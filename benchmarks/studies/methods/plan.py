"""The runs of the methods study: scans and methods as tasks, which are left to do, their order and cost."""

import functools
import pkgutil
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from ctsim.benchmarks import methods
from ctsim.benchmarks.engine.record import done
from ctsim.benchmarks.known_beam import with_beam
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores.score import lacks_twin
from ctsim.benchmarks.studies.methods.records import METAL, TWIN, Run, RunRecord, RunTask, rank, task_of
from ctsim.benchmarks.studies.methods.volumes import is_kept
from ctsim.dataset.store import StoredScan
from ctsim.errors import InputError
from ctsim.phantoms.suites import read_toml

OPEN = "ctsim.dataset.store:open_scan"
"""The function that opens a scan's folder."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run to do: a scan, or its metal-free twin by `variant`, and a method.

    `scene` and `seed` come from `repetition`; `place` numbers the scan and the method among those asked for.
    """

    stored: StoredScan
    variant: str
    method: Method
    scene: str
    seed: int
    place: tuple[int, int] = (0, 0)
    open: str = OPEN

    @functools.cached_property
    def task(self) -> RunTask:
        """The task: what determines the result, and where a worker finds scan and method."""
        run = Run(
            scene=self.scene,
            scene_id=self.stored.scene_id,
            seed=self.seed,
            method=self.method.target,
            params=self.method.params,
            mask=self.method.mask,
            variant=self.variant,
        )
        return task_of(
            run,
            self.method.label,
            data=self.stored.content_hash,
            code=self.method.code,
            place=self.place,
            name=self.stored.name,
            folder=str(self.stored.folder.resolve()),
            method=self.method.name,
            overrides=self.method.overrides,
            open=self.open,
        )


def repetition(stored: StoredScan) -> tuple[str, int]:
    """Return the scene's name and its seed; make-dataset names the repetitions of a scene NAME-sSEED."""
    path = stored.folder / "scene.toml"
    recipe = read_toml(path, "that make-dataset wrote") if path.exists() else {}
    seed = recipe.get("seed", stored.info.seed)
    if not isinstance(seed, int):
        raise InputError(f"{path}: seed must be a whole number, got {seed!r}")
    return stored.name.removesuffix(f"-s{seed}"), seed


def jobs(scans: Sequence[StoredScan], chosen: Sequence[Method], *, anchor: bool) -> list[Job]:
    """List every run: all methods on all scans; with `anchor` each first on the metal-free twin, if there is one.

    Raises InputError for two scans that would be one row: NAME, whose own seed is 1, and NAME-s1.
    """
    found: list[Job] = []
    for i, stored in enumerate(scans):
        variants = (TWIN, METAL) if anchor and stored.metal_free is not None else (METAL,)
        found += jobs_on(stored, variants, [(method, (i, k)) for k, method in enumerate(chosen)])
    first: dict[tuple[str, int], StoredScan] = {}
    for job in found:
        if (other := first.setdefault((job.scene, job.seed), job.stored)) is not job.stored:
            raise InputError(
                f"{other.folder} and {job.stored.folder} are the same scene and seed, so a table cannot hold both; "
                "choose one with --scene, or move one to another data folder"
            )
    return found


def jobs_on(
    stored: StoredScan, variants: Sequence[str], placed: Sequence[tuple[Method, tuple[int, int]]], open: str = OPEN
) -> list[Job]:
    """List the runs of methods, each with its place, on the given variants of a scan."""
    scene, seed = repetition(stored)
    return [
        Job(
            stored=stored,
            variant=variant,
            method=fitted(method, stored),
            scene=scene,
            seed=seed,
            place=place,
            open=open,
        )
        for method, place in placed
        for variant in variants
    ]


def fitted(method: Method, stored: StoredScan) -> Method:
    """Return the method as it runs on a scan: where no true mask is stored it finds the metal itself.

    A method that is told the spectrum gets the scan's tube and detector.
    """
    if not stored.has_truth and method.mask == "oracle":
        method = methods.find(method.name, {**method.overrides, "mask": "auto"})
    return with_beam(method, stored)


def job_of(task: RunTask) -> Job:
    """Open the scan and the method of a task."""
    hints = task.hints
    stored = pkgutil.resolve_name(hints["open"])(Path(hints["folder"]))
    method = methods.find(hints["method"], hints["overrides"])
    (job,) = jobs_on(stored, (task.part,), [(method, (task.place[0], task.place[1]))], hints["open"])
    if job.task.identity != task.identity:
        raise InputError(
            f"{task.subject} on {stored.name}: a worker has another version of the data or of the method's code than "
            "this command; expected the same files and the same installation"
        )
    return job


def pending(tasks: Sequence[RunTask], records: Sequence[RunRecord], results: Path) -> list[RunTask]:
    """Return the tasks without a record that ended well; a missing volume of a scan does not matter.

    A scan that was scored without its twin is run again if the twin is among the tasks. A twin is run again if its scan
    is to be run and the twin's volume was not kept.
    """
    known = done(records)
    alone = {r.task.identity for r in records if r.finished and lacks_twin(r.scores)}
    alone -= {r.task.identity for r in records if r.finished and not lacks_twin(r.scores)}
    twins = {(task.case, task.subject): task for task in tasks if task.part == TWIN}
    left: list[RunTask] = []
    for task in (t for t in tasks if t.part == METAL):
        twin = twins.get((task.case, task.subject))
        wanted = not known[task.identity] or (twin is not None and task.identity in alone)
        if twin is not None and (not known[twin.identity] or (wanted and not is_kept(twin, results))):
            left.append(twin)
        if wanted:
            left.append(task)
    return left


class Costs:
    """Seconds of recorded runs that ended well, without warm-up and scoring."""

    def __init__(self, records: Sequence[RunRecord]) -> None:
        self._seconds: dict[str, list[float]] = {}
        for record in records:
            if record.finished and record.cost is not None:
                self._seconds.setdefault(record.label, []).append(record.cost.wall)

    def method(self, label: str) -> float | None:
        """Return the median of a method's seconds, None if it has never run."""
        return statistics.median(self._seconds[label]) if label in self._seconds else None


def ordered(left: Sequence[RunTask], costs: Costs) -> list[tuple[RunTask, ...]]:
    """Group runs, each scan after its twin, cheap methods first, so that the table soon has whole rows.

    A method that has never run counts as expensive as those before it in the methods table, which starts with the
    cheap ones.
    """
    labels = sorted(dict.fromkeys(task.subject for task in left), key=rank)
    expected: dict[str, float] = {}
    for label in labels:
        known = costs.method(label)
        expected[label] = max(expected.values(), default=0.0) if known is None else known
    groups = [tuple(tasks) for _, tasks in groupby(left, key=lambda task: (task.case, task.subject))]
    return sorted(groups, key=lambda g: (expected[g[0].subject], labels.index(g[0].subject), g[0].place))
