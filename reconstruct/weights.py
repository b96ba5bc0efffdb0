"""How much a reading counts: by its photons, and by how well a model of finite resolution can explain it."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


def photon_weights(p: Image, valid: NDArray[np.bool_]) -> Image:
    """Return the share of photons that came through, exp(−p), of line integrals [view, v, u]; 0 where not `valid`."""
    weights = np.empty(p.shape, np.float32)
    for reading, seen, weight in zip(p, valid, weights, strict=True):  # a view at a time stays in the cache
        weight[...] = np.where(seen, np.exp(-np.maximum(reading, 0)), 0)
    return weights


def doubt_edges(p: Image, weights: Image, edges: float) -> None:
    """Lower weights w > 0, in place, to 1/(1/w + (Δ/edges)²): Δ is the range of `p` over 3 × 3 pixels.

    A pixel on an edge averages intensities, and where in it the edge lies no grid tells: its model errs by a share of
    Δ, an error like noise of variance Δ². Bright rays along a wire's shadow, with all their photons, would otherwise
    outweigh the dark ones that hold the wire. Dark rays change little, since 1/w is large there. `edges` is the Δ at
    which an open ray keeps half of its weight. Arrays are [view, v, u]; pixels of weight 0 say nothing of others, and
    bounds, w < 0, stay as they are.
    """
    for reading, weight in zip(p, weights, strict=True):
        says, silent = weight != 0, np.float32(-np.inf)
        range_ = _greatest(np.where(says, reading, silent)) + _greatest(np.where(says, -reading, silent))
        step = np.where(weight > 0, range_ / np.float32(edges), np.float32(0))
        weight /= 1 + weight * step * step


def _greatest(image: Image) -> Image:
    """Return the greatest of 3 × 3 pixels, of fewer at the rim: [v, u]."""
    for axis in (0, 1):
        lines = np.moveaxis(image, axis, 0)
        found = lines.copy()
        np.maximum(found[1:], lines[:-1], out=found[1:])
        np.maximum(found[:-1], lines[1:], out=found[:-1])
        image = np.moveaxis(found, 0, axis)
    return image
