"""A process that carries out cases one after the other, so that a hang or a crash costs one case.

A process a case would start two hundred times; this one is replaced only when a case has killed it or overstayed.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.stress_cases import Case, Outcome

THREADS = "NUMBA_NUM_THREADS"


class Worker:
    """Carries out the cases of a catalogue, a module with `catalogue() -> list[Case]`, in a process of its own."""

    def __init__(self, catalogue: str, seconds: float) -> None:
        self.catalogue, self.seconds = catalogue, seconds
        self._process: Any = None
        self._pipe: Connection | None = None

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, case: Case, side: int) -> Outcome:
        """Carry out a case; what does not end in time, the process's start included, or dies has failed."""
        pipe = self._pipe or self._start()
        try:
            pipe.send((case.name, case.subject, side))
            if pipe.poll(self.seconds):
                return pipe.recv()
            found = f"did not end within {self.seconds:g} s"
        except (EOFError, OSError):
            self._process.join()
            found = _last_words(self._process.exitcode)
        self._end()
        return Outcome(ok=False, found=f"NOT EXPECTED: {found}")

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        threads = int(os.environ.get(THREADS, len(os.sched_getaffinity(0))))
        self._process = context.Process(target=_serve, args=(theirs, self.catalogue, threads), daemon=True)
        with _at_least_two(threads):
            self._process.start()
        theirs.close()
        return self._pipe

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None


def _last_words(exit_code: int) -> str:
    how = f"signal {signal.Signals(-exit_code).name}" if exit_code < 0 else f"exit code {exit_code}"
    return f"the process died with {how}"


@contextlib.contextmanager
def _at_least_two(threads: int) -> Iterator[None]:
    """Let a process that starts meanwhile have two threads at least, so that it can compare one with two."""
    before = os.environ.get(THREADS)
    os.environ[THREADS] = str(max(2, threads))
    try:
        yield
    finally:
        if before is None:
            del os.environ[THREADS]
        else:
            os.environ[THREADS] = before


def _serve(pipe: Connection, catalogue: str, threads: int) -> None:
    """Be the process: carry out what is asked for, on so many threads, until nobody asks any more."""
    import numba

    from benchmarks.stress_cases import carry_out

    numba.set_num_threads(threads)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    cases = {(c.name, c.subject): c for c in importlib.import_module(catalogue).catalogue()}
    with contextlib.suppress(EOFError):
        while True:
            name, subject, side = pipe.recv()
            pipe.send(carry_out(cases[name, subject], side))
