"""Which voxels a view shows to be empty: each voxel's centre is projected and the pixel it falls on looked up."""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def carve(poses, blocked, z, y, x, state):
    """Mark `state` [z, y, x], 0 at first: −1 where a view sees the voxel empty, else 1 where a view sees it at all.

    `poses` [view, 12] as `Geometry.pose_array`; `blocked` [view, v, u] is False where a pixel shows nothing.
    """
    for k in prange(z.size):
        for view in range(poses.shape[0]):
            _carve_slice(poses[view], blocked[view], z[k], y, x, state[k])


@njit(cache=True, error_model="numpy")
def _carve_slice(pose, blocked, z, y, x, state):
    """Mark voxels as seen (1) or empty (−1).

    Cramer's rule on source + t·(p − source) = centre + a·u + b·v leaves quotients of linear functions of p, with the
    depth as the common denominator.
    """
    n_v, n_u = blocked.shape
    ax, ay, az = pose[3] - pose[0], pose[4] - pose[1], pose[5] - pose[2]
    uu = pose[6] ** 2 + pose[7] ** 2 + pose[8] ** 2
    vv = pose[9] ** 2 + pose[10] ** 2 + pose[11] ** 2
    uv = pose[6] * pose[9] + pose[7] * pose[10] + pose[8] * pose[11]
    det = uu * vv - uv * uv
    nx = pose[7] * pose[11] - pose[8] * pose[10]
    ny = pose[8] * pose[9] - pose[6] * pose[11]
    nz = pose[6] * pose[10] - pose[7] * pose[9]
    height = ax * nx + ay * ny + az * nz
    nx, ny, nz = nx / height, ny / height, nz / height
    ux, uy, uz = [(pose[6 + k] * vv - pose[9 + k] * uv) / det for k in range(3)]
    vx, vy, vz = [(pose[9 + k] * uu - pose[6 + k] * uv) / det for k in range(3)]
    u_end = 0.5 * n_u - (ax * ux + ay * uy + az * uz)
    v_end = 0.5 * n_v - (ax * vx + ay * vy + az * vz)
    cz = z - pose[2]
    for j in range(y.size):
        cy = y[j] - pose[1]
        of_depth, of_u, of_v = cy * ny + cz * nz, cy * uy + cz * uz, cy * vy + cz * vz
        for i in range(x.size):
            if state[j, i] < 0:
                continue
            cx = x[i] - pose[0]
            depth = cx * nx + of_depth
            over = 1 / depth
            u, v = (cx * ux + of_u) * over + u_end, (cx * vx + of_v) * over + v_end  # in pixels from the first's edge
            if depth > 0 and 0 <= u < n_u and 0 <= v < n_v:
                state[j, i] = 1 if blocked[np.uint32(v), np.uint32(u)] else -1  # unsigned: no wrap-around is looked for
