"""Scatter that a scan shows by itself: what its open pixels read beyond the open field."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.geometry import few_views

NEAR = 5  # pixels a side over which noise is averaged
SIGNIFICANT = 5.0  # standard deviations of that average
NORMAL = 1.4826  # standard deviation over median deviation
DARKEST, VIEWS = 1e-3, 60  # share of the averages that may hold less than the scatter found, and where they are taken


def open_excess(p: NDArray[np.float32], valid: NDArray[np.bool_]) -> float:
    """Return scatter over the open field, S/I0, as a constant: what pixels that no shadow reaches read beyond it.

    The open field is taken without an object and so without its scatter, and nothing else makes a ray brighter than
    that but noise and a drift of the tube. `p` is −ln(signal/open), float32 [view, v, u], read where `valid`. Found is
    the median over those pixels around which, in the mean over the views, more than half of the brightest excess is
    left; 0 where that is no more than noise, as in scans without a pixel that stays open. It is at most what the
    darkest readings hold, as scatter is.
    """
    total, count = np.zeros(p.shape[1:]), np.zeros(p.shape[1:], np.int64)
    looked_at = set(few_views(len(p), VIEWS).tolist())
    dark: list[NDArray[np.float64]] = []
    for view, (reading, seen) in enumerate(zip(p, valid, strict=True)):
        signal = np.where(seen, np.exp(-reading.astype(np.float64)), 0)
        total += signal
        count += seen
        if view in looked_at:
            dark.append(ndimage.uniform_filter(signal, NEAR, mode="nearest").ravel())
    mean = np.where(count == len(p), total / len(p), 0)
    around = ndimage.uniform_filter(mean, NEAR, mode="nearest")
    brightest = float(around.max(initial=0)) - 1
    if brightest <= 0 or not (mean > 1).any():  # a filter of ones may round to more
        return 0.0
    # a median: at the object's outline a pixel is far from the mean around it
    noise = NORMAL * float(np.median(np.abs(mean - around)[mean > 1])) / NEAR
    if brightest <= SIGNIFICANT * noise:
        return 0.0
    found = float(np.median(mean[around > 1 + brightest / 2])) - 1
    return min(found, float(np.quantile(np.concatenate(dark), DARKEST)))
