"""Run methods over stored scans, score what they return, and estimate how long a run will take.

A method that fails gives a result with a status and a reason; the next command tries it again. What it writes into its
scan or sets in its process does not reach other runs. With --isolate a run has a process of its own: its peak memory is
measured alone, and a crash or a time limit ends only that run.
"""

import dataclasses
import functools
import math
import signal
import tempfile
import time

import msgspec
import torch

from ctsim.benchmarks.engine.process import Process, Stopped
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores import placement
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.projection import HeldOut
from ctsim.benchmarks.scores.score import NO_TWIN, NOT_ASKED, TWIN_ENDED
from ctsim.benchmarks.scores.unreferenced import HeldViews, Unreferenced
from ctsim.benchmarks.studies.methods import heldout
from ctsim.benchmarks.studies.methods.attempt import SCORED, Outcome, describe, run_here, scan_for, skip, warm_up
from ctsim.benchmarks.studies.methods.grids import with_grid
from ctsim.benchmarks.studies.methods.plan import Job, job_of
from ctsim.benchmarks.studies.methods.records import METAL, TWIN, Result, RunTask
from ctsim.benchmarks.studies.methods.splits import with_split
from ctsim.benchmarks.studies.methods.study import Flags
from ctsim.benchmarks.studies.methods.volumes import (
    intermediates_of,
    is_kept,
    keep,
    read_volume,
    volume_name,
    write_intermediates,
)
from ctsim.dataset.store import StoredScan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.splat.course import in_passes
from ctsim.reconstruct.splat.fast import finer
from ctsim.types import Scan

MOST_VIEWS = 32  # scans whose held-out views are kept: 10 MB each at the size of `core`
LATE = 120.0  # further seconds for a method that gets its time limit as a parameter


def measure(task: RunTask, given: Flags, job: Job | None = None) -> list[Result]:
    """Run a task and score it; `job` has its scan and method if they are open already.

    Raises InputError where this process has another version of its inputs.
    """
    return [_runner(given).run(job or job_of(task))]


@functools.lru_cache(maxsize=1)
def _runner(given: Flags) -> "Runner":
    """Return this process's runner, which remembers what is compiled."""
    return Runner(given)


