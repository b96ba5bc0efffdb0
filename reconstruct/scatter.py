"""Scatter that a scan shows by itself: what its open pixels read beyond the open field, carried on behind the object.

Photons scatter where the object takes them out of the beam, and the more of them leave it the thinner it is: their
source is −ln(T)·T, T the share that passes straight through. The panel sees it blurred by the way from the object. This
is the model of scatter kernels (Ohnesorge et al., Eur. Radiol. 9, 1999; Sun and Star-Lack, Phys. Med. Biol. 55, 2010)
with one kernel, whose height is not assumed but read, with a constant, from the pixels that no shadow reaches.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, sparse

from ctsim.geometry import Geometry

BLOCKS = 48  # most along a side of the panel, over which readings are averaged: scatter is smooth
SPREAD = 0.22  # σ of the kernel over the distance from the axis to the panel
ROUNDS = 3  # of the scatter and of the source without it
BRIGHT, APART = 0.1, 0.25  # of the open field: no open block is so much darker than it, or than the brightest
NORMAL, TRIMMED = 1.4826, 0.1  # standard over median deviation; share of the views at either end that is no usual one
NEAR, MARGIN = 3, 2  # blocks a side that are compared with one, and around an open one, which must be open, too
LOW, HIGH = 2.0, 5.0  # standard deviations that an open block may be below the open field, and above its neighbours
CUT, SIGNIFICANT = 0.055, 5.0
"""The mean of a Gaussian above −LOW, and standard deviations of the mean, beyond which open blocks show an excess."""
FEWEST = 100  # open blocks, below which nothing is told
FAINTEST = 1e-4  # primary over open field below which the source is not told from none
DARKEST = 0.01  # share of the blocks that may, in the mean around them, hold less than the scatter found

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

    def details(self) -> dict[str, object]:
        """Return what a result says of its scatter: the mean, the gain and the constant, over the open field."""
        return {"scatter": self.mean, "scatter_kernel": {"gain": self.gain, "floor": self.floor}}

    def of(self, view: int, shape: tuple[int, int]) -> Image:
        """Return the scatter of a view's pixels, [v, u], by straight lines between the middles of the blocks."""
        if self.source is None:
            return np.full(shape, self.floor, np.float32)
        rows, columns = (
            between(n, blocks, step) for n, blocks, step in zip(shape, self.source.shape[1:], self.step, strict=True)
        )
        return np.float32(self.floor) + np.float32(self.gain) * laid(self.source[view], rows, columns)


def scatter_of(p: Image, valid: NDArray[np.bool_], geometry: Geometry, i0: float) -> Scatter:
    """Find the scatter of p = −ln(signal/open), float32 [view, v, u], where the `valid` readings have signal.

    The open field is taken without an object and so without its scatter, and nothing else makes a ray brighter than
    that but noise and a drift of the tube. Gain and constant, neither below 0, are fitted to the blocks of pixels that
    are as bright as the open field, within a noise of at least that of `i0` photons, and not next to darker ones. Where
    these do not exceed the open field significantly, or there are none, scatter is 0. What is found is scaled down
    until 99 % of the blocks hold it.
    """
    means, step = _block_means(p, valid)
    noise = _noise(means, 1 / math.sqrt(i0 * math.prod(step)))
    means *= _steadied(means, noise)
    is_open = _open_blocks(means, noise)
    excess = means[is_open].astype(np.float64) - 1
    if excess.size < FEWEST or excess.mean() <= (CUT + SIGNIFICANT / math.sqrt(excess.size)) * noise:
        return Scatter(floor=0.0)
    d_v, d_u = (d * k for d, k in zip(geometry.d_detector, step, strict=True))
    gain, constant, source = 0.0, 0.0, np.zeros_like(means)
    for _ in range(ROUNDS):
        source = source_of(np.minimum(means - gain * source - constant, 1), geometry, (d_v, d_u))
        both = np.stack([source[is_open], np.ones(excess.size)], 1, dtype=np.float64)
        gain, constant = optimize.nnls(both, excess)[0].tolist()
    held = _held(means, gain * source + constant)
    if gain == 0:
        return Scatter(floor=held * constant)
    return Scatter(floor=held * constant, gain=held * gain, source=source, step=step)


def source_of(primary: Image, geometry: Geometry, d: tuple[float, float]) -> Image:
    """Return where scatter comes from as the panel sees it: −ln(T)·T, blurred, of blocks [view, v, u] `d` (mm) long."""
    primary = np.maximum(primary, np.float32(FAINTEST))
    gap = SPREAD * (geometry.dsd - geometry.dso)
    sigma = (0.0, *(gap / k for k in d))
    return np.asarray(ndimage.gaussian_filter(-np.log(primary) * primary, sigma, mode="nearest"), np.float32)


