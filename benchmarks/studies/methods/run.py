"""Run methods over stored scans, score what they return, and record each run with what it took.

A method that fails is a record with a status and a reason; the next run tries it again. What it writes into its scan
or sets in its process no other run sees (`.own`). With `isolate` a run has a process of its own: its
peak memory is its own, a crash or a time limit ends only it.
"""

import dataclasses
import datetime
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctsim.benchmarks.engine.host import commit, host
from ctsim.benchmarks.engine.limited import refuse_unless_positive
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores import artefact
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.protocol import Score, Stored
from ctsim.benchmarks.studies.methods import intermediates, records
from ctsim.benchmarks.studies.methods.attempt import SCORED, describe, run_here, scan_for, skip, warm_up
from ctsim.benchmarks.studies.methods.isolate import Outcome, run_apart
from ctsim.benchmarks.studies.methods.records import Record, Run
from ctsim.benchmarks.studies.methods.volumes import identity_of, keep, read_volume
from ctsim.errors import InputError
from ctsim.phantoms.suites import read_toml

STORE = "ctsim.store:open_scan"
LATE = 120.0  # seconds beyond its own


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How to run: `seconds` limits one run and implies `isolate`; `anchor` runs on the metal-free twins too.

    A method that was told these seconds has `LATE` more to start and to end. `store` names the function that opens a
    scan's folder.
    """

    device: str = "cpu"
    isolate: bool = False
    seconds: float | None = None
    force: bool = False
    keep_volumes: bool = True
    anchor: bool = True
    store: str = STORE

    def __post_init__(self) -> None:
        refuse_unless_positive(self.seconds)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run to do: a scan (the twin without metal where `variant` says so) and a method.

    `scene` and `seed` are those of `repetition`; `place` are the numbers of the scan and of the method among those
    asked for.
    """

    stored: Stored
    variant: str
    method: Method
    scene: str
    seed: int
    place: tuple[int, int] = (0, 0)

    @functools.cached_property
    def run(self) -> Run:
        """What determines the measurement."""
        return Run(
            scene=self.scene,
            scene_id=self.stored.scene_id,
            scan=self.stored.content_hash,
            seed=self.seed,
            method=self.method.target,
            params=self.method.params,
            mask=self.method.mask,
            variant=self.variant,
            code=self.method.code,
        )

    @property
    def file_name(self) -> str:
        """The kept volume's name: scene and method with what the file system allows."""
        label = "".join(c if c.isalnum() or c in "-.=" else "_" for c in self.method.label)
        twin = "" if self.variant == "metal" else "__metal_free"
        return f"{self.stored.name}{twin}__{label}.tif"


def repetition(stored: Stored) -> tuple[str, int]:
    """Return the scene's name and its seed; make-dataset names the repetitions of a scene NAME-sSEED."""
    path = stored.folder / "scene.toml"
    recipe = read_toml(path, "that make-dataset wrote") if path.exists() else {}
    seed = recipe.get("seed", stored.info.seed)
    if not isinstance(seed, int):
        raise InputError(f"{path}: seed must be a whole number, got {seed!r}")
    return stored.name.removesuffix(f"-s{seed}"), seed


def tasks(scans: list[Stored], methods: list[Method], options: Options) -> list[Task]:
    """List every run: all methods on all scans, each on the metal-free twin first where asked and there is one."""
    found = []
    for i, stored in enumerate(scans):
        variants = ("metal_free", "metal") if options.anchor and stored.metal_free is not None else ("metal",)
        found += tasks_on(stored, variants, [(method, (i, k)) for k, method in enumerate(methods)])
    return found


def tasks_on(stored: Stored, variants: Sequence[str], placed: Sequence[tuple[Method, tuple[int, int]]]) -> list[Task]:
    """List the runs of methods, each with its place, on a scan and on its twin, as `variants` say."""
    scene, seed = repetition(stored)
    return [
        Task(stored=stored, variant=variant, method=method, scene=scene, seed=seed, place=place)
        for method, place in placed
        for variant in variants
    ]


def pending(listed: list[Task], results: Path, force: bool) -> list[Task]:
    """Keep the tasks that have no ok record, all of them with `force`; a scan's kept volume is not asked for.

    A scan that was scored without its twin's volume is run again where the twin is among the tasks. A
    twin is run again where its scan is to be run and the twin's volume was not kept.
    """
    if force:
        return listed
    found = records.read_all(results)[0]
    known = records.done(found)
    alone = {identity for identity, record in records.last(found).items() if artefact.lacks_twin(record.scores)}
    twins = {(id(task.stored), task.method.label): task for task in listed if task.variant == "metal_free"}
    left = []
    for task in (t for t in listed if t.variant == "metal"):
        twin = twins.get((id(task.stored), task.method.label))
        wanted = task.run.identity not in known or (twin is not None and task.run.identity in alone)
        if twin is not None and (twin.run.identity not in known or (wanted and not _kept(twin, results))):
            left.append(twin)
        if wanted:
            left.append(task)
    return left


