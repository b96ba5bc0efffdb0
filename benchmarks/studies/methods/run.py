"""Run methods over stored scans and score what they return.

A method that fails is a result with a status and a reason; the next command tries it again. What it writes into its
scan or sets in its process no other run sees. With --isolate a run has a process of its own: its peak memory is its
own, a crash or a time limit ends only it.
"""

import dataclasses
import functools
import signal

import msgspec

from ctsim.benchmarks.engine.process import Process, Stopped
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.score import NO_TWIN, NOT_ASKED, TWIN_ENDED
from ctsim.benchmarks.studies.methods.attempt import SCORED, Outcome, describe, run_here, scan_for, skip, warm_up
from ctsim.benchmarks.studies.methods.plan import Job, job_of
from ctsim.benchmarks.studies.methods.records import METAL, TWIN, Result, RunTask
from ctsim.benchmarks.studies.methods.study import Flags
from ctsim.benchmarks.studies.methods.volumes import (
    intermediates_of,
    is_kept,
    keep,
    read_volume,
    volume_name,
    write_intermediates,
)

LATE = 120.0  # seconds that a method which was told its limit has beyond it


def measure(task: RunTask, given: Flags, job: Job | None = None) -> list[Result]:
    """Run a task and score it; `job` holds its scan and method where they are known.

    Raises InputError where this process has another version of its inputs.
    """
    return [_runner(given).run(job or job_of(task))]


@functools.lru_cache(maxsize=1)
def _runner(given: Flags) -> "Runner":
    """Return this process's runner, which knows from earlier tasks what is compiled."""
    return Runner(given)


class Runner:
    """Runs jobs in this process and remembers what the next needs: compiled methods, a scan's truth, its twin."""

    def __init__(self, given: Flags) -> None:
        self._given, self._results = given, given.results
        self._warm: dict[tuple[str, str], float] = {}
        self._judge: tuple[str, Judge] | None = None
        self._twin: tuple[Job, Outcome] | None = None

    def run(self, job: Job) -> Result:
        """Run and score a job, and keep its volume."""
        if self._judge is None or self._judge[0] != job.stored.content_hash:
            self._judge = self._twin = None  # let go of the last scan's masks first
            self._judge = (job.stored.content_hash, Judge.of(job.stored))
        outcome = self._outcome(job)
        if job.variant == METAL:
            pair = self._pair(job)
            self._twin = None
        else:
            pair, self._twin = Twin(), (job, outcome)
        result = self._scored(job, outcome, self._judge[1], pair)
        outcome.at_50kev = None  # a twin waits for its scan's run, which asks for the volume that was returned alone
        return result

    def _outcome(self, job: Job) -> Outcome:
        """Run a job here or, where that is asked for, in a process of its own."""
        stored, method, given = job.stored, job.method, self._given
        outcome = skip(method, stored, job.variant)
        if outcome is None and (given.isolate or given.seconds is not None):
            limit = given.seconds
            if limit is not None and method.params.get("seconds") == limit:
                limit += LATE
            return _isolated(job, limit)
        if outcome is None:
            # also before the twin: without metal a method may take another way, and not be compiled
            scan = scan_for(method, stored, METAL)
            key = (method.label, str(scan.counts.dtype))
            if key not in self._warm:
                self._warm[key] = warm_up(method, scan)
            del scan
            outcome = run_here(stored, job.variant, method, self._warm[key])
        return outcome

    def _pair(self, job: Job) -> Twin:
        """Return what the same method with the same parameters made of the metal-free scan, or why nothing."""
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

    def _scored(self, job: Job, outcome: Outcome, judge: Judge, pair: Twin) -> Result:
        """Score an outcome and write its volume."""
        scores, files, task = {}, {}, job.task
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
            details=outcome.details,
            data_code=job.stored.code,
        )


def _isolated(job: Job, seconds: float | None) -> Outcome:
    """Run a job in a new process and wait at most `seconds` for it, its start and compilation included."""
    with Process() as process:
        try:
            return process.run(_alone, job.task, seconds=seconds)
        except Stopped as end:
            if end.exit_code == -signal.SIGKILL:
                reason = "the process was killed, as the system does when memory is short"
                return Outcome(status="out_of_memory", reason=reason)
            return Outcome(status=end.status, reason=str(end))


def _alone(task: RunTask) -> Outcome:
    """Be the process of an isolated run."""
    job = job_of(task)
    warm = warm_up(job.method, scan_for(job.method, job.stored, METAL))
    outcome = run_here(job.stored, job.variant, job.method, warm)
    if outcome.cost is not None:
        outcome.cost = msgspec.structs.replace(outcome.cost, isolated=True)
    return outcome
