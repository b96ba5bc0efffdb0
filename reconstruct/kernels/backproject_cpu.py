"""Voxel-driven backprojection of filtered views on the CPU.

For a circular orbit the detector column u and the distance weight depend on a voxel's (x, y) only, and
the detector row is affine in z. Volume columns (fixed x, y) are therefore the unit of work: two detector
columns are blended once per view, then read along z. Each thread owns tiles of volume columns, sums views
in one fixed order and writes nobody else's voxels: results are bitwise equal for any number of threads.
A volume of one slice has no columns to speak of: there each thread owns rows of voxels.
"""

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

TILE_X = 16
TILE_Y = 8
VIEW_BLOCK = 8
FAST = {"contract", "reassoc", "nsz", "arcp"}


def backproject(
    filtered: NDArray[np.float32],
    angles: NDArray[np.float64],
    orbit: NDArray[np.float64],
    grid: NDArray[np.float64],
    volume: NDArray[np.float32],
) -> None:
    """Add the weighted backprojection of `filtered` [view, v, u] to `volume` [z, y, x] in place.

    `angles` [view] in radians. `orbit` is (dso, dsd, d_v, d_u, off_v, off_u), `grid` is (d_z, d_y, d_x,
    off_z, off_y, off_x, radius), all mm; columns farther than `radius` from the axis stay untouched.
    Views are sampled bilinearly and weighted by (dso / distance from the source along the central ray)²;
    samples off the detector (more than half a pixel past the outermost centres) count as zero.
    """
    n_view, n_v, n_u = filtered.shape
    if volume.shape[0] == 1:
        _add_slice(filtered, np.cos(angles), np.sin(angles), orbit, grid, volume[0])
        return
    columns = np.empty((n_view, n_u + 2, n_v + 2), np.float32)
    _pad_transposed(filtered, columns)
    tiles = _tiles(volume.shape, grid)
    _add_tiles(columns, np.cos(angles), np.sin(angles), orbit, grid, tiles, volume)


def _tiles(shape: tuple[int, ...], grid: NDArray[np.float64]) -> NDArray[np.int64]:
    """First (y, x) of every tile that touches the field of view, [tile, 2]."""
    _, n_y, n_x = shape
    nearest = []
    for n, d, off, size in ((n_y, grid[1], grid[4], TILE_Y), (n_x, grid[2], grid[5], TILE_X)):
        centres = (np.arange(n) + 0.5 - n / 2) * d + off
        nearest.append([float(np.min(centres[i : i + size] ** 2)) for i in range(0, n, size)])
    # A lower bound on the distance: y and x minimised separately.
    inside = np.add.outer(nearest[0], nearest[1]) <= grid[6] ** 2
    # argwhere gives Fortran order unless there is one tile; the kernel is compiled for one layout only.
    return np.ascontiguousarray(np.argwhere(inside) * np.array([TILE_Y, TILE_X]))


