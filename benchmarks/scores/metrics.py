"""Metrics between volumes: PSNR3D, SSIM3D, and ratio, Dice and boundary of reconstructed metal.

Volumes are [z, y, x] in 1/mm. The data range is always an argument, never taken from a dtype. A
metric that does not exist (identical volumes, an empty region) is None, never infinity or NaN.

SSIM: Wang et al., IEEE TIP 13 (2004) 600, doi:10.1109/TIP.2003.819861, of every slice along each of the three axes:
Gaussian weights with σ = 1.5 on an 11 × 11 window, population covariance, K1 = 0.01, K2 = 0.03. This equals
scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)` slice by slice
and is several times faster, because the five filtered images of a slice stay in the cache.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.metrics import structural_similarity

from ctsim.benchmarks.scores.kernels.ssim_cpu import slice_sums
from ctsim.errors import InputError

Array = NDArray[Any]
Mask = NDArray[np.bool_]

RADIUS = 5
SIGMA = 1.5
K1, K2 = 0.01, 0.03
METAL = ("core_ratio", "dice", "boundary_rms")


def _check(values: Array, reference: Array, region: Mask | None, data_range: float) -> None:
    """Refuse shapes that differ, an empty region and a range that is not positive."""
    if values.ndim != 3 or values.shape != reference.shape or (region is not None and region.shape != values.shape):
        shapes = [values.shape, reference.shape] + ([] if region is None else [region.shape])
        raise InputError(f"a metric needs volumes and a region of one 3-D shape, got {shapes}")
    if not (math.isfinite(data_range) and data_range > 0):
        raise InputError(f"the data range must be positive and finite, got {data_range}")
    if region is not None and not region.any():
        raise InputError("the region of the metric is empty")


def dilate(mask: Mask, steps: int) -> Mask:
    """Grow `mask` by `steps` voxels along every axis and diagonal (a cube of 2·steps + 1)."""
    return ndimage.maximum_filter(mask.astype(np.uint8), 2 * steps + 1, mode="constant", cval=0) > 0


def erode(mask: Mask, steps: int = 1) -> Mask:
    """Shrink `mask` by `steps` voxels; the volume's edge does not count as outside."""
    return ndimage.minimum_filter(mask.astype(np.uint8), 2 * steps + 1, mode="nearest") > 0


def box_around(mask: Mask, reach: int | Sequence[int] = 0) -> tuple[slice, ...]:
    """Return the smallest box that holds `mask`, extended by `reach` voxels (one number, or one an axis)."""
    tight = ndimage.find_objects(mask.astype(np.uint8))[0]
    return tuple(slice(max(0, s.start - r), s.stop + r) for s, r in zip(tight, np.broadcast_to(reach, 3), strict=True))


def mse3d(values: Array, reference: Array, region: Mask | None = None) -> float:
    """Return the mean squared difference over `region` (everywhere if None), summed in float64."""
    if region is not None:
        values, reference = values[region], reference[region]
    difference = values.astype(np.float64, copy=False) - reference
    return float(np.vdot(difference, difference)) / difference.size


def psnr(mse: float, data_range: float) -> float | None:
    """Return 10·log10(range²/MSE) in dB; None where the MSE is 0, that is for identical inputs."""
    return None if mse == 0 else 10 * math.log10(data_range**2 / mse)


def psnr3d(values: Array, reference: Array, *, data_range: float, region: Mask | None = None) -> float | None:
    """Return 10·log10(range²/MSE) in dB over `region`; None for identical volumes."""
    _check(values, reference, region, data_range)
    return psnr(mse3d(values, reference, region), data_range)


def window() -> NDArray[np.float64]:
    """Return the 11 Gaussian weights of the window; they sum to 1."""
    offsets = np.arange(-RADIUS, RADIUS + 1)
    weights = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    return weights / weights.sum()


def border(n: int, mode: str) -> NDArray[np.int64]:
    """Return the source index of each padded position of an axis of length `n`.

    `mode` "mirror" repeats the edge sample (scipy's "reflect"); "zero" marks the outside with -1.
    """
    if mode == "zero":
        return np.pad(np.arange(n), RADIUS, constant_values=-1)
    return np.pad(np.arange(n), RADIUS, mode="symmetric")


