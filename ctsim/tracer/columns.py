"""The label volume as vertical columns: where a label changes along z, or runs of voxels with their density.

Where the rotation axis is z and the detector stands upright, all rays of a detector column share one
footprint in the xy plane. A boundary between two labels in a voxel column then splits those rays into
those below and those above it, so a view costs label changes, not voxels: about five a column for a
thorax of 256 voxels. A density map varies from voxel to voxel: there a view costs the rows that see each run.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.tracer.kernels.columns_cpu import count_boundaries, list_boundaries
from ctsim.tracer.kernels.density_cpu import list_runs
from ctsim.tracer.kernels.gather_cpu import PAD
from ctsim.types import Phantom


class Columns(NamedTuple):
    """Label boundaries of a volume (flat arrays only, for numba).

    The boundaries of voxel column (y, x) are `change`[`first`[y, x] : `first`[y, x + 1]], upwards; each
    is height | label below << 16 | label above << 24, the height counted in voxels from the grid's bottom.
    """

    first: NDArray[np.int32]
    change: NDArray[np.uint32]


class DensityColumns(NamedTuple):
    """Runs of voxels of one material, with their density (flat arrays only, for numba).

    The runs of voxel column (y, x) are `run`[`first`[y, x] : `first`[y, x + 1]], each (lowest voxel, the one after the
    highest, label, place of the lowest one's density in `values`). `values` has PAD zeros between two runs, and a zero
    for each voxel of another material within a run, of which there are less than `density_cpu.MERGED` in a row.
    """

    first: NDArray[np.int64]
    run: NDArray[np.int64]
    values: NDArray[np.float32]


def make_columns(phantom: Phantom) -> Columns | None:
    """List a phantom's label boundaries; None where a density map makes every voxel differ."""
    if phantom.density is not None or phantom.labels.shape[0] > 0xFFFF:
        return None
    n_y, n_x = phantom.labels.shape[1:]
    count = np.zeros((n_y, n_x), np.int64)
    count_boundaries(phantom.labels, count)
    first = _first(count).astype(np.int32)
    change = np.empty(int(first[-1, -1]), np.uint32)
    list_boundaries(phantom.labels, first[:, :-1].astype(np.int64), change)
    return Columns(first=first, change=change)


def make_density_columns(phantom: Phantom) -> DensityColumns | None:
    """List the runs of a phantom with a density map; None where there is no map."""
    if phantom.density is None:
        return None
    present = np.flatnonzero(np.bincount(phantom.labels.ravel(), minlength=1)[1:]) + 1
    runs, places = (np.zeros(phantom.labels.shape[1:], np.int64) for _ in range(2))
    list_runs(
        phantom.labels, phantom.density, present, runs, places, np.empty((0, 4), np.int64), np.empty(0, np.float32)
    )
    first, start = _first(runs), PAD + _first(places)
    run, values = np.empty((int(first[-1, -1]), 4), np.int64), np.zeros(int(start[-1, -1]), np.float32)
    if run.size:
        begin, places = np.ascontiguousarray(first[:, :-1]), np.ascontiguousarray(start[:, :-1])
        list_runs(phantom.labels, phantom.density, present, begin, places, run, values)
    return DensityColumns(first=first, run=run, values=values)


def _first(count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where the entries of each voxel column begin, [y, x + 1], from their number [y, x]."""
    first = np.zeros((count.shape[0], count.shape[1] + 1), np.int64)
    first[:, 1:] = np.cumsum(count.ravel()).reshape(count.shape)
    first[1:, 0] = first[:-1, -1]
    return first
