"""Volumes of splats, and the transpose: the sum of Gaussians in every voxel, and sums over voxels per splat."""

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.kernels import voxelise_cpu as kernels
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import CUTOFF


def voxelise(
    splats: Splats,
    geometry: Geometry,
    values: NDArray[np.float32] | None = None,
    *,
    mean: bool = True,
    cutoff: float = CUTOFF,
) -> NDArray[np.float32]:
    """Sum values [splat, channel], or the densities (1/mm), times the Gaussians: float32 [channel, z, y, x].

    `mean` gives the mean over each voxel (to second order), which keeps a splat's mass however thin it is; otherwise
    the value at its centre. Beyond the Mahalanobis radius `cutoff` a splat is zero. Splats that are not finite or have
    no extent are left out. Raises InputError where `values` do not fit.
    """
    given = splats.densities if values is None else values
    if given.ndim != 2 or given.shape[0] != len(splats) or given.dtype != np.float32:
        raise InputError(
            f"values must be float32 of shape ({len(splats)}, channel), got {given.dtype} of shape {given.shape}"
        )
    n_z, n_y, n_x = geometry.n_voxel
    volume = np.zeros((given.shape[1] * n_z * n_y, n_x + WIDTH), np.float32)
    kernels.voxelise(splats.shapes(), given, _grid(geometry, mean, cutoff), geometry.n_voxel, volume)
    return np.ascontiguousarray(volume.reshape(-1, n_z, n_y, n_x + WIDTH)[..., :n_x])


def voxelise_adjoint(
    splats: Splats, geometry: Geometry, volume: NDArray[np.float32], *, mean: bool = True, cutoff: float = CUTOFF
) -> NDArray[np.float32]:
    """Apply the transpose of `voxelise` to `volume`, float32 [channel, z, y, x]: float32 [splat, channel].

    Raises InputError where the volume does not fit the grid.
    """
    n_z, n_y, n_x = geometry.n_voxel
    if volume.ndim != 4 or volume.shape[1:] != (n_z, n_y, n_x) or volume.dtype != np.float32:
        raise InputError(
            f"the volume must be float32 of shape (channel, {n_z}, {n_y}, {n_x}), "
            f"got {volume.dtype} of shape {volume.shape}"
        )
    padded = np.zeros((volume.shape[0] * n_z * n_y, n_x + WIDTH), np.float32)
    padded[:, :n_x] = volume.reshape(-1, n_x)
    sums = np.zeros((len(splats), volume.shape[0]), np.float32)
    kernels.voxelise_adjoint(splats.shapes(), _grid(geometry, mean, cutoff), geometry.n_voxel, padded, sums)
    return sums


def _grid(geometry: Geometry, mean: bool, cutoff: float) -> NDArray[np.float64]:
    """Return voxel sizes and the centre of the first voxel (z, y, x; mm), the cutoff and a voxel's own variance."""
    first = [axis[0] for axis in geometry.voxel_centres()]
    return np.array([*geometry.d_voxel, *first, cutoff, 1 / 12 if mean else 0.0])
