"""Products of a sparse matrix in compressed rows with a dense table, in float64."""

import numpy as np
from numpy.typing import NDArray


def multiply(
    parts: NDArray[np.int64],
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: NDArray[np.float32],
    table: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    """Do as in `sparse_cpu`; `parts` does not matter here."""
    for row in range(starts.size - 1):
        entries = slice(starts[row], starts[row + 1])
        out[row] = values[entries].astype(np.float64) @ table[columns[entries]].astype(np.float64)
