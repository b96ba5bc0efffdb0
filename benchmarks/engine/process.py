"""Functions in processes of their own: one with a time limit (`Process`), or several at once (`Pool`).

A process is a fresh interpreter: it does not import the user's script again, may be started by a daemon such as a Dask
worker, counts its own memory only, and ends with the process that started it. What a function has loaded, compiled or
cached there stays for the next one.
"""

import _thread
import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from typing import TYPE_CHECKING, Any, Protocol, Self

from ctsim.errors import InputError

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

THREADS = {"numba": "NUMBA_NUM_THREADS", "torch": "OMP_NUM_THREADS"}  # a library and its variable
TRIES = 3  # how often a job is started if its process dies
TICK = 1.0  # seconds between two checks of running jobs
GRACE = 10.0  # seconds for an interrupted job to save its state

# sys.path comes first: ctsim is found by it
_BEGIN = """import sys
from multiprocessing.connection import Connection
pipe = Connection(int(sys.argv[1]))
sys.path[:] = pipe.recv()
from ctsim.benchmarks.engine import process
process.serve(pipe)"""

Function = Callable[..., Any]
Answers = Iterator[tuple[int, Any] | None]


def check_limit(seconds: float | None) -> None:
    """Require a positive, finite time limit (--seconds); None means unlimited. Raises InputError."""
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"--seconds must be positive, got {seconds:g}")


def how_it_ended(exit_code: int) -> str:
    """Name the signal or the exit code that ended a process."""
    return f"signal {signal.Signals(-exit_code).name}" if exit_code < 0 else f"exit code {exit_code}"


def at_most(threads: int) -> dict[str, str]:
    """Return the variables that limit the threads of libraries, or lower limits that are set already."""
    before = {v: os.environ.get(v, "").partition(",")[0] for v in THREADS.values()}
    return {v: str(min(threads, int(given)) if given.isdecimal() else threads) for v, given in before.items()}


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM, by which schedulers stop a job, interrupt as Ctrl-C does, and let no interrupt be lost.

    An interrupt that arrives in a callback from C, such as those of LLVM while a kernel compiles, cannot pass through
    C: Python prints it and goes on. Here it is raised again shortly after, in code that it can end.
    """
    before, hook = signal.signal(signal.SIGTERM, signal.default_int_handler), sys.unraisablehook

    def repeat(lost: "UnraisableHookArgs") -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(0.05, _thread.interrupt_main, (signal.SIGTERM,)).start()
        else:
            hook(lost)

    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)


class Stopped(RuntimeError):
    """A call that did not end within its limit, or whose process died.

    `status` is that of a record; `exit_code` is the process's, None after a timeout.
    """

    def __init__(self, status: str, reason: str, exit_code: int | None = None) -> None:
        super().__init__(reason)
        self.status, self.exit_code = status, exit_code


class Process:
    """A process that calls functions one after the other: started by the first call, replaced after a crash.

    `environment` is added to this process's variables. Ctrl-C reaches this process only, which ends the other.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._environment = environment or {}
        self._popen: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, function: Function, *arguments: Any, seconds: float | None = None) -> Any:
        """Return `function(*arguments)`, all picklable; raise what it raises.

        `seconds` limits the call and, where it is due, the start of the process. Raises Stopped where the call does
        not end in time or the process dies.
        """
        try:
            self.send(function, *arguments)
            in_time = self.pipe.poll(seconds)
        except BaseException:  # Ctrl-C: the call ends with its process
            self.kill()
            raise
        if not in_time:
            self.kill()
            raise Stopped("timeout", f"did not end within {seconds:g} s")
        return self.receive()

    def send(self, function: Function, *arguments: Any) -> None:
        """Start a call, whose answer `receive` takes; `pipe` is ready when there is one."""
        if self._popen is None:
            self._start()
        with contextlib.suppress(OSError):  # the process is dead: `receive` reports it
            self.pipe.send((function, arguments))

    def receive(self) -> Any:
        """Wait for the answer to the call sent; return it or raise it. Raises Stopped where the process dies."""
        assert self._popen is not None
        try:
            failed, answer = self.pipe.recv()
        except (EOFError, OSError):
            code = self._popen.wait()
            self.kill()
            raise Stopped("error", f"the process died with {how_it_ended(code)}", code) from None
        except KeyboardInterrupt:  # half an answer was read
            self.kill()
            raise
        if failed:
            raise answer
        return answer

    def ask_to_end(self) -> None:
        """Let an idle process end, and interrupt a busy one, which can then save its state."""
        if self._popen is not None:
            self._popen.terminate()
            self.pipe.close()

    def close(self, seconds: float = GRACE) -> None:
        """End the process; kill it after `seconds`."""
        if self._popen is not None:
            self.pipe.close()  # an idle process ends by itself
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._popen.wait(seconds)
        self.kill()

    def kill(self) -> None:
        """Kill the process with all that it has started."""
        if self._popen is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._popen.pid, signal.SIGKILL)
        self._popen.wait()
        self.pipe.close()
        os.close(self._alive)
        self._popen = None

    def _start(self) -> None:
        self.pipe, theirs = connection.Pipe()
        read, self._alive = os.pipe()  # nothing is written: its end says that this process has ended
        threads = {v: sys.modules.get(name) for name, v in THREADS.items()}  # as set by calls, which are not inherited
        now = {v: str(library.get_num_threads()) for v, library in threads.items() if library is not None}
        self._popen = subprocess.Popen(
            [sys.executable, "-P", "-c", _BEGIN, str(theirs.fileno())],
            stdin=read,
            pass_fds=[theirs.fileno()],
            env={**os.environ, **now, **self._environment},
            start_new_session=True,
        )
        os.close(read)
        theirs.close()
        with contextlib.suppress(OSError):  # as in `send`
            self.pipe.send(sys.path)


