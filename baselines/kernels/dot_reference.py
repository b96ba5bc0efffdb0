"""Readable float64 twin of `dot_cpu`."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def dot_by_row(a: Array, b: Array, weights: Array) -> NDArray[np.float64]:
    """Return Σ weights·a·b over each row of the arrays [row, n]."""
    return np.einsum("rk,rk,rk->r", weights.astype(np.float64), a.astype(np.float64), b.astype(np.float64))
