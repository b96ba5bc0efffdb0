"""Files that survive: flushed, replaced whole, and finished folders put in their place.

A file that is to replace another is written next to it, under a name that no other process uses, and renamed.
"""

import contextlib
import ctypes
import errno
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ctsim.dataset import process

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NEW = re.compile(r"\..+\.([0-9a-f]{8})-([0-9]+)-[0-9a-f]{8}\.new", re.DOTALL)
_SILENT = 86400.0  # seconds; a process of another machine that has not written for so long counts as ended
_swept: set[tuple[int, str]] = set()


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


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new, empty file next to `path`, which takes its place when the block ends, and is removed if it fails.

    Processes that replace the same file do not meet: the last to end has its way. What killed ones left in the folder
    is removed. Raises OSError with the name of `path` where it cannot be written.
    """
    known = (os.getpid(), str(path.parent))
    if known not in _swept:
        sweep(path.parent)
        _swept.add(known)
    # a name may have 255 bytes, four of them a letter; the whole of it is not needed
    new = path.with_name(f".{path.name[:40]}.{process.machine()}-{os.getpid()}-{secrets.token_hex(4)}.new")
    try:
        os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
        yield new
        new.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            new.unlink()
        _rename(error, new, path)
        raise


@contextlib.contextmanager
def making(folder: Path) -> Iterator[Path]:
    """Yield a new folder next to `folder`, which takes its place when the block ends, and is removed if it fails.

    Raises OSError with the name of `folder` where something in it cannot be written.
    """
    new = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(new, ignore_errors=True)
    try:
        new.mkdir(parents=True)
        yield new
        put_in_place(new, folder)
    except BaseException as error:
        shutil.rmtree(new, ignore_errors=True)
        _rename(error, new, folder)
        raise


def _rename(error: BaseException, new: Path, final: Path) -> None:
    """Raise an OSError that names nothing, or what is at `new`, with the name of what that was to become."""
    if isinstance(error, OSError) and error.errno is not None:
        named = error.filename
        if named is None or Path(os.fsdecode(named)).is_relative_to(new):
            raise OSError(error.errno, error.strerror, str(final)) from error


def is_new(name: str) -> bool:
    """Say whether a file's name is one that `replacing` makes."""
    return _NEW.fullmatch(name) is not None


def sweep(folder: Path) -> None:
    """Remove the files that processes were writing when they were killed; those of processes that may run stay."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:  # whoever cannot read it, cannot write either
        for entry in entries:
            found = _NEW.fullmatch(entry.name)
            if found is None:
                continue
            with contextlib.suppress(OSError):
                elsewhere = found[1] != process.machine() and time.time() - entry.stat().st_mtime > _SILENT
                if elsewhere or process.ended(found[1], int(found[2])):
                    os.unlink(entry.path)


def write_synced(path: Path, data: bytes) -> None:
    """Replace a small file whole: after a crash it holds the old or the new bytes.

    Raises OSError with its name where it cannot be written, and leaves no temporary file.
    """
    with replacing(path) as new, new.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


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
