"""Jobs on several processes: of this machine (`Local`) or of a Dask cluster (`Cluster`), behind one interface.

A job is a value that can be pickled and a function of a module that takes it. Jobs begin in the order given and
are answered as they end. One whose process dies is begun again elsewhere, at most `TRIES` times in all; so a
job must be one that can be repeated.
"""

import contextlib
import gc
import importlib
import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any, Protocol, Self

from ctsim.errors import InputError

TRIES = 3
TICK = 1.0  # seconds between two looks at what goes on
GRACE = 10.0  # seconds that a worker has to write down where it stopped
CONNECT = 10.0  # seconds that a scheduler has to answer
CERTIFICATES = ("distributed.comm.tls.ca-file", "distributed.comm.tls.client.cert")

Function = Callable[[Any], Any]
Answers = Iterator[tuple[int, Any] | None]


@dataclass(frozen=True, slots=True)
class Lost:
    """The answer to a job whose process died each time."""

    reason: str


class Pool(Protocol):
    """What runs jobs."""

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """Yield (number of a job, what `function` returned or how it ended) as jobs end, None when nothing happened.

        A job may end as `Lost`. Raises what a job raised, with a note of where; the others end with the pool.
        """
        ...


def open_pool(workers: int, scheduler: str | None) -> contextlib.AbstractContextManager[Pool | None]:
    """Return what --workers and --scheduler ask for; a pool of None where this process is to do all.

    Raises InputError for less than one worker, for both at once, and for a scheduler that cannot be used.
    """
    if workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more")
    if scheduler is None:
        return contextlib.nullcontext() if workers == 1 else Local(workers)
    if workers != 1:
        raise InputError("--workers and --scheduler exclude each other: the scheduler's own workers do the work")
    return Cluster(scheduler)


@dataclass(slots=True)
class Worker:
    """A process, the pipe to it, and the number of the job that it has."""

    process: Any
    pipe: connection.Connection
    job: int | None = None


class Local:
    """Processes of this machine, each with its share of the cores for the kernels."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._workers: list[Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.terminate()
            worker.pipe.close()
        end = time.monotonic() + GRACE
        try:
            for worker in self._workers:
                worker.process.join(max(0.0, end - time.monotonic()))
        finally:
            for worker in self._workers:
                worker.process.kill()
                worker.process.join()
            self._workers = []

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """See `Pool`."""
        waiting, deaths = deque(range(len(jobs))), Counter[int]()
        while waiting or any(w.job is not None for w in self._workers):
            while waiting and (worker := self._idle()) is not None:
                worker.job = waiting.popleft()
                with contextlib.suppress(OSError):  # it is dead: its end of the pipe will say so below
                    worker.pipe.send((function, jobs[worker.job]))
            busy = {w.pipe: w for w in self._workers if w.job is not None}
            ready = connection.wait(list(busy), TICK)
            if not ready:
                yield None
            for worker in (busy[pipe] for pipe in ready if isinstance(pipe, connection.Connection)):
                job, worker.job = worker.job, None
                assert job is not None
                try:
                    failed, answer = worker.pipe.recv()
                except (EOFError, OSError):
                    how = self._bury(worker)
                    deaths[job] += 1
                    if deaths[job] == TRIES:
                        yield job, Lost(f"its process died {TRIES} times, the last time with {how}")
                    else:
                        waiting.appendleft(job)
                    continue
                if failed:
                    raise answer
                yield job, answer

    def _idle(self) -> Worker | None:
        """Return a worker without a job, a new one where there may be more, None where all are busy."""
        for worker in self._workers:
            if worker.job is None:
                return worker
        if len(self._workers) == self._n:
            return None
        self._workers.append(start(threads_of(self._n)))
        return self._workers[-1]

    def _bury(self, worker: Worker) -> str:
        """Forget a worker whose pipe is closed; say how it ended."""
        from ctsim.benchmarks.engine.process import how_it_ended

        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join()
        return how_it_ended(worker.process.exitcode)


def threads_of(n: int) -> dict[str, str]:
    """Return the variables by which each of `n` processes gets its share of the cores; never more than were set."""
    share = max(1, len(os.sched_getaffinity(0)) // n)
    before = {name: os.environ.get(name, "").partition(",")[0] for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    return {name: str(min(share, int(given)) if given.isdecimal() else share) for name, given in before.items()}


def start(environment: Mapping[str, str], *, apart: bool = False) -> Worker:
    """Start a worker with these variables, such as `threads_of` a number of workers: libraries read them on import.

    It does not hear Ctrl-C: the parent decides what that means. With `apart` it leads a process group, which can be
    ended whole.
    """
    context = multiprocessing.get_context("spawn")
    mine, its = context.Pipe()
    process = context.Process(target=_serve, args=(its, apart))
    before = {name: os.environ.get(name) for name in environment}
    heard = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited, so that it holds from the first instruction
    os.environ.update(environment)
    try:
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.signal(signal.SIGINT, heard)
    its.close()
    return Worker(process, mine)


def _serve(pipe: connection.Connection, apart: bool) -> None:
    """Be a worker: answer jobs until the pipe closes or the parent ends."""
    if apart:
        os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a job can so write down where it stopped
    threading.Thread(target=_follow_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            function, job = pipe.recv()
            pipe.send(_attempt(function, job))


def _attempt(function: Function, job: Any) -> tuple[bool, Any]:
    """Return (whether it failed, the answer or the exception)."""
    try:
        return False, function(job)
    except InputError as error:
        return True, InputError(str(error))
    except Exception as error:
        note = "".join(traceback.format_exception(error))  # where it was raised does not cross processes
        # Dask teaches pickle to take tracebacks along, and fails at the long one of a RecursionError
        error.__traceback__ = error.__cause__ = error.__context__ = None
        error = error if _travels(error) else RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(note)
        return True, error


def _travels(error: Exception) -> bool:
    """Say whether an exception can be pickled and made again, which its own arguments may not suffice for."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return False
    return True


