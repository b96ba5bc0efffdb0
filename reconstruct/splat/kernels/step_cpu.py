"""Steps of the splats' unknowns and what leads to them, in passes without temporaries: they are tens of millions."""

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True)
def multiply(slopes, pixels, finer, scratch, out):
    """Write slopes [view, channel, row, column] times the pixel [view, row, column] that each lies in to `out`.

    A pixel has finer × finer of them. The last columns, `scratch` of either, become 0; `out` may be `slopes`.
    """
    n_views, n_c, n_rows, n_columns = slopes.shape
    for task in prange(n_views * n_rows):
        view, row = task // n_rows, task % n_rows
        line = pixels[view, row // finer, : pixels.shape[2] - scratch]
        for c in range(n_c):
            given, product = slopes[view, c, row], out[view, c, row]
            for k in range(finer):
                for i in range(line.size):
                    product[finer * i + k] = given[finer * i + k] * line[i]
            product[n_columns - scratch :] = 0


@njit(parallel=True, cache=True)
def put_tissue(values, u, metal, index, volume):
    """Put values of unknowns below `metal`, and 0 for others, into the flat `volume` at `index`."""
    for i in prange(u.size):
        volume[index[i]] = values[i] if u[i] < metal else np.float32(0)


@njit(parallel=True, cache=True)
def move(u, metal, last, roots, halves, index, spread):
    """Step in place by a root times the flat volume `spread` at `index`, metal times its own half; 0 to `last`."""
    for i in prange(u.size):
        half = spread[index[i]] if u[i] < metal else halves[i]
        u[i] = min(max(u[i] + roots[i] * half, np.float32(0)), last)
