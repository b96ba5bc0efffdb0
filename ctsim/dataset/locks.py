"""Locks between processes, also on file systems without flock.

A lock is a file that its owner makes, holds with flock and removes. It says who the owner is. Where the file system
has no flock, as some network file systems, the file alone is the lock: whoever makes it has it. One that a killed
process of this machine left is taken over; of another machine nobody can know, so the error names the file.
"""

import contextlib
import errno
import fcntl
import os
import platform
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec

from ctsim.dataset import process
from ctsim.errors import InputError

PATIENCE = 60.0  # seconds for which a line may take to be appended; it takes milliseconds
_TICK = 0.02
_NO_FLOCK = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)


class Busy(InputError):
    """Another process has the lock; `certain` says whether it is known to run."""

    def __init__(self, text: str, *, certain: bool = True) -> None:
        super().__init__(text)
        self.certain = certain


class Owner(msgspec.Struct, frozen=True, kw_only=True):
    """Who has a lock; `flock` says whether the system holds it, too, and lets go of it when the process ends."""

    host: str
    machine: str
    pid: int
    started: str
    token: str
    flock: bool


@dataclass(frozen=True, slots=True)
class Lock:
    """A lock that this process has; a context manager that gives it back."""

    path: Path
    handle: int
    owner: Owner

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Remove the lock file while it is still held, then let go."""
        try:
            if _read(self.path) == self.owner:
                self.path.unlink(missing_ok=True)
        finally:
            os.close(self.handle)


def lock(path: Path, what: str) -> Lock:
    """Take the lock file `path`, which guards `what`, such as "the scene 'rods'".

    Raises
    ------
    Busy
        When another process has it.
    """
    while True:
        try:
            handle, made = _open(path)
        except FileNotFoundError:
            if not path.parent.is_dir():
                raise
            continue  # its owner removed it between our two tries
        try:
            owner = _take(path, handle, made, what)
        except BaseException:
            os.close(handle)
            raise
        if owner is not None:
            return Lock(path, handle, owner)
        os.close(handle)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[int]:
    """Open a file of lines for appending, made if it is not there, alone among processes; yield its descriptor.

    Whoever replaces the file whole holds it locked, too. Raises `Busy` where the file system has no flock and the
    file's lock stays for `PATIENCE` seconds.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            instead = None if _flock(path, handle, wait=True) else _wait(path)
            try:
                if _is(path, handle):  # else it was replaced between our open and our lock
                    yield handle
                    return
            finally:
                if instead is not None:
                    instead.release()
        finally:
            os.close(handle)


def _open(path: Path) -> tuple[int, bool]:
    """Open a lock file; say whether it was made."""
    flags = os.O_RDWR | os.O_CLOEXEC
    try:
        return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644), True
    except FileExistsError:
        return os.open(path, flags), False


def _take(path: Path, handle: int, made: bool, what: str) -> Owner | None:
    """Become the owner of an open lock file; return None where it is to be opened again."""
    try:
        flocked = _flock(path, handle, wait=False)
    except BlockingIOError:
        raise _busy(path, what, _read(path), certain=True) from None
    if flocked and not _is(path, handle):
        return None  # its owner removed it between our open and our lock
    found = None if made else _read(path)
    if not flocked and not made and found is None:
        found = _settled(path)
    if not made and not (flocked and (found is None or found.flock)):
        if found is None or not process.ended(found.machine, found.pid, found.started):
            raise _busy(path, what, found, certain=found is not None and found.machine == process.machine())
        _remove(path, found, what)
        return None
    return _sign(path, handle, flock=flocked)


def _sign(path: Path, handle: int, *, flock: bool) -> Owner:
    """Write into an open lock file that this process has it."""
    owner = Owner(
        host=platform.node(),
        machine=process.machine(),
        pid=os.getpid(),
        started=process.started(os.getpid()),
        token=secrets.token_hex(4),
        flock=flock,
    )
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, msgspec.json.encode(owner), 0)
    except BaseException as error:
        path.unlink(missing_ok=True)  # without flock nobody could tell whose it was
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    return owner


def _settled(path: Path) -> Owner | None:
    """Give whoever just makes a lock file the time to say so in it."""
    for _ in range(50):
        found = _read(path)
        if found is not None or not path.exists():
            return found
        time.sleep(_TICK)
    return None


def _remove(path: Path, dead: Owner, what: str) -> None:
    """Remove the lock of a process that has ended, unless another process has done so and made its own meanwhile."""
    with lock(path.with_name(f"{path.name}.{dead.token}"), what):
        if _read(path) == dead:
            path.unlink()


def _wait(path: Path) -> Lock:
    """Take the lock that stands for flock on a file of lines, as soon as it is free."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return lock(path.with_name(f".{path.name}.lock"), f"{path.name}")
        except Busy:
            if time.monotonic() > end:
                raise
        time.sleep(_TICK)


def _flock(path: Path, handle: int, *, wait: bool) -> bool:
    """Hold an open file with flock; return False where the file system has none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno in _NO_FLOCK:
            return False
        raise OSError(error.errno, error.strerror, str(path)) from error
    return True


def _is(path: Path, handle: int) -> bool:
    """Say whether an open file is still the one of that name."""
    try:
        return path.stat().st_ino == os.fstat(handle).st_ino
    except FileNotFoundError:
        return False


def _read(path: Path) -> Owner | None:
    """Return who a lock file says has it; None where it does not say, as one that is just being made."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Owner)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def _busy(path: Path, what: str, owner: Owner | None, *, certain: bool) -> Busy:
    who = "another process" if owner is None else f"another process ({owner.pid} on {owner.host})"
    doubt = "" if certain else f", or was killed while it did; delete {path} if it runs no more"
    return Busy(f"{path.parent}: {who} is writing {what}{doubt}", certain=certain)