def _kept(task: Task, results: Path) -> bool:
    """Say whether the volume on the disk is this very run's, not one of other parameters, code or data."""
    return identity_of(results / "volumes" / task.file_name) == task.run.identity


def run_all(listed: list[Task], results: Path, options: Options) -> Iterator[Record]:
    """Run the tasks one after another; each record is on the disk before it is yielded.

    Raises OSError where results cannot be written. Failures of methods are records, not exceptions.
    """
    runner = Runner(results, options)
    for task in listed:
        record = runner.run(task)
        records.append(results / records.NAME, record)
        yield record


class Runner:
    """Runs tasks in this process and remembers what the next needs: compiled methods, a scan's truth, its twin."""

    def __init__(self, results: Path, options: Options) -> None:
        self._results, self._options = results, options
        self._warm: dict[tuple[str, str, str], float] = {}
        self._judge: tuple[str, Judge] | None = None
        self._twin: tuple[Task, Outcome] | None = None

    def run(self, task: Task) -> Record:
        """Run and score a task, keep its volume and return its record, which is the caller's to append."""
        if self._judge is None or self._judge[0] != task.stored.content_hash:
            self._judge = self._twin = None  # let go of the last scan's masks first
            self._judge = (task.stored.content_hash, Judge.of(task.stored))
        outcome = run_one(task, self._options, self._warm)
        if task.variant == "metal":
            pair = _twin(task, self._twin, self._results, self._options)
            self._twin = None
        else:
            pair, self._twin = Twin(), (task, outcome)
        record = _record(task, outcome, (self._judge[1], pair), self._results, self._options)
        outcome.at_50kev = None  # a twin waits for its scan's run, which asks for the volume that was returned alone
        return record


def _twin(task: Task, last: tuple[Task, Outcome] | None, results: Path, options: Options) -> Twin:
    """Return what the same method with the same parameters made of the metal-free scan, or why there is nothing."""
    if task.stored.metal_free is None:
        return Twin(reason=artefact.NO_TWIN)
    if not options.anchor:
        return Twin(reason=artefact.NOT_ASKED)
    twin = dataclasses.replace(task, variant="metal_free")
    if last is not None and last[0].run.identity == twin.run.identity:
        outcome = last[1]
        if outcome.values is not None and outcome.status == "ok":
            return Twin(values=outcome.values)
        return Twin(reason=f"{artefact.TWIN_ENDED} {outcome.status}: {outcome.reason}")
    if _kept(twin, results):
        return Twin(values=read_volume(results / "volumes" / twin.file_name))
    return Twin(reason=artefact.NOT_ASKED)


def run_one(task: Task, options: Options, warm: dict[tuple[str, str, str], float]) -> Outcome:
    """Run one task. `warm` remembers which methods are compiled for which counts."""
    stored, method, device = task.stored, task.method, options.device
    outcome = skip(method, stored, task.variant)
    if outcome is None and (options.isolate or options.seconds is not None):
        limit = options.seconds
        if limit is not None and method.overrides.get("seconds") == limit:
            limit += LATE
        return run_apart(options.store, stored.folder, task.variant, method, device, limit)
    if outcome is None:
        # also before the twin: without metal a method may take another way, and not be compiled
        scan = scan_for(method, stored, "metal")
        key = (method.label, str(scan.counts.dtype), device)
        if key not in warm:
            warm[key] = warm_up(method, scan, device)
        del scan
        outcome = run_here(stored, task.variant, method, device, warm[key])
    return outcome


def _record(task: Task, outcome: Outcome, by: tuple[Judge, Twin], results: Path, options: Options) -> Record:
    """Score an outcome and write its volume."""
    scores, kept, identity = {}, None, task.run.identity
    if outcome.values is not None and outcome.status in SCORED:
        try:
            scores = by[0].scores(outcome.values, task.variant, by[1], outcome.at_50kev)
        except MemoryError as error:
            outcome.status, outcome.reason = "out_of_memory", f"while scoring: {describe(error)}"
    if outcome.values is not None and options.keep_volumes:
        kept = f"volumes/{task.file_name}"
        keep(results / kept, outcome.values, outcome.at_50kev, identity)
        if outcome.intermediates:
            beside = intermediates.path_of(results / kept)
            intermediates.write(beside, outcome.intermediates, identity)
    return describe_run(task, outcome, scores, kept)


def describe_run(task: Task, outcome: Outcome, scores: dict[str, Score], kept: str | None) -> Record:
    """Return the record of a run with where and when it was made; `kept` is its volume's path within the results."""
    return Record(
        identity=task.run.identity,
        run=task.run,
        label=task.method.label,
        inputs=task.method.inputs,
        status=outcome.status,
        reason=outcome.reason,
        scores=scores,
        cost=outcome.cost,
        volume=kept,
        place=task.place,
        host=host(),
        commit=commit(),
        time=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        details=outcome.details,
        data_code=task.stored.code,
    )
