"""How much a reading counts: by its photons, and by how well a model of finite resolution can explain it."""

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float32]

DARK = 3.0  # P above which a reading is dark: little but metal makes it so


def photon_weights(p: Image, valid: NDArray[np.bool_]) -> Image:
    """Return the share of photons that came through, exp(−p), of line integrals [view, v, u]; 0 where not `valid`."""
    weights = np.empty(p.shape, np.float32)
    for reading, seen, weight in zip(p, valid, weights, strict=True):  # a view at a time stays in the cache
        weight[...] = np.where(seen, np.exp(-np.maximum(reading, 0)), 0)
    return weights


def even_out(weights: Image, error: float) -> None:
    """Make weights w > 0 of readings (1 + error)·w/(1 + error·w), in place; bounds keep theirs.

    Weights exp(−p) are inverse variances by the noise of photons, that of an open ray over a ray's. Here both have an
    error of the model added, whose variance is `error` times that of an open ray's noise.
    """
    more = np.float32(error)
    for weight in weights:  # a view at a time stays in the cache
        weight *= np.where(weight > 0, (1 + more) / (1 + more * np.maximum(weight, 0)), np.float32(1))


def doubt_edges(p: Image, weights: Image, edges: float, scatter: float = 0.0) -> None:
    """Lower weights w > 0, in place, to 1/(1/w + (b/edges)²), where b says how sharply line integrals `p` bend.

    b is the greater of the absolute second differences of `p` along u and v. A pixel averages intensities, and where in
    it an edge lies no grid tells: what a model misses grows with b, as if 1/w, the variance of a reading in units of an
    open ray's, were larger. Bright rays along a wire's shadow, with all their photons, would otherwise outweigh the
    dark ones that hold the wire. An edge that the grid misplaces reaches over the next pixel: where one of the 3 × 3
    readings around a pixel exceeds `DARK`, b is the greatest of the nine. `edges` is the b at which an open ray keeps
    half of its weight; it is chosen, not derived. Arrays are [view, v, u]. Pixels of weight 0 and those beyond the rim
    bend nothing and are not dark. Bounds, w < 0, keep their weights; their p lacks `scatter`, S/I0, which that of
    readings has.
    """

    def doubt(view: tuple[Image, Image]) -> None:
        reading, weight = as_read(*view, scatter), view[1]
        bend = bends(reading, weight != 0) / np.float32(edges)
        dark = (reading > DARK) & (weight != 0)
        if dark.any():
            bend = np.where(ndimage.maximum_filter(dark, 3), ndimage.maximum_filter(bend, 3), bend)
        weight /= 1 + np.maximum(weight, 0) * bend * bend

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        list(pool.map(doubt, zip(p, weights, strict=True)))


def as_read(p: Image, weights: Image, scatter: float) -> Image:
    """Return line integrals with `scatter`, S/I0, in those of bounds, w < 0, too."""
    return np.where(weights < 0, -np.log(np.exp(-p) + np.float32(scatter)), p) if scatter else p


def bends(image: Image, says: NDArray[np.bool_]) -> Image:
    """Return the greater of the absolute second differences along v and u of an image [v, u], as of `doubt_edges`."""
    return np.maximum(_bend(image, says, 0), _bend(image, says, 1))


def _bend(image: Image, says: NDArray[np.bool_], axis: int) -> Image:
    """Return the absolute second difference along an axis; a neighbour that says nothing is taken as equal."""
    values, said = np.moveaxis(image, axis, 0), np.moveaxis(says, axis, 0)
    step = np.where(said[1:] & said[:-1], np.diff(values, axis=0), np.float32(0))
    bend = np.zeros_like(values)
    bend[:-1] += step
    bend[1:] -= step
    return np.moveaxis(np.abs(bend), 0, axis)
