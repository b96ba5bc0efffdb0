"""The open field of a scan that comes without one: the level of the columns next to the object, and its noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.geometry import few_views

SAMPLED = 24  # views that are looked at
STRIP = 0.02  # of the columns at either side, and at least 2
OPEN = 0.97  # of the brightest strip's level: a strip above it sees no object
BRIGHT = 99.0  # percentile of a whole view that an open strip must reach, to `OPEN`
AVERAGED = 3  # pixels, squared: of single ones the percentile is noise, and more of them miss a narrow open edge
LIKELY = 4.0  # standard deviations of such a mean below the percentile within which pixels pass for open
_MAD = 1.4826  # standard deviations in a median of absolute deviations from the median of normal numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenField:
    """Level of an open pixel above the pedestal, photons in it by its noise (None: no noise), and what falls short."""

    level: float
    photons: float | None
    note: str = ""


def open_field(read: Callable[[int], NDArray[Any]], n_views: int, dark: float, level: float | None = None) -> OpenField:
    """Measure the open field in the columns at the detector's sides, in up to 24 views.

    A column is open where it is as bright as the brightest. The noise is that of differences of successive views, so
    that a pattern of the pixels does not count; `read` must return pixels as they were read out, for interpolation
    takes noise away. With `level`, of a flat field, only the noise is measured. Where no
    side is open in any view, the level is that of the brightest pixels of all and the note says so.
    """
    strips, brightest = [], 0.0
    for view in few_views(n_views, SAMPLED):
        view = int(view)
        beside = view + 1 if view + 1 < n_views else max(view - 1, 0)
        pair = [_strips(read(k)) - dark for k in (view, beside)]
        strips.append((pair, [float(np.median(side)) for side in pair[0]]))
        brightest = max(brightest, _brightest(*(np.asarray(read(k), np.float64) - dark for k in (view, beside))))
    levels = np.array([found for _, found in strips])
    bar = OPEN * max(float(levels.max()), brightest) if level is None else OPEN * level
    is_open = levels >= bar
    note = ""
    if level is None:
        level = float(np.median(levels[is_open])) if is_open.any() else brightest
    if not is_open.any():
        note = "no column next to the object is open in every row: the open field is that of the brightest pixels"
    noise = [
        _MAD * float(np.median(np.abs(pair[1][side] - pair[0][side]))) / math.sqrt(2)
        for (pair, _), sides in zip(strips, is_open, strict=True)
        for side in np.flatnonzero(sides)
        if n_views > 1
    ]
    spread = float(np.median(noise)) if noise else 0.0
    return OpenField(level=level, photons=(level / spread) ** 2 if spread > 0 and level > 0 else None, note=note)


def _brightest(image: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the median of a view's brightest pixels, by their noise: that of its differences from another view.

    The percentile of means picks those that noise has raised; all within their noise of it are taken instead.
    """
    smooth = ndimage.uniform_filter(image, AVERAGED, mode="nearest")
    top = float(np.percentile(smooth, BRIGHT))
    bright = smooth >= OPEN * top
    noise = _MAD * float(np.median(np.abs(image - other)[bright])) / math.sqrt(2) / AVERAGED
    return float(np.median(image[smooth >= min(OPEN * top, top - LIKELY * noise)]))


def _strips(image: NDArray[Any]) -> NDArray[np.float64]:
    """Return the columns at the left and at the right side, [side, v, u]."""
    wide = min(max(2, int(STRIP * image.shape[1])), image.shape[1])
    return np.stack([image[:, :wide], image[:, -wide:]]).astype(np.float64)
