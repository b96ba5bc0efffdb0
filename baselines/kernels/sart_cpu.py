"""The update of SART: every voxel moves by a share of the weighted mean that its rays lack."""

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy")
def move(x, change, sums, relaxation, positivity):
    """Add relaxation · change / sums to `x` in place where sums are positive, and cut at zero where asked."""
    for row in prange(x.shape[0]):
        for k in range(x.shape[1]):
            for z in range(x.shape[2]):
                if sums[row, k, z] > 0:
                    value = x[row, k, z] + relaxation * change[row, k, z] / sums[row, k, z]
                    x[row, k, z] = np.float32(0.0) if positivity and value < 0 else value
