"""Products of a sparse matrix in compressed rows with a dense table, on the CPU.

A product is parallel over its rows, which are shared out by their entries, so that results are bitwise equal for any
number of threads. float32 and float64.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def multiply(
    parts: NDArray[np.int64],
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: NDArray[np.float32],
    table: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    """Fill `out` [row, feature] with the sums of values · `table` [column, feature] over the entries of each row.

    Entries of row r are `starts[r]` … `starts[r + 1]`; rows `parts[k]` … `parts[k + 1]` go to one thread at a time.
    """
    n_f = table.shape[1]
    for part in prange(parts.size - 1):
        sums = np.empty(n_f, table.dtype)
        for row in range(parts[part], parts[part + 1]):
            for f in range(n_f):
                sums[f] = 0
            for k in range(starts[row], starts[row + 1]):
                column, value = columns[k], values[k]
                for f in range(n_f):
                    sums[f] += value * table[column, f]
            for f in range(n_f):
                out[row, f] = sums[f]
