"""Sums of the SSIM map over a region, slice by slice: the five filtered images of a slice stay in the cache."""

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once


@njit(cache=True, fastmath={"contract"})
def _filter_slice(px, py, weights, rows, out):
    """Fill `out` [5, h, w] with the window means of x, y, x², y² and xy; `rows` [5, h + 10, w] is scratch."""
    n_taps = weights.size
    height, width = out.shape[1], out.shape[2]
    rows[:] = 0.0
    for i in range(height + n_taps - 1):
        for t in range(n_taps):
            weight = weights[t]
            for j in range(width):
                a, b = px[i, j + t], py[i, j + t]
                rows[0, i, j] += weight * a
                rows[1, i, j] += weight * b
                rows[2, i, j] += weight * a * a
                rows[3, i, j] += weight * b * b
                rows[4, i, j] += weight * a * b
    out[:] = 0.0
    for q in range(5):
        for i in range(height):
            for t in range(n_taps):
                weight = weights[t]
                for j in range(width):
                    out[q, i, j] += weight * rows[q, i + t, j]


@njit(cache=True)
def _load(source, index_v, index_u, padded):
    """Copy a slice into its padded buffer; index -1 is outside and reads as 0."""
    for i in range(index_v.size):
        for j in range(index_u.size):
            inside = index_v[i] >= 0 and index_u[j] >= 0
            padded[i, j] = source[index_v[i], index_u[j]] if inside else 0.0


@compiled_once(
    *("float64[:,::1]", "float64[:,::1]", "boolean[:,:]", "float64[::1]", "UniTuple(float64, 2)", "int64"),
    "float64[::1]",
)
def _sum_slice(px, py, region, weights, constants, k, sums):
    """Sum the SSIM map of two padded slices over `region`, into sums[k]."""
    height, width = region.shape
    c1, c2 = constants
    rows = np.empty((5, px.shape[0], width))
    m = np.empty((5, height, width))
    _filter_slice(px, py, weights, rows, m)
    total = 0.0
    for i in range(height):
        for j in range(width):
            if region[i, j]:
                a, b = m[0, i, j], m[1, i, j]
                var = m[2, i, j] - a * a + m[3, i, j] - b * b
                cov = m[4, i, j] - a * b
                total += (2 * a * b + c1) * (2 * cov + c2) / ((a * a + b * b + c1) * (var + c2))
    sums[k] = total


@njit(parallel=True, cache=True)
def _sums(sum_slice, x, y, region, weights, borders, constants):
    index_v, index_u = borders
    sums = np.zeros(len(x))
    for k in prange(len(x)):
        if region[k].any():
            px = np.empty((index_v.size, index_u.size))
            py = np.empty((index_v.size, index_u.size))
            _load(x[k], index_v, index_u, px)
            _load(y[k], index_v, index_u, py)
            _sum_slice(sum_slice, px, py, region[k], weights, constants, k, sums)
    return sums


def slice_sums(x, y, region, weights, borders, constants):
    """Sum the SSIM map of x and y over `region`, for every slice along the first axis: float64 [n].

    `borders` are the source indices of the padded rows and columns, `constants` are (c1, c2).
    """
    return _sums(_sum_slice.address(), x, y, region, weights, borders, constants)