class Runner:
    """Runs jobs in this process; remembers the compiled methods, the scan's truth, and its twin's volume."""

    def __init__(self, given: Flags) -> None:
        self._given, self._results = given, given.results
        self._warm: dict[tuple[str, str], float] = {}
        self._judge: tuple[str, Judge | Unreferenced] | None = None
        self._views: dict[str, HeldOut | HeldViews | str] = {}
        self._twin: tuple[Job, Outcome] | None = None

    def run(self, job: Job) -> Result:
        """Run and score a job, and keep its volume."""
        self._judge_for(job.stored)
        return self.finish(job, self._outcome(job))

    def finish(self, job: Job, outcome: Outcome) -> Result:
        """Score the outcome of a job, and keep its volume; a scan's after its twin's."""
        judge = self._judge_for(job.stored)
        if job.variant == METAL:
            pair = self._pair(job)
            self._twin = None
        else:
            pair, self._twin = Twin(), (job, outcome)
        result = self._scored(job, outcome, judge, pair)
        outcome.at_50kev = None  # a twin is kept for its scan's run, which needs its main volume only
        return result

    def _judge_for(self, stored: StoredScan) -> Judge | Unreferenced:
        """Return what a scan's volumes are scored with; that of the last scan is remembered."""
        if self._judge is None or self._judge[0] != stored.content_hash:
            self._judge = self._twin = None  # frees the last scan's masks first
            self._judge = (stored.content_hash, self._judge_of(stored))
        return self._judge[1]

    def _judge_of(self, stored: StoredScan) -> Judge | Unreferenced:
        """Load what a scan's volumes are scored with; methods come round by round, so its views are kept."""
        known = self._views.pop(stored.content_hash, None)
        if known is None and stored.has_truth:
            known = heldout.kept(stored, self._results)
        new = known is None
        judge = _judge(stored, known)
        if new and isinstance(judge.views, HeldOut):
            heldout.keep(judge.views, stored, self._results)
        self._views[stored.content_hash] = judge.views
        if len(self._views) > MOST_VIEWS:
            del self._views[next(iter(self._views))]
        return judge

    def _outcome(self, job: Job) -> Outcome:
        """Run a job in this process or, with --isolate, in its own."""
        stored, method, given = job.stored, job.method, self._given
        outcome = skip(method, stored, job.variant)
        if outcome is None and (given.isolate or given.seconds is not None):
            limit = given.seconds
            if limit is not None and method.params.get("seconds") == limit:
                limit += LATE
            return _isolated(job, limit)
        if outcome is None:
            # with metal also for the twin: without metal a method may skip code that then is not compiled
            scan = scan_for(method, stored, METAL)
            key = (method.label, str(scan.counts.dtype))
            if key not in self._warm:
                self._warm[key] = warm_up(method, scan)
            del scan
            outcome = run_here(stored, job.variant, method, self._warm[key])
        return outcome

    def _pair(self, job: Job) -> Twin:
        """Return the volume of the metal-free scan by the same method and parameters, or why there is none."""
        if job.stored.metal_free is None:
            return Twin(reason=NO_TWIN)
        if not self._given.anchor:
            return Twin(reason=NOT_ASKED)
        twin = dataclasses.replace(job, variant=TWIN)
        if self._twin is not None and self._twin[0].task.identity == twin.task.identity:
            outcome = self._twin[1]
            if outcome.values is not None and outcome.status == OK:
                return Twin(values=outcome.values)
            return Twin(reason=f"{TWIN_ENDED} {outcome.status}: {outcome.reason}")
        if is_kept(twin.task, self._results):
            return Twin(values=read_volume(self._results / volume_name(twin.task)))
        return Twin(reason=NOT_ASKED)

    def _scored(self, job: Job, outcome: Outcome, judge: Judge | Unreferenced, pair: Twin) -> Result:
        """Score an outcome and write its volume."""
        scores, files, task = {}, {}, job.task
        if job.method.program:
            _refuse_misplaced(outcome, judge, job.stored)
        if outcome.values is not None and outcome.status in SCORED:
            try:
                scores = judge.scores(outcome.values, job.variant, pair, outcome.at_50kev)
            except MemoryError as error:
                outcome.status, outcome.reason = "out_of_memory", f"while scoring: {describe(error)}"
        if outcome.values is not None and self._given.keep_volumes:
            files["volume"] = volume_name(task)
            path = self._results / files["volume"]
            keep(path, outcome.values, outcome.at_50kev, task.identity)
            if outcome.intermediates:
                write_intermediates(intermediates_of(path), outcome.intermediates, task.identity)
        return Result(
            ok=outcome.status in (OK, "skipped"),
            status=outcome.status,
            reason=outcome.reason,
            files=files,
            inputs=job.method.inputs,
            scores=scores,
            cost=outcome.cost,
            details=with_split(
                with_grid(outcome.details, job.stored.geometry, job.stored.info.label_grid),
                job.method.inputs,
                job.stored.split,
            ),
            data_code=job.stored.code,
            kerma=job.stored.kerma,
            phantom=job.stored.phantom,
        )


def _refuse_misplaced(outcome: Outcome, judge: Judge | Unreferenced, stored: StoredScan) -> None:
    """Let a program's run fail whose volume has another unit or is turned."""
    if outcome.values is not None and outcome.status in SCORED:
        try:
            water = effective_attenuation(stored)
            known = isinstance(judge, Judge)
            reference = placement.tissue_of(judge.truth) if known else placement.reference_of(stored)
            placement.check("the program's volume", outcome.values, reference, "1/mm", water)
        except InputError as error:
            outcome.fail("error", str(error))


def _judge(stored: StoredScan, views: HeldOut | HeldViews | str | None) -> Judge | Unreferenced:
    """Load what a scan's volumes are scored with; `views` are those of an earlier judge of the scan."""
    if stored.has_truth:
        assert not isinstance(views, HeldViews)
        return Judge.of(stored, views)
    return Unreferenced.of(stored, views)


