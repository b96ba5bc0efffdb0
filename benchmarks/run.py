"""Run methods over stored scans, score what they return, and record each run with what it took.

A method that fails is a record with a status and a reason; the next run tries it again. With
`isolate` a run has a process of its own: its peak memory is its own, a crash or a time limit ends
only it.
"""

import contextlib
import dataclasses
import datetime
import logging
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import records
from benchmarks.host import commit, host, measured
from benchmarks.isolate import Outcome, run_apart
from benchmarks.methods import Method
from benchmarks.protocol import Stored, Truth, evaluate, truth_of
from benchmarks.records import Cost, Record, Run
from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.types import Scan

log = logging.getLogger(__name__)

STORE = "ctsim.store:open_scan"
ANCHOR = "fdk"
"""The method whose reconstruction of the metal-free twin is the zero of the anchored score."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How to run: `seconds` limits one run and implies `isolate`; `anchor` runs FDK on the metal-free twins too.

    `store` names the function that opens a scan's folder.
    """

    device: str = "cpu"
    isolate: bool = False
    seconds: float | None = None
    force: bool = False
    keep_volumes: bool = True
    anchor: bool = True
    store: str = STORE

    def __post_init__(self) -> None:
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise InputError(f"seconds must be positive, got {self.seconds}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One run to do: a scan (the twin without metal where `variant` says so) and a method."""

    stored: Stored
    variant: str
    method: Method

    @property
    def scan(self) -> "Scan":
        """What the method gets."""
        return variant_of(self.stored, self.variant).scan

    @property
    def run(self) -> Run:
        """What determines the measurement."""
        return Run(
            scene=self.stored.name,
            scene_id=self.stored.scene_id,
            scan=self.stored.content_hash,
            seed=int(self.stored.info.get("seed", 0)),
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


def variant_of(stored: Stored, variant: str) -> Stored:
    """Return the scan itself or its twin without metal."""
    found = stored if variant == "metal" else stored.metal_free
    if found is None:
        raise InputError(f"scan {stored.name!r} has no metal-free twin")
    return found


def tasks(scans: list[Stored], methods: list[Method], options: Options) -> list[Task]:
    """List every run: all methods on all scans, and FDK on the metal-free twins where asked."""
    found = []
    for stored in scans:
        found += [Task(stored=stored, variant="metal", method=m) for m in methods]
        if options.anchor and stored.metal_free is not None:
            found += [Task(stored=stored, variant="metal_free", method=m) for m in methods if m.label == ANCHOR]
    return found


def pending(listed: list[Task], results: Path, force: bool) -> list[Task]:
    """Keep the tasks that have no ok record, all of them with `force`; a kept volume is not asked for."""
    if force:
        return listed
    known = records.done(records.read_all(results)[0])
    return [task for task in listed if task.run.identity not in known]


def run_all(listed: list[Task], results: Path, options: Options) -> Iterator[Record]:
    """Run the tasks one after another; each record is on the disk before it is yielded.

    Raises OSError where results cannot be written. Failures of methods are records, not exceptions.
    """
    warm: dict[tuple[str, str, str], float] = {}
    truth: tuple[str, Truth] | None = None
    for task in listed:
        if truth is None or truth[0] != task.stored.content_hash:
            truth = None  # let go of the last scan's masks first
            truth = (task.stored.content_hash, truth_of(task.stored))
        record = run_one(task, truth[1], results, options, warm)
        records.append(results / records.NAME, record)
        yield record


def run_one(
    task: Task, truth: Truth, results: Path, options: Options, warm: dict[tuple[str, str, str], float]
) -> Record:
    """Run one task and score it. `warm` remembers which methods are compiled for which counts."""
    outcome = _skip(task)
    if outcome is None and (options.isolate or options.seconds is not None):
        outcome = run_apart(
            options.store, task.stored.folder, task.variant, task.method, options.device, options.seconds
        )
    elif outcome is None:
        key = (task.method.label, str(task.scan.counts.dtype), options.device)
        if key not in warm:
            warm[key] = warm_up(task.method, task.scan, options.device)
        outcome = attempt(task.method, task.scan, options.device, warm[key])
    return _record(task, outcome, truth, results, options)


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
    values = None
    with measured() as usage:
        try:
            volume = method.reconstruct(scan, device)
            status, reason = str(volume.status), volume.reason
            values = np.asarray(volume.values.detach().cpu().numpy(), np.float32)
            cost["view_updates"] = int(volume.details.get("view_updates", scan.geometry.n_views))
        except MemoryError as error:
            status, reason = "out_of_memory", describe(error)
        except Exception as error:  # a method's failure is a result
            log.debug("method %s failed", method.name, exc_info=True)
            out_of_memory = type(error).__name__ == "OutOfMemoryError"  # torch's, for devices
            status, reason = "out_of_memory" if out_of_memory else "error", describe(error)
    outcome = Outcome(status=status, reason=reason, values=values)
    outcome.cost = Cost(wall=usage.wall, cpu=usage.cpu, peak_bytes=usage.peak_bytes, **{"view_updates": 0, **cost})
    return checked(outcome, scan.geometry.n_voxel)


def checked(outcome: Outcome, shape: tuple[int, int, int]) -> Outcome:
    """Turn a volume of another shape into an error and one that is not finite into that status."""
    values = outcome.values
    if values is None or outcome.status not in ("ok", "diverged"):
        return outcome
    if values.shape != shape:
        outcome.status, outcome.values = "error", None
        outcome.reason = f"the volume has shape {values.shape}, the geometry says {shape}"
    elif not np.isfinite(values).all():
        outcome.status = "nonfinite"
        outcome.reason = f"{int(values.size - np.isfinite(values).sum())} of {values.size} voxels are not finite"
    return outcome


def warm_up(method: Method, scan: "Scan", device: str) -> float:
    """Run the method on a tiny scan of the same kind, so that compiling is not timed; return its seconds.

    The method's own complaint about the tiny scan is not its result and is only logged.
    """
    with measured() as usage:
        try:
            method.reconstruct(tiny(scan), device)
        except Exception as error:
            log.info("warm-up of %s: %s", method.name, describe(error))
    return usage.wall


def tiny(scan: "Scan") -> "Scan":
    """Return a scan of the first 8 views of `scan` and 8 whole slices of its volume.

    The counts are a view into the scan's own and the slices keep their size, so that kernels are
    compiled for the very types (dtype, layout, alignment; one tile or several) of the timed run.
    """
    g = scan.geometry
    n = min(8, g.n_views)
    changes: dict[str, Any] = {"n_views": n, "n_voxel": (min(8, g.n_voxel[0]), *g.n_voxel[1:])}
    for name in ("angles_deg", "poses"):
        if getattr(g, name) is not None:
            changes[name] = getattr(g, name)[:n]
    return dataclasses.replace(scan, geometry=msgspec.structs.replace(g, **changes), counts=scan.counts[:n])


def _record(task: Task, outcome: Outcome, truth: Truth, results: Path, options: Options) -> Record:
    """Score an outcome and write its volume."""
    scores, kept = {}, None
    if outcome.values is not None and outcome.status in ("ok", "diverged"):
        try:
            scores = evaluate(outcome.values, truth, anchor=task.variant != "metal")
        except MemoryError as error:
            outcome.status, outcome.reason = "out_of_memory", f"while scoring: {describe(error)}"
    if outcome.values is not None and options.keep_volumes:
        kept = f"volumes/{task.file_name}"
        write_volume(results / kept, outcome.values)
    run = task.run
    return Record(
        identity=run.identity,
        run=run,
        label=task.method.label,
        inputs=task.method.inputs,
        status=outcome.status,
        reason=outcome.reason,
        scores=scores,
        cost=outcome.cost,
        volume=kept,
        host=host(),
        commit=commit(),
        time=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def write_volume(path: Path, values: NDArray[np.float32]) -> None:
    """Write a volume [z, y, x] in 1/mm as an uncompressed TIFF stack, whole or not at all."""
    import tifffile

    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".part")
    try:
        tifffile.imwrite(aside, values, photometric="minisblack", metadata={"axes": "ZYX", "unit": "1/mm"})
        os.replace(aside, path)
    finally:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
