"""Round splats on the reconstruction grid, where there is something."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.kernels import step_cpu
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.ramp import ramp
from ctsim.reconstruct.tv import Denoiser, SparseDenoiser, axis_ratios, denoiser_on

SIGMA = 0.45
"""σ of a splat in voxels: wider ones, not negative, cannot make the edges of a volume of this grid."""
PIECE = 1 << 22  # splats


@dataclass(slots=True, kw_only=True)
class Lattice:
    """One round splat in the middle of each voxel of `support` [z, y, x] (bool); values are per splat.

    Splats are ordered by y, x and z, so that upright columns of them lie together. `unit` is what a lattice of ones
    sums to at a point, on average; a splat's density is its attenuation over it. `index` tells where a splat is in the
    flat box, [y, x, z], that holds the support.
    """

    geometry: Geometry
    support: NDArray[np.bool_]
    scale: float = field(init=False)
    unit: float = field(init=False)
    index: NDArray[np.int64] = field(init=False)
    _box: tuple[slice, ...] = field(init=False)
    _axes: tuple[NDArray[np.float32], ...] = field(init=False)  # y, x and z (mm) within the box
    _size: tuple[int, ...] = field(init=False)
    _denoiser: Denoiser | SparseDenoiser = field(init=False)
    _volume: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        columns, (z, y, x) = self.support.transpose(1, 2, 0), self.geometry.voxel_centres()
        d = np.array(self.geometry.d_voxel)
        self.scale = SIGMA * float(np.prod(d)) ** (1 / 3)
        self.unit = float((math.sqrt(2 * math.pi) * self.scale) ** 3 / np.prod(d))
        held = (np.flatnonzero(columns.any(others)) for others in ((1, 2), (0, 2), (0, 1)))
        self._box = tuple(slice(int(n[0]), int(n[-1]) + 1) if n.size else slice(0, 0) for n in held)
        self._axes = tuple(axis[part].astype(np.float32) for axis, part in zip((y, x, z), self._box, strict=True))
        inside = np.ascontiguousarray(columns[self._box])
        self._size, self.index = inside.shape, np.flatnonzero(inside)
        self._volume = np.empty(self._size, np.float32)
        self._denoiser = denoiser_on(inside, axis_ratios(self.geometry), positivity=True)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def positions(self) -> NDArray[np.float32]:
        """The middles of the splats, (x, y, z) in mm: [splat, 3], made anew each time."""
        return self._at(self.index)

    @property
    def heights(self) -> NDArray[np.float32]:
        """The splats' z in mm."""
        return self._height(self.index)

    def runs(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return (x, y) in mm of runs, splats on end above each other, and where they start and the last ends."""
        begins = np.ones(len(self) + 1, np.bool_)
        begins[1:-1] = (np.diff(self.index) != 1) | (self.index[1:] % max(self._size[2], 1) == 0)
        starts = np.flatnonzero(begins)
        return np.stack(self._above(self.index[starts[:-1]]), 1).astype(np.float64), starts

    def _at(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.stack([*self._above(index), self._height(index)], 1)

    def _height(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        return self._axes[2][index % max(self._size[2], 1)]

    def _above(self, index: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return x and y in mm at places in the flat box."""
        column = index // max(self._size[2], 1)
        return self._axes[1][column % max(self._size[1], 1)], self._axes[0][column // max(self._size[1], 1)]

    def splats(self, densities: NDArray[np.float32]) -> Splats:
        """Return the splats with densities [splat, channel] that are given as attenuations of the volume."""
        return self._some(densities, slice(None))

    def pieces(self, densities: NDArray[np.float32]) -> Iterator[Splats]:
        """Return the splats in pieces: all at once they take more memory than the rest of a large fit."""
        for first in range(0, max(len(self), 1), PIECE):
            yield self._some(densities, slice(first, first + PIECE))

    def _some(self, densities: NDArray[np.float32], which: slice) -> Splats:
        positions = self._at(self.index[which])
        return Splats(
            positions=positions,
            scales=np.full((len(positions), 1), self.scale, np.float32),
            densities=(densities[which] / np.float32(self.unit)).astype(np.float32),
        )

    @property
    def dual(self) -> NDArray[np.float32]:
        """The denoiser's dual field, with which it starts."""
        return self._denoiser.dual

    def gather(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take the values of a volume [z, y, x] at the splats: [splat]."""
        return volume.transpose(1, 2, 0)[self._box].reshape(-1)[self.index]

    def scattered(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put values [splat] into a volume of the grid, zero elsewhere: [z, y, x]."""
        volume = np.zeros(self.support.shape, np.float32)
        volume.transpose(1, 2, 0)[self._box] = self._filled(values)
        return volume

    def denoise(self, values: NDArray[np.float32], tau: float, iterations: int) -> NDArray[np.float32]:
        """Return argmin ½‖x − values‖² + tau·TV(x), x not negative."""
        return self._denoiser.run(self._filled(values), tau, iterations).reshape(-1)[self.index]

    def spread(
        self, u: NDArray[np.float32], below: np.float32, values: NDArray[np.float32], n_views: int
    ) -> NDArray[np.float32]:
        """Filter the values where `u` is below a limit by the ramp of a subset of views.

        The result is flat, at `index` for each splat, and holds until the next call.
        """
        (n_y, n_x, _), (_, *across) = self._size, self.support.shape
        self._volume.fill(0)
        step_cpu.put_tissue(values, u, below, self.index, self._volume.reshape(-1))
        ramp((n_y, n_x), (across[0], across[1]), n_views).apply(self._volume)
        return self._volume.reshape(-1)

    def _filled(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put values [splat] into the smallest box [y, x, z] that holds the support, zero elsewhere."""
        self._volume.fill(0)
        self._volume.reshape(-1)[self.index] = values
        return self._volume
