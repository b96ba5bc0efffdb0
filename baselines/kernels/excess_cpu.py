"""What a known spectrum adds to line integrals: straight-line attenuation of the lengths, less the hardened one."""

import math

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy")
def add_excess(p, lengths, mu, weights, mono):
    """Add mono − poly of `lengths` [material, ray] (mm) to `p` [ray]; `mu` is [material, energy]."""
    for i in prange(p.size):
        _add_one(p, i, lengths, mu, weights, mono)


@njit(cache=True, error_model="numpy")
def _add_one(p, i, lengths, mu, weights, mono):
    n, n_energies = mu.shape
    straight = 0.0
    for m in range(n):
        straight += mono[m] * lengths[m, i]
    if straight <= 0:
        return
    least = np.inf
    for k in range(n_energies):
        depth = 0.0
        for m in range(n):
            depth += mu[m, k] * lengths[m, i]
        least = min(least, depth)
    signal = 0.0
    for k in range(n_energies):
        depth = 0.0
        for m in range(n):
            depth += mu[m, k] * lengths[m, i]
        signal += weights[k] * math.exp(least - depth)
    p[i] += np.float32(straight - least + math.log(signal))
