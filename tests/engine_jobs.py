"""What the tests of the engine let other processes do; imports nothing that takes time."""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ctsim.benchmarks.engine import host, process
from ctsim.benchmarks.engine.process import Pool, Process, Stopped
from ctsim.errors import InputError


def until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    """Wait until something is true; fail if that takes too long."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


@contextlib.contextmanager
def started(command: Sequence[object], **how: Any) -> Iterator[subprocess.Popen[Any]]:
    """Start a program that is killed at the end, as a test that fails would wait for it for ever."""
    with subprocess.Popen([str(word) for word in command], **how) as it:
        try:
            yield it
        finally:
            it.kill()


def lives(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())
    except OSError:
        return False


def write(path: str, text: object) -> None:
    """Write a small file at once: whoever sees it sees all of it."""
    Path(path + ".new").write_text(str(text), encoding="utf-8")
    os.rename(path + ".new", path)


def say(path: str) -> None:
    write(path, os.getpid())


def tell() -> dict:
    """Say who we are and what we were given."""
    return {
        "pid": os.getpid(),
        "leads": os.getsid(0) == os.getpid(),
        "stdin": sys.stdin.read(),
        "path": sys.path,
        "environment": dict(os.environ),
        "peak": host.peak_memory(),
    }


def input_error(words: str) -> None:
    raise InputError(words)


def stopped_error() -> None:
    """Raise an exception that cannot be made again from its own arguments."""
    raise Stopped("error", "its arguments are not those of its making")


class Keeps(Exception):
    """Cannot be pickled."""

    def __init__(self) -> None:
        super().__init__("a lock")
        self.lock = threading.Lock()


def job(given: str) -> str:
    """Be one of many jobs, some of which end badly."""
    if given == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if given == "refuse":
        raise InputError("not this one")
    if given == "fails":
        raise OSError("its own")
    if given == "recurses":
        return job(given)
    if given == "keeps":
        raise Keeps
    return f"{given} with {os.environ.get('NUMBA_NUM_THREADS')}"


def die_once(path: str) -> str:
    """Die where no other process has done so before."""
    try:
        Path(path).touch(exist_ok=False)
    except FileExistsError:
        return "done"
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def die_and_count(path: str) -> None:
    with open(path, "a") as file:
        file.write("x")
    os.kill(os.getpid(), signal.SIGKILL)


def unpicklable() -> object:
    return threading.Lock()


def nested() -> list:
    """Return an answer that pickle cannot follow to its end."""
    inner: list = []
    for _ in range(100_000):
        inner = [inner]
    return inner


def sleep_in_two(path: str) -> None:
    """Start a process that sleeps, leave our number and its, and sleep."""
    with subprocess.Popen(["sleep", "60"], start_new_session=False) as other:
        write(path, f"{os.getpid()} {other.pid}")
        time.sleep(60)


def start_and_leave(path: str) -> int:
    """Start a process that sleeps, and return."""
    other = subprocess.Popen(["sleep", "60"])
    write(path, other.pid)
    other.returncode = 0  # no warning that it still runs
    return other.pid


def sleep_and_note(path: str) -> None:
    """Sleep until interrupted, and write that down."""
    try:
        write(path, os.getpid())
        time.sleep(60)
    except KeyboardInterrupt:
        write(path + ".stopped", "here")
        raise


def sleep_on(path: str) -> None:
    """Do not hear what interrupts us."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    write(path, os.getpid())
    while True:
        time.sleep(60)


def sleep_on_with_little_grace(path: str) -> None:
    process.GRACE = 0.2
    sleep_on(path)


def touch_at_exit(path: str) -> None:
    atexit.register(Path(path).touch)


def call_from_here(path: str) -> None:
    """Use processes from this one, such as a daemon, which may have no children of multiprocessing."""
    with Process() as one, Pool(2) as pool:
        answers = dict(a for a in pool.answers(job, ["one", "two"]) if a is not None)
        write(path, f"{one.run(os.getppid) == os.getpid()} {sorted(a[:3] for a in answers.values())}")


def fatal_once(scan: Any, *, device: str) -> Any:
    """Reconstruct by FDK, but the first process that is asked is killed: CTSIM_TEST_MARK is a file then."""
    from ctsim.reconstruct.fdk import reconstruct

    try:
        Path(os.environ["CTSIM_TEST_MARK"]).touch(exist_ok=False)
    except FileExistsError:
        return reconstruct(scan)
    os.kill(os.getpid(), signal.SIGKILL)


def hang(scan: Any, *, device: str) -> None:
    time.sleep(60)
