"""Run methods over stored scans, score what they return, and record each run with what it took.

A method that fails is a record with a status and a reason; the next run tries it again. With
`isolate` a run has a process of its own: its peak memory is its own, a crash or a time limit ends
only it.
"""

import dataclasses
import datetime
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import artefact, details, intermediates, records
from benchmarks.host import commit, host, measured
from benchmarks.isolate import Outcome, run_apart
from benchmarks.judge import Judge, Twin
from benchmarks.limited import refuse_unless_positive
from benchmarks.methods import Method
from benchmarks.protocol import Score, Stored
from benchmarks.records import Cost, Record, Run
from benchmarks.volumes import identity_of, keep, read_volume
from ctsim.errors import InputError
from phantoms.suites import read_toml

if TYPE_CHECKING:
    import torch

    from ctsim.types import Scan, Volume

log = logging.getLogger(__name__)

STORE = "ctsim.store:open_scan"
LATE = 120.0  # seconds beyond its own
SCORED = ("ok", "diverged")  # a run's status
WARM, WARM_UPS = 1.0, 5  # seconds that a warm-up lasts beyond compiling, where a method knows of time, and how often


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One run to do: a scan (the twin without metal where `variant` says so) and a method.

    `place` are the numbers of the scan and of the method among those asked for.
    """

    stored: Stored
    variant: str
    method: Method
    place: tuple[int, int] = (0, 0)

    @property
    def scan(self) -> "Scan":
        """What the method gets."""
        return scan_for(self.method, self.stored, self.variant)

    @property
    def run(self) -> Run:
        """What determines the measurement."""
        scene, seed = repetition(self.stored)
        return Run(
            scene=scene,
            scene_id=self.stored.scene_id,
            scan=self.stored.content_hash,
            seed=seed,
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
    seed = recipe.get("seed", stored.info.get("seed", 0))
    if not isinstance(seed, int):
        raise InputError(f"{path}: seed: {seed!r} is no integer")
    return stored.name.removesuffix(f"-s{seed}"), seed


def scan_for(method: Method, stored: Stored, variant: str) -> "Scan":
    """Return the scan itself or its twin without metal; with the true mask where the method's is "oracle".

    Raises InputError where there is no twin. The twin's true mask is empty.
    """
    found = stored if variant == "metal" else stored.metal_free
    if found is None:
        raise InputError(f"scan {stored.name!r} has no metal-free twin")
    if method.mask != "oracle":
        return found.scan
    import torch

    metal = np.asarray(stored.metal) > 0
    return dataclasses.replace(found.scan, metal=torch.from_numpy(metal & (variant == "metal")))


def tasks(scans: list[Stored], methods: list[Method], options: Options) -> list[Task]:
    """List every run: all methods on all scans, each on the metal-free twin first where asked and there is one."""
    found = []
    for i, stored in enumerate(scans):
        variants = ("metal_free", "metal") if options.anchor and stored.metal_free is not None else ("metal",)
        found += [
            Task(stored=stored, variant=v, method=m, place=(i, k)) for k, m in enumerate(methods) for v in variants
        ]
    return found


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
    outcome = _skip(task)
    if outcome is None and (options.isolate or options.seconds is not None):
        limit = options.seconds
        if limit is not None and task.method.overrides.get("seconds") == limit:
            limit += LATE
        return run_apart(options.store, task.stored.folder, task.variant, task.method, options.device, limit)
    if outcome is None:
        key = (task.method.label, str(task.scan.counts.dtype), options.device)
        if key not in warm:
            # also before the twin: without metal a method may take another way, and not be compiled
            warm[key] = warm_up(task.method, scan_for(task.method, task.stored, "metal"), options.device)
        outcome = attempt(task.method, task.scan, options.device, warm[key])
    return outcome


def _skip(task: Task) -> Outcome | None:
    try:
        reason = task.method.skip(task.scan)
    except Exception as error:  # the asked module is somebody else's
        return Outcome(status="error", reason=f"skip() failed: {describe(error)}")
    return None if reason is None else Outcome(status="skipped", reason=reason)


def describe(error: BaseException) -> str:
    """Say an exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def attempt(method: Method, scan: "Scan", device: str, warm_up_seconds: float) -> Outcome:
    """Run a method in this process and turn whatever happens into an outcome."""
    cost: dict[str, Any] = {"device": device, "warm_up": warm_up_seconds}
    volume, values, shown, said = None, None, {}, {}
    with measured() as usage:
        try:
            volume = method.reconstruct(scan, device)
            status, reason = str(volume.status), volume.reason
            values = _array(volume.values)
            cost["view_updates"] = int(volume.details.get("view_updates", scan.geometry.n_views))
            shown = intermediates.taken(volume.details, scan.geometry)
            said = details.kept(volume.details)
        except Exception as error:  # a method's failure is a result
            status, reason = _failure(method, error)
    outcome = Outcome(status=status, reason=reason, values=values, intermediates=shown, details=said)
    outcome.cost = Cost(wall=usage.wall, cpu=usage.cpu, peak_bytes=usage.peak_bytes, **{"view_updates": 0, **cost})
    if volume is not None and status in SCORED:
        _read_at_50kev(outcome, method, volume)
    return checked(outcome, scan.geometry.n_voxel)


