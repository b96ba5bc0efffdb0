"""Where a field is evaluated, and what its values look like from the source: points, their projection, and the volume.

A field is evaluated once a step at the centres of the voxels that the shadows leave, and the exact pair of
`ctsim.reconstruct.projector` integrates it along the rays. Evaluated along the rays as published, a step of six views
of 96² pixels would need some 36 times as many evaluations.
"""

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.reconstruct.projector import adjoint_columns, forward_columns

Views = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Some voxels of a scan's grid, the points, in the order of [y, x, z].

    `whole` is the grid that they are voxels of. `geometry` is it cropped to the box that holds them, as empty slices
    cost time; `box` the box's first voxel [z, y, x], and `index` the points in it, flat in [y, x, z].
    """

    whole: Geometry
    geometry: Geometry
    box: tuple[int, int, int]
    index: NDArray[np.int64]

    @classmethod
    def of(cls, geometry: Geometry, support: NDArray[np.bool_]) -> "Grid":
        """Take the voxels of a support [z, y, x] that has at least one."""
        ranges = []
        for axis in range(3):
            filled = np.flatnonzero(support.any(tuple(k for k in range(3) if k != axis)))
            ranges.append((int(filled[0]), int(filled[-1]) + 1))
        inside = support[tuple(slice(*r) for r in ranges)]
        offsets = tuple(
            off + (0.5 * (first + last) - 0.5 * n) * d
            for off, (first, last), n, d in zip(
                geometry.off_origin, ranges, geometry.n_voxel, geometry.d_voxel, strict=True
            )
        )
        cropped = msgspec.structs.replace(geometry, n_voxel=inside.shape, off_origin=offsets)
        return cls(
            whole=geometry,
            geometry=cropped,
            box=(ranges[0][0], ranges[1][0], ranges[2][0]),
            index=np.flatnonzero(inside.transpose(1, 2, 0)),
        )

    def __len__(self) -> int:
        return self.index.size

    def inside(self) -> NDArray[np.bool_]:
        """Return which voxels of the box are points, [y, x, z]."""
        n_z, n_y, n_x = self.geometry.n_voxel
        found = np.zeros(n_y * n_x * n_z, bool)
        found[self.index] = True
        return found.reshape(n_y, n_x, n_z)

    def axes(self) -> tuple[NDArray[np.float64], ...]:
        """Return the centres of the box's voxels along y, x and z, from 0 to 1 along the whole grid's longest axis."""
        sizes = self.whole.d_voxel
        longest = max(n * d for n, d in zip(self.whole.n_voxel, sizes, strict=True))
        numbers = (
            np.arange(n, dtype=np.float64) + first for n, first in zip(self.geometry.n_voxel, self.box, strict=True)
        )
        z, y, x = ((number + 0.5) * d / longest for number, d in zip(numbers, sizes, strict=True))
        return y, x, z

    def columns(self, values: torch.Tensor) -> torch.Tensor:
        """Put values [point] into the box, 0 elsewhere: [y, x, z]."""
        n_z, n_y, n_x = self.geometry.n_voxel
        empty = torch.zeros(n_y * n_x * n_z, dtype=values.dtype)
        return empty.index_put((torch.from_numpy(self.index),), values).view(n_y, n_x, n_z)

    def at_points(self, columns: torch.Tensor) -> torch.Tensor:
        """Return the values of the box [y, x, z] at the points: [point]."""
        return columns.reshape(-1)[torch.from_numpy(self.index)]

    def of_volume(self, volume: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a volume's values [z, y, x] at the points: [point]."""
        ranges = tuple(slice(first, first + n) for first, n in zip(self.box, self.geometry.n_voxel, strict=True))
        return volume[ranges].transpose(1, 2, 0).reshape(-1)[self.index]

    def filled(self, values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return values [point] as a volume on the whole grid, 0 elsewhere: [z, y, x]."""
        return self.volume(values.astype(np.float32), self.whole) > 0.5

    def project(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Integrate values [point] in 1/mm along the rays of some views: [view, v, u], in the values' type."""
        return _Project.apply(values, self, views)  # pyright: ignore[reportReturnType]

    def volume(self, values: NDArray[np.float32], geometry: Geometry) -> NDArray[np.float32]:
        """Return values [point] as means over the voxels of a grid with the same outline: [z, y, x]."""
        boxed = np.zeros(self.geometry.n_voxel, np.float32)
        boxed.transpose(1, 2, 0)[np.unravel_index(self.index, boxed.transpose(1, 2, 0).shape)] = values
        for axis in range(3):
            n, m, k = geometry.n_voxel[axis], self.whole.n_voxel[axis], boxed.shape[axis]
            shares = overlaps(n, m)[:, self.box[axis] : self.box[axis] + k]
            boxed = np.moveaxis(np.tensordot(shares, boxed, (1, axis)), 0, axis)
        return np.ascontiguousarray(boxed, np.float32)


def overlaps(n: int, m: int) -> NDArray[np.float32]:
    """Return the share that each of m equal cells has in each of n over the same length, [n, m]."""
    at = np.arange(n + 1)[:, None] * (m / n) - np.arange(m)
    covered = np.clip(at, 0, 1)
    return (np.diff(covered, axis=0) * (n / m)).astype(np.float32)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, grid: Grid, views: Views) -> torch.Tensor:
        ctx.grid, ctx.views, ctx.kind = grid, views, values.dtype
        columns = grid.columns(values.detach().float()).numpy()
        return torch.from_numpy(forward_columns(columns, grid.geometry, views)).to(values.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        images = np.ascontiguousarray(gradients[0].detach().float().numpy())
        columns = adjoint_columns(images, ctx.grid.geometry, ctx.views)
        return ctx.grid.at_points(torch.from_numpy(columns)).to(ctx.kind), None, None
