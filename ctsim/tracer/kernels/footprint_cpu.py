"""The voxel columns that the central rays of a detector column cross, where the detector stands upright.

All rays of detector column u run in one vertical plane. It meets voxel column (y, x) between ray parameters λ that are
the same for all rows: 0 at the source, 1 at the pixel.
"""

from numba import njit

LANES = 16  # detector columns done together: the lengths of a row fill cache lines
FIRST = 1e-9  # λ from which on a ray is followed
TINY = 1e-12  # a horizontal direction (voxels) below this counts as parallel to the axis


@njit(inline="always", error_model="numpy")
def _clip(o, d, n, t0, t1):
    """Cut [t0, t1] to where 0 ≤ o + d·t ≤ n; also 1/d."""
    d = (TINY if d >= 0 else -TINY) if abs(d) < TINY else d
    inverse = 1.0 / d
    a, b = -o * inverse, (n - o) * inverse
    return max(t0, min(a, b)), min(t1, max(a, b)), inverse


@njit(cache=True, error_model="numpy")
def footprint(grid, pose, u, cells, ends):
    """List the voxel columns that detector column u (from the detector's centre) crosses; return how many.

    Voxel column (y, x) is y·(n_x + 1) + x in `cells` [k], which has room for n_x + n_y of them. It is crossed from
    λ = ends[k] to ends[k + 1]. `grid` [9] as in `ctsim.tracer.bricks`; `pose` [12].
    """
    n_x, n_y = int(grid[0]), int(grid[1])
    hx, hy = pose[3] + u * pose[6] - pose[0], pose[4] + u * pose[7] - pose[1]
    ox, oy = (pose[0] - grid[6]) * grid[3], (pose[1] - grid[7]) * grid[4]
    dx, dy = hx * grid[3], hy * grid[4]
    near, end, ix = _clip(ox, dx, float(n_x), FIRST, 1.0)
    near, end, iy = _clip(oy, dy, float(n_y), near, end)
    if not near < end:
        return 0
    ux, uy = int(ix > 0), int(iy > 0)
    sx, sy = 2 * ux - 1, 2 * uy - 1
    x = min(max(int(ox + dx * near), 0), n_x - 1)
    y = min(max(int(oy + dy * near), 0), n_y - 1)
    tx, ty = (x + ux - ox) * ix, (y + uy - oy) * iy
    n, ends[0] = 0, near
    while True:
        near = min(max(min(tx, ty), near), end)
        cells[n], ends[n + 1] = y * (n_x + 1) + x, near
        n += 1
        if tx <= ty:
            x += sx
            tx = (x + ux - ox) * ix
        else:
            y += sy
            ty = (y + uy - oy) * iy
        if x < 0 or y < 0 or x >= n_x or y >= n_y or near >= end:
            return n