def ssim_along_axes(
    values: Array, reference: Array, region: Mask, data_range: float, mode: str = "mirror"
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return, for slices normal to z, y and x, the sum of the SSIM map over `region` in each slice.

    Slices outside the box around the region are left out with `mode` "mirror"; "zero" keeps all.
    """
    box = box_around(region, RADIUS) if mode == "mirror" else (slice(None),) * 3
    arrays = [np.ascontiguousarray(a[box]) for a in (values, reference, region)]
    constants = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    sums = []
    for axis in range(3):
        x, y, inside = (np.moveaxis(a, axis, 0) for a in arrays)
        _, height, width = x.shape
        borders = border(height, mode), border(width, mode)
        sums.append(slice_sums(x, y, inside, window(), borders, constants))
    return sums[0], sums[1], sums[2]


def ssim3d(values: Array, reference: Array, *, data_range: float, region: Mask | None = None) -> float:
    """Return the SSIM map averaged over `region` and over slices along z, y and x.

    Outside the region the reconstruction is replaced by the reference before filtering, so that no other
    voxel can leak in through the window. Same numbers as scikit-image's slice-wise map.
    """
    _check(values, reference, region, data_range)
    if region is None:
        region = np.ones(values.shape, bool)
    else:
        values = np.where(region, values, reference)
    sums = ssim_along_axes(values, reference, region, data_range)
    return float(sum(s.sum() for s in sums)) / (3 * int(region.sum()))


def ssim3d_r2(values: Array, reference: Array) -> float | None:
    """Return SSIM as R2-Gaussian's evaluation reports it, for comparison with printed tables only.

    Peak 1, zeros beyond the border of a slice, slices whose reference is nowhere positive left out.
    """
    _check(values, reference, None, 1.0)
    sums = ssim_along_axes(values, reference, np.ones(values.shape, bool), 1.0, mode="zero")
    means = []
    for axis, per_slice in enumerate(sums):
        kept = reference.max(axis=tuple(a for a in range(3) if a != axis)) > 0
        if kept.any():
            means.append(float(per_slice[kept].mean()) * per_slice.size / values.size)
    return sum(means) / 3 if len(means) == 3 else None


def ssim3d_naf(values: Array, reference: Array) -> float | None:
    """Return SSIM as NAF's evaluation reports it: a 7³ uniform window and scikit-image's float range 2.

    None for a volume with fewer than 7 voxels along an axis.
    """
    _check(values, reference, None, 2.0)
    if min(values.shape) < 7:
        return None
    return float(np.asarray(structural_similarity(reference, values, win_size=7, data_range=2.0)))


def least_squares_gain(values: Array, reference: Array, region: Mask) -> float | None:
    """Return the gain g that minimises Σ(g·values − reference)² over `region`; None if values are 0 there."""
    x = values[region].astype(np.float64)
    power = float(np.vdot(x, x))
    return None if power == 0 else float(np.vdot(x, reference[region].astype(np.float64))) / power


def surface(mask: Mask) -> Mask:
    """Return the voxels of `mask` that have one of six neighbours outside it."""
    return mask & ~np.asarray(ndimage.binary_erosion(mask, border_value=1), np.bool_)


def boundary_rms(found: Mask, truth: Mask, d_voxel: tuple[float, float, float]) -> float | None:
    """Return the RMS distance in mm between the surfaces of two masks, taken both ways.

    Distances run between surface voxel centres; None where either mask has no surface.
    """
    a, b = (np.argwhere(surface(m)) * np.asarray(d_voxel) for m in (found, truth))
    if len(a) == 0 or len(b) == 0:
        return None
    ab, ba = KDTree(b).query(a)[0], KDTree(a).query(b)[0]
    return float(np.sqrt((np.vdot(ab, ab) + np.vdot(ba, ba)) / (len(ab) + len(ba))))


def dice(found: Mask, truth: Mask) -> float | None:
    """Return 2·|A ∩ B| / (|A| + |B|); None if both are empty."""
    total = int(found.sum()) + int(truth.sum())
    return None if total == 0 else 2 * int((found & truth).sum()) / total


def metal_metrics(
    values: Array,
    reference: Array,
    metal: Mask,
    judged: Mask,
    d_voxel: tuple[float, float, float],
    kinds: Array | None = None,
) -> dict[str, float | None]:
    """Return how the metal came out: mean ratio in its core, Dice at half maximum, boundary RMS (mm).

    The core is the mask eroded by one voxel (the whole mask where nothing is left). A voxel is found to be metal above
    half the reconstruction's median in the core of the metal nearest to it: of its kind where `kinds`, labels above 0,
    tell several apart, since titanium has less than half of gold's. Dice counts every voxel of `judged` above it; the
    boundary is compared within 8 voxels of the metal, so that distant streaks count once, in Dice.
    """
    core = _core(metal)
    mean_reference = float(reference[core].mean(dtype=np.float64))
    ratio = float(values[core].mean(dtype=np.float64)) / mean_reference if mean_reference else None
    level = _levels(values, metal, np.zeros(metal.shape, np.uint8) if kinds is None else kinds)
    found = (values >= level / 2) & judged & (level > 0)
    return {
        "core_ratio": ratio,
        "dice": dice(found, metal),
        "boundary_rms": boundary_rms(found & dilate(metal, 8), metal, d_voxel),
    }


def _core(mask: Mask) -> Mask:
    """Return a mask eroded by one voxel, or as it is where nothing is left."""
    core = erode(mask)
    return core if core.any() else mask


def _levels(values: Array, metal: Mask, kinds: Array) -> Array:
    """Return the median of the core of each voxel's nearest kind of metal, [z, y, x]; one where no kinds are told."""
    told = metal & (kinds > 0)
    medians = {kind: float(np.median(values[_core(told & (kinds == kind))])) for kind in np.unique(kinds[told])}
    if len(medians) < 2:
        return np.full(metal.shape, np.median(values[_core(metal)]), np.float64)
    nearest = ndimage.distance_transform_edt(~told, return_distances=False, return_indices=True)
    table = np.zeros(int(max(medians)) + 1)
    table[list(medians)] = list(medians.values())
    return table[kinds[tuple(nearest)]]
