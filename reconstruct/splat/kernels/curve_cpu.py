"""A material curve, its transpose, and what steps of unknowns on it need, one pass over the unknowns each.

The curve from an unknown to two densities is piecewise linear: `knots` [knot], `densities` [knot, 2] and `slopes`
[knot − 1, 2], float64.
"""

import math

import numpy as np
from numba import njit, prange

LEAST = 1e-20  # curvature, of what no ray sees


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


@njit(parallel=True, cache=True, error_model="numpy")
def precondition(u, knots, downhill, sums, upwards, curvature, limits, halves, roots):
    """Write the roots of steps, and roots times gradients (`halves`): [unknown].

    Gradients are `sums` by both densities [unknown, 2] times the slopes `downhill`, curvatures likewise, float32.
    Of `limits`, an unknown below the first counts as that, and below the second a root is at most the third.
    """
    faint, metal, longest = limits
    for i in prange(u.size):
        k = _piece(knots, u[i])
        gradient = downhill[k, 0] * sums[i, 0] + downhill[k, 1] * sums[i, 1]
        bend = upwards[k, 0] * curvature[i, 0] + upwards[k, 1] * curvature[i, 1]
        root = math.sqrt(max(u[i], faint) / max(bend, np.float32(LEAST)))
        if u[i] < metal:
            root = min(root, longest)
        roots[i] = root
        halves[i] = root * gradient
