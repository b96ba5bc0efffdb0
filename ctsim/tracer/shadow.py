"""Where a shadow falls on the detector: in every row, the columns that a part of the object can darken."""

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import crosswise
from ctsim.solids import BOUND, BOX, CAPSULE, ELLIPSOID, FRUSTUM, KIND, MATERIAL, MATRIX, PARAMS, TORUS
from ctsim.tracer.kernels.shadow_cpu import cast_hulls

THIN = 1.5  # primitives thinner than this many pixels can hide between the corners of a pixel
MOST_TIMES = 16  # and get at most this many times the usual sub-rays
_SIGNS = np.array([[2 * ((k >> axis) & 1) - 1 for axis in range(3)] for k in range(8)])


def box_corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of an axis-parallel box in mm: [1, 8, 3]."""
    return np.where(_SIGNS > 0, high, low)[None]


def primitive_corners(prims: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of a box around each primitive, along its own axes, in mm: [primitive, 8, 3]."""
    kind, (a, b, c) = prims[:, KIND].astype(int), prims[:, PARAMS].T[:3]
    half = np.stack([a, b, c], 1)  # ellipsoid, box
    across, along = np.zeros(len(prims)), np.zeros(len(prims))
    for of, width, length in ((FRUSTUM, np.maximum(b, c), a), (CAPSULE, b, a + b), (TORUS, a + b, b)):
        across, along = np.where(kind == of, width, across), np.where(kind == of, length, along)
    upright = np.isin(kind, (FRUSTUM, CAPSULE, TORUS))
    half[upright] = np.stack([across, across, along], 1)[upright]
    rotation = prims[:, MATRIX].reshape(-1, 3, 3)
    return prims[:, None, BOUND][..., :3] + (_SIGNS * half[:, None]) @ rotation


def cast(poses: NDArray[np.float64], shape: tuple[int, int], corners: NDArray[np.float64]) -> NDArray[np.int64]:
    """Columns (from, to) of each row in which the hulls of `corners` [part, 8, 3] are seen: [view, v, part, 2].

    Both ends are meant and from > to where nothing is seen. A part that reaches behind the source is seen everywhere.
    On every side there is a margin of half a pixel's diagonal (see `inflate`), at least a pixel.
    """
    source, centre, e_u, e_v = _parts(poses)
    p_u, p_v = crosswise(e_u, e_v)
    diagonal = _diagonal(e_u, e_v) / 2
    margins = [np.maximum(np.ceil(diagonal / np.linalg.norm(p, axis=1)), 1) for p in (p_v, p_u)]
    normal = np.cross(e_u, e_v)[:, :, None]
    towards = corners - source[:, None, None]
    reach = (towards @ normal[:, None])[..., 0] / ((centre - source)[:, None] @ normal)
    behind: NDArray[np.bool_] = np.any(reach <= 1e-9, axis=2)
    hit = (source - centre)[:, None, None] + towards / np.where(behind[..., None], 1.0, reach)[..., None]
    u, v = (
        (hit @ (p / (p * p).sum(1, keepdims=True))[:, None, :, None])[..., 0] + (n - 1) / 2
        for p, n in ((p_u, shape[1]), (p_v, shape[0]))
    )
    out = np.empty((len(poses), shape[0], len(corners), 2), np.int64)
    for k in range(len(poses)):
        cast_hulls(u[k], v[k], behind[k], float(margins[0][k]), int(margins[1][k]), shape[1], out[k])
    return out


def _parts(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return source, detector centre, u step and v step, [view, xyz] each."""
    return tuple(poses.reshape(-1, 4, 3).transpose(1, 0, 2))


def _diagonal(e_u: NDArray[np.float64], e_v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length of a pixel's longer diagonal in mm, [view]."""
    return np.sqrt((e_u**2).sum(1) + (e_v**2).sum(1) + 2 * np.abs((e_u * e_v).sum(1)))


def everywhere(shape: tuple[int, int], n_parts: int) -> NDArray[np.int64]:
    """Return what `cast` does for parts that are seen in every pixel."""
    return np.tile(np.array([-1, shape[1]]), (shape[0], n_parts, 1))


def row_spans(shadows: NDArray[np.int64], n_u: int) -> NDArray[np.int64]:
    """Columns (from, to), the latter left out, that hold all parts of [..., v, part, 2] in each row: [..., v, 2]."""
    low, high = shadows[..., 0].min(-1, initial=n_u), shadows[..., 1].max(-1, initial=-1)
    out = np.stack([np.maximum(low, 0), np.minimum(high + 1, n_u)], -1)
    out[out[..., 0] >= out[..., 1]] = 0
    return out


def join(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the columns (from, to) of each row that hold those of both `row_spans` [v, 2]."""
    both = np.stack([np.minimum(one[:, 0], other[:, 0]), np.maximum(one[:, 1], other[:, 1])], 1)
    empty = [(spans[:, 0] >= spans[:, 1])[:, None] for spans in (one, other)]
    return np.where(empty[0], other, np.where(empty[1], one, both))


def inflate(prims: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grow the primitives that can hide within a pixel by its half diagonal, [view, primitive, …].

    The others are marked with kind −1. The material's place holds how many times the usual sub-rays such a primitive
    needs.
    """
    source, centre, e_u, e_v = _parts(poses)
    pixel = _diagonal(e_u, e_v) / np.linalg.norm(centre - source, axis=1)
    pixel = pixel[:, None] * np.linalg.norm(prims[:, BOUND][:, :3] - source[:, None], axis=2)
    kind, sizes = prims[:, KIND].astype(int), prims[:, PARAMS]
    thinnest = np.where(np.isin(kind, (ELLIPSOID, BOX)), sizes[:, :3].min(1), sizes[:, 1])
    radius = np.maximum(sizes[:, 1], sizes[:, 2])
    thinnest = np.where(kind == FRUSTUM, np.minimum(sizes[:, 0], radius), thinnest)
    fat = np.repeat(prims[None], len(poses), 0)
    fat[..., PARAMS] += _GROWING[kind] * pixel[..., None] / 2
    fat[..., BOUND.stop - 1] += 2 * pixel
    # spacing of n lattice points is 1/√n of a pixel
    times = np.ceil(THIN * pixel / np.maximum(2 * thinnest, 1e-3 * pixel))
    fat[..., MATERIAL] = np.minimum(times, MOST_TIMES)
    fat[..., KIND] = np.where(2 * thinnest >= THIN * pixel, -1, prims[:, KIND])
    return fat


# which of a primitive's four parameters are half thicknesses, by kind
_GROWING = np.zeros((5, 4))
_GROWING[[ELLIPSOID, FRUSTUM, BOX], :3] = 1
_GROWING[[CAPSULE, TORUS], 1] = 1
