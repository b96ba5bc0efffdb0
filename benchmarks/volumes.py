"""Kept reconstructions: TIFF stacks that name the run they came from."""

import contextlib
import json
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError


def write_volume(path: Path, values: NDArray[np.float32], identity: str = "") -> None:
    """Write a volume [z, y, x] in 1/mm as an uncompressed TIFF stack, whole or not at all.

    `identity` is the run's; a reader can tell by it whether the file is still that run's.
    """
    import tifffile

    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".part")
    text = {"axes": "ZYX", "unit": "1/mm", "run": identity}
    try:
        tifffile.imwrite(aside, values, photometric="minisblack", metadata=text)
        os.replace(aside, path)
    finally:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)


def identity_of(path: Path) -> str | None:
    """Return the identity of the run that wrote `path`; None where there is no such volume or it does not say."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            found = json.loads(file.pages.first.description).get("run")
    except (OSError, ValueError, AttributeError, tifffile.TiffFileError):
        return None
    return found if isinstance(found, str) and found else None


def read_volume(path: Path) -> NDArray[np.float32]:
    """Read a kept volume [z, y, x] in 1/mm.

    Raises InputError where the file is not there or no volume.
    """
    import tifffile

    try:
        values = np.asarray(tifffile.imread(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such volume; run the method again with --force") from None
    except (ValueError, tifffile.TiffFileError) as error:
        raise InputError(f"{path}: cannot be read as a TIFF stack: {error}") from None
    if values.ndim != 3:
        raise InputError(f"{path}: expected a volume [z, y, x], got shape {values.shape}")
    return values
