"""Voxelising in float64 for reading: overlaps summed one by one, solids counted at sample points.

Same functions and arguments as `voxelise_cpu`, whose `bound` is left out: nothing is skipped here, and so
no distance is needed. Sample points are the centres of equal parts, n along each axis of a voxel or cell.
"""

import numpy as np
from numpy.typing import NDArray

from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, KIND, MATRIX, OFFSET, PARAMS

SAMPLES = 24
_Array = NDArray[np.float64]


def average(labels, density, table, first, weights, counts, out):
    """Average table[label]·density over each target voxel into `out`; density may have size 0.

    Along axis a target voxel i overlaps the source voxels first[a][i] + 0…counts[a][i]−1 by the shares
    weights[a][i, :] of its own size.
    """
    values = np.asarray(table, np.float64)[labels]
    if density.size:
        values = values * density
    for z, y, x in np.ndindex(*out.shape):
        at = tuple(slice(first[a][i], first[a][i] + counts[a][i]) for a, i in enumerate((z, y, x)))
        shares = [weights[a][i, : counts[a][i]] for a, i in enumerate((z, y, x))]
        out[z, y, x] = np.sum(values[at] * np.einsum("k,j,i->kji", *shares))


def share(prim: _Array, x: float, y: float, z: float, width: float) -> float:
    """Return the share of a cell of the given width, centred at (x, y, z), that the primitive fills."""
    return float(np.mean(_inside(prim, _samples((z, y, x), (width, width, width), (SAMPLES,) * 3))))


def mark(prims, start, pitch, touched):
    """Set `touched` [z, y, x] uint8 to 1 where a primitive holds a sample point of the voxel."""
    for at in np.ndindex(*touched.shape):
        points = _samples(start + np.array(at) * pitch, pitch, (SAMPLES,) * 3)
        if any(np.any(_inside(prim, points)) for prim in prims):
            touched[at] = 1


def cover(prims, channel, start, pitch, cells, shape, index, first, sought, out):
    """Fill `out` [k, channel] with the share of each listed voxel that each channel is seen in.

    `index` [k] are flat voxel numbers, of which `first` tells nothing new; `channel` [primitive] and `cells`
    (z, y, x) the sample points along a voxel. Each belongs to the last primitive that holds it. A slice is left at the
    first voxel that `sought` [channel] fill by half.
    """
    left = -1
    for k, flat in enumerate(index):
        at = np.unravel_index(flat, shape)
        if at[0] == left:
            continue
        centre = start + np.array(at) * pitch
        points = _samples(centre, pitch, cells)
        seen = np.full(points.shape[1], -1)
        for prim, number in zip(prims, channel, strict=True):
            seen[_inside(prim, points)] = number
        for number in range(out.shape[1]):
            out[k, number] = np.mean(seen == number)
        if out[k, sought].sum() >= 0.5:
            left = at[0]


def _samples(centre, size, n) -> _Array:
    """Return the sample points of a box, (x, y, z) [3, point]; centre, size and number are (z, y, x)."""
    z, y, x = (c + d * ((np.arange(m) + 0.5) / m - 0.5) for c, d, m in zip(centre, size, n, strict=True))
    return np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1]).reshape(3, -1)


def _inside(prim: _Array, points: _Array) -> NDArray[np.bool_]:
    """Tell which world points (x, y, z) [3, point] are in the primitive; its surface counts as inside."""
    x, y, z = prim[MATRIX].reshape(3, 3) @ points + prim[OFFSET][:, None]
    kind, (a, b, c, _) = int(prim[KIND]), prim[PARAMS]
    rho = np.hypot(x, y)
    if kind == ELLIPSOID:
        return (x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2 <= 1
    if kind == BOX:
        return (np.abs(x) <= a) & (np.abs(y) <= b) & (np.abs(z) <= c)
    if kind == FRUSTUM:
        return (np.abs(z) <= a) & (rho <= b + (c - b) * (z + a) / (2 * a))
    if kind == CAPSULE:
        return np.hypot(rho, z - np.clip(z, -a, a)) <= b
    return np.hypot(rho - a, z) <= b
