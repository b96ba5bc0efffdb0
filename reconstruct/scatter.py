"""Scatter that a scan shows by itself: what its open pixels read beyond the open field, carried on behind the object.

Photons scatter where the object takes them out of the beam, and the more of them leave it the thinner it is: their
source is −ln(T)·T, T the share that passes straight through. The panel sees it blurred by the way from the object. This
is the model of scatter kernels (Ohnesorge et al., Eur. Radiol. 9, 1999; Sun and Star-Lack, Phys. Med. Biol. 55, 2010)
with one kernel, whose height is not assumed but read, with a constant, from the pixels that no shadow reaches.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from ctsim.geometry import Geometry

BLOCKS = 48  # most along a side of the panel, over which readings are averaged: scatter is smooth
SPREAD = 0.22  # σ of the kernel over the distance from the axis to the panel
ROUNDS = 3  # of the scatter and of the source without it
BRIGHT, NORMAL = 0.1, 1.4826  # of the open field, below open ones; standard over median deviation
NOISE, MARGIN = 2.0, 2  # standard deviations of a block below 1, and blocks around it, that are no open pixels
APART = 0.25  # of the open field: more than that, open readings do not differ by
SIGNIFICANT, FEWEST = 0.2, 100  # mean excess over the noise of a block, and open blocks, below which nothing is told
FAINTEST = 1e-4  # primary over open field below which the source is not told from none
DARKEST = 0.01  # share of the blocks that may, in the mean around them, hold less than the scatter found
NEAR = 3  # blocks a side around one

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatter:
    """Scatter over the open field, S/I0: `gain` times the blurred `source`, float32 [view, row, column], and `floor`.

    A block of the source covers `step` pixels along v and u; without one, scatter is the constant `floor`.
    """

    floor: float
    gain: float = 0.0
    source: Image | None = None
    step: tuple[int, int] = (1, 1)

    @property
    def mean(self) -> float:
        """The mean over all blocks."""
        return self.floor + (0.0 if self.source is None else self.gain * float(self.source.mean(dtype=np.float64)))

    def of(self, view: int, shape: tuple[int, int]) -> Image:
        """Return the scatter of a view's pixels, [v, u], by straight lines between the middles of the blocks."""
        if self.source is None:
            return np.full(shape, self.floor, np.float32)
        rows, columns = (
            _between(n, blocks, step) for n, blocks, step in zip(shape, self.source.shape[1:], self.step, strict=True)
        )
        return np.float32(self.floor) + np.float32(self.gain) * (rows @ self.source[view] @ columns.T)


def scatter_of(p: Image, valid: NDArray[np.bool_], geometry: Geometry, i0: float) -> Scatter:
    """Find the scatter of p = −ln(signal/open), float32 [view, v, u], where the `valid` readings have signal.

    The open field is taken without an object and so without its scatter, and nothing else makes a ray brighter than
    that but noise and a drift of the tube. Gain and constant are fitted by least squares, neither below 0, to the
    blocks of pixels that are as bright as the open field, within a noise of at least that of `i0` photons, and not next
    to darker ones. Where these hardly exceed the open field, or there are none, scatter is 0. What is found is scaled
    down until the darkest readings hold it.
    """
    means, step = _block_means(p, valid)
    least = max(1.0, float(np.quantile(means, 0.99)) - APART)
    around = ndimage.uniform_filter(means, (1, NEAR, NEAR), mode="nearest")
    bright = means > least - BRIGHT
    deviation = NORMAL * float(np.median(np.abs(means - around)[bright])) if bright.any() else 0.0
    noise = max(deviation, 1 / math.sqrt(i0 * math.prod(step)))  # a median: the object's outline deviates by more
    near = (1, 2 * MARGIN + 1, 2 * MARGIN + 1)
    is_open = ndimage.minimum_filter(means, near, mode="nearest") >= least - NOISE * noise
    excess = means[is_open].astype(np.float64) - 1
    if excess.size < FEWEST or excess.mean() <= SIGNIFICANT * noise:
        return Scatter(floor=0.0)
    gap = SPREAD * (geometry.dsd - geometry.dso)
    sigma = (0.0, *(gap / (d * k) for d, k in zip(geometry.d_detector, step, strict=True)))
    gain, constant, source = 0.0, 0.0, np.zeros_like(means)
    for _ in range(ROUNDS):
        primary = np.clip(means - gain * source - constant, FAINTEST, 1)
        source = ndimage.gaussian_filter(-np.log(primary) * primary, sigma, mode="nearest")
        both = np.stack([source[is_open], np.ones(excess.size)], 1, dtype=np.float64)
        gain, constant = optimize.nnls(both, excess)[0].tolist()
    most = float(np.quantile(around / np.maximum(gain * source + constant, FAINTEST), DARKEST))
    held = min(max(most, 0.0), 1.0)
    if gain == 0:
        return Scatter(floor=held * constant)
    return Scatter(floor=held * constant, gain=held * gain, source=source, step=step)


def _block_means(p: Image, valid: NDArray[np.bool_]) -> tuple[Image, tuple[int, int]]:
    """Return the mean signal over the open field of blocks, [view, row, column], and their pixels along v and u.

    Invalid pixels are left out, but count as dark where they are more than half of a block.
    """
    step_v, step_u = (-(-n // BLOCKS) for n in p.shape[1:])
    at_v, at_u = (np.arange(0, n, step) for n, step in zip(p.shape[1:], (step_v, step_u), strict=True))
    means = np.empty((len(p), at_v.size, at_u.size), np.float32)
    for mean, reading, seen in zip(means, p, valid, strict=True):
        signal = np.where(seen, np.exp(-reading), 0)
        total, counted, pixels = (
            np.add.reduceat(np.add.reduceat(a, at_v, axis=0, dtype=np.float64), at_u, axis=1)
            for a in (signal, seen, np.ones_like(seen))
        )
        mean[...] = total / np.maximum(counted, pixels / 2)
    return means, (step_v, step_u)


def _between(n: int, blocks: int, step: int) -> Image:
    """Return the matrix that interpolates `n` pixels from blocks of `step` pixels, of which the last may be shorter."""
    middles = np.minimum(np.arange(blocks) * step + (step - 1) / 2, (np.arange(blocks) * step + n - 1) / 2)
    weights = [np.interp(np.arange(n), middles, unit) for unit in np.eye(blocks)]
    return np.stack(weights, 1, dtype=np.float32)
