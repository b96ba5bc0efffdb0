"""Layers of a label volume that a scan's rays can cross: for one detector row a few of hundreds."""

import math
from dataclasses import replace

import numpy as np

from ctsim.geometry import Geometry, Triple
from ctsim.types import Phantom

WORTH = 4  # a phantom is cut where this many times fewer layers are left


def layers_seen(phantom: Phantom, geometry: Geometry) -> Phantom:
    """Return the phantom without the layers of its labels above and below all rays; its solids stay.

    `geometry` is that of a point source. A tilted detector, and one that sees most layers, leave the phantom as it is.
    """
    n, d, off = phantom.labels.shape, phantom.d_voxel, phantom.off_origin
    part = crossed(n, d, off, geometry)
    if part == slice(None):
        return phantom
    return replace(
        phantom,
        labels=phantom.labels[part],
        density=None if phantom.density is None else phantom.density[part],
        off_origin=(off[0] + (part.start + part.stop - n[0]) / 2 * d[0], *off[1:]),
    )


def crossed(
    n: tuple[int, ...], d_voxel: Triple, off_origin: Triple, geometry: Geometry, *, grid: bool = False
) -> slice:
    """Return the layers that rays can cross of labels of n voxels (z, y, x); all, if those are most.

    With `grid` the layers that the reconstruction grid covers are among them. `d_voxel` and `off_origin` are in mm.
    """
    heights = _heights(n, d_voxel, off_origin, geometry)
    if heights is None:
        return slice(None)
    low, high = heights
    if grid:
        middle, half = geometry.off_origin[0], geometry.s_voxel[0] / 2
        low, high = min(low, middle - half), max(high, middle + half)
    low, high = ((height - off_origin[0]) / d_voxel[0] + n[0] / 2 for height in (low, high))  # in layers
    first = min(max(int(np.floor(low)) - 1, 0), n[0] - 1)  # a layer more on either side than any ray needs
    after = min(max(int(np.ceil(high)) + 1, first + 1), n[0])
    return slice(None) if WORTH * (after - first) > n[0] else slice(first, after)


def _heights(n: tuple[int, ...], d_voxel: Triple, off_origin: Triple, geometry: Geometry) -> tuple[float, float] | None:
    """Lowest and highest z (mm) of all rays in the cylinder around the labels; None for a tilted detector."""
    source, centre, e_u, e_v = (geometry.pose_array()[:, k : k + 3] for k in (0, 3, 6, 9))
    normal = np.cross(e_u, e_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if np.abs(normal[:, 2]).max() > 1e-9:
        return None
    across = zip(n[1:], d_voxel[1:], off_origin[1:], strict=True)
    radius = math.hypot(*(k * d / 2 + abs(off) for k, d, off in across))
    # depths along the detector's normal, over the detector's own: the rays' parameter
    reach = ((centre - source) * normal).sum(1)
    axis = -(source * normal).sum(1)
    ends = np.stack([np.maximum((axis + sign * radius) / reach, 0) for sign in (-1, 1)])
    n_v, n_u = geometry.n_detector
    half = (n_v * np.abs(e_v[:, 2]) + n_u * np.abs(e_u[:, 2])) / 2
    rise = np.stack([centre[:, 2] - source[:, 2] + sign * half for sign in (-1, 1)])
    z = source[:, 2] + ends[:, None] * rise[None]
    return float(z.min()), float(z.max())
