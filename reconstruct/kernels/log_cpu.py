"""Line integrals from counts, pixel by pixel: −ln of the signal, and which pixels are clamped."""

import math

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True)
def look_up(counts, table, low, log_open, dead, p, clamped):
    """Fill `p` and `clamped` [view, v, u] from integer counts; `table` and `low` [count]: logarithm, clamped or not."""
    n_view, n_v, n_u = counts.shape
    for row in prange(n_view * n_v):
        view, v = row // n_v, row % n_v
        for u in range(n_u):
            c = counts[view, v, u]
            p[view, v, u] = log_open[v, u] - table[c]
            clamped[view, v, u] = low[c] | dead[v, u]


@njit(parallel=True, cache=True)
def take_log(counts, dark, floor, log_open, dead, p, clamped):
    """Fill `p` and `clamped` [view, v, u] from float32 counts; `log_open` and `dead` [v, u] are of the open field."""
    n_view, n_v, n_u = counts.shape
    for row in prange(n_view * n_v):
        view, v = row // n_v, row % n_v
        for u in range(n_u):
            signal = counts[view, v, u] - dark
            seen = floor < signal < np.float32(np.inf)
            p[view, v, u] = log_open[v, u] - math.log(signal if seen else floor)
            clamped[view, v, u] = (not seen) | dead[v, u]
