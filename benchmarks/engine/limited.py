"""A process that does jobs one after the other within a time limit: one that hangs or crashes costs itself only.

What a job has loaded, compiled or cached stays for the next. The process is replaced only where a job has killed
it or overstayed.
"""

import contextlib
import math
import os
import signal
from collections.abc import Callable, Mapping
from typing import Any, Self

from ctsim.benchmarks.engine import workers
from ctsim.benchmarks.engine.process import how_it_ended
from ctsim.errors import InputError


def refuse_unless_positive(seconds: float | None) -> None:
    """Raise InputError for a time limit (--seconds) that is none; None stands for no limit."""
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"--seconds must be positive, got {seconds:g}")


class Stopped(RuntimeError):
    """A job that did not end within its limit or whose process died: `status` as of a record, and the sentence."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Limited:
    """Does jobs in a process of its own, each within `seconds`, None for no limit; `environment` is added to ours."""

    def __init__(self, seconds: float | None, environment: Mapping[str, str] | None = None) -> None:
        refuse_unless_positive(seconds)
        self.seconds = seconds
        self._environment = environment or {}
        self._worker: workers.Worker | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._worker is not None:  # it waits for a job: it can end by itself and clean up
            self._worker.pipe.close()
            self._worker.process.join(workers.GRACE)
        self._end()

    def run(self, function: Callable[..., Any], *given: Any) -> Any:
        """Return `function(*given)`, both picklable; raise what it raised.

        Raises Stopped where it does not end in time, the process's start included, or its process dies.
        """
        worker = self._worker = self._worker or workers.start(self._environment, apart=True)
        try:
            worker.pipe.send((_called, (function, given)))
            answered = worker.pipe.recv() if worker.pipe.poll(self.seconds) else None
        except (EOFError, OSError):
            worker.process.join()
            how = how_it_ended(worker.process.exitcode)
            self._end()
            raise Stopped("error", f"the process died with {how}") from None
        except BaseException:  # Ctrl-C: the job goes with its process
            self._end()
            raise
        if answered is None:
            self._end()
            raise Stopped("timeout", f"did not end within {self.seconds:g} s")
        failed, answer = answered
        if failed:
            raise answer
        return answer

    def _end(self) -> None:
        if self._worker is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._worker.process.pid, signal.SIGKILL)  # with what jobs have started
            self._worker.process.kill()  # it may not lead its group yet
            self._worker.process.join()
            self._worker.pipe.close()
        self._worker = None


def _called(job: tuple[Callable[..., Any], tuple[Any, ...]]) -> Any:
    function, given = job
    return function(*given)
