"""Joseph's line integrals through a voxel volume, and their exact transpose, on the CPU.

Lengths are counted in voxels from the centre of voxel 0, the ray parameter λ from the source (0) to the pixel
(1). A ray is sampled on the planes of voxel centres normal to its main axis, the one along which it meets most
planes. Where the detector stands upright all rays of a detector column share their place in the xy plane: two
voxel columns are blended once, then read along z for all rows, or, in the transpose, one voxel column's worth of
rows is gathered and given to both. Other poses go ray by ray. Work is shared out by detector columns in one
direction and by planes of voxels in the other, so that results are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ctsim.kernels.once import compiled_once

LANES = 16  # detector columns done together, written as whole cache lines
PLANES = 4  # planes of voxels that share one reading of the views
CHUNK_BYTES = 1 << 26
FAST = {"contract", "reassoc", "nsz", "arcp"}


def project(
    volume: NDArray[np.float32],
    poses: NDArray[np.float64],
    grid: NDArray[np.float64],
    rows: NDArray[np.int64],
    projections: NDArray[np.float32],
) -> None:
    """Fill `projections` [view, v, u] with the line integrals of `volume` [y, x, z] (1/mm).

    `poses` [view, 12] as `Geometry.pose_array`; `grid` is (d_z, d_y, d_x, off_z, off_y, off_x), mm;
    `rows` [view, 2] is the range of detector rows wanted, the others become zero.
    """
    lines, size = _in_voxels(poses, grid, volume.shape), np.ascontiguousarray(grid[2::-1])
    upright = _upright(lines, projections.shape)
    filled = np.zeros(volume.shape[:2], np.bool_)
    _find_filled(volume, filled)
    shape, flat = np.array(volume.shape), volume.reshape(-1)
    for fill, which in ((_fill_columns, upright), (_fill_rays, ~upright)):
        views = np.flatnonzero(which)
        if views.size:
            fill(flat, filled.reshape(-1), shape, lines, size, rows, views, projections)


def backproject(
    projections: NDArray[np.float32],
    poses: NDArray[np.float64],
    grid: NDArray[np.float64],
    rows: NDArray[np.int64],
    volume: NDArray[np.float32],
) -> None:
    """Add the transpose of `project`, applied to `projections`, to `volume` [y, x, z]."""
    lines, size = _in_voxels(poses, grid, volume.shape), np.ascontiguousarray(grid[2::-1])
    upright = _upright(lines, projections.shape)
    shape, flat = np.array(volume.shape), volume.reshape(-1)
    _, n_v, n_u = projections.shape
    chunk = max(1, CHUNK_BYTES // (4 * (n_v + 2) * n_u))
    for add, which in ((_add_columns, upright), (_add_rays, ~upright)):
        chosen = np.flatnonzero(which)
        for first in range(0, chosen.size, chunk):
            views = chosen[first : first + chunk]
            scaled = np.zeros((views.size, n_u, n_v + 2), np.float32)
            live = np.zeros((views.size, n_u), np.bool_)
            _scale(projections, lines, size, rows, views, scaled, live)
            for axis in range(3 if add is _add_rays else 2):
                add(scaled, live, shape, lines, views, axis, flat)


def _in_voxels(poses: NDArray[np.float64], grid: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the poses with places in voxels from the centre of voxel 0 and steps in voxels, [view, 12]."""
    n = np.array([shape[1], shape[0], shape[2]])
    d, off = grid[2::-1], grid[:2:-1]
    first = (0.5 - n / 2) * d + off
    lines = np.array(poses, np.float64).reshape(-1, 4, 3)
    lines[:, :2] -= first
    return np.ascontiguousarray((lines / d).reshape(-1, 12))