def _isolated(job: Job, seconds: float | None) -> Outcome:
    """Run a job in a new process and wait at most `seconds` for it, its start and compilation included.

    What it leaves in its folder for temporary files is removed.
    """
    with (
        tempfile.TemporaryDirectory(prefix="ctsim-", ignore_cleanup_errors=True) as folder,
        Process({"TMPDIR": folder}) as process,
    ):
        try:
            return process.run(_alone, job.task, seconds=seconds)
        except Stopped as end:
            if end.exit_code == -signal.SIGKILL:
                reason = "the process was killed, as the system does when memory is short"
                return Outcome(status="out_of_memory", reason=reason)
            return Outcome(status=end.status, reason=str(end))


def _alone(task: RunTask) -> Outcome:
    """Run a job in the process that was started for it."""
    job = job_of(task)
    warm = warm_up(job.method, scan_for(job.method, job.stored, METAL))
    outcome = run_here(job.stored, job.variant, job.method, warm)
    if outcome.cost is not None:
        outcome.cost = msgspec.structs.replace(outcome.cost, isolated=True)
    return outcome


# --- estimates ----------------------------------------------------------------------------------------

FDKS = {
    "fdk": 1.0,
    "fdk-ramp": 1.0,
    "zero": 0.01,
    "hull": 2.6,
    "twin-fdk": 1.0,
    "limar": 2.0,
    "nmar": 4.4,
    "bhc-poly": 6.8,
    "water-precorrection": 1.7,
    "ibhc": 2.7,
    "sart": 3.0,
    "os-sart": 2.3,
    "sirt": 1.5,
    "cgls": 1.3,
    "fista-tv": 1.5,
    "asd-pocs": 2.3,
    "awpcsd": 3.7,
    "fusion": 28.0,
    "denoise": 23.0,
    "denoise-lite": 54.0,
    "dicdnet-lite": 56.0,
    "acdnet-lite": 38.0,
    "oscnet-lite": 84.0,
    "splat": 2.9,
    "splat-paper": 0.49,
    "splat-r2": 1.27,
    "naf": 3.6,
    "polyner": 6.9,
    "park": 5.2,
    "field": 4.3,
}
"""Time in units of FDK's, per iteration or step where a method has them, measured on lung-Fe of `quick`.

For `splat`: of a pass over a grid of the same number of voxels, on `core`.
"""
UNKNOWN = 5.0  # for a method that is not in the table
AMOUNTS = ("iterations", "steps")
PIXEL = 30  # voxels that are backprojected in the time of the logarithm and the filter of a pixel
SMALL = 64  # at most this many voxels along an axis, and views, of the scan that FDK is timed on


def in_fdks(method: Method, geometry: Geometry) -> float | None:
    """Estimate a run's time in units of FDK's; None for an unknown method or an invalid count."""
    name, params = method.name, method.params
    try:
        if name == "splat":
            fine = finer(geometry, params["fineness"])
            passes = in_passes(fine, params["passes"])
            return FDKS[name] * passes * math.prod(fine.n_voxel) / math.prod(geometry.n_voxel)
        count = next((params[key] for key in AMOUNTS if params.get(key) is not None), 1.0)
        return FDKS[name] * float(count)
    except (KeyError, IndexError, TypeError, ValueError):  # the method itself reports a wrong parameter
        return None


@functools.cache
def fdk_seconds(geometry: Geometry) -> float:
    """Estimate FDK's seconds from a blank scan of fewer voxels and views, timed after a run that compiles."""
    small = msgspec.structs.replace(
        geometry,
        n_voxel=tuple(min(n, SMALL) for n in geometry.n_voxel),
        n_views=min(geometry.n_views, SMALL),
        angles_deg=None,
        poses=None,  # FDK takes none; dso and dsd are enough
    )
    blank = Scan(geometry=small, counts=torch.ones(small.shape), flat=torch.ones(small.n_detector))
    fdk(blank)
    start = time.perf_counter()
    fdk(blank)
    seconds = time.perf_counter() - start
    return seconds * _work(geometry) / _work(small)


def _work(geometry: Geometry) -> int:
    return geometry.n_views * (math.prod(geometry.n_voxel) + PIXEL * math.prod(geometry.n_detector))


def estimated(job: Job) -> float | None:
    """Estimate a run's seconds from FDK's time on this machine; None for a method of the user's."""
    geometry = job.stored.geometry
    fdks = in_fdks(job.method, geometry)
    given = job.method.params.get("seconds")
    limit = given if isinstance(given, int | float) else math.inf
    return None if fdks is None else min(fdks * fdk_seconds(geometry), limit)
