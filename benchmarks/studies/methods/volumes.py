"""Kept reconstructions: TIFF stacks that name the run they came from."""

import json
import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsim.durable import replacing
from ctsim.errors import InputError
from ctsim.tiffstack import write_all

# what tifffile (TiffFileError is a ValueError) and JSON raise for files that are cut short or changed
DAMAGED = (ValueError, LookupError, AttributeError, TypeError, RecursionError, struct.error)


def write_volume(path: Path, values: NDArray[np.float32], identity: str = "") -> None:
    """Write a volume [z, y, x] in 1/mm as an uncompressed TIFF stack, whole or not at all.

    `identity` is the run's; a reader can tell by it whether the file is still that run's.
    """
    import tifffile

    path.parent.mkdir(parents=True, exist_ok=True)
    text = {"axes": "ZYX", "unit": "1/mm", "run": identity}
    with replacing(path) as new:
        tifffile.imwrite(new, shape=values.shape, dtype=np.float32, photometric="minisblack", metadata=text)
        with tifffile.TiffFile(new) as laid_out:
            offset = laid_out.series[0].dataoffset
        if offset is None:
            raise RuntimeError(f"{new}: tifffile did not lay the volume out in one piece")
        handle = os.open(new, os.O_WRONLY)
        try:
            write_all(handle, np.ascontiguousarray(values, np.float32), offset)  # says why a disk refuses
        finally:
            os.close(handle)


def keep(path: Path, values: NDArray[np.float32], at_50kev: NDArray[np.float32] | None, identity: str) -> None:
    """Write a run's volume, and beside it the one at 50 keV; without one, that of an earlier run of this name goes."""
    write_volume(path, values, identity)
    beside = at_50kev_of(path)
    if at_50kev is None:
        beside.unlink(missing_ok=True)
    else:
        write_volume(beside, at_50kev, identity)


def at_50kev_of(path: Path) -> Path:
    """Return where the volume at 50 keV of a kept volume's run lies."""
    return path.parent / "50kev" / path.name


def own_at_50kev(path: Path, identity: str) -> Path | None:
    """Return where the volume at 50 keV of a kept volume's run lies; None where that very run has none."""
    beside = at_50kev_of(path)
    return beside if identity_of(beside) == identity else None


def identity_of(path: Path) -> str | None:
    """Return the identity of the run that wrote `path`; None where there is no such volume or it does not say."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            found = json.loads(file.pages.first.description).get("run")
    except (OSError, *DAMAGED):
        return None
    return found if isinstance(found, str) and found else None


def map_volume(path: Path) -> NDArray[np.float32]:
    """Map a kept volume [z, y, x] in 1/mm, reading nothing yet.

    Raises InputError where the file is damaged.
    """
    import tifffile

    try:
        return tifffile.memmap(path, mode="r")
    except DAMAGED as error:
        raise InputError(f"{path}: cannot be read ({error}); run the method again with --force") from None


def read_volume(path: Path) -> NDArray[np.float32]:
    """Read a kept volume [z, y, x] in 1/mm, which is not compressed: no more than the file holds.

    Raises InputError where the file is not there or no volume.
    """
    try:
        values = np.array(map_volume(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such volume; run the method again with --force") from None
    if values.ndim != 3:
        raise InputError(f"{path}: expected a volume [z, y, x], got shape {values.shape}")
    return values
