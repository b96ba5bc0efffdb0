"""Readable float64 twin of `sart_cpu`."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def move(x: Array, change: Array, sums: Array, relaxation: float, positivity: bool) -> NDArray[np.float64]:
    """Return `x` moved by relaxation · change / sums where sums are positive, and there cut at zero where asked."""
    met = sums > 0
    moved = x[met].astype(np.float64) + relaxation * change[met].astype(np.float64) / sums[met]
    out = x.astype(np.float64)
    out[met] = np.maximum(moved, 0) if positivity else moved
    return out
