"""The label volume as vertical columns: only where a label changes along z is kept.

Where the rotation axis is z and the detector stands upright, all rays of a detector column share one
footprint in the xy plane. A boundary between two labels in a voxel column then splits those rays into
those below and those above it, so a view costs label changes, not voxels: about five a column for a
thorax of 256 voxels. A density map varies from voxel to voxel and is left to `ctsim.tracer.bricks`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.tracer.kernels.columns_cpu import count_boundaries, list_boundaries
from ctsim.types import Phantom


class Columns(NamedTuple):
    """Label boundaries of a volume (flat arrays only, for numba).

    The boundaries of voxel column (y, x) are `change`[`first`[y, x] : `first`[y, x + 1]], upwards; each
    is height | label below << 16 | label above << 24, the height counted in voxels from the grid's bottom.
    """

    first: NDArray[np.int32]
    change: NDArray[np.uint32]


def make_columns(phantom: Phantom) -> Columns | None:
    """List a phantom's label boundaries; None where a density map makes every voxel differ."""
    if phantom.density is not None or phantom.labels.shape[0] > 0xFFFF:
        return None
    n_y, n_x = phantom.labels.shape[1:]
    count = np.zeros((n_y, n_x), np.int64)
    count_boundaries(phantom.labels, count)
    ends = np.cumsum(count.ravel())
    first = np.zeros((n_y, n_x + 1), np.int32)
    first[:, 1:] = ends.reshape(n_y, n_x)
    first[1:, 0] = first[:-1, -1]
    change = np.empty(int(ends[-1]), np.uint32)
    list_boundaries(phantom.labels, first[:, :-1].astype(np.int64), change)
    return Columns(first=first, change=change)
