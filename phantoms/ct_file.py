"""A CT volume from a file in HU: spacing and rescale by the file or the recipe, metal refused or replaced."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.errors import InputError
from ctsim.geometry import Triple
from ctsim.io.payload import quoted
from ctsim.io.volumes.volumefile import VolumeFile
from ctsim.phantoms.ct_headers import digest_at, range_at, volume_at

ALIKE = 1e-3
"""Largest relative difference of a stated spacing to the file's: it is half a voxel over 500 of them."""
SAME = 1e-5
"""The same for slope and intercept, which NIfTI stores as float32."""
BLOOM = 2.0
"""Distance (mm) to metal within which its blur is replaced, too."""
NO_CHANGE = (1.0, 0.0)
PLATEAU = 8
"""Voxels of the greatest value in one piece from which a CT may be cut off there."""
TIMES = 10
"""So many times the next lower value's voxels, and all brighter ones', has a value at which a CT is cut off."""
ABOVE = 300.0
"""HU above which a CT may be cut off: what is cut off below has lost all bone."""
LEVELS = 32
"""Different values from which a volume is a CT that may be cut off, rather than a drawn one."""
AIR = -200.0
"""HU below which a CT has some voxel, of the air around the body; grey values and attenuations have none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settled:
    """A file with the size of its voxels (z, y, x) in mm, and slope and intercept to HU."""

    file: VolumeFile
    spacing: Triple
    rescale: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ct:
    """A CT volume: HU [z, y, x] and the size of its voxels (z, y, x) in mm."""

    hu: NDArray[np.float32]
    spacing: Triple


def settle(path: str, spacing: Triple | None, rescale: tuple[float, float] | None) -> Settled:
    """Read a file's headers and settle what it leaves open by what is stated.

    Raises InputError where something is stated by neither, or differently by both, and for a file that cannot be read.
    """
    try:
        file = volume_at(Path(path))
    except InputError as error:
        raise InputError(f"path: {error}") from None
    found = file.spacing or spacing
    if found is None:
        raise InputError(f"spacing: {path} states none; expected the size of its voxels (z, y, x) in mm")
    if spacing and not np.allclose(spacing, found, rtol=ALIKE, atol=0):
        raise InputError(f"spacing: got {spacing} mm, but {path} says {found} (z, y, x); expected the same or none")
    if not all(1e-3 <= d <= 2000 for d in found):
        raise InputError(f"path: {path} has voxels of {found} mm (z, y, x), expected 0.001 to 2000 mm")
    if rescale and file.rescale and not np.allclose(rescale, file.rescale, rtol=SAME, atol=SAME):
        raise InputError(f"rescale: got {rescale}, but {path} says {file.rescale}; expected the same or none")
    if not rescale:
        _check_hu(path, file)
    return Settled(file=file, spacing=found, rescale=file.rescale or rescale or NO_CHANGE)


def _check_hu(path: str, file: VolumeFile) -> None:
    """Refuse values that are no HU, of which nobody says that they are. Raises InputError."""
    if not file.holds_hu:
        raise InputError(
            f"rescale: {path} holds grey values ({file.dtype.name}) that cannot be HU, for air has -1000; "
            "expected a slope and an intercept"
        )
    slope, intercept = file.rescale or NO_CHANGE
    if file.unit:
        raise InputError(
            f"rescale: {path} states that its values are {quoted(file.unit)}; expected HU, or "
            f"rescale = [{slope:g}, {intercept:g}] if these are HU"
        )
    try:
        lowest, highest = (value * slope + intercept for value in range_at(file))
    except InputError as error:
        raise InputError(f"path: {error}") from None
    if lowest > AIR:
        raise InputError(
            f"rescale: {path} holds {lowest:.4g} to {highest:.4g}, but a CT in HU has air (below {AIR:g}); "
            f"expected a slope and an intercept, or rescale = [{slope:g}, {intercept:g}] if these are HU"
        )


def digest_of(file: VolumeFile) -> str:
    """Return the SHA-256 of a volume's files. Raises InputError where one cannot be read."""
    try:
        return digest_at(file)
    except InputError as error:
        raise InputError(f"path: {error}") from None


def read_hu(settled: Settled) -> NDArray[np.float32]:
    """Return the volume in HU, [z, y, x]. Raises InputError for values that are no finite HU."""
    try:
        values = settled.file.values()
    except InputError as error:
        raise InputError(f"path: {error}") from None
    slope, intercept = settled.rescale
    with np.errstate(over="ignore", invalid="ignore"):
        hu = values.astype(np.float32) * np.float32(slope) + np.float32(intercept)
    if not np.isfinite(hu).all():
        raise InputError(
            f"path: {settled.file.path} holds values that are no finite HU under rescale = {settled.rescale}"
        )
    return hu


def cut_off(hu: NDArray[np.float32]) -> tuple[float, int] | None:
    """Return the value at which a CT is cut off and the size of the largest piece of it; None where it is not.

    The brightest of a CT that is not cut off are few, and fewer than those of the next value: a histogram ends with
    its thinnest bin. One that is cut off ends with all that lay above it, but for a few hot voxels or letters. Noise
    that was added, or interpolation, hides it.
    """
    values, numbers = np.unique(hu[hu > ABOVE], return_counts=True)
    if not values.size:
        return None
    above, below = np.cumsum(numbers[::-1])[::-1] - numbers, np.concatenate([[0], numbers[:-1]])
    last = above == 0
    many = (numbers >= PLATEAU) & np.where(last, numbers > 2 * below, numbers > TIMES * np.maximum(above, below))
    if not many.any() or np.unique(hu).size < LEVELS:
        return None
    at = float(values[np.flatnonzero(many)[-1]])
    names: Any = ndimage.label(hu == at, np.ones((3, 3, 3)))[0]
    size = int(np.bincount(names.ravel())[1:].max())
    return (at, size) if size >= PLATEAU else None


def without_metal(ct: Ct, metal_hu: float) -> Ct:
    """Replace voxels above `metal_hu`, and those within `BLOOM` of them, by the nearest voxel that is neither.

    The streaks that the metal casts stay. Raises InputError where nothing but metal is there.
    """
    metal = ct.hu > metal_hu
    if not metal.any():
        return ct
    reach = np.ceil(np.divide(BLOOM, ct.spacing)).astype(int) + 1
    around = _box(metal, reach)
    outside = np.asarray(ndimage.distance_transform_edt(~metal[around], sampling=ct.spacing)) > BLOOM
    if not outside.any():
        raise InputError(f"metal_hu: all voxels are above {metal_hu:g} HU or next to such; expected a CT of a body")
    nearest: Any = ndimage.distance_transform_edt(
        ~outside, sampling=ct.spacing, return_distances=False, return_indices=True
    )
    hu = ct.hu.copy()
    hu[around] = hu[around][tuple(nearest)]
    return Ct(hu=hu, spacing=ct.spacing)


def _box(mask: NDArray[np.bool_], reach: NDArray[np.int_]) -> tuple[slice, ...]:
    """Return the box around a mask with `reach` voxels to all sides: one more than what is replaced."""
    spans = []
    for axis, margin in enumerate(reach):
        found = np.flatnonzero(mask.any(tuple(a for a in range(3) if a != axis)))
        spans.append(slice(max(0, found[0] - margin), found[-1] + margin + 1))
    return tuple(spans)
