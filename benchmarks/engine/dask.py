"""Jobs on the workers of a Dask scheduler, which comes with the extra `cluster`."""

import gc
import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import CancelledError
from typing import Any, Self

import distributed
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from ctsim.benchmarks.engine.process import TICK, Answers, Function, Lost, answered
from ctsim.errors import InputError

CONNECT = 10.0  # seconds within which a scheduler must answer
CERTIFICATES = ("distributed.comm.tls.ca-file", "distributed.comm.tls.client.cert")


class Cluster:
    """The workers of a Dask scheduler: one job at a time each, with as many threads as Dask gave the worker.

    Certificates for a scheduler at tls:// come from Dask's configuration. Workers may come and go. They outlive the
    command: when it is interrupted, jobs that have begun there end by themselves.
    """

    def __init__(self, address: str) -> None:
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # our errors are enough
        self._address, reason = address, ""
        try:
            self._client: Any = distributed.Client(address, timeout=CONNECT)
        except (OSError, ValueError, RuntimeError, TypeError) as error:
            said = " ".join(str(error).split()) or type(error).__name__
            reason = f"no Dask scheduler answers there, expected tcp://host:port or tls://host:port ({said})"
            if isinstance(error, TypeError) and address.startswith("tls://"):  # it would connect without a context
                reason = f"needs certificates: expected {' and '.join(CERTIFICATES)} in Dask's configuration"
        if reason:
            # the failed client closes when it is collected; after another one is made, that close would wait for ever
            gc.collect()
            raise InputError(f"--scheduler {address}: {reason}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()  # jobs that have not begun are cancelled

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """See `Jobs`. Raises InputError when the scheduler is gone."""
        try:
            yield from self._answers(function, jobs)
        except (CancelledError, CommClosedError) as error:
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

    @property
    def workers(self) -> int:
        """How many workers there are now, at least 1."""
        return max(1, self._workers())

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
            found: Any = distributed.wait(futures, timeout=TICK, return_when="FIRST_COMPLETED")
            return found.done
        except TimeoutError:
            return set()

    def _answer(self, future: Any) -> Any:
        error = future.exception()
        if isinstance(error, KilledWorker):
            return Lost("its process died each time that Dask started it")
        if error is not None:
            raise error
        failed, answer = future.result()
        if failed:
            raise answer
        return answer


_ALONE = threading.Lock()


def _alone(function: Function, job: Any) -> tuple[bool, Any]:
    """Be a Dask task: alone in its process, for neither kernels nor measurements share one.

    An exception is returned, not raised: one that Dask cannot pickle would be lost, and the client would wait for ever.
    """
    with _ALONE:
        _give(distributed.get_worker().state.nthreads)
        return answered(function, job)


def _give(threads: int) -> None:
    """Give kernels and torch so many threads, now or when a job loads them: not every job needs those seconds.

    Dask starts its workers with one thread for OpenMP and MKL.
    """
    if (kernels := sys.modules.get("numba")) is not None:
        kernels.set_num_threads(min(threads, kernels.config.NUMBA_NUM_THREADS))
    else:
        most = int(os.environ.get("NUMBA_NUM_THREADS", len(os.sched_getaffinity(0))))
        os.environ["NUMBA_NUM_THREADS"] = str(min(threads, most))
    if (tensors := sys.modules.get("torch")) is not None:
        tensors.set_num_threads(threads)
    else:
        os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
