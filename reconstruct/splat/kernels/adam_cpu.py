"""A step of Adam, and the activations that turn what it learns into scales and densities.

`torch.optim.Adam(fused=True)` takes 1 to 2.5 times as long for 5 000 to 500 000 splats, needs a tensor for each
learning rate, and imports torch's compiler at its first step, which takes a second.

`numbers` are the least scale, the range of scales, and 1/unit, as float32.
"""

import math

import numpy as np
from numba import njit, prange

FIRST, SECOND, EPS = 0.9, 0.999, 1e-15
ONE = np.float32(1)


@njit(parallel=True, cache=True, error_model="numpy")
def step(values, gradient, first, second, rates, corrections):
    """Change `values`, `first` and `second`, all flat, in place, in pieces of the size of `rates`, one a value.

    `corrections` divide the moments by 1 − β^steps. Values of all channels lie in one loop, which so is vectorised.
    """
    of_first, of_second = corrections
    size = rates.size
    for piece in prange((values.size + size - 1) // size):
        part = slice(piece * size, (piece + 1) * size)
        x, g, m, v = values[part], gradient[part], first[part], second[part]
        for i in range(x.size):
            mean = np.float32(FIRST) * m[i] + np.float32(1 - FIRST) * g[i]
            square = np.float32(SECOND) * v[i] + np.float32(1 - SECOND) * g[i] * g[i]
            m[i], v[i] = mean, square
            x[i] -= rates[i] * (mean * of_first) / (math.sqrt(square * of_second) + np.float32(EPS))


@njit(parallel=True, cache=True, error_model="numpy")
def activate(scales, densities, numbers, out_scales, out_densities):
    """Fill scales [splat, 3] by low + span·sigmoid(x) and densities [splat, channel] by softplus(x)."""
    low, span = numbers
    for i in prange(scales.shape[0]):
        for k in range(scales.shape[1]):
            out_scales[i, k] = low + span / (ONE + math.exp(-scales[i, k]))
        for c in range(densities.shape[1]):
            x = densities[i, c]
            # log(1 + eˣ) without overflow
            out_densities[i, c] = max(x, np.float32(0)) + math.log1p(math.exp(-abs(x)))


@njit(parallel=True, cache=True, error_model="numpy")
def through(given, numbers, out_scales, out_densities):
    """Take gradients by log scales and densities to those by what is learned.

    `given` are the scales, the densities before activation, and the gradients by log scales and by densities.
    """
    scales, densities, by_log_scales, by_densities = given
    low, span = numbers
    for i in prange(scales.shape[0]):
        for k in range(scales.shape[1]):
            share = (scales[i, k] - low) / span
            out_scales[i, k] = by_log_scales[i, k] * share * (ONE - share) * span / scales[i, k]  # d log s/dx
        for c in range(densities.shape[1]):
            out_densities[i, c] = by_densities[i, c] / (ONE + math.exp(-densities[i, c]))
