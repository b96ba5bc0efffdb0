"""A small matrix times each of a stack of wide ones (numba), columns in lanes.

Not BLAS: its threads stay awake beside numba's for a while, and their number may change bits.
"""

import numpy as np
from numba import njit, prange

from ctsim.kernels.lanes import WIDTH, fma, load, pick, spread, store
from ctsim.kernels.once import compiled_once

ROWS = 4  # of the result that are summed in registers together, each in two of them
PAIR = 2 * WIDTH
WIDE = 4 * PAIR  # columns that are copied together: of a long matrix, each row lies on another page
ARRAY = "float32[:,::1]"


@compiled_once(ARRAY, ARRAY, ARRAY, "float32", "int64")
def _columns(matrix, given, out, scale, first):
    """Write matrix @ given, plus scale times what is there, to the columns of `out` from `first` on, `WIDE` at most."""
    n_rows, n = matrix.shape
    width = min(WIDE, given.shape[1] - first)
    panel, tile = np.zeros((WIDE // PAIR * n, PAIR), np.float32), np.empty((ROWS, WIDE), np.float32)
    for k in range(n):
        for i in range(width):
            panel[i // PAIR * n + k, i % PAIR] = given[k, first + i]
    zero = spread(np.float32(0))
    for row in range(0, n_rows, ROWS):
        for at in range(0, width, PAIR):
            a, b, c, d = zero, zero, zero, zero
            e, f, g, h = zero, zero, zero, zero
            for k in range(n):
                here = at // PAIR * n + k
                left, right = load(panel, here, 0), load(panel, here, WIDTH)
                factor = pick(matrix, row, k)
                a, e = fma(factor, left, a), fma(factor, right, e)
                factor = pick(matrix, row + 1, k)
                b, f = fma(factor, left, b), fma(factor, right, f)
                factor = pick(matrix, row + 2, k)
                c, g = fma(factor, left, c), fma(factor, right, g)
                factor = pick(matrix, row + 3, k)
                d, h = fma(factor, left, d), fma(factor, right, h)
            store(tile, 0, at, a)
            store(tile, 1, at, b)
            store(tile, 2, at, c)
            store(tile, 3, at, d)
            store(tile, 0, at + WIDTH, e)
            store(tile, 1, at + WIDTH, f)
            store(tile, 2, at + WIDTH, g)
            store(tile, 3, at + WIDTH, h)
        for j in range(min(ROWS, out.shape[0] - row)):
            for i in range(width):
                before = scale * out[row + j, first + i] if scale != 0 else np.float32(0)
                out[row + j, first + i] = tile[j, i] + before


@njit(cache=True, error_model="numpy", parallel=True)
def _products(address, matrix, stack, out, scale):
    tasks = (stack.shape[2] + WIDE - 1) // WIDE
    for task in prange(stack.shape[0] * tasks):
        k = task // tasks
        _columns(address, matrix, stack[k], out[k], scale, task % tasks * WIDE)


def products(matrix, stack, out, scale=0.0):
    """Write matrix @ stack[k] plus `scale` times out[k], none of which is read if that is 0, to out[k].

    All are float32 and C-contiguous: the stack is [k, n, columns] and out [k, m, columns]; the matrix, [rows, n], has
    rows of zeros beyond m up to a multiple of `ROWS` (`padded_rows`).
    """
    _products(_columns.address(), matrix, stack, out, np.float32(scale))


def padded_rows(matrix):
    """Return a matrix [m, n] as float32 with rows of zeros up to a multiple of `ROWS`."""
    return np.ascontiguousarray(np.pad(matrix, [(0, -len(matrix) % ROWS), (0, 0)]), np.float32)
