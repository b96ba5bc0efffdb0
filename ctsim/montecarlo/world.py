"""A phantom as photons meet it: bricks and solids of the ray tracer, and blocks with their greatest attenuation."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.montecarlo.tables import Interactions
from ctsim.solids import BOUND, pack
from ctsim.tracer.bricks import Bricks, make_bricks
from ctsim.tracer.kernels.bricks_cpu import SIDE
from ctsim.types import Phantom

LEAST_BRICKS, MOST_BLOCKS = 4, 32
"""Bricks along a block's edge, at least, and blocks along an axis of the voxels, at most. Smaller blocks have tighter
bounds but more faces to cross: 2 bricks were up to a third slower for bodies of one material, and 8 for teeth."""
MOST_AROUND = 32


class Blocks(NamedTuple):
    """Boxes of whole bricks that hold few materials each.

    `kind` [bz, by, bx] numbers the sets of voxel materials that occur; `most` [kind, energy] bounds the attenuation
    (1/mm) of a set between energies i and i + 1, solids left out. The solids that reach into block b are
    listed[first[b] : first[b + 1]], in paint order. `frame` is the low corner and the edges of a block (x, y, z; mm).
    There are blocks of air around the voxels where solids reach out of them, up to MOST_AROUND on a side.
    """

    kind: NDArray[np.int64]
    most: NDArray[np.float32]
    first: NDArray[np.int64]
    listed: NDArray[np.int64]
    frame: NDArray[np.float64]


class World(NamedTuple):
    """Everything that the kernel needs to know of a phantom."""

    bricks: Bricks
    prims: NDArray[np.float64]
    blocks: Blocks
    tables: Interactions

    @staticmethod
    def of(phantom: Phantom, e_max: float) -> "World":
        """Prepare a phantom for photons of up to `e_max` keV."""
        tables = Interactions.of(phantom.materials, e_max)
        prims = pack(phantom.solids, phantom.materials)
        return World(
            bricks=make_bricks(phantom), prims=prims, blocks=make_blocks(phantom, prims, tables), tables=tables
        )


def make_blocks(phantom: Phantom, prims: NDArray[np.float64], tables: Interactions) -> Blocks:
    """Cut a phantom into blocks."""
    edge = SIDE * max(LEAST_BRICKS, -(-max(phantom.labels.shape) // (SIDE * MOST_BLOCKS)))
    inner = tuple(-(-n // edge) for n in phantom.labels.shape)
    n = np.array(phantom.labels.shape[::-1])
    d = np.array(phantom.d_voxel[::-1], np.float64)
    low, wide = np.array(phantom.off_origin[::-1], np.float64) - n * d / 2, edge * d
    before, behind = _around(prims, low, low + wide * inner[::-1], wide)
    low = low - before * wide
    shape = tuple(int(b) for b in inner + (before + behind)[::-1])
    present = np.zeros((np.prod(shape), len(phantom.materials)), bool)
    present[:, 0] = True
    scale = np.ones(np.prod(shape))
    for at in np.ndindex(*inner):
        b = np.ravel_multi_index(tuple(at + before[::-1]), shape)
        part = tuple(slice(edge * c, edge * (c + 1)) for c in at)
        present[b, np.unique(phantom.labels[part])] = True
        if phantom.density is not None:
            scale[b] = max(1.0, float(phantom.density[part].max()))
    first, listed = _listed(prims, shape, low, wide)
    # sets with the same greatest density share a row, which is rounded up to a sixteenth
    rounded = np.ceil(scale * 16) / 16
    sets, kind = np.unique(np.column_stack([present, rounded]), axis=0, return_inverse=True)
    total = tables.mu.sum(2)
    bound = np.maximum(total, np.roll(total, -1, 1))
    most = np.stack([np.where(row[:-1, None] > 0, bound, 0).max(0) * row[-1] for row in sets])
    return Blocks(
        kind=np.ascontiguousarray(kind.reshape(shape).astype(np.int64)),
        most=np.nextafter(most.astype(np.float32), np.float32(np.inf)) * (most > 0),
        first=first,
        listed=listed,
        frame=np.concatenate([low, wide]),
    )


def _around(
    prims: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], wide: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return how many blocks (x, y, z) solids reach out of the voxels, on the low side and on the high one."""
    if not len(prims):
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    centre, radius = prims[:, BOUND][:, :3], prims[:, BOUND][:, 3:]
    outs = (low - (centre - radius).min(0), (centre + radius).max(0) - high)
    before, behind = (np.clip(np.ceil(out / wide), 0, MOST_AROUND).astype(np.int64) for out in outs)
    return before, behind


def _listed(
    prims: NDArray[np.float64], shape: tuple[int, ...], low: NDArray[np.float64], wide: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the primitives whose bounding sphere reaches into each block."""
    centres = np.stack(np.meshgrid(*(np.arange(s) + 0.5 for s in shape), indexing="ij"), -1).reshape(-1, 3)[:, ::-1]
    centres = low + centres * wide
    bounds = prims[:, BOUND]
    gap = np.maximum(np.abs(centres[:, None] - bounds[None, :, :3]) - wide / 2, 0.0)
    near = (gap**2).sum(2) <= bounds[None, :, 3] ** 2
    first = np.concatenate([[0], np.cumsum(near.sum(1))]).astype(np.int64)
    return first, np.nonzero(near)[1].astype(np.int64)
