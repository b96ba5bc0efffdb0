"""Readings with hardly a photon: all that they say is that a ray is at least so dark.

Their logarithm is noise, and its weight, the share of photons that came through, next to nothing: metal that only such
rays cross would stay hollow. So they pull, with a weight of their own, wherever the fit is brighter than their bound.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.reconstruct.log import count_floor
from ctsim.reconstruct.scatter import Scatter
from ctsim.reconstruct.weights import photon_weights
from ctsim.types import Scan

SURE = 2.0  # standard deviations of the dark noise that a reading may lie below the truth
UNSEEN = 3.0  # photons that may have been expected where none came, at 95 %
DOUBT = 0.25  # of the scatter, which is known no better behind metal
WEIGHT = 0.002  # of a bound, as of a reading of P = 6.2
ENOUGH = 100  # readings below the dark level that tell noise
HALF, SPREAD = math.sqrt(2 / math.pi), math.sqrt(1 - 3 / math.pi)
"""Mean over root mean square of half a Gaussian, and its standard deviation times √(number of readings)."""
SIGNIFICANT = 5.0  # standard deviations

Image = NDArray[np.float32]


def weights_and_bounds(scan: Scan, p: Image, valid: NDArray[np.bool_], scatter: Scatter, noise: float) -> Image:
    """Return weights [view, v, u]: exp(−p) of readings, 0 of what says nothing, and −WEIGHT of bounds.

    `p` is changed. Where a reading is a bound, it becomes the least −ln(primary/open) that it allows; elsewhere what
    would be read if scatter were the same everywhere, its mean, which keeps the logarithm finite. `noise`, the standard
    deviation of a dark reading, is over the open field.
    """
    open_field = scan.flat.numpy() - np.float32(scan.dark)
    floor, mean = count_floor(scan), np.float32(scatter.mean)
    usable = np.isfinite(open_field) & (open_field > floor)
    scale = np.where(usable, 1 / np.where(usable, open_field, 1), 0).astype(np.float32)
    typical = float(open_field[usable].mean(dtype=np.float64)) if usable.any() else 1.0
    faint = np.float32(typical) * scale  # where the open field is weak, as behind a bow-tie, little is a large share
    least = np.float32(max(floor / typical, SURE * noise)) * faint
    darkest = np.float32(math.hypot(SURE * noise, UNSEEN / scan.i0)) * faint
    weights = photon_weights(p, valid)
    for view, (reading, weight) in enumerate(zip(p, weights, strict=True)):
        scattered = scatter.of(view, reading.shape)
        share, doubt = _signal(scan, view) * scale - scattered, np.float32(DOUBT) * scattered
        starved = usable & np.isfinite(share) & (share <= least + doubt)
        weight[starved] = -WEIGHT
        if scatter.source is not None:
            read = weight > 0
            reading[read] = -np.log(share[read] + mean)
        reading[starved] = -np.log((np.maximum(share, 0) + darkest + doubt)[starved])
    return weights


@dataclass(frozen=True, slots=True, kw_only=True)
class Below:
    """Readings below the dark level: how many, their mean and root mean square depth over the open field."""

    count: int
    mean: float
    rms: float

    @classmethod
    def of(cls, scan: Scan) -> "Below":
        """Look at all views."""
        count, total, squares = 0, 0.0, 0.0
        rounded = 0.0 if scan.counts.is_floating_point() else 0.5  # a whole count stands for as much on either side
        for view in range(scan.geometry.n_views):
            signal = _signal(scan, view)
            below = -signal[np.isfinite(signal) & (signal < -rounded)].astype(np.float64) - rounded
            count, total, squares = count + below.size, total + below.sum(), squares + np.square(below).sum()
        open_field = float(scan.flat.double().mean()) - scan.dark
        if not open_field > 0 or not squares > 16 * rounded**2 * count:  # twice a count: less may be rounding alone
            return cls(count=0, mean=0.0, rms=0.0)
        return cls(count=count, mean=float(total) / count / open_field, rms=math.sqrt(squares / count) / open_field)

    @property
    def noise(self) -> float:
        """The standard deviation of a reading without photons: half of such readings are below, half a Gaussian."""
        return self.rms if self.count >= ENOUGH else 0.0

    @property
    def sentence(self) -> str:
        """Say that the dark level is too high, or nothing.

        Where it is right, noise alone puts readings below it: half a Gaussian, whose mean is 0.8 of its root mean
        square. Where it is too high the ratio is nearer to 1.
        """
        if self.count < ENOUGH or self.mean <= (HALF + SIGNIFICANT * SPREAD / math.sqrt(self.count)) * self.rms:
            return ""
        return f"{self.count} readings are below the dark level, by more than noise: is the scan's dark level right?"


def _signal(scan: Scan, view: int) -> Image:
    return scan.counts[view].numpy().astype(np.float32) - np.float32(scan.dark)
