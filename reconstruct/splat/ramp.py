"""A ramp filter of the transverse frequencies of a volume, level beyond a few of them.

Such a filter is its level times the volume, less what the few frequencies lack of it. Those are sums with cosines and
sines: two products with matrices there, and two back, instead of Fourier transforms.
"""

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ctsim.reconstruct.splat.kernels.product_cpu import padded_rows, products

STEEPEST = 0.8
"""Greatest gain of the ramp, as a share of the views in a subset."""
ROOM = 4  # a period has room for this part of a volume besides: a ramp's tails fall as the distance squared

Image = NDArray[np.float32]


class Ramp:
    """The gain πf/n, at least 1 and at most `STEEPEST`·n, for n views and f in cycles a field of view.

    For volumes of `size` (y, x) within a field of view of `across` (y, x) voxels.
    """

    def __init__(self, size: tuple[int, int], across: tuple[int, int], n_views: int) -> None:
        self.level = max(STEEPEST * n_views, 1.0)
        highest = self.level * n_views / math.pi  # cycles, from which on the gain is level
        (of_y, f_y), (of_x, f_x) = (_waves(n, whole, highest) for n, whole in zip(size, across, strict=True))
        gain = np.clip(np.hypot(f_y[:, None], f_x) * math.pi / n_views, 1, self.level)
        self._lack = (gain - self.level).astype(np.float32)[..., None]
        self._there = padded_rows(of_y), padded_rows(of_x)
        self._back = padded_rows(of_y.T), padded_rows(of_x.T)

    def apply(self, volume: Image) -> None:
        """Filter a C-contiguous volume, float32 [y, x, z], in place."""
        (n_y, n_x, n_z), (k_y, k_x, _) = volume.shape, self._lack.shape
        along_y, both = np.empty((k_y, n_x, n_z), np.float32), np.empty((k_y, k_x, n_z), np.float32)
        flat, sums = volume.reshape(1, n_y, -1), along_y.reshape(1, k_y, -1)
        products(self._there[0], flat, sums)
        products(self._there[1], along_y, both)
        both *= self._lack
        products(self._back[1], both, along_y)
        products(self._back[0], sums, flat, self.level)


@functools.lru_cache(maxsize=8)
def ramp(size: tuple[int, int], across: tuple[int, int], n_views: int) -> Ramp:
    """Return the `Ramp`: a fit asks for the same few in every step."""
    return Ramp(size, across, n_views)


def _waves(n: int, whole: int, highest: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cosines and sines [wave, n] of unit norm over a period, up to a frequency, and their frequencies."""
    period = n + n // ROOM
    k = np.arange(min(int(highest * period / whole), period // 2) + 1)
    angles = 2 * math.pi / period * np.outer(k, np.arange(n))
    norms = np.where((k == 0) | (2 * k == period), 1, math.sqrt(2))[:, None] / math.sqrt(period)
    odd = (k > 0) & (2 * k < period)  # the others' sines are 0
    waves = np.concatenate([norms * np.cos(angles), (norms * np.sin(angles))[odd]])
    return waves, np.append(k, k[odd]) * whole / period