@njit(parallel=True, cache=True)
def _pad_transposed(filtered, columns):
    """Copy views to [view, u, v] with the border pixels repeated once on every side."""
    n_view, n_v, n_u = filtered.shape
    for view in prange(n_view):
        for first in range(0, n_u + 2, 16):
            for v in range(n_v + 2):
                row = min(max(v - 1, 0), n_v - 1)
                for u in range(first, min(first + 16, n_u + 2)):
                    columns[view, u, v] = filtered[view, row, min(max(u - 1, 0), n_u - 1)]


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")
def _add_slice(filtered, cos, sin, orbit, grid, image):
    """Add all views to a volume of one slice, `image` [y, x]: a column of one voxel is not worth its set-up."""
    n_y, n_x = image.shape
    n_view, n_v, n_u = filtered.shape
    z_mm, middle_u, middle_v = grid[3], (n_u - 1) / 2, (n_v - 1) / 2
    places = np.arange(n_x).astype(np.float32)
    for y in prange(n_y):
        y_mm = (y + 0.5 - n_y / 2) * grid[1] + grid[4]
        first, last = n_x, 0  # columns within the field of view
        for x in range(n_x):
            x_mm = (x + 0.5 - n_x / 2) * grid[2] + grid[5]
            if x_mm * x_mm + y_mm * y_mm <= grid[6] * grid[6]:
                first, last = min(first, x), x + 1
        n = max(last - first, 0)
        total = np.zeros(n, np.float32)
        work = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)
        from_mm = (first + 0.5 - n_x / 2) * grid[2] + grid[5]
        for view in range(n_view):
            c, s = cos[view], sin[view]
            if n_v == 1:
                along, across = from_mm * c + y_mm * s, y_mm * c - from_mm * s
                _add_line(
                    filtered[view, 0],
                    (orbit[0] - along, across, -grid[2] * c, -grid[2] * s),
                    z_mm,
                    orbit,
                    places,
                    work,
                    total,
                )
                continue
            for x in range(n):
                x_mm = from_mm + x * grid[2]
                inverse = 1.0 / (orbit[0] - (x_mm * c + y_mm * s))
                scale = orbit[1] * inverse
                u = (scale * (y_mm * c - x_mm * s) - orbit[5]) / orbit[3] + middle_u
                v = (scale * z_mm - orbit[4]) / orbit[2] + middle_v
                if u < -0.5 or u > n_u - 0.5 or v < -0.5 or v > n_v - 0.5:
                    continue
                # the border pixels count once more on every side
                u, v = min(max(u, 0.0), n_u - 1.0), min(max(v, 0.0), n_v - 1.0)
                i, j = np.uint32(u), np.uint32(v)
                right, above = np.uint32(min(i + 1, n_u - 1)), np.uint32(min(j + 1, n_v - 1))
                t, r = np.float32(u - i), np.float32(v - j)
                low = filtered[view, j, i] + t * (filtered[view, j, right] - filtered[view, j, i])
                high = filtered[view, above, i] + t * (filtered[view, above, right] - filtered[view, above, i])
                total[x] += np.float32((orbit[0] * inverse) ** 2) * (low + r * (high - low))
        for x in range(n):
            image[y, first + x] += total[x]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _add_line(line, view, z_mm, orbit, places, work, total):
    """Add a view of one row to the voxels of a line of the slice.

    `view` is (distance, across, their steps from one voxel to the next): the first voxel's place along the central ray
    from the source and across it, in mm. `places` counts voxels, in float32: a loop that converts integers, or that
    checks its divisor, does not become vector code. `work` has room for each voxel's column, its share of the next
    column, and its weight.
    """
    column, share, weight = work
    near, step = np.float32(view[0]), np.float32(view[2])
    per = orbit[1] / orbit[3]
    side, side_step = np.float32(per * view[1]), np.float32(per * view[3])
    half = np.float32((line.size - 1) / 2)
    moved, dso = np.float32(half - orbit[5] / orbit[3]), np.float32(orbit[0])
    rise, off_v, highest = np.float32(orbit[1] * z_mm), np.float32(orbit[4]), np.float32(0.5 * orbit[2])
    last, more = np.int32(max(line.size - 2, 0)), np.uint32(min(line.size - 1, 1))
    for x in range(total.size):
        inverse = np.float32(1) / (near + places[x] * step)
        u = (side + places[x] * side_step) * inverse + moved
        nearer = dso * inverse
        nearer = nearer * nearer if abs(u - half) <= half + np.float32(0.5) else np.float32(0)
        weight[x] = nearer if abs(rise * inverse - off_v) <= highest else np.float32(0)
        u = min(max(u, np.float32(0)), half + half)
        column[x] = max(min(np.int32(u), last), np.int32(0))  # NaN in the source's plane
        share[x] = u - np.float32(column[x])
    for x in range(total.size):
        i = np.uint32(column[x])
        a, b = line[i], line[i + more]
        total[x] += weight[x] * (a + share[x] * (b - a))


