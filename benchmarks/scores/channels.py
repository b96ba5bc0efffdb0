"""Channels of a model observer: what it sees of a region of interest around a known location.

Laguerre–Gauss functions of the distance r from the location (Gallas and Barrett 2003, doi:10.1364/JOSAA.20.001725),
j = 0, 1, … : exp(−π r²/a²)·L_j^(d/2 − 1)(2π r²/a²). In a slice, d = 2, they are the published ones; in a volume, d = 3,
the generalised polynomials keep them orthogonal under the same Gaussian.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_genlaguerre

from ctsim.geometry import Geometry, Triple

N_CHANNELS = 5
WIDTH = 1.0
"""a, in diameters of the lesion."""
REACH = 1.0
"""Radius of the region of interest, in diameters of the lesion."""


@dataclass(frozen=True, slots=True)
class Channels:
    """Weights [channel, k] of the voxels `index` (flat) of a volume; each channel has the norm 1."""

    index: NDArray[np.int64]
    weights: NDArray[np.float64]

    def of(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the channels' responses [channel] to a volume [z, y, x]."""
        return self.weights @ values.reshape(-1)[self.index].astype(np.float64)


def laguerre_gauss(r: NDArray[np.float64], width: float, dimensions: int) -> NDArray[np.float64]:
    """Return the channels [channel, k] at distances r [k] in mm, not normalised; `width` is a in mm."""
    x = 2 * np.pi * (r / width) ** 2
    return np.stack([np.exp(-x / 2) * eval_genlaguerre(j, dimensions / 2 - 1, x) for j in range(N_CHANNELS)])


def channels(
    geometry: Geometry, at: Triple, diameter: float, *, seen: NDArray[np.bool_] | None = None, dimensions: int = 3
) -> Channels:
    """Return the channels around a location (x, y, z) in mm for a lesion of `diameter` mm.

    With 3 `dimensions` they fill a ball, with 2 a disc in the axial slice nearest to the location. The voxels that are
    not `seen` [z, y, x] are left out.
    """
    z, y, x = (c - p for c, p in zip(geometry.voxel_centres(), reversed(at), strict=True))
    if dimensions == 2:
        z = np.where(np.arange(len(z)) == np.argmin(np.abs(z)), 0.0, np.inf)
    r = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2).reshape(-1)
    index = np.flatnonzero((r <= REACH * diameter) & (True if seen is None else seen.reshape(-1)))
    weights = laguerre_gauss(r[index], WIDTH * diameter, dimensions)
    return Channels(index, weights / np.linalg.norm(weights, axis=1, keepdims=True))
