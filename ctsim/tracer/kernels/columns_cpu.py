"""Path lengths of all central rays of a detector column at once, from the volume's label boundaries.

The rays of column u cross the voxel column (y, x) between the same ray parameters λ0 and λ1 (see `footprint_cpu`).
A boundary at height z is met by the ray of row v(λ) = B + A·(z − source z)/λ, so rows above both v(λ0) and v(λ1) gain
λ1 − λ0 of the label above, the rare rows between them a part. Gains are entered as differences along v and summed
once. λ is an integer in 2⁻⁵⁰, so that sums are exact and what a ray does not meet is exactly 0; the result does not
depend on the order or the number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.footprint_cpu import LANES, footprint

FIXED = 2.0**50


@njit(cache=True)
def count_boundaries(labels, count):
    """Add each voxel column's changes of label to `count` [y, x]; outside `labels` [z, y, x] the label is 0."""
    n_z, n_y, n_x = labels.shape
    for z in range(n_z + 1):
        for y in range(n_y):
            for x in range(n_x):
                below = labels[z - 1, y, x] if z > 0 else 0
                above = labels[z, y, x] if z < n_z else 0
                count[y, x] += below != above


@njit(cache=True)
def list_boundaries(labels, at, change):
    """Write each column's boundaries, upwards, into `change` from place `at` [y, x] on, which moves past them."""
    n_z, n_y, n_x = labels.shape
    for z in range(n_z + 1):
        for y in range(n_y):
            for x in range(n_x):
                below = np.uint32(labels[z - 1, y, x] if z > 0 else 0)
                above = np.uint32(labels[z, y, x] if z < n_z else 0)
                if below != above:
                    change[at[y, x]] = np.uint32(z) | below << np.uint32(16) | above << np.uint32(24)
                    at[y, x] += 1


@njit(inline="always", error_model="numpy")
def _row(a, n_v):
    """First row at or above the height whose image is at row `a`, within 0…n_v + 1."""
    return n_v + 1 - int(n_v + 1 - min(max(a, 0.0), n_v + 1.0))


@njit(inline="always", error_model="numpy")
def _split(change, low, high, rays, near, far, sums, lane):
    """Enter the boundaries change[low:high] of one voxel column, crossed from λ `near` to λ `far`."""
    n_v = sums.shape[1] - 2
    source_z, d_z, row_0, per_row, level, middle = rays
    gain = np.int64(far * FIXED) - np.int64(near * FIXED)
    scale_near, scale_far = per_row / near, per_row / far
    for k in range(low, high):
        word = change[k]
        below, above = (word >> np.uint32(16)) & np.uint32(255), word >> np.uint32(24)
        rise = np.float64(word & np.uint32(0xFFFF)) * d_z + source_z
        i, j = _row(rise * scale_near + row_0, n_v), _row(rise * scale_far + row_0, n_v)
        top = max(i, j)
        sums[above, top, lane] += gain
        sums[below, top, lane] -= gain
        for v in range(min(i, j), min(top, n_v)):
            meets = np.int64(rise / (level + (v - middle) / per_row) * FIXED)
            part = meets - np.int64(near * FIXED) if v >= i else np.int64(far * FIXED) - meets
            part = min(max(part, 0), gain)
            sums[above, v, lane] += part
            sums[above, v + 1, lane] -= part
            sums[below, v, lane] -= part
            sums[below, v + 1, lane] += part


@njit(cache=True, error_model="numpy")
def _lengths(sums, pose, u_0, lengths):
    """Sum the differences along v and turn λ into mm: `lengths` [material, v, u] from column u_0 on."""
    n_m, n_v, n_u = lengths.shape
    lanes = min(LANES, n_u - u_0)
    across, total = np.zeros(LANES), np.zeros((n_m, LANES), np.int64)
    for lane in range(lanes):
        u = u_0 + lane - (n_u - 1) / 2
        across[lane] = (pose[3] + u * pose[6] - pose[0]) ** 2 + (pose[4] + u * pose[7] - pose[1]) ** 2
    longest = np.empty(LANES)
    for v in range(n_v):
        height = pose[5] - pose[2] + (v - (n_v - 1) / 2) * pose[11]
        for lane in range(LANES):
            longest[lane] = math.sqrt(across[lane] + height * height) * (1.0 / FIXED)
        for m in range(1, n_m):
            for lane in range(LANES):
                total[m, lane] += sums[m, v, lane]
            for lane in range(lanes):
                lengths[m, v, u_0 + lane] = total[m, lane] * longest[lane]


@compiled_once("Tuple((int32[:,::1], uint32[::1]))", "float64[::1]", "float64[::1]", "int64", "float32[:,:,::1]")
def _block(columns, grid, pose, u_0, lengths):
    first, change = columns
    starts, steps = first.ravel(), int(grid[0] + grid[1])
    cells, ends = np.empty(steps, np.int64), np.empty(steps + 1)
    n_m, n_v, n_u = lengths.shape
    sums = np.zeros((n_m, n_v + 2, LANES), np.int64)
    per_row, level, middle = 1.0 / pose[11], pose[5] - pose[2], (n_v - 1) / 2
    rays = (grid[8] - pose[2], 1.0 / grid[5], middle - level * per_row, per_row, level, middle)
    for u in range(u_0, min(u_0 + LANES, n_u)):
        for k in range(footprint(grid, pose, u - (n_u - 1) / 2, cells, ends)):
            low, high = starts[cells[k]], starts[cells[k] + 1]
            if low < high:
                _split(change, low, high, rays, ends[k], ends[k + 1], sums, u - u_0)
    _lengths(sums, pose, u_0, lengths)


@njit(parallel=True, cache=True, error_model="numpy")
def _blocks(block, columns, grid, pose, order, lengths):
    for index in prange(order.size):
        _block(block, columns, grid, pose, order[index] * LANES, lengths)


def fill_view(columns, grid, pose, order, lengths):
    """Fill `lengths` [material, v, u] (mm, float32) of one view with what the central rays cross in the volume.

    `columns` is (first, change) of `ctsim.tracer.columns`, `grid` [9] as in `ctsim.tracer.bricks`; `pose` [12] must be
    upright: u step horizontal, v step along +z. `order` [block] is the order of work on blocks of LANES detector
    columns. Material 0 is left alone.
    """
    _blocks(_block.address(), columns, grid, pose, order, lengths)
