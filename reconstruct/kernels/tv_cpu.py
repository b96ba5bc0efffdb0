"""Forward differences of a volume [y, x, z] and their transpose, and the steps of total variation built on them.

`ratios` [3] multiply the differences along y, x and z; a dual field is [3, y, x, z].
"""

import math

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _slope(x, i, j, k, ratios):
    """Forward differences of one voxel along y, x and z."""
    here = x[i, j, k]
    a = (x[i + 1, j, k] - here) * ratios[0] if i + 1 < x.shape[0] else np.float32(0)
    b = (x[i, j + 1, k] - here) * ratios[1] if j + 1 < x.shape[1] else np.float32(0)
    c = (x[i, j, k + 1] - here) * ratios[2] if k + 1 < x.shape[2] else np.float32(0)
    return a, b, c


@njit(inline="always")
def _back(field, i, j, k, ratios):
    """Dᵀ of a field at one voxel; the field's last entries along each axis must be zero."""
    value = -(field[0, i, j, k] * ratios[0] + field[1, i, j, k] * ratios[1] + field[2, i, j, k] * ratios[2])
    if i > 0:
        value += field[0, i - 1, j, k] * ratios[0]
    if j > 0:
        value += field[1, i, j - 1, k] * ratios[1]
    if k > 0:
        value += field[2, i, j, k - 1] * ratios[2]
    return value


@njit(parallel=True, cache=True)
def primal(b, field, tau, ratios, support, positivity, x):
    """Fill `x` with b − τ Dᵀ field, zero off `support` and, if asked, where negative."""
    for i in prange(b.shape[0]):
        for j in range(b.shape[1]):
            for k in range(b.shape[2]):
                value = b[i, j, k] - tau * _back(field, i, j, k, ratios)
                if not support[i, j, k] or (positivity and value < 0):
                    value = np.float32(0)
                x[i, j, k] = value


@njit(parallel=True, cache=True)
def ascend(x, start, ahead, dual, step, momentum, ratios):
    """Step the dual field from `start` up the slopes of x, back into the unit balls, and on by its momentum: `ahead`.

    `start` may be one of the two that are written: all of a voxel's values are loaded before any is stored, and no
    other voxel's step reads or writes them.
    """
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                a, b, c = start[0, i, j, k] + step * a, start[1, i, j, k] + step * b, start[2, i, j, k] + step * c
                shrink = np.float32(1) / max(np.float32(1), np.sqrt(a * a + b * b + c * c))
                a, b, c = a * shrink, b * shrink, c * shrink
                ahead[0, i, j, k] = a + momentum * (a - dual[0, i, j, k])
                ahead[1, i, j, k] = b + momentum * (b - dual[1, i, j, k])
                ahead[2, i, j, k] = c + momentum * (c - dual[2, i, j, k])
                dual[0, i, j, k], dual[1, i, j, k], dual[2, i, j, k] = a, b, c


@njit(parallel=True, cache=True)
def sum_slopes(x, ratios, sums):
    """Fill `sums` float64 [y] with the sum of |D x| over each slab."""
    for i in prange(x.shape[0]):
        total = 0.0
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                total += math.sqrt(np.float64(a) * a + np.float64(b) * b + np.float64(c) * c)
        sums[i] = total


@njit(parallel=True, cache=True, error_model="numpy")
def normalised_slopes(x, ratios, per_delta, least, field):
    """Fill `field` with the weighted slopes over their smoothed root."""
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                u, v = math.exp(-((a * per_delta) ** 2)), math.exp(-((b * per_delta) ** 2))
                w = math.exp(-((c * per_delta) ** 2))
                root = np.sqrt(u * a * a + v * b * b + w * c * c + least * least)
                field[0, i, j, k], field[1, i, j, k], field[2, i, j, k] = u * a / root, v * b / root, w * c / root


@njit(parallel=True, cache=True, error_model="numpy")
def smoothed_slopes(x, ratios, least, field, sums):
    """Fill `field` with slopes over their smoothed root √(|D x|² + least²), and `sums` float64 [y] with the roots'."""
    for i in prange(x.shape[0]):
        total = 0.0
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                root = math.sqrt(a * a + b * b + c * c + least * least)
                total += root
                field[0, i, j, k], field[1, i, j, k], field[2, i, j, k] = a / root, b / root, c / root
        sums[i] = total


@njit(parallel=True, cache=True)
def transposed(field, ratios, gradient):
    """Fill `gradient` [y, x, z] with Dᵀ field."""
    for i in prange(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            for k in range(gradient.shape[2]):
                gradient[i, j, k] = _back(field, i, j, k, ratios)
