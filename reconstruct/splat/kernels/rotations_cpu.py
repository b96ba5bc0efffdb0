"""Rotation matrices of quaternions (numba)."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def write_rotations(quaternions, rows):
    """Write R of quaternions (w, x, y, z) [splat, 4] of any length, row by row, into rows [9, splat]; 0 gives NaN."""
    for i in range(quaternions.shape[0]):
        w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
        y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
        t = 2 / (w * w + x * x + y * y + z * z)
        rows[0, i], rows[1, i], rows[2, i] = 1 - t * (y * y + z * z), t * (x * y - w * z), t * (x * z + w * y)
        rows[3, i], rows[4, i], rows[5, i] = t * (x * y + w * z), 1 - t * (x * x + z * z), t * (y * z - w * x)
        rows[6, i], rows[7, i], rows[8, i] = t * (x * z - w * y), t * (y * z + w * x), 1 - t * (x * x + y * y)