def _upright(lines: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Tell the views whose u step is horizontal, whose v step is upward and whose rays all have main axis x or y."""
    _, n_v, n_u = shape
    straight = (lines[:, 8] == 0) & (lines[:, 9] == 0) & (lines[:, 10] == 0) & (lines[:, 11] > 0)
    u = np.arange(n_u) - (n_u - 1) / 2
    across = lines[:, 3:5, None] + u * lines[:, 6:8, None] - lines[:, :2, None]
    rise = np.abs(lines[:, 5] - lines[:, 2]) + (n_v - 1) / 2 * lines[:, 11]
    return straight & (rise <= np.abs(across).max(1).min(1))


@njit(parallel=True, cache=True)
def _find_filled(volume, filled):
    """Mark the voxel columns that are not zero throughout; NaN counts as filled."""
    for y in prange(volume.shape[0]):
        for x in range(volume.shape[1]):
            for z in range(volume.shape[2]):
                if volume[y, x, z] != 0:
                    filled[y, x] = True
                    break


@njit(inline="always")
def _length(line, size, v, u):
    """Length (mm) of ray (v, u) between two planes of its main axis; v, u from the detector's middle."""
    x = line[3] + u * line[6] + v * line[9] - line[0]
    y = line[4] + u * line[7] + v * line[10] - line[1]
    z = line[5] + u * line[8] + v * line[11] - line[2]
    length = math.sqrt((x * size[0]) ** 2 + (y * size[1]) ** 2 + (z * size[2]) ** 2)
    return length / max(abs(x), abs(y), abs(z))


@njit(parallel=True, cache=True, error_model="numpy")
def _fill_blocks(fill_block, volume, filled, shape, lines, size, rows, views, projections):
    blocks = (projections.shape[2] + LANES - 1) // LANES
    for index in prange(views.size * blocks):
        view, u = views[index // blocks], index % blocks * LANES
        _fill_block(fill_block, volume, filled, shape, lines, size, rows, view, u, projections)


def _fill_columns(*arguments):
    _fill_blocks(_fill_block.address(), *arguments)


@compiled_once(
    *("float32[::1]", "boolean[::1]", "int64[::1]", "float64[:,::1]", "float64[::1]", "int64[:,::1]"),
    *("int64", "int64", "float32[:,:,::1]"),
)
def _fill_block(volume, filled, shape, lines, size, rows, view, u_0, projections):
    _, n_v, n_u = projections.shape
    total = np.zeros((LANES, n_v), np.float32)
    first, last = max(rows[view, 0], 0), min(rows[view, 1], n_v)
    lanes = min(LANES, n_u - u_0)
    for lane in range(lanes):
        _fill_column(volume, filled, shape, lines[view], u_0 + lane - (n_u - 1) / 2, first, last, total[lane])
    line = lines[view]
    for v in range(n_v):
        for lane in range(lanes):
            length = _length(line, size, v - (n_v - 1) / 2, u_0 + lane - (n_u - 1) / 2)
            projections[view, v, u_0 + lane] = total[lane, v] * length


@njit(inline="always", error_model="numpy")
def _cross(i, j, n_j, across, along):
    """Return the voxel columns at place j on plane i and at the next, and their weights, 0 for a missing one."""
    low = int(math.floor(j))
    part = j - low
    left, right = i * along + low * across, i * along + (low + 1) * across
    w_left, w_right = 1.0 - part, part
    if low < 0:
        left, w_left = right, 0.0
    if low + 1 >= n_j:
        right, w_right = left, 0.0
    return left, right, np.float32(w_left), np.float32(w_right)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _fill_column(volume, filled, shape, line, u, first, last, total):
    """Sum the samples of one detector column's rows first … last, without their step length."""
    n_y, n_x, n_z = shape[0], shape[1], shape[2]
    hx, hy = line[3] + u * line[6] - line[0], line[4] + u * line[7] - line[1]
    along_x = abs(hx) >= abs(hy)
    s_i, h_i, n_i, along = (line[0], hx, n_x, 1) if along_x else (line[1], hy, n_y, n_x)
    s_j, h_j, n_j, across = (line[1], hy, n_y, n_x) if along_x else (line[0], hx, n_x, 1)
    height = line[5] - (total.size - 1) / 2 * line[11] - line[2]
    blend = np.zeros(n_z + 3, np.float32)
    index, part = np.empty(total.size, np.int32), np.empty(total.size, np.float32)
    for i in range(n_i):
        share = (i - s_i) / h_i
        j = s_j + share * h_j
        if not (0.0 < share < 1.0 and -1.0 < j < n_j):
            continue
        left, right, w_left, w_right = _cross(i, j, n_j, across, along)
        if not (filled[left] or filled[right]):
            continue
        slope, base = share * line[11], line[2] + share * height
        low = int(math.ceil(min(max((-1.0 - base) / slope, first), last)))
        high = int(math.floor(min(max((n_z - base) / slope, first - 1), last - 1))) + 1
        if low >= high:
            continue
        a, b = volume[left * n_z : left * n_z + n_z], volume[right * n_z : right * n_z + n_z]
        middle = blend[1 : n_z + 1]
        for z in range(middle.size):
            middle[z] = w_left * a[z] + w_right * b[z]
        step, origin = np.float32(slope), np.float32(base + slope * low + 1.0)
        rows, at, rest = total[low:high], index[: high - low], part[: high - low]
        for v in range(rows.size):
            place = origin + step * np.float32(v)
            at[v] = np.int32(place)
            rest[v] = place - np.float32(np.int32(place))
        for v in range(rows.size):
            k = np.uint32(at[v])
            rows[v] += blend[k] + rest[v] * (blend[k + np.uint32(1)] - blend[k])


@njit(parallel=True, cache=True, error_model="numpy")
def _scale(projections, lines, size, rows, views, scaled, live):
    """Copy the wanted rows times their step length to [view, u, 1 + v], and mark columns that are not zero."""
    _, n_v, n_u = projections.shape
    for index in prange(views.size):
        view = views[index]
        line = lines[view]
        for v in range(max(rows[view, 0], 0), min(rows[view, 1], n_v)):
            for u in range(n_u):
                value = projections[view, v, u]
                if value != 0:
                    length = _length(line, size, v - (n_v - 1) / 2, u - (n_u - 1) / 2)
                    scaled[index, u, v + 1] = value * length
                    live[index, u] = True


@njit(parallel=True, cache=True, error_model="numpy")
def _add_columns(scaled, live, shape, lines, views, axis, volume):
    n_i = shape[1] if axis == 0 else shape[0]
    for slab in prange((n_i + PLANES - 1) // PLANES):
        _add_slab(scaled, live, shape, lines, views, axis, slab, volume)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _add_slab(scaled, live, shape, lines, views, axis, slab, volume):
    """Add all detector columns with this main axis to the voxels of one slab."""
    n_z, n_v = shape[2], scaled.shape[2] - 2
    n_i, n_j = (shape[1], shape[0]) if axis == 0 else (shape[0], shape[1])
    along, across = (1, shape[1]) if axis == 0 else (shape[1], 1)
    middle = (scaled.shape[1] - 1) / 2
    sums, gap, index = np.empty(n_z, np.float32), np.empty(n_z, np.float32), np.empty(n_z, np.int32)
    for k in range(views.size):
        line = lines[views[k]]
        height = line[5] - (n_v - 1) / 2 * line[11] - line[2]
        for u in range(scaled.shape[1]):
            hx, hy = line[3] + (u - middle) * line[6] - line[0], line[4] + (u - middle) * line[7] - line[1]
            if not live[k, u] or (abs(hx) >= abs(hy)) != (axis == 0):
                continue
            h_i, h_j = (hx, hy) if axis == 0 else (hy, hx)
            column = scaled[k, u]
            for i in range(slab * PLANES, min(slab * PLANES + PLANES, n_i)):
                share = (i - line[axis]) / h_i
                j = line[1 - axis] + share * h_j
                if not (0.0 < share < 1.0 and -1.0 < j < n_j):
                    continue
                left, right, w_left, w_right = _cross(i, j, n_j, across, along)
                slope, base = share * line[11], line[2] + share * height
                low = int(math.ceil(min(max(base - 1.0, 0.0), n_z)))
                high = int(math.floor(min(max(base + slope * (n_v - 1) + 1.0, -1.0), n_z - 1))) + 1
                if low >= high:
                    continue
                # Rows within one voxel of height z: from the first above z − 1, which lies `gap` above it.
                step, inverse = np.float32(slope), np.float32(1.0 / slope)
                origin = np.float32((low - 1.0 - base) / slope)
                part, at, rest = sums[: high - low], index[: high - low], gap[: high - low]
                for z in range(part.size):
                    place = origin + inverse * np.float32(z)
                    row = min(max(np.floor(place) + np.float32(1.0), np.float32(0.0)), np.float32(n_v))
                    at[z] = np.int32(row) + 1
                    rest[z] = (row - place) * step - np.float32(1.0)
                    part[z] = 0.0
                for tap in range(int(math.ceil(min(2.0 / slope, n_v)))):
                    offset = np.float32(tap * slope)
                    for z in range(part.size):
                        weight = np.float32(1.0) - abs(rest[z] + offset)
                        v = np.uint32(min(at[z] + np.int32(tap), np.int32(n_v + 1)))
                        part[z] += max(weight, np.float32(0.0)) * column[v]
                a = volume[left * n_z + low : left * n_z + high]
                b = volume[right * n_z + low : right * n_z + high]
                for z in range(part.size):
                    a[z] += w_left * part[z]
                for z in range(part.size):
                    b[z] += w_right * part[z]


@njit(inline="always", error_model="numpy")
def _sample(line, shape, main, i, u, v):
    """Return where ray (v, u) meets plane i of its main axis: in order the other two axes' places, and whether."""
    share = (i - line[main]) / (line[3 + main] + u * line[6 + main] + v * line[9 + main] - line[main])
    a, b = (1 if main == 0 else 0), (1 if main == 2 else 2)
    at_a = line[a] + share * (line[3 + a] + u * line[6 + a] + v * line[9 + a] - line[a])
    at_b = line[b] + share * (line[3 + b] + u * line[6 + b] + v * line[9 + b] - line[b])
    meets = 0.0 < share < 1.0 and -1.0 < at_a < shape[a] and -1.0 < at_b < shape[b]
    return a, b, at_a, at_b, meets


@njit(inline="always")
def _ray_axis(line, u, v):
    """Axis along which ray (v, u) meets most planes: 0 x, 1 y, 2 z."""
    x = abs(line[3] + u * line[6] + v * line[9] - line[0])
    y = abs(line[4] + u * line[7] + v * line[10] - line[1])
    z = abs(line[5] + u * line[8] + v * line[11] - line[2])
    return 0 if x >= y and x >= z else (1 if y >= z else 2)


@njit(parallel=True, cache=True, error_model="numpy")
def _fill_rays(volume, filled, shape, lines, size, rows, views, projections):
    n_v = projections.shape[1]
    for index in prange(views.size * n_v):
        view, v = views[index // n_v], index % n_v
        if rows[view, 0] <= v < rows[view, 1]:
            _fill_row(volume, shape, lines[view], size, v, projections[view])
        else:
            projections[view, v] = 0.0


@njit(cache=True, error_model="numpy")
def _fill_row(volume, shape, line, size, v, projection):
    n_v, n_u = projection.shape
    n, strides = (shape[1], shape[0], shape[2]), (shape[2], shape[1] * shape[2], 1)
    row = v - (n_v - 1) / 2
    for k in range(n_u):
        u, total = k - (n_u - 1) / 2, 0.0
        main = _ray_axis(line, u, row)
        for i in range(n[main]):
            a, b, at_a, at_b, meets = _sample(line, n, main, i, u, row)
            if meets:
                low_a, low_b = int(math.floor(at_a)), int(math.floor(at_b))
                for j in range(max(low_a, 0), min(low_a + 2, n[a])):
                    for m in range(max(low_b, 0), min(low_b + 2, n[b])):
                        at = i * strides[main] + j * strides[a] + m * strides[b]
                        total += volume[at] * ((1.0 - abs(at_a - j)) * (1.0 - abs(at_b - m)))
        projection[v, k] = total * _length(line, size, row, u)


@njit(parallel=True, cache=True, error_model="numpy")
def _add_rays(scaled, live, shape, lines, views, axis, volume):
    n_i = shape[1] if axis == 0 else (shape[0] if axis == 1 else shape[2])
    for i in prange(n_i):
        _add_plane(scaled, live, shape, lines, views, axis, i, volume)


@njit(cache=True, error_model="numpy")
def _add_plane(scaled, live, shape, lines, views, axis, i, volume):
    """Add all rays with this main axis to the voxels of plane i."""
    n_u, n_v = scaled.shape[1], scaled.shape[2] - 2
    n, strides = (shape[1], shape[0], shape[2]), (shape[2], shape[1] * shape[2], 1)
    for k in range(views.size):
        line = lines[views[k]]
        for column in range(n_u):
            if not live[k, column]:
                continue
            u = column - (n_u - 1) / 2
            for row in range(n_v):
                value, v = scaled[k, column, row + 1], row - (n_v - 1) / 2
                if value == 0 or _ray_axis(line, u, v) != axis:
                    continue
                a, b, at_a, at_b, meets = _sample(line, n, axis, i, u, v)
                if meets:
                    low_a, low_b = int(math.floor(at_a)), int(math.floor(at_b))
                    for j in range(max(low_a, 0), min(low_a + 2, n[a])):
                        for m in range(max(low_b, 0), min(low_b + 2, n[b])):
                            at = i * strides[axis] + j * strides[a] + m * strides[b]
                            volume[at] += value * ((1.0 - abs(at_a - j)) * (1.0 - abs(at_b - m)))
