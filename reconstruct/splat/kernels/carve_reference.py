"""Readable float64 twin of `carve_cpu`: each voxel's ray solved for the pixel that it meets."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def pixels(pose: Array, shape: tuple[int, int], points: Array) -> tuple[Array, Array]:
    """Return the places (v, u) [n, 2] in pixels where rays through `points` [n, 3] (mm) meet the detector, and t.

    source + t·(point − source) = centre + a·e_u + b·e_v, solved as three linear equations; t > 0 is ahead of it.
    """
    source, centre, e_u, e_v = pose.reshape(4, 3)
    columns = [np.stack([point - source, -e_u, -e_v], 1) for point in points]
    t, a, b = np.linalg.solve(np.stack(columns), np.tile(centre - source, (len(points), 1))[..., None])[..., 0].T
    return np.stack([b + (shape[0] - 1) / 2, a + (shape[1] - 1) / 2], 1), t


def carve(poses: Array, blocked: NDArray[np.bool_], z: Array, y: Array, x: Array) -> NDArray[np.int8]:
    """Return 1 for voxels [z, y, x] that a view sees and none sees empty, −1 for those seen empty, else 0."""
    grid = np.stack(np.meshgrid(z, y, x, indexing="ij"), -1)
    seen, empty = np.zeros((2, grid.size // 3), bool)
    for pose, image in zip(poses, blocked, strict=True):
        place, t = pixels(pose, image.shape, grid.reshape(-1, 3)[:, ::-1])
        near = np.floor(place + 0.5).astype(int)
        inside = (t > 0) & np.all((near >= 0) & (near < image.shape), axis=1)
        seen |= inside
        empty[inside] |= ~image[tuple(near[inside].T)]
    return np.where(empty, -1, seen).astype(np.int8).reshape(grid.shape[:3])
