"""Files that survive: locks between processes, flushing, and putting a finished folder in its place."""

import contextlib
import ctypes
import errno
import fcntl
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from ctsim.errors import InputError

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


class Busy(InputError):
    """Another process has the lock."""


def lock(path: Path) -> int:
    """Take the lock file `path` and return its handle; `unlock` gives it back.

    Raises
    ------
    Busy
        When another process has it.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.fstat(handle)
            if path.exists() and path.stat().st_ino == mine.st_ino:
                return handle
        except BlockingIOError:
            os.close(handle)
            scene = path.name.removeprefix(".").removesuffix(".lock")
            raise Busy(f"{path.parent}: another process is writing the scene {scene!r}") from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its owner removed the file between our open and our lock


def unlock(path: Path, handle: int) -> None:
    """Remove the lock file while it is still held, then let go."""
    path.unlink(missing_ok=True)
    os.close(handle)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[int]:
    """Open a file of lines for appending, made if it is not there, alone among processes; yield its descriptor.

    Whoever replaces the file whole holds it locked, too.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            if os.fstat(handle).st_ino == path.stat().st_ino:  # else it was replaced between our open and our lock
                yield handle
                return
        finally:
            os.close(handle)


def cut_torn(handle: int) -> None:
    """Cut off a last line whose writing was interrupted, of a file that is `locked`."""
    size = os.fstat(handle).st_size
    if size and os.pread(handle, 1, size - 1) != b"\n":
        os.ftruncate(handle, os.pread(handle, size, 0).rfind(b"\n") + 1)


def append_synced(path: Path, handle: int, data: bytes) -> None:
    """Append to the file `path`, which is `locked`, and flush it to the disk.

    Raises OSError with its name where it cannot be written; the file is then as it was before.
    """
    size, written = os.fstat(handle).st_size, 0
    try:
        while written < len(data):
            written += os.write(handle, data[written:])
        os.fsync(handle)
    except OSError as error:
        with contextlib.suppress(OSError):  # what is left is cut off by the next to append
            os.ftruncate(handle, size)
        raise OSError(error.errno, error.strerror, str(path)) from error


def sync(path: Path) -> None:
    """Flush one file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush every file and folder below `folder`, and itself, to the disk."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def write_synced(path: Path, data: bytes) -> None:
    """Replace a small file whole: after a crash it holds the old or the new bytes.

    Raises OSError with its name where it cannot be written, and leaves nothing beside it.
    """
    aside = path.with_name(path.name + ".new")
    try:
        with aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise OSError(error.errno, error.strerror, str(path)) from error


def put_in_place(new: Path, final: Path) -> None:
    """Rename folder `new` to `final`; a folder that is there is swapped out in one step and removed.

    Where the system cannot swap, the old folder is moved aside first; `recover` mends a crash between.
    """
    old = aside(final)
    if not final.exists():
        new.rename(final)
    else:
        shutil.rmtree(old, ignore_errors=True)
        if _exchange(new, final):
            new.rename(old)
        else:
            final.rename(old)
            new.rename(final)
        shutil.rmtree(old)
    sync(final.parent)


def recover(final: Path) -> None:
    """Finish or undo a `put_in_place` that was cut off."""
    old = aside(final)
    if old.exists() and not final.exists():
        old.rename(final)
    elif old.exists():
        shutil.rmtree(old)


def aside(final: Path) -> Path:
    """Return where the folder that `final` replaces waits to be removed."""
    return final.with_name(f".{final.name}.old")


def _exchange(one: Path, other: Path) -> bool:
    """Swap two paths atomically; False where the system or file system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    done = rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE)
    if done == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EPERM):
        return False
    raise OSError(code, os.strerror(code), str(other))
