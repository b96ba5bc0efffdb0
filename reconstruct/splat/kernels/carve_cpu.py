"""Which voxels a view shows to be empty: each voxel's centre is projected and the pixel it falls on looked up."""

import math

import numpy as np
from numba import njit, prange

GOLDEN = 0.6180339887498949


def carve(poses, blocked, z, y, x, state):
    """Mark the voxels of `state` [z, y, x] that are 0: −1 where a view sees the voxel empty, else 1 where one sees it.

    Voxels of another value are left as they are. `poses` [view, 12] as `Geometry.pose_array`; `blocked` [view, v, u] is
    False where a pixel shows nothing. Views far from each other follow each other, so that few have to look at air.
    """
    n = len(poses)
    stride = next(k for k in range(max(round(GOLDEN * n), 1), 2 * n + 1) if math.gcd(k, n) == 1)
    _carve(poses, blocked, z, y, x, stride, state)


@njit(cache=True, parallel=True, error_model="numpy")
def _carve(poses, blocked, z, y, x, stride, state):
    n_views = poses.shape[0]
    lines = np.empty((n_views, 11))
    for view in range(n_views):
        _quotients(poses[view], blocked.shape[1], blocked.shape[2], lines[view])
    for k in prange(z.size):
        left = np.empty(x.size, np.int64)
        for j in range(y.size):
            n = 0
            for i in range(x.size):
                if state[k, j, i] == 0:
                    left[n] = i
                    n += 1
            view = 0
            for _ in range(n_views):
                if n == 0:
                    break
                n = _look(poses[view], lines[view], blocked[view], z[k], y[j], x, left[:n], state[k, j])
                view = (view + stride) % n_views


@njit(cache=True, error_model="numpy")
def _quotients(pose, n_v, n_u, line):
    """Fill in the normals by which a point's depth, u and v follow, and where the pixels begin.

    Cramer's rule on source + t·(p − source) = centre + a·u + b·v leaves quotients of linear functions of p, with the
    depth as the common denominator.
    """
    ax, ay, az = pose[3] - pose[0], pose[4] - pose[1], pose[5] - pose[2]
    uu = pose[6] ** 2 + pose[7] ** 2 + pose[8] ** 2
    vv = pose[9] ** 2 + pose[10] ** 2 + pose[11] ** 2
    uv = pose[6] * pose[9] + pose[7] * pose[10] + pose[8] * pose[11]
    det = uu * vv - uv * uv
    nx = pose[7] * pose[11] - pose[8] * pose[10]
    ny = pose[8] * pose[9] - pose[6] * pose[11]
    nz = pose[6] * pose[10] - pose[7] * pose[9]
    height = ax * nx + ay * ny + az * nz
    line[0], line[1], line[2] = nx / height, ny / height, nz / height
    for k in range(3):
        line[3 + k] = (pose[6 + k] * vv - pose[9 + k] * uv) / det
        line[6 + k] = (pose[9 + k] * uu - pose[6 + k] * uv) / det
    line[9] = 0.5 * n_u - (ax * line[3] + ay * line[4] + az * line[5])
    line[10] = 0.5 * n_v - (ax * line[6] + ay * line[7] + az * line[8])


@njit(cache=True, error_model="numpy")
def _look(pose, line, blocked, z, y, x, left, state):
    """Mark those voxels of a row that are `left`; return how many of them, put first in `left`, are not empty."""
    n_v, n_u = blocked.shape
    cy, cz = y - pose[1], z - pose[2]
    of_depth = cy * line[1] + cz * line[2]
    of_u, of_v = cy * line[4] + cz * line[5], cy * line[7] + cz * line[8]
    n = 0
    for i in left:
        cx = x[i] - pose[0]
        depth = cx * line[0] + of_depth
        over = 1 / depth
        u, v = (cx * line[3] + of_u) * over + line[9], (cx * line[6] + of_v) * over + line[10]  # from the first's edge
        if depth > 0 and 0 <= u < n_u and 0 <= v < n_v:
            if not blocked[np.uint32(v), np.uint32(u)]:  # unsigned: no wrap-around is looked for
                state[i] = -1
                continue
            state[i] = 1
        left[n] = i
        n += 1
    return n
