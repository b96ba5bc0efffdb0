"""A material curve and its transpose, one pass over the unknowns each.

The curve from an unknown to two densities is piecewise linear: `knots` [knot], `densities` [knot, 2] and `slopes`
[knot − 1, 2], float64.
"""

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _piece(knots, value):
    k = 0
    while k < knots.size - 2 and value >= knots[k + 1]:
        k += 1
    return k


@njit(parallel=True, cache=True, error_model="numpy")
def evaluate(u, knots, densities, slopes, unit, out):
    """Write both densities of each unknown over `unit`, `out` [unknown, 2]."""
    over = 1 / unit
    for i in prange(u.size):
        k = _piece(knots, u[i])
        past = u[i] - knots[k]
        for c in range(2):
            out[i, c] = (densities[k, c] + slopes[k, c] * past) * over


@njit(parallel=True, cache=True, error_model="numpy")
def transpose(u, knots, slopes, sums, out):
    """Write how sums by both densities [unknown, 2] change with each unknown, `out` [unknown]; slopes are float32."""
    for i in prange(u.size):
        k = _piece(knots, u[i])
        out[i] = np.float32(slopes[k, 0]) * sums[i, 0] + np.float32(slopes[k, 1]) * sums[i, 1]
