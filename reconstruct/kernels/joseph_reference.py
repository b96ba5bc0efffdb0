"""Readable float64 twin of joseph_cpu: one ray at a time, its voxels and weights written out."""

import numpy as np
from numpy.typing import NDArray


def project(
    volume: NDArray[np.float64],
    poses: NDArray[np.float64],
    grid: NDArray[np.float64],
    rows: NDArray[np.int64],
    projections: NDArray[np.float64],
) -> None:
    """Fill `projections` [view, v, u] with the line integrals of `volume` [y, x, z] (1/mm).

    `poses` [view, 12] as `Geometry.pose_array`; `grid` is (d_z, d_y, d_x, off_z, off_y, off_x), mm;
    `rows` [view, 2] is the range of detector rows wanted, the others become zero.
    """
    projections[:] = 0.0
    for view, v, u in np.ndindex(projections.shape):
        if rows[view, 0] <= v < rows[view, 1]:
            at, weight = _ray(volume.shape, poses[view], grid, _from_middle(projections.shape, v, u))
            projections[view, v, u] = np.sum(volume[at] * weight)


def backproject(
    projections: NDArray[np.float64],
    poses: NDArray[np.float64],
    grid: NDArray[np.float64],
    rows: NDArray[np.int64],
    volume: NDArray[np.float64],
) -> None:
    """Add the transpose of `project`, applied to `projections`, to `volume` [y, x, z]."""
    for view, v, u in np.ndindex(projections.shape):
        if rows[view, 0] <= v < rows[view, 1]:
            at, weight = _ray(volume.shape, poses[view], grid, _from_middle(projections.shape, v, u))
            np.add.at(volume, at, weight * projections[view, v, u])


def _from_middle(shape: tuple[int, ...], v: int, u: int) -> tuple[float, float]:
    return v - (shape[1] - 1) / 2, u - (shape[2] - 1) / 2


def _ray(shape, pose, grid, pixel):
    """Return the voxels (y, x, z indices) that one ray meets and their weights in mm.

    Joseph, IEEE Trans. Med. Imaging 1, 1982, doi:10.1109/TMI.1982.4307572: on each plane of voxel centres
    normal to the axis along which the ray meets most planes, interpolate between the four nearest voxels.
    """
    n = np.array([shape[1], shape[0], shape[2]])  # x, y, z
    d, off = grid[[2, 1, 0]], grid[[5, 4, 3]]
    first = (0.5 - n / 2) * d + off
    end = pose[3:6] + pixel[0] * pose[9:12] + pixel[1] * pose[6:9]
    source, step = (pose[:3] - first) / d, (end - pose[:3]) / d  # in voxels from the first centre
    main = int(np.argmax(np.abs(step)))
    share = (np.arange(n[main]) - source[main]) / step[main]
    share = share[(share > 0) & (share < 1)]
    place = source + share[:, None] * step
    a, b = (axis for axis in range(3) if axis != main)
    low_a, low_b = np.floor(place[:, a]).astype(int), np.floor(place[:, b]).astype(int)
    found, weights = [], []
    for i in (0, 1):
        for j in (0, 1):
            index = np.empty((share.size, 3), int)
            index[:, main] = np.rint(place[:, main])
            index[:, a], index[:, b] = low_a + i, low_b + j
            weight = (1 - np.abs(place[:, a] - index[:, a])) * (1 - np.abs(place[:, b] - index[:, b]))
            inside = np.all((index >= 0) & (index < n), axis=1)
            found.append(index[inside])
            weights.append(weight[inside])
    x, y, z = np.concatenate(found).T
    length = np.linalg.norm(end - pose[:3]) / abs(step[main])
    return (y, x, z), np.concatenate(weights) * length
