"""Round splats on the reconstruction grid, where there is something."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ctsim.geometry import Geometry
from reconstruct.splat.model import Splats
from reconstruct.tv import Denoiser, axis_ratios

SIGMA = 0.45
"""σ of a splat in voxels: wider ones, not negative, cannot make the edges of a volume of this grid."""


@dataclass(slots=True, kw_only=True)
class Lattice:
    """One round splat in the middle of each voxel of `support` [z, y, x] (bool); values are per splat.

    `unit` is what a lattice of ones sums to at a point, on average; a splat's density is its attenuation over it.
    """

    geometry: Geometry
    support: NDArray[np.bool_]
    positions: NDArray[np.float32] = field(init=False)
    scale: float = field(init=False)
    unit: float = field(init=False)
    _index: NDArray[np.int64] = field(init=False)
    _denoiser: Denoiser = field(init=False)

    def __post_init__(self) -> None:
        z, y, x = (axis.astype(np.float32) for axis in self.geometry.voxel_centres())
        k, j, i = np.nonzero(self.support)
        self._index = np.flatnonzero(self.support)
        self.positions = np.stack([x[i], y[j], z[k]], 1)
        d = np.array(self.geometry.d_voxel)
        self.scale = SIGMA * float(np.prod(d)) ** (1 / 3)
        self.unit = float((math.sqrt(2 * math.pi) * self.scale) ** 3 / np.prod(d))
        self._denoiser = Denoiser(
            np.ascontiguousarray(self.support.transpose(1, 2, 0)), axis_ratios(self.geometry), positivity=True
        )

    def __len__(self) -> int:
        return len(self._index)

    def splats(self, densities: NDArray[np.float32]) -> Splats:
        """Return the splats with densities [splat, channel] that are given as attenuations of the volume."""
        return Splats(
            positions=self.positions,
            scales=np.full((len(self), 1), self.scale, np.float32),
            densities=(densities / np.float32(self.unit)).astype(np.float32),
        )

    @property
    def padded(self) -> tuple[int, int]:
        """Size (y, x) of a slice with room for the tails of a ramp filter, which fall as the square of the distance."""
        n_y, n_x = (int(fft.next_fast_len(n + n // 4, real=True) or n) for n in self.support.shape[1:])
        return n_y, n_x

    def scatter(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put values [splat] into their voxels: [z, y, x], zero elsewhere."""
        volume = np.zeros(self.support.size, np.float32)
        volume[self._index] = values
        return volume.reshape(self.support.shape)

    def gather(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take the values of a volume [z, y, x] at the splats: [splat]."""
        return np.ascontiguousarray(volume).reshape(-1)[self._index]

    def denoise(self, values: NDArray[np.float32], tau: float, iterations: int) -> NDArray[np.float32]:
        """Return argmin ½‖x − values‖² + tau·TV(x), x not negative."""
        columns = np.ascontiguousarray(self.scatter(values).transpose(1, 2, 0))
        return self.gather(self._denoiser.run(columns, tau, iterations).transpose(2, 0, 1))

    def filter_slices(self, values: NDArray[np.float32], gain: NDArray[np.float32]) -> NDArray[np.float32]:
        """Multiply the spectrum of every slice, `padded`, by `gain`, as `rfft2` orders it."""
        (_, n_y, n_x), size = self.support.shape, self.padded
        spectrum = np.asarray(fft.rfft2(self.scatter(values), s=size, axes=(1, 2), workers=-1)) * gain
        filtered = np.asarray(fft.irfft2(spectrum, s=size, axes=(1, 2), workers=-1), np.float32)
        return self.gather(filtered[:, :n_y, :n_x])
