"""Binary morphology on masks [z, y, x] or [v, u]."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def _all(ndim: int) -> Mask:
    return np.ones((3,) * ndim, np.bool_)


def dilate(mask: Mask, n: int, *, corners: bool = False) -> Mask:
    """Grow a mask n times by its neighbours, those across edges and corners too where asked."""
    if not n:
        return mask
    if corners:
        return _filtered(scipy.ndimage.maximum_filter, mask, 2 * n + 1)
    return np.asarray(scipy.ndimage.binary_dilation(mask, None, n), np.bool_)


def spread(mask: Mask, reach: tuple[int, ...]) -> Mask:
    """Grow a mask by its axes' reaches (≥ 1), less aslant: where Σ |distance|/reach ≤ 1. `dilate` if all are alike."""
    if len(set(reach)) == 1:
        return dilate(mask, reach[0])
    grid = np.meshgrid(*(np.arange(-n, n + 1) / n for n in reach), indexing="ij", sparse=True)
    return np.asarray(scipy.ndimage.binary_dilation(mask, sum(map(np.abs, grid)) <= 1 + 1e-9), np.bool_)


def opened(mask: Mask) -> Mask:
    """Leave out of a mask what is thinner than three pixels."""
    return dilate(_filtered(scipy.ndimage.minimum_filter, mask, 3), 1, corners=True)


def _filtered(by: Callable[..., Any], mask: Mask, width: int) -> Mask:
    """Return a cube's dilation or erosion, which filters each axis by itself, as scipy's binary ones do not."""
    return np.asarray(by(mask.view(np.uint8), width, mode="constant"), np.bool_)


def filled(mask: Mask) -> Mask:
    """Fill the holes of a mask."""
    return np.asarray(scipy.ndimage.binary_fill_holes(mask), np.bool_)


def pieces(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """Return a mask's pieces, numbered from 1 with neighbours across edges and corners joined, and their number."""
    names, n = cast(tuple[NDArray[np.int32], int], cast(Any, scipy.ndimage.label(mask, _all(mask.ndim))))
    return names, n