def serve(pipe: connection.Connection) -> None:
    """Be the process: answer calls until the pipe closes or the parent ends."""
    threading.Thread(target=_follow_parent, args=(os.dup(0),), daemon=True).start()
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)  # a job that asks the user gets no answer
    with interruptible(), contextlib.suppress(EOFError, OSError, KeyboardInterrupt):  # a job can save its state
        while True:
            answer = answered(_called, pipe.recv_bytes())
            try:
                data = pickle.dumps(answer)
            except Exception as error:
                data = pickle.dumps(answered(_raise, error))
            pipe.send_bytes(data)


def _called(call: bytes) -> Any:
    function, arguments = pickle.loads(call)
    return function(*arguments)


def _raise(error: Exception) -> None:
    raise error


def answered(function: Function, *arguments: Any) -> tuple[bool, Any]:
    """Call a function; return whether it failed, and the answer or the exception in a form that can be pickled."""
    try:
        return False, function(*arguments)
    except InputError as error:
        return True, InputError(str(error))
    except Exception as error:
        note = "".join(traceback.format_exception(error))  # tracebacks do not cross processes
        # Dask teaches pickle to take tracebacks along, and fails at the long one of a RecursionError
        error.__traceback__ = error.__cause__ = error.__context__ = None
        error = error if _can_travel(error) else RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(note)
        return True, error


def _can_travel(error: Exception) -> bool:
    """Whether an exception survives pickling; some cannot be built from their arguments."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return False
    return True


def _follow_parent(pipe: int) -> None:
    """End this process, with what it has started, when its parent has ended."""
    os.read(pipe, 1)
    os.killpg(0, signal.SIGTERM)  # this thread may be killed before the others have ended
    time.sleep(GRACE)
    os.killpg(0, signal.SIGKILL)


@dataclass(frozen=True, slots=True)
class Lost:
    """The answer to a job whose process died each time; `status` is that of a record."""

    reason: str
    status: str = "error"


class Jobs(Protocol):
    """Runs several jobs at once."""

    @property
    def workers(self) -> int:
        """How many, or at least 1 where workers come and go."""
        ...

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """Yield (number of a job, what `function(job)` returned or `Lost`) as jobs end, None when nothing happened.

        Jobs begin in order. One whose process dies starts again, so it must be repeatable. Raises what a job raises;
        the others then end with the pool.
        """
        ...


class Pool:
    """Several processes of this machine, each with its share of the cores."""

    def __init__(self, n: int) -> None:
        threads = at_most(max(1, len(os.sched_getaffinity(0)) // n))
        self._processes = [Process(threads) for _ in range(n)]
        self._idle = list(self._processes)
        self._busy: dict[connection.Connection, tuple[Process, int]] = {}

    @property
    def workers(self) -> int:
        """How many processes there are."""
        return len(self._processes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.ask_to_end()
        end = time.monotonic() + GRACE
        try:
            for process in self._processes:
                process.close(max(0.0, end - time.monotonic()))
        finally:
            for process in self._processes:
                process.kill()

    def answers(self, function: Function, jobs: Sequence[Any]) -> Answers:
        """See `Jobs`."""
        waiting, deaths = deque(range(len(jobs))), Counter[int]()
        while waiting or self._busy:
            while waiting and self._idle:
                process, number = self._idle[-1], waiting[0]
                process.send(function, jobs[number])  # raises where a job cannot be pickled
                self._busy[process.pipe] = self._idle.pop(), waiting.popleft()
            ready = connection.wait(list(self._busy), TICK)
            if not ready:
                yield None
            for pipe in ready:
                assert isinstance(pipe, connection.Connection)
                process, number = self._busy.pop(pipe)
                self._idle.append(process)
                try:
                    answer = process.receive()
                except Stopped as end:
                    deaths[number] += 1
                    if deaths[number] < TRIES:
                        waiting.appendleft(number)
                        continue
                    how, killed = how_it_ended(end.exit_code or 0), end.exit_code == -signal.SIGKILL
                    status = "out_of_memory" if killed else "error"  # as the system does when memory is short
                    answer = Lost(f"its process died {TRIES} times, the last time with {how}", status)
                yield number, answer
