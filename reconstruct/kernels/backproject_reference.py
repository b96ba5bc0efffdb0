"""Readable float64 twin of backproject_cpu: one view and one voxel slice at a time."""

import numpy as np
from numpy.typing import NDArray


def backproject(
    filtered: NDArray[np.float32],
    angles: NDArray[np.float64],
    orbit: NDArray[np.float64],
    grid: NDArray[np.float64],
    volume: NDArray[np.float64],
) -> None:
    """Add the weighted backprojection of `filtered` [view, v, u] to `volume` [z, y, x] in place.

    `angles` [view] in radians. `orbit` is (dso, dsd, d_v, d_u, off_v, off_u), `grid` is (d_z, d_y, d_x,
    off_z, off_y, off_x, radius), all mm.
    """
    dso, dsd, d_v, d_u, off_v, off_u = orbit
    d_z, d_y, d_x, off_z, off_y, off_x, radius = grid
    _, n_v, n_u = filtered.shape
    n_z, n_y, n_x = volume.shape
    y = ((np.arange(n_y) + 0.5 - n_y / 2) * d_y + off_y)[:, None]
    x = ((np.arange(n_x) + 0.5 - n_x / 2) * d_x + off_x)[None, :]
    inside = x**2 + y**2 <= radius**2
    for view, a in zip(filtered.astype(np.float64), angles, strict=True):
        distance = dso - (x * np.cos(a) + y * np.sin(a))
        u = (dsd * (y * np.cos(a) - x * np.sin(a)) / distance - off_u) / d_u + (n_u - 1) / 2
        padded = np.pad(view, 1, mode="edge")
        for k in range(n_z):
            z = (k + 0.5 - n_z / 2) * d_z + off_z
            v = (dsd * z / distance - off_v) / d_v + (n_v - 1) / 2
            seen = inside & (u >= -0.5) & (u <= n_u - 0.5) & (v >= -0.5) & (v <= n_v - 0.5)
            sample = _bilinear(padded, v[seen] + 1, u[seen] + 1)
            volume[k][seen] += (dso / distance[seen]) ** 2 * sample


def _bilinear(image: NDArray[np.float64], v: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    s, t = v - i, u - j
    low = image[i, j] * (1 - t) + image[i, j + 1] * t
    high = image[i + 1, j] * (1 - t) + image[i + 1, j + 1] * t
    return low * (1 - s) + high * s
