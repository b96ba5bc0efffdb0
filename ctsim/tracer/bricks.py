"""The label volume as bricks: uniform ones are crossed in one step, mixed ones voxel by voxel.

A ray spends its time in memory, not in arithmetic. The table of 4³-voxel bricks of a 256³ volume is
0.5 MB and stays in cache; it says, for a brick of one label, how far the same label reaches in every
direction ahead of a ray, so that it leaves a large uniform region in a few steps.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.tracer.kernels.bricks_cpu import MIXED, SIDE, reach
from ctsim.types import Phantom


class Bricks(NamedTuple):
    """A label volume for the ray tracer (flat arrays only, for numba).

    `code` [octant, bz, by, bx] holds label | reach << 8, reach ≥ 1 in bricks (see `reach`);
    `slot` [bz, by, bx] is a mixed brick's place in `pool`, SIDE³ labels each (and in `density`, which is
    empty without a density map).
    `grid` holds voxel counts, voxels per mm and the grid's low corner (mm), each in x, y, z order;
    `box` is the bounding box of what is not air, (low x y z, high x y z), empty if low > high.
    """

    code: NDArray[np.uint16]
    slot: NDArray[np.int32]
    pool: NDArray[np.uint8]
    density: NDArray[np.float32]
    grid: NDArray[np.float64]
    box: NDArray[np.float64]


def make_bricks(phantom: Phantom) -> Bricks:
    """Cut a phantom's label volume (and density map) into bricks."""
    labels = _cut(phantom.labels)
    mixed = labels.min(1) != labels.max(1)
    dense = np.zeros(0, np.float32)
    if phantom.density is not None:
        pieces = _cut(phantom.density)
        # air has no density to vary; everything else must be exactly nominal to be crossed in one step
        mixed |= ((pieces != 1) & (labels != 0)).any(1)
        dense = pieces[mixed]
    shape = tuple(-(-s // SIDE) for s in phantom.labels.shape)
    kind = np.where(mixed, MIXED, labels[:, 0]).astype(np.uint16).reshape(shape)
    slot = np.where(mixed, np.cumsum(mixed) - 1, -1).astype(np.int32).reshape(shape)
    n = np.array(phantom.labels.shape[::-1], np.int64)
    d = np.array(phantom.d_voxel[::-1], np.float64)
    low = np.array(phantom.off_origin[::-1], np.float64) - n * d / 2
    return Bricks(
        code=reach(kind),
        slot=slot,
        pool=labels[mixed].ravel(),
        density=dense.ravel(),
        grid=np.concatenate([n.astype(np.float64), 1 / d, low]),
        box=_bounding_box(kind, n, d, low),
    )


def _cut(volume: NDArray) -> NDArray:
    """Return [brick, SIDE³], padded to whole bricks with what is next to them, which keeps these uniform."""
    pad = [(0, -s % SIDE) for s in volume.shape]
    padded = np.pad(volume, pad, "edge") if any(p[1] for p in pad) else volume
    z, y, x = (s // SIDE for s in padded.shape)
    cut = padded.reshape(z, SIDE, y, SIDE, x, SIDE).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(cut).reshape(z * y * x, SIDE**3)


def _bounding_box(kind: NDArray, n: NDArray, d: NDArray, low: NDArray) -> NDArray[np.float64]:
    """Box of the bricks that are not plain air."""
    box = np.concatenate([np.full(3, np.inf), np.full(3, -np.inf)])
    solid = kind != 0
    if not solid.any():
        return box
    for axis in range(3):  # x, y, z
        hit = np.flatnonzero(solid.any(axis=tuple(a for a in range(3) if a != 2 - axis)))
        box[axis] = low[axis] + hit[0] * SIDE * d[axis]
        box[3 + axis] = low[axis] + min((hit[-1] + 1) * SIDE, n[axis]) * d[axis]
    return box
