"""What a field is fitted to: line integrals and their weights, views that are kept apart, and the support."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.level import Data as Level
from ctsim.reconstruct.splat.level import carve

Image = NDArray[np.float32]
Views = NDArray[np.int64]
SIGMAS, FAINTEST = 5.0, 0.02
"""A ray met something above this many standard deviations of an open pixel, and above a millimetre of water."""
SHARE, MOST, FEWEST = 10, 12, 4
"""One view in ten is kept from the fit, at most twelve; none of a scan with fewer than four views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Line integrals `p` and their weights, float32 [view, v, u]; `power` is that of the misfit, 1 or 2.

    Weights are 0 where a reading says nothing. Where one is negative, p is the least that a dark reading allows.
    """

    p: Image
    weights: Image
    power: int = 1

    def misfit(self, found: torch.Tensor, views: Views) -> torch.Tensor:
        """Return the mean of weight · |p − P|^power over the pixels of some views; `found` is P [view, v, u]."""
        return self.misfits(found, views).mean()

    def misfits(self, found: torch.Tensor, views: Views) -> torch.Tensor:
        """Return weight · |p − P|^power of each pixel, [view, v, u]."""
        weights = torch.from_numpy(self.weights[views]).to(found.dtype)
        lacking = torch.from_numpy(self.p[views]).to(found.dtype) - found
        lacking = torch.where(weights < 0, lacking.clamp(min=0), lacking)
        return weights.abs() * (lacking.abs() if self.power == 1 else lacking * lacking)


def held_out_views(n_views: int) -> Views:
    """Return the views that are kept from the fit, evenly spread."""
    n = 0 if n_views < FEWEST else min(max(n_views // SHARE, 1), MOST)
    return np.unique(np.linspace(0, n_views - 1, n + 2).round().astype(np.int64)[1:-1])


def subsets(views: Views, size: int, seed: int, turn: int) -> list[Views]:
    """Return views in evenly spread subsets of about `size`, in the random order of a turn over all of them."""
    n = max(round(len(views) / size), 1)
    order = np.random.default_rng((seed, turn)).permutation(n)
    return [views[k::n] for k in order]


def support_of(geometry: Geometry, p: Image, weights: Image, i0: float, scatter: float) -> NDArray[np.bool_]:
    """Return the voxels [z, y, x] that some view sees and none shows to be empty."""
    level = Level(geometry=geometry, p=p, weights=weights, scatter=scatter)
    return carve(level, max(FAINTEST, SIGMAS / float(np.sqrt(i0))))


def mean_attenuation(p: Image, weights: Image, lengths: Image) -> float:
    """Return Σ p / Σ length over the readings that count, 1/mm: about that of the object's bulk; 0 without any."""
    seen = (weights > 0) & (lengths > 0)
    path = float(lengths.sum(where=seen, dtype=np.float64))
    return max(float(p.sum(where=seen, dtype=np.float64)) / path, 0.0) if path > 0 else 0.0
