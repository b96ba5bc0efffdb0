"""A CT volume in a file or in several, of which only the headers were read; and the digest of those files."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Triple
from ctsim.io.volumes.frame import Axes


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeFile:
    """What the headers say of a volume; `read` decodes its values as they are stored, in the file's own axes.

    `files` is everything that is read, slices in their order in space. `shape` and `dtype` are those of the stored
    array. `axes` is None where the format states none: the array is then [z, y, x]. `rescale` is slope and intercept
    to HU where the file states them; `unit` is what they lead to where the file says that it is no HU.
    """

    path: Path
    files: tuple[Path, ...]
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    read: Callable[[], NDArray[Any]]
    axes: Axes | None = None
    rescale: tuple[float, float] | None = None
    unit: str = ""

    @property
    def spacing(self) -> Triple | None:
        """Size of the voxels (z, y, x) in mm; None where the format states none."""
        return self.axes.spacing if self.axes else None

    @property
    def holds_hu(self) -> bool:
        """Whether the stored type reaches −1000, the HU of air, or the file says how to get HU."""
        return self.rescale is not None or self.dtype.kind == "f" or np.iinfo(self.dtype).min <= -1000

    def values(self) -> NDArray[Any]:
        """Return the stored values as [z, y, x] in the patient's frame (`ctsim.io.volumes.frame`)."""
        values = self.read()
        return self.axes.turned(values) if self.axes else values

    def digest(self) -> str:
        """Return the SHA-256 of the file; of several, that of their SHA-256s. Names do not matter."""
        found = [_sha256(path) for path in self.files]
        return found[0] if len(found) == 1 else hashlib.sha256("".join(found).encode()).hexdigest()


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})") from None
