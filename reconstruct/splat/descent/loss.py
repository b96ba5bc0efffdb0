"""Losses of the published splat methods with their gradients: L1 + 0.25 (1 − SSIM), and total variation of a brick."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import rng
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.kernels import ssim_cpu as kernels

Image = NDArray[np.floating]
SSIM_SHARE = 0.25
TV_SHARE = 0.05
BRICK = 32  # voxels a side


def l1_ssim(p: Image, target: Image, data_range: float, share: float = SSIM_SHARE) -> tuple[float, Image]:
    """Return mean |p − target| + share·(1 − mean SSIM) of images [v, u], and the gradient by `p` [v, u].

    Both images are float32 or both float64. `data_range` is fixed by the caller, or views would weigh differently.
    SSIM (Wang et al. 2004) has an 11 × 11 Gaussian window of 1.5 pixels, zero outside the image, as in the published
    methods.
    """
    kind, size = p.dtype, p.size
    constants = tuple(kind.type(c) for c in ((0.01 * data_range) ** 2, (0.03 * data_range) ** 2, 2))
    weights = kind.type(1 / size), kind.type(-share / size)
    parts, gradient = np.empty((p.shape[0], 3, p.shape[1]), kind), np.empty_like(p)
    sums = np.zeros((2, p.shape[0]))
    kernels.l1_ssim(p, target, kernels.TAPS.astype(kind), constants, weights, parts, gradient, sums)
    difference, similarity = sums.sum(1) / size
    return float(difference + share * (1 - similarity)), gradient


def total_variation(volume: Image) -> tuple[float, Image]:
    """Return the mean |difference of neighbours| along z, y and x, and its gradient; a single voxel has none."""
    value, count, gradient = 0.0, 0, np.zeros_like(volume)
    for axis in range(3):
        difference = np.diff(volume, axis=axis)
        value, count = value + float(np.abs(difference).sum()), count + difference.size
        sign = np.sign(difference)
        ahead = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        behind = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        gradient[ahead] += sign
        gradient[behind] -= sign
    return value / max(count, 1), gradient / max(count, 1)


def brick(geometry: Geometry, scene: str, step: int, edge: int = BRICK) -> Geometry:
    """Return `geometry` with a part of its grid, `edge` voxels a side where it has that many, at a random place.

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
