"""Linear interpolation over the gaps of detector rows."""

import numpy as np
from numba import njit


@njit(cache=True)
def fill_rows(image, trace, rows):
    """Bridge the gaps of `trace` in `rows` of `image` [v, u]; a gap at the edge takes its only neighbour's value."""
    n_u = image.shape[1]
    for v in rows:
        u = 0
        while u < n_u:
            if not trace[v, u]:
                u += 1
                continue
            end = u
            while end < n_u and trace[v, end]:
                end += 1
            if u > 0 or end < n_u:
                left = image[v, u - 1] if u > 0 else image[v, end]
                right = image[v, end] if end < n_u else image[v, u - 1]
                for k in range(u, end):
                    w = np.float32(k - u + 1) / np.float32(end - u + 1)
                    image[v, k] = left + w * (right - left)
            u = end