def _follow_parent() -> None:
    """End this process when the one that started it has ended, however that happened."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os.kill(os.getpid(), signal.SIGKILL)


class Cluster:
    """The workers of a Dask scheduler: one job at a time each, with as many threads as Dask gave the worker.

    Certificates for a scheduler at tls:// come from Dask's configuration. Workers may come and go. Those of a
    cluster outlive the command: when it is interrupted, jobs that have begun there end by themselves.
    """

    def __init__(self, address: str) -> None:
        try:
            self._dask: Any = importlib.import_module("distributed")
        except ImportError:
            raise InputError("--scheduler needs the package distributed: pip install 'ctsim[cluster]'") from None
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said by our errors
        self._address, reason = address, ""
        try:
            self._client = self._dask.Client(address, timeout=CONNECT)
        except (OSError, ValueError, RuntimeError, TypeError) as error:
            said = " ".join(str(error).split()) or type(error).__name__
            reason = f"no Dask scheduler answers there, expected tcp://host:port or tls://host:port ({said})"
            if isinstance(error, TypeError) and address.startswith("tls://"):  # it would connect without a context
                reason = f"needs certificates: expected {' and '.join(CERTIFICATES)} in Dask's configuration"
        if reason:
            # the client that failed closes itself when it is collected; while another is made that waits for ever
            gc.collect()
            raise InputError(f"--scheduler {address}: {reason}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()  # what nobody waits for any more is not begun

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """See `Pool`. Raises InputError when the scheduler is gone."""
        try:
            yield from self._answers(function, jobs)
        except (CancelledError, self._dask.comm.CommClosedError) as error:
            raise self._gone() from error

    def _gone(self) -> InputError:
        return InputError(f"--scheduler {self._address}: it is gone; the same command goes on from here")

    def _answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        waiting, running = deque(range(len(jobs))), {}
        while waiting or running:
            # no more jobs than workers: Dask gives each to an idle one, and moves it when that is lost
            for _ in range(min(len(waiting), self._workers() - len(running))):
                number = waiting.popleft()
                running[self._client.submit(_alone, function, jobs[number], pure=False)] = number
            done = self._done(list(running))
            if not done:
                yield None
            for future in done:
                yield running.pop(future), self._answer(future)

    def _workers(self) -> int:
        try:
            return len(self._client.nthreads())
        except OSError as error:  # it does not answer in time
            raise self._gone() from error

    def _done(self, futures: list[Any]) -> set[Any]:
        """Wait a little for one of the futures; return those that have ended."""
        if not futures:  # no worker is there yet
            time.sleep(TICK)
            return set()
        try:
            return self._dask.wait(futures, timeout=TICK, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            return set()

    def _answer(self, future: Any) -> Any:
        error = future.exception()
        if isinstance(error, self._dask.scheduler.KilledWorker):
            return Lost("its process died each time that Dask began it anew")
        if error is not None:
            raise error
        failed, answer = future.result()
        if failed:
            raise answer
        return answer


_ALONE = threading.Lock()


def _alone(function: Function, job: Any) -> tuple[bool, Any]:
    """Be a Dask task: alone in its process, for neither kernels nor measurements share one.

    An exception is returned: where Dask cannot pickle one, nobody hears of it and the client waits for ever.
    """
    with _ALONE:
        import numba
        import torch
        from distributed import get_worker
        from numba.core import config

        threads: int = get_worker().state.nthreads
        most = int(config.NUMBA_NUM_THREADS)  # pyright: ignore[reportAttributeAccessIssue]
        numba.set_num_threads(min(threads, most))
        torch.set_num_threads(threads)
        return _attempt(function, job)
