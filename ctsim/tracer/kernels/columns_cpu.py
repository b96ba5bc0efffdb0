"""Path lengths of all central rays of a detector column at once, from the volume's label boundaries.

The rays of column u cross the voxel column (y, x) between the same ray parameters λ0 and λ1 (0 at the source,
1 at the pixel). A boundary at height z is met by the ray of row v(λ) = B + A·(z − source z)/λ, so rows above
both v(λ0) and v(λ1) gain λ1 − λ0 of the label above, the rare rows between them a part. Gains are entered as
differences along v and summed once. λ is an integer in 2⁻⁵⁰, so that sums are exact and what a ray does not
meet is exactly 0; the result does not depend on the order or the number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once

LANES = 16  # detector columns done together: their sums fill vector registers, their results cache lines
FIXED = 2.0**50
TINY = 1e-12  # a horizontal direction (voxels) below this counts as parallel to the axis


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
def _clip(o, d, n, t0, t1):
    """Cut [t0, t1] to where 0 ≤ o + d·t ≤ n; also 1/d."""
    d = (TINY if d >= 0 else -TINY) if abs(d) < TINY else d
    inverse = 1.0 / d
    a, b = -o * inverse, (n - o) * inverse
    return max(t0, min(a, b)), min(t1, max(a, b)), inverse


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
def _cross(columns, grid, pose, u, sums, lane):
    """Walk the footprint of detector column u (from the detector's centre) through the xy plane."""
    first, change = columns
    n_y, n_x = first.shape[0], first.shape[1] - 1
    hx, hy = pose[3] + u * pose[6] - pose[0], pose[4] + u * pose[7] - pose[1]
    ox, oy = (pose[0] - grid[6]) * grid[3], (pose[1] - grid[7]) * grid[4]
    dx, dy = hx * grid[3], hy * grid[4]
    near, end, ix = _clip(ox, dx, float(n_x), 1e-9, 1.0)
    near, end, iy = _clip(oy, dy, float(n_y), near, end)
    if not near < end:
        return
    per_row, level = 1.0 / pose[11], pose[5] - pose[2]
    middle = (sums.shape[1] - 3) / 2
    rays = (grid[8] - pose[2], 1.0 / grid[5], middle - level * per_row, per_row, level, middle)
    ux, uy = int(ix > 0), int(iy > 0)
    sx, sy = 2 * ux - 1, 2 * uy - 1
    x = min(max(int(ox + dx * near), 0), n_x - 1)
    y = min(max(int(oy + dy * near), 0), n_y - 1)
    tx, ty = (x + ux - ox) * ix, (y + uy - oy) * iy
    while True:
        far = min(max(min(tx, ty), near), end)
        low, high = first[y, x], first[y, x + 1]
        if low < high:
            _split(change, low, high, rays, near, far, sums, lane)
        near = far
        if tx <= ty:
            x += sx
            tx = (x + ux - ox) * ix
        else:
            y += sy
            ty = (y + uy - oy) * iy
        if x < 0 or y < 0 or x >= n_x or y >= n_y or near >= end:
            return


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
    n_m, n_v, n_u = lengths.shape
    sums = np.zeros((n_m, n_v + 2, LANES), np.int64)
    for u in range(u_0, min(u_0 + LANES, n_u)):
        _cross(columns, grid, pose, u - (n_u - 1) / 2, sums, u - u_0)
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
