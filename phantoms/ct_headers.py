"""Headers, SHA-256 and range of a CT's files, found once for as long as the files do not change.

A scene needs them where it is read and where it is built, and pydicom takes seconds for the headers of a long series.
"""

import functools
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from ctsim.io.volumes.formats import open_volume
from ctsim.io.volumes.volumefile import VolumeFile

SETTLED = 2.0
"""Seconds after which a change shows: file systems round times, some to 2 s, so a younger file can change unseen."""
KEPT = 16  # volumes; a series of 300 slices takes 0.7 MB

Stamp = tuple[tuple[int | str, ...], ...]


@dataclass(frozen=True, slots=True)
class _Known:
    """A path whose links are resolved, and the stamp of what is there; `opened` is the path as it was given."""

    where: Path
    stamp: Stamp
    opened: Path = field(compare=False)


def volume_at(path: Path) -> VolumeFile:
    """Return the headers of a CT volume, as `open_volume` does, and raise InputError where it does."""
    stamp = _stamp(path)
    return _opened(_Known(path.resolve(), stamp, path.absolute())) if stamp else open_volume(path)


def digest_at(file: VolumeFile) -> str:
    """Return the SHA-256 of a volume's files, and raise InputError, as `VolumeFile.digest` does."""
    stamp = _stamp(*file.files)
    return _digest(file, stamp) if stamp else file.digest()


def range_at(file: VolumeFile) -> tuple[float, float]:
    """Return the lowest and the highest value of a volume as it is stored; raises as `VolumeFile.values`."""
    stamp = _stamp(*file.files)
    return _range(file, stamp) if stamp else _range_of(file)


@functools.lru_cache(KEPT)
def _opened(known: _Known) -> VolumeFile:
    return open_volume(known.opened)


@functools.lru_cache(KEPT)
def _digest(file: VolumeFile, stamp: Stamp) -> str:
    return file.digest()


@functools.lru_cache(KEPT)
def _range(file: VolumeFile, stamp: Stamp) -> tuple[float, float]:
    return _range_of(file)


def _range_of(file: VolumeFile) -> tuple[float, float]:
    values = file.values()
    return float(values.min()), float(values.max())


def _stamp(*paths: Path) -> Stamp:
    """Return what changes when a file, or one in a folder, does; nothing where one is missing or too young to tell."""
    try:
        files = (file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path]))
        found = [(file.name, os.stat(file)) for file in files]
    except OSError:
        return ()
    if any(time.time() - s.st_ctime < SETTLED for _, s in found):
        return ()
    return tuple((name, s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for name, s in found)