def _noise(means: Image, photons: float) -> float:
    """Return the standard deviation of an open block by its neighbours, at least that of `photons`."""
    bright = means > 1 - BRIGHT
    # a median: the object's outline deviates by more
    deviation = NORMAL * float(np.median(np.abs(means - _mean(means))[bright])) if bright.any() else 0.0
    return max(deviation, photons)


def _steadied(means: Image, noise: float) -> Image:
    """Return by what each view is to be multiplied so that what is open in all of them stays the same, within noise.

    Otherwise the brighter views of a tube that flickers would be taken for scatter, and those that are darker, as a
    screen's first ones, for shadow.
    """
    always = _smallest(means.mean(0), 2 * MARGIN + 1) >= 1 - noise
    if not always.any():
        return np.ones((len(means), 1, 1), np.float32)
    levels = np.median(means[:, always], axis=1).astype(np.float64)
    cut = int(TRIMMED * len(levels))
    usual = float(np.mean(np.partition(levels, (cut, len(levels) - cut - 1))[cut : len(levels) - cut]))
    unsteady = (np.abs(levels - usual) > noise) & (levels > 0)  # less is scatter's own course as well
    return np.asarray(np.where(unsteady, usual / np.where(unsteady, levels, 1), 1), np.float32)[:, None, None]


def _open_blocks(means: Image, noise: float) -> NDArray[np.bool_]:
    """Return which blocks [view, row, column] no shadow reaches."""
    least = max(1.0, float(np.quantile(means, 0.99)) - APART)
    # a block that is bright alone holds a defect or a hit of the panel
    alone = means - ndimage.median_filter(means, (1, NEAR, NEAR), mode="nearest") > HIGH * noise
    return (_smallest(means, 2 * MARGIN + 1) >= least - LOW * noise) & ~alone


def _smallest(blocks: NDArray[Any], side: int) -> NDArray[Any]:
    """Return the smallest of the blocks around each, `side` along row and column, the last two axes."""
    return np.asarray(ndimage.minimum_filter(blocks, (*[1] * (blocks.ndim - 2), side, side), mode="nearest"))


def _mean(blocks: Image) -> Image:
    """Return the mean of the blocks [view, row, column] around each."""
    size: Any = (1, NEAR, NEAR)
    return np.asarray(ndimage.uniform_filter(blocks, size, mode="nearest"), np.float32)


def _held(means: Image, scatter: Image) -> float:
    """Return the share of the scatter, both [view, row, column], that all blocks but some of the darkest hold."""
    around = _mean(means)  # noise alone may be darker
    ratios = (around / np.maximum(scatter, FAINTEST))[alive(means)]
    return min(float(np.quantile(ratios, DARKEST)), 1.0) if ratios.size else 0.0


def alive(means: Image) -> NDArray[np.bool_]:
    """Return which blocks [view, row, column] are not dead, nor of a view that is lost, nor next to such blocks."""
    lit = means > 0
    somewhere, in_some = np.any(lit, axis=0, keepdims=True), np.any(lit, axis=(1, 2), keepdims=True)
    return np.asarray(_smallest(np.logical_and(somewhere, in_some), NEAR), np.bool_)


def _block_means(p: Image, valid: NDArray[np.bool_]) -> tuple[Image, tuple[int, int]]:
    """Return the mean signal over the open field of blocks, [view, row, column], and their pixels along v and u.

    Invalid pixels are left out, but count as dark where they are more than half of a block.
    """
    step_v, step_u = (-(-n // BLOCKS) for n in p.shape[1:])
    at_v, at_u = (np.arange(0, n, step) for n, step in zip(p.shape[1:], (step_v, step_u), strict=True))
    means = np.empty((len(p), at_v.size, at_u.size), np.float32)

    def summed(image: NDArray[Any]) -> NDArray[np.float64]:
        return np.add.reduceat(np.add.reduceat(image, at_v, axis=0, dtype=np.float64), at_u, axis=1)

    half = summed(np.ones(p.shape[1:], np.bool_)) / 2
    for mean, reading, seen in zip(means, p, valid, strict=True):
        mean[...] = summed(np.where(seen, np.exp(-reading), 0)) / np.maximum(summed(seen), half)
    return means, (step_v, step_u)


def between(n: int, blocks: int, step: int) -> sparse.csr_array:
    """Return the matrix that interpolates `n` pixels from blocks of `step` pixels, of which the last may be shorter."""
    middles = np.minimum(np.arange(blocks) * step + (step - 1) / 2, (np.arange(blocks) * step + n - 1) / 2)
    weights = [np.interp(np.arange(n), middles, unit) for unit in np.eye(blocks)]
    return sparse.csr_array(np.stack(weights, 1, dtype=np.float32))


def laid(blocks: Image, rows: sparse.csr_array, columns: sparse.csr_array) -> Image:
    """Return an image of blocks laid over pixels, [v, u], by the matrices of `between` along v and u.

    Dense products would be slower, and their last bits would depend on how many threads NumPy's BLAS has.
    """
    return np.ascontiguousarray((columns @ (rows @ blocks).T).T, np.float32)
