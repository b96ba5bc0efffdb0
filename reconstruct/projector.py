"""Line integrals through a voxel volume, and their exact adjoint.

Rays run from the source to the centre of each detector pixel and are weighted by Joseph's rule, bilinear
interpolation on planes of voxel centres (IEEE Trans. Med. Imaging 1, 1982, doi:10.1109/TMI.1982.4307572).
Volume [z, y, x] in 1/mm, projections [view, v, u], unitless. The volume is zero outside its grid.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.kernels.joseph_cpu import backproject, project

Views = Sequence[int] | NDArray[np.integer] | slice | None
Rows = NDArray[np.bool_] | NDArray[np.integer] | None


def forward(volume: torch.Tensor, geometry: Geometry, views: Views = None, *, rows: Rows = None) -> torch.Tensor:
    """Integrate `volume`, float32 [z, y, x], along the rays of `geometry`: float32 [view, v, u].

    `views` chooses views by index, in any order (None: all). `rows` says which detector rows are wanted,
    one entry a chosen view: bool [view, v], or the half-open range [view, 2]; rows outside the smallest
    range that holds them become zero. Raises InputError for wrong shapes, views that do not exist and
    another device than the CPU.
    """
    _check(volume, geometry.n_voxel, "the volume")
    columns = np.ascontiguousarray(volume.detach().numpy().transpose(1, 2, 0), np.float32)
    return torch.from_numpy(forward_columns(columns, geometry, views, rows=rows))


def adjoint(projections: torch.Tensor, geometry: Geometry, views: Views = None, *, rows: Rows = None) -> torch.Tensor:
    """Apply the transpose of `forward` to `projections`, float32 [view, v, u]: float32 [z, y, x], in mm.

    `views` and `rows` as in `forward`; projections hold the chosen views only, and rows that are not
    wanted are not read. Raises InputError as `forward` does.
    """
    chosen = view_indices(geometry, views)
    _check(projections, (chosen.size, *geometry.n_detector), "the projections")
    columns = adjoint_columns(projections.detach().numpy(), geometry, chosen, rows=rows)
    return torch.from_numpy(np.ascontiguousarray(columns.transpose(2, 0, 1)))


def forward_columns(
    columns: NDArray[np.float32], geometry: Geometry, views: Views = None, *, rows: Rows = None
) -> NDArray[np.float32]:
    """Do as `forward` for a volume that is stored as [y, x, z], which iterations keep to save transposes."""
    chosen = view_indices(geometry, views)
    projections = np.empty((chosen.size, *geometry.n_detector), np.float32)
    project(columns, geometry.pose_array()[chosen], _grid(geometry), _ranges(rows, geometry, chosen), projections)
    return projections


def adjoint_columns(
    projections: NDArray[np.float32], geometry: Geometry, views: Views = None, *, rows: Rows = None
) -> NDArray[np.float32]:
    """Do as `adjoint`, giving the volume as [y, x, z]."""
    chosen = view_indices(geometry, views)
    n_z, n_y, n_x = geometry.n_voxel
    columns = np.zeros((n_y, n_x, n_z), np.float32)
    stack = np.ascontiguousarray(projections, np.float32)
    backproject(stack, geometry.pose_array()[chosen], _grid(geometry), _ranges(rows, geometry, chosen), columns)
    return columns


def view_indices(geometry: Geometry, views: Views) -> NDArray[np.int64]:
    """Return the chosen views as an index array; raises InputError where one does not exist."""
    if views is None or isinstance(views, slice):
        return np.arange(geometry.n_views)[slice(None) if views is None else views]
    chosen = np.asarray(views)
    if chosen.ndim != 1 or not (np.issubdtype(chosen.dtype, np.integer) or chosen.size == 0):
        raise InputError(f"views must be a list of view indices, got {chosen.dtype} of shape {chosen.shape}")
    chosen = chosen.astype(np.int64)
    if chosen.size and (chosen.min() < 0 or chosen.max() >= geometry.n_views):
        raise InputError(f"views must lie within 0 … {geometry.n_views - 1}, got {chosen.min()} … {chosen.max()}")
    return chosen


def _ranges(rows: Rows, geometry: Geometry, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the half-open range of wanted rows of each chosen view, [view, 2]."""
    n_view, n_v = chosen.size, geometry.n_detector[0]
    if rows is None:
        return np.tile(np.array([0, n_v], np.int64), (n_view, 1))
    given = np.asarray(rows)
    if given.dtype == np.bool_ and given.shape == (n_view, n_v):
        last = np.where(given.any(1), n_v - given[:, ::-1].argmax(1), 0)
        return np.stack([np.where(given.any(1), given.argmax(1), 0), last], 1).astype(np.int64)
    if np.issubdtype(given.dtype, np.integer) and given.shape == (n_view, 2):
        return np.ascontiguousarray(given, np.int64)
    raise InputError(
        f"rows must be bool [{n_view}, {n_v}] or a range of integers [{n_view}, 2], "
        f"got {given.dtype} of shape {given.shape}"
    )


def _grid(geometry: Geometry) -> NDArray[np.float64]:
    return np.array([*geometry.d_voxel, *geometry.off_origin], np.float64)


def _check(given: torch.Tensor, shape: tuple[int, ...], name: str) -> None:
    if given.device.type != "cpu":
        raise InputError(f"projecting runs on the CPU only; expected {name} there, got device {given.device}")
    if tuple(given.shape) != shape:
        raise InputError(f"expected {name} of shape {shape}, got {tuple(given.shape)}")
