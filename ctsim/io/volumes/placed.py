"""A volume to be written: its values, and where they are in the scanner's frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Triple


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """A volume [z, y, x]; `spacing` of its voxels and the `centre` of the array (z, y, x) are mm.

    DICOM wants to know what it is of: volumes of one `study` share their frame, `subject` is its patient.
    """

    values: NDArray[Any]
    spacing: Triple
    centre: Triple
    subject: str = "ctsim"
    study: str = ""

    @property
    def first(self) -> NDArray[np.float64]:
        """Place of the first voxel's middle (x, y, z) in mm."""
        sides = zip(self.centre, self.values.shape, self.spacing, strict=True)
        return np.array([c - (n - 1) / 2 * d for c, n, d in sides][::-1])
