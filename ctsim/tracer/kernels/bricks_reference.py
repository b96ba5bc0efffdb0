"""Readable twin of `bricks_cpu.reach`: every cube ahead of a brick is looked at whole."""

import numpy as np
from numpy.typing import NDArray


def reach(kind: NDArray[np.uint16]) -> NDArray[np.int64]:
    """Edge of the largest cube of one label ahead of each brick, at most 255: [octant, bz, by, bx].

    Octant bit 0, 1, 2 is set where the ray runs towards larger x, y, z. What lies outside `kind` [bz, by, bx] does not
    end a cube.
    """
    edges = np.empty((8, *kind.shape), np.int64)
    for octant, z, y, x in np.ndindex(edges.shape):
        edge = 1
        while edge < 255 and np.all(kind[_ahead((z, y, x), edge + 1, octant)] == kind[z, y, x]):
            edge += 1
        edges[octant, z, y, x] = edge
    return edges


def _ahead(corner: tuple[int, int, int], edge: int, octant: int) -> tuple[slice, ...]:
    """Return the box of bricks from `corner` on along z, y, x."""
    upwards = (octant >> 2 & 1, octant >> 1 & 1, octant & 1)
    first = [i if up else max(i + 1 - edge, 0) for i, up in zip(corner, upwards, strict=True)]
    last = [i + edge - 1 if up else i for i, up in zip(corner, upwards, strict=True)]
    return tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
