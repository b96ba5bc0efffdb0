"""Weighted dot products, one a row, so that their sum has one order for any number of threads."""

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True, fastmath={"reassoc", "contract"})
def dot_by_row(a, b, weights, sums):
    """Fill `sums` float64 [row] with Σ weights·a·b over each row of the arrays [row, n]."""
    for row in prange(a.shape[0]):
        total = 0.0
        for k in range(a.shape[1]):
            total += np.float64(weights[row, k]) * a[row, k] * b[row, k]
        sums[row] = total
