"""Readable float64 twin of `excess_cpu`."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.floating]


def excess(lengths: Array, mu: Array, weights: Array, mono: Array) -> NDArray[np.float64]:
    """Return mono − poly [ray] of `lengths` [material, ray] (mm); `mu` is [material, energy] in 1/mm."""
    depth = mu.T.astype(np.float64) @ lengths.astype(np.float64)
    poly = np.asarray(logsumexp(-depth, axis=0, b=weights[:, None]))
    return mono @ lengths.astype(np.float64) + poly