@njit(parallel=True, cache=True)
def _add_tiles(columns, cos, sin, orbit, grid, tiles, volume):
    n_z, n_y, n_x = volume.shape
    n_view = columns.shape[0]
    for tile in prange(tiles.shape[0]):
        y0, x0 = tiles[tile, 0], tiles[tile, 1]
        y1, x1 = min(y0 + TILE_Y, n_y), min(x0 + TILE_X, n_x)
        total = np.zeros((TILE_Y, TILE_X, n_z), np.float32)
        row = np.empty(columns.shape[2], np.float32)
        index = np.empty(n_z, np.int32)
        part = np.empty(n_z, np.float32)
        # A block of views at a time keeps their few detector columns in cache across the tile.
        for first in range(0, n_view, VIEW_BLOCK):
            last = min(first + VIEW_BLOCK, n_view)
            for y in range(y0, y1):
                y_mm = (y + 0.5 - n_y / 2) * grid[1] + grid[4]
                for x in range(x0, x1):
                    x_mm = (x + 0.5 - n_x / 2) * grid[2] + grid[5]
                    if x_mm * x_mm + y_mm * y_mm > grid[6] * grid[6]:
                        continue
                    for view in range(first, last):
                        along = x_mm * cos[view] + y_mm * sin[view]
                        across = y_mm * cos[view] - x_mm * sin[view]
                        _add_column(columns[view], along, across, orbit, grid, row, index, part, total[y - y0, x - x0])
        for z in range(n_z):
            for y in range(y0, y1):
                for x in range(x0, x1):
                    volume[z, y, x] += total[y - y0, x - x0, z]


@njit(cache=True, fastmath=FAST)
def _add_column(columns, along, across, orbit, grid, row, index, part, total):
    """Add one view's samples to one volume column; `along` and `across` are its place in the view's frame."""
    n_z = total.size
    n_u, n_v = columns.shape[0] - 2, columns.shape[1] - 2
    distance = orbit[0] - along
    scale = orbit[1] / distance
    u = (scale * across - orbit[5]) / orbit[3] + (n_u - 1) / 2
    if not (-0.5 <= u <= n_u - 0.5):
        return
    # Detector row of voxel z is start + step·z; keep the z whose row lies on the detector.
    step = scale * grid[0] / orbit[2]
    start = (scale * ((0.5 - n_z / 2) * grid[0] + grid[3]) - orbit[4]) / orbit[2] + (n_v - 1) / 2
    low = max(0, int(math.ceil(min((-0.5 - start) / step, float(n_z)))))
    high = min(n_z, int(math.floor(max((n_v - 0.5 - start) / step, -1.0))) + 1)
    if low >= high:
        return
    left = np.uint32(u + 1)
    weight = (orbit[0] / distance) ** 2
    w_right = np.float32(weight * (u + 1 - left))
    w_left = np.float32(weight - weight * (u + 1 - left))
    # One spare row on either side: the places below are rounded to float32.
    first = max(int(start + step * low), 0)
    last = min(int(start + step * (high - 1)) + 4, n_v + 2)
    # Slices counted from zero spare the compiler negative indices, and so become vector code.
    a, b, blend = columns[left, first:last], columns[left + np.uint32(1), first:last], row[: last - first]
    for v in range(blend.size):
        blend[v] = w_left * a[v] + w_right * b[v]
    slope, origin = np.float32(step), np.float32(start + step * low + 1 - first)
    index, part, total = index[: high - low], part[: high - low], total[low:high]
    for z in range(index.size):
        place = origin + slope * np.float32(z)
        index[z] = np.int32(place)
        part[z] = place - np.float32(np.int32(place))
    for z in range(index.size):
        i = np.uint32(index[z])
        total[z] += blend[i] + part[z] * (blend[i + np.uint32(1)] - blend[i])
