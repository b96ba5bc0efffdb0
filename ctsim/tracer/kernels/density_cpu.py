"""Path lengths times density of all central rays of a detector column at once, from runs of voxels along z.

The rays of column u cross the voxel column (y, x) between the same ray parameters λ (see `footprint_cpu`), at heights
that are linear in λ and in the row v. Where no ray climbs more than a voxel, it meets the voxel of its upper end
and perhaps the one below: two densities, and the share of the way below the plane between them. That is vector
code over the rows. Steeper stretches are cut into shorter ones. Every ray is summed in the order of its footprint,
in float64, so results are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.footprint_cpu import LANES, footprint
from ctsim.tracer.kernels.gather_cpu import PAD, WIDTH, add_rows

MERGED = 16  # voxels of others within a run: as long to pass in a loop over rows as to begin another run
SHORTEST = 1e-12  # a step of λ
FLAT = 1e-300  # a slope below this counts as this


@njit(cache=True, error_model="numpy")
def _runs(labels, density, y, x, m, k, at, run, value):
    """List the runs of material m in voxel column (y, x) from run k and place `at` on; return what follows them.

    With an empty `run` they are counted only.
    """
    last, begun = -MERGED - 1, k
    for z in range(labels.shape[0]):
        if labels[z, y, x] == m:
            if z - last > MERGED:
                at += PAD if k > begun else 0
                last, k = z - 1, k + 1
                if run.size:
                    run[k - 1, 0], run[k - 1, 2], run[k - 1, 3] = z, m, at
            at += z - last
            last = z
            if run.size:
                run[k - 1, 1], value[at - 1] = z + 1, density[z, y, x]
    return k, at + PAD if k > begun else at


@njit(parallel=True, cache=True, error_model="numpy")
def list_runs(labels, density, present, first, start, run, value):
    """List the runs of voxels of one material in each voxel column, and their densities.

    `labels`, `density` [z, y, x]; `present` [k] are the labels to list. The runs of column (y, x) begin at run
    `first` [y, x] and `start` [y, x] in `value`. Where `run` [n, 4] and `value` are empty, the numbers of runs and of
    places are written to `first` and `start` instead.
    """
    _, n_y, n_x = labels.shape
    for y in prange(n_y):
        for x in range(n_x):
            k, at = (first[y, x], start[y, x]) if run.size else (0, 0)
            for m in present:
                k, at = _runs(labels, density, y, x, m, k, at, run, value)
            if run.size == 0:
                first[y, x], start[y, x] = k, at


@njit(inline="always", error_model="numpy")
def _cross(run, r, values, rays, near, far, slope, inverse, total):
    """Add to `total` [material, v] what the rays meet in run r between λ `near` and `far`."""
    base, per_row, row_0, n_v = rays
    bottom, size, material, place = base - run[r, 0], run[r, 1] - run[r, 0], run[r, 2], run[r, 3]
    low, high = -bottom * per_row, (size - bottom) * per_row
    while near < far:
        # the rows of which a part is in the run; others meet its zeros
        first = int(min(max(min(low / near, low / far) + row_0, 0.0), float(n_v)))
        last = int(min(max(max(high / near, high / far) + row_0 + 1.0, 0.0), float(n_v)))
        if first >= last:
            return
        steepest = max(abs(slope[first]), abs(slope[last - 1]))
        to = far if steepest * (far - near) <= 1.0 else min(far, near + max(1.0 / steepest, SHORTEST))
        for v in range(first, last, WIDTH):
            add_rows(total, material, slope, inverse, v, values, place, size, bottom, near, to)  # pyright: ignore[reportCallIssue]  numba supplies the context
        near = to


@njit(cache=True, error_model="numpy")
def _write(total, pose, u, lengths):
    """Turn what detector column u has collected, `total` [material, v], into mm in `lengths` [material, v, u]."""
    n_m, n_v, n_u = lengths.shape
    across = u - (n_u - 1) / 2
    square = (pose[3] + across * pose[6] - pose[0]) ** 2 + (pose[4] + across * pose[7] - pose[1]) ** 2
    for v in range(n_v):
        height = pose[5] - pose[2] + (v - (n_v - 1) / 2) * pose[11]
        longest = math.sqrt(square + height * height)
        for m in range(1, n_m):
            lengths[m, v, u] = total[m, v] * longest


@compiled_once(
    *("Tuple((int64[:,::1], int64[:,::1], float32[::1]))", "float64[::1]", "float64[::1]", "int64", "float32[:,:,::1]"),
)
def _block(columns, grid, pose, u_0, lengths):
    first, run, values = columns
    n_m, n_v, n_u = lengths.shape
    starts, steps = first.ravel(), int(grid[0] + grid[1])
    cells, ends = np.empty(steps, np.int64), np.empty(steps + 1)
    # vectors may begin at any row
    slope, inverse, total = np.empty(n_v + WIDTH), np.empty(n_v + WIDTH), np.empty((n_m, n_v + WIDTH))
    for v in range(slope.size):
        slope[v] = (pose[5] - pose[2] + (v - (n_v - 1) / 2) * pose[11]) * grid[5]
        inverse[v] = 1.0 / max(abs(slope[v]), FLAT)
    per_row = 1.0 / (pose[11] * grid[5])
    rays = (pose[2] - grid[8]) * grid[5], per_row, -slope[0] * per_row, n_v
    for u in range(u_0, min(u_0 + LANES, n_u)):
        total[:] = 0.0
        for k in range(footprint(grid, pose, u - (n_u - 1) / 2, cells, ends)):
            for r in range(starts[cells[k]], starts[cells[k] + 1]):
                _cross(run, r, values, rays, ends[k], ends[k + 1], slope, inverse, total)
        _write(total, pose, u, lengths)


@njit(parallel=True, cache=True, error_model="numpy")
def _blocks(block, columns, grid, pose, order, lengths):
    for index in prange(order.size):
        _block(block, columns, grid, pose, order[index] * LANES, lengths)


def fill_view(columns, grid, pose, order, lengths):
    """Fill `lengths` [material, v, u] (mm, float32) of one view with what the central rays cross in the volume.

    `columns` is (first, run, values) of `ctsim.tracer.columns.DensityColumns`; `grid`, `pose`, `order` and material 0
    as in `columns_cpu.fill_view`.
    """
    _blocks(_block.address(), columns, grid, pose, order, lengths)
