"""The patient's frame, and how the axes of a file lie in it.

x, y and z point to the patient's left, back and head: DICOM's frame (LPS), right-handed, in mm. Volumes are [z, y, x].
NIfTI's x and y point the other way (RAS).
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import FARTHEST, Triple

FROM_RAS = np.array([-1.0, -1.0, 1.0])
"""Signs of x, y, z that turn RAS into LPS, and back."""
SKEW = 1e-3
"""Largest cosine between two axes: it shifts a volume's 500th slice by half a voxel. Gantries are tilted by degrees."""
DIGITS = 6
"""Digits of a spacing: formats that store float32 and formats that store text then agree."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axes:
    """Which axis of a file's array is nearest to z, y and x, whether it runs the other way, and its spacing in mm."""

    order: tuple[int, int, int]
    flipped: tuple[bool, bool, bool]
    spacing: Triple

    def shape(self, found: tuple[int, ...]) -> tuple[int, int, int]:
        """Return the shape [z, y, x] of a file's array."""
        z, y, x = (found[axis] for axis in self.order)
        return z, y, x

    def turned(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a file's array as [z, y, x], turned by quarter turns only and never mirrored; a view."""
        back = tuple(slice(None, None, -1 if flip else 1) for flip in self.flipped)
        return np.transpose(array, self.order)[back]


def unit_vectors(path: Path, key: str, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions [n, 3]. Raises InputError unless each is 1 long: a longer one would pass for a spacing."""
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rows, axis=1)
    if not (np.abs(lengths - 1) <= SKEW).all():
        raise InputError(f"{path} has {key} of the lengths {np.round(lengths, 4).tolist()}, expected unit vectors")
    return rows


def axes_of(steps: NDArray[np.float64], path: Path) -> Axes:
    """Find the axes from the steps between neighbours: row a is the step (x, y, z) in mm along array axis a.

    An oblique volume keeps its voxels: each axis is taken as the nearest one of the patient's.
    Raises InputError for steps that are no lengths, and for axes that do not meet at right angles.
    """
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(steps, axis=1)
    if not np.isfinite(steps).all() or not (lengths > 0).all() or lengths.max() > FARTHEST:
        raise InputError(
            f"{path} places neighbouring voxels {[float(f'{v:.6g}') for v in lengths]} mm apart; "
            "expected three positive lengths"
        )
    unit = steps / lengths[:, None]
    cosines = np.abs(unit @ unit.T - np.eye(3))
    if cosines.max() > SKEW:
        angle = np.degrees(np.arccos(min(1.0, cosines.max())))
        raise InputError(
            f"{path} has axes that meet at {angle:.4g}° (a tilted gantry, or a sheared volume); "
            "expected 90°: resample it first"
        )
    order = max(itertools.permutations(range(3)), key=lambda o: sum(abs(unit[axis, 2 - k]) for k, axis in enumerate(o)))
    z, y, x = (bool(unit[axis, 2 - k] < 0) for k, axis in enumerate(order))
    dz, dy, dx = (float(f"{lengths[axis]:.{DIGITS}g}") for axis in order)
    return Axes(order=(order[0], order[1], order[2]), flipped=(z, y, x), spacing=(dz, dy, dx))
