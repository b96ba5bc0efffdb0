"""Which voxels a view shows to be empty: each voxel's centre is projected and the pixel it falls on looked up."""

from numba import njit, prange


@njit(cache=True, parallel=True)
def carve(poses, blocked, z, y, x, state):
    """Mark `state` [z, y, x], 0 at first: −1 where a view sees the voxel empty, else 1 where a view sees it at all.

    `poses` [view, 12] as `Geometry.pose_array`; `blocked` [view, v, u] is False where a pixel shows nothing.
    """
    for k in prange(z.size):
        for view in range(poses.shape[0]):
            _carve_slice(poses[view], blocked[view], z[k], y, x, state[k])


@njit(cache=True)
def _carve_slice(pose, blocked, z, y, x, state):
    """Mark voxels as seen (1) or empty (−1): v_c from Cramer's rule on source + t·(p − source) = centre + a·u + b·v."""
    n_v, n_u = blocked.shape
    ax, ay, az = pose[3] - pose[0], pose[4] - pose[1], pose[5] - pose[2]
    nx = pose[7] * pose[11] - pose[8] * pose[10]
    ny = pose[8] * pose[9] - pose[6] * pose[11]
    nz = pose[6] * pose[10] - pose[7] * pose[9]
    height = ax * nx + ay * ny + az * nz
    uu = pose[6] ** 2 + pose[7] ** 2 + pose[8] ** 2
    vv = pose[9] ** 2 + pose[10] ** 2 + pose[11] ** 2
    uv = pose[6] * pose[9] + pose[7] * pose[10] + pose[8] * pose[11]
    for j in range(y.size):
        for i in range(x.size):
            if state[j, i] < 0:
                continue
            cx, cy, cz = x[i] - pose[0], y[j] - pose[1], z - pose[2]
            depth = (cx * nx + cy * ny + cz * nz) / height
            if depth <= 0:
                continue
            ox, oy, oz = cx / depth - ax, cy / depth - ay, cz / depth - az
            a = ox * pose[6] + oy * pose[7] + oz * pose[8]
            b = ox * pose[9] + oy * pose[10] + oz * pose[11]
            u = (a * vv - b * uv) / (uu * vv - uv * uv) + 0.5 * (n_u - 1)
            v = (b * uu - a * uv) / (uu * vv - uv * uv) + 0.5 * (n_v - 1)
            if -0.5 <= u < n_u - 0.5 and -0.5 <= v < n_v - 0.5:
                state[j, i] = 1 if blocked[int(v + 0.5), int(u + 0.5)] else -1