def _read_at_50kev(outcome: Outcome, method: Method, volume: "Volume") -> None:
    """Add the volume at 50 keV where the method knows energies; what goes wrong there is the run's failure."""
    from ctsim.simulate import REFERENCE_KEV

    try:
        outcome.at_50kev = None if volume.at_energy is None else _array(volume.at_energy(REFERENCE_KEV))
    except Exception as error:
        outcome.values = None
        outcome.status, reason = _failure(method, error)
        outcome.reason = f"the volume at 50 keV: {reason}"


def _failure(method: Method, error: Exception) -> tuple[str, str]:
    """Return the status and reason of a run that ended by an exception."""
    log.debug("method %s failed", method.name, exc_info=error)
    # torch has an error of its own for devices
    out_of_memory = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return "out_of_memory" if out_of_memory else "error", describe(error)


def checked(outcome: Outcome, shape: tuple[int, int, int]) -> Outcome:
    """Turn a volume of another shape into an error and one that is not finite into that status."""
    for what, values in (("volume", outcome.values), ("volume at 50 keV", outcome.at_50kev)):
        if values is None or outcome.status not in SCORED:
            continue
        if values.shape != shape:
            outcome.status, outcome.values, outcome.at_50kev = "error", None, None
            outcome.reason = f"the {what} has shape {values.shape}, the geometry says {shape}"
        elif not (finite := np.isfinite(values)).all():
            outcome.status = "nonfinite"
            outcome.reason = f"{int((~finite).sum())} of {values.size} voxels of the {what} are not finite"
    return outcome


def _array(volume: "torch.Tensor") -> NDArray[np.float32]:
    return np.asarray(volume.detach().cpu().numpy(), np.float32)


def warm_up(method: Method, scan: "Scan", device: str) -> float:
    """Run the method on a tiny scan of the same kind, so that compiling is not timed; return its seconds.

    A method that can be told how many seconds it may take gets one, again until it needs no more: what it did not get
    to while it was compiled would be compiled in the timed run. It keeps nothing that a later run would go on from.
    Its own complaint about the tiny scan is not its result and is only logged.
    """
    told = {"seconds": WARM, "checkpoints": None}
    told = {name: value for name, value in told.items() if name in method.params}
    method = dataclasses.replace(method, overrides={**method.overrides, **told})
    with measured() as usage:
        for _ in range(WARM_UPS):
            began = time.perf_counter()
            try:
                method.reconstruct(tiny(scan), device)
            except Exception as error:
                log.info("warm-up of %s: %s", method.name, describe(error))
            if "seconds" not in told or time.perf_counter() - began < 2 * WARM:
                break
    return usage.wall


def tiny(scan: "Scan") -> "Scan":
    """Return a scan of the first 8 views of `scan` and 8 whole slices of its volume.

    The counts are a view into the scan's own and the slices keep their size, so that kernels are
    compiled for the very types (dtype, layout, alignment; one tile or several) of the timed run. Of a
    true mask the 8 slices with the most metal are kept, so that correcting it is compiled too.
    """
    g = scan.geometry
    n = min(8, g.n_views)
    changes: dict[str, Any] = {"n_views": n, "n_voxel": (min(8, g.n_voxel[0]), *g.n_voxel[1:])}
    for name in ("angles_deg", "poses"):
        if getattr(g, name) is not None:
            changes[name] = getattr(g, name)[:n]
    more: dict[str, Any] = {}
    if scan.metal is not None:
        height = changes["n_voxel"][0]
        per_slice = np.asarray(scan.metal.sum((1, 2)))
        most = int(np.argmax(np.convolve(per_slice, np.ones(height, per_slice.dtype), "valid")))
        more["metal"] = scan.metal[most : most + height]
    return dataclasses.replace(scan, **more, geometry=msgspec.structs.replace(g, **changes), counts=scan.counts[:n])


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
    )
