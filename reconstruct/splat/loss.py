"""Losses of the published splat methods with their gradients: L1 + 0.25 (1 − SSIM), and total variation of a brick."""

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from ctsim import rng
from ctsim.geometry import Geometry

Image = NDArray[np.floating]
SSIM_SHARE = 0.25
TV_SHARE = 0.05
BRICK = 32  # voxels a side
RADIUS, SIGMA = 5, 1.5  # of SSIM's window, in pixels
_TAPS = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
_TAPS = _TAPS / _TAPS.sum()


def l1_ssim(p: Image, target: Image, data_range: float, share: float = SSIM_SHARE) -> tuple[float, Image]:
    """Return mean |p − target| + share·(1 − mean SSIM) of images [v, u], and the gradient by `p` [v, u].

    `data_range` is fixed by the caller, for instance the largest P of the scan, or views would weigh differently.
    """
    similarity, by_similarity = ssim(p, target, data_range)
    difference = p - target
    loss = float(np.abs(difference).mean()) + share * (1 - similarity)
    return loss, np.sign(difference) / difference.size - share * by_similarity


def ssim(x: Image, y: Image, data_range: float) -> tuple[float, Image]:
    """Return the mean SSIM (Wang et al. 2004) of images [v, u] and its gradient by `x`.

    An 11 × 11 Gaussian window of 1.5 pixels, zero outside the image, as in the published methods.
    """
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    mean_x, mean_y = _blurred(x), _blurred(y)
    var_x, var_y = _blurred(x * x) - mean_x**2, _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    a1, a2 = 2 * mean_x * mean_y + c1, 2 * covariance + c2
    b1, b2 = mean_x**2 + mean_y**2 + c1, var_x + var_y + c2
    similarity = a1 * a2 / (b1 * b2)
    by_variance, by_covariance = -similarity / b2, 2 * a1 / (b1 * b2)
    by_mean = 2 * mean_y * a2 / (b1 * b2) - 2 * mean_x * similarity / b1
    by_mean -= 2 * mean_x * by_variance + mean_y * by_covariance
    # the window is even, so the blur is its own transpose
    gradient = _blurred(by_mean) + 2 * x * _blurred(by_variance) + y * _blurred(by_covariance)
    return float(similarity.mean()), gradient / x.size


def _blurred(image: Image) -> Image:
    rows = correlate1d(image, _TAPS, axis=0, mode="constant")
    return correlate1d(rows, _TAPS, axis=1, mode="constant")


def total_variation(volume: Image) -> tuple[float, Image]:
    """Return Σ |differences of neighbours| along z, y and x over the number of voxels, and its gradient."""
    value, gradient = 0.0, np.zeros_like(volume)
    for axis in range(3):
        difference = np.diff(volume, axis=axis)
        value += float(np.abs(difference).sum())
        sign = np.sign(difference)
        ahead = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        behind = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        gradient[ahead] += sign
        gradient[behind] -= sign
    return value / volume.size, gradient / volume.size


def brick(geometry: Geometry, scene: str, step: int, edge: int = BRICK) -> Geometry:
    """Return `geometry` with a part of its grid, `edge` voxels a side where it has so many, at a random place.

    The place depends on the scene's name and the step alone.
    """
    draws = rng.uniform(rng.stream_key(scene, "tv-brick", step), 2).ravel()
    size = tuple(min(edge, n) for n in geometry.n_voxel)
    first = [int(d * (n - m + 1)) for d, n, m in zip(draws, geometry.n_voxel, size, strict=False)]
    offsets = tuple(
        o + (k + m / 2 - n / 2) * d
        for o, k, m, n, d in zip(geometry.off_origin, first, size, geometry.n_voxel, geometry.d_voxel, strict=True)
    )
    return msgspec.structs.replace(geometry, n_voxel=size, off_origin=offsets)
