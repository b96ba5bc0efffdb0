"""A scan at one resolution: binned data on a coarser grid, fewer views of it, and back."""

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.geometry import Geometry, few_views
from ctsim.reconstruct.splat.kernels import carve_cpu
from ctsim.reconstruct.starved import WEIGHT
from ctsim.reconstruct.weights import as_read, bends, doubt_edges, even_out, photon_weights

OPEN, LEAST_OPEN = 5.0, 0.01  # standard deviations of an open pixel, or p, below which a ray met nothing
COARSE_ERROR, MOST_EVEN = 0.005, 160.0
"""The error of P on a coarse grid besides noise, 0.004 to 0.016 on the scenes of `headline`, and the greatest variance
of it, in those of an open ray, that weights are evened out by: no greater one was tried."""
VIEWS = 12  # whose pixels stand for all
DARKER = 0.9  # share of the rays that are brighter than the dark one
SHARE = 0.5  # of the usual weight, that the dark ray is to have
MOST_SCATTER = 2 / 3, 1.0
"""Scatter over the primary of the dark ray up to which its weight is raised in full, and from which it is not."""
MOST_STARVED = 0.05, 0.1
"""The same of the share of the rays that are starved: from the second on a ray darker than nine tenths is starved."""
SMOOTH = 0.5  # second difference of p from pixel to pixel that wire and the outlines of metal exceed
LOUD = 3.0  # standard deviations of a second difference, which noise alone does not exceed
LEFT_OUT = 2  # any state but those that carving gives
AROUND = 3  # pixels whose majority counts: noise alone makes a reading of some pixel without photons in some view


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Line integrals `p` and their weights, float32 [view, v, u]; `scatter`, S/I0, is in p still.

    Where a weight is negative, p is the least that a dark reading allows, without scatter (see `starved`). `error` is
    that of weights which were evened out (`even_out`).
    """

    geometry: Geometry
    p: NDArray[np.float32]
    weights: NDArray[np.float32]
    scatter: float = 0.0
    error: float = 0.0

    @property
    def open(self) -> float:
        """What p is where a ray met nothing."""
        return -math.log1p(self.scatter)


def weighted(geometry: Geometry, p: NDArray[np.float32], valid: NDArray[np.bool_], scatter: float = 0.0) -> Data:
    """Weight line integrals [view, v, u] by the photons that came through, exp(−p), and 0 where not `valid`."""
    return Data(geometry=geometry, p=p, weights=photon_weights(p, valid), scatter=scatter)


def coarser(data: Data) -> Data:
    """Return every second view, with pixels and voxels of twice the size; intensities are averaged, not their logs.

    An odd last row or column of pixels is left out; an odd number of voxels is rounded up.
    """
    fine = data.geometry
    views = np.arange(0, fine.n_views, 2)
    n_v, n_u = (max(n // 2, 1) for n in fine.n_detector)
    step = [1 if n == 1 else 2 for n in fine.n_detector]
    poses = fine.pose_array()[views]
    poses[:, 3:6] -= 0.5 * (fine.n_detector[0] - n_v * step[0]) * poses[:, 9:12]
    poses[:, 3:6] -= 0.5 * (fine.n_detector[1] - n_u * step[1]) * poses[:, 6:9]
    poses[:, 6:9] *= step[1]
    poses[:, 9:12] *= step[0]
    n_voxel = tuple((n + 1) // 2 for n in fine.n_voxel)
    odd = [0.5 * (2 * m - n) * d for m, n, d in zip(n_voxel, fine.n_voxel, fine.d_voxel, strict=True)]
    geometry = msgspec.structs.replace(
        fine,
        n_voxel=n_voxel,
        d_voxel=tuple(2 * d for d in fine.d_voxel),
        off_origin=tuple(o + s for o, s in zip(fine.off_origin, odd, strict=True)),
        n_detector=(n_v, n_u),
        d_detector=(fine.d_detector[0] * step[0], fine.d_detector[1] * step[1]),
        n_views=views.size,
        angles_deg=None,
        poses=tuple(tuple(row) for row in poses.tolist()),
    )
    p = np.empty(geometry.shape, np.float32)
    seen, bounds = (np.empty(geometry.shape, np.bool_) for _ in range(2))
    shape = (n_v, step[0], n_u, step[1])
    for k, view in enumerate(views):
        of_four, weights = (a[view, : n_v * step[0], : n_u * step[1]].reshape(shape) for a in (data.p, data.weights))
        valid, dark = weights > 0, weights < 0
        n = (valid | dark).sum((1, 3))
        signal = np.exp(-of_four) + data.scatter * dark
        mean = np.where(valid | dark, signal, 0).sum((1, 3)) / np.maximum(n, 1)
        seen[k] = n > 0
        bounds[k] = dark.any((1, 3)) & ~valid.any((1, 3))
        p[k] = -np.log(np.where(seen[k], mean - data.scatter * bounds[k], 1))
    coarse = weighted(geometry, p, seen, data.scatter)
    coarse.weights[bounds] = -WEIGHT
    return coarse


def doubted(levels: list[Data], i0: float, edges: float) -> list[Data]:
    """Return the levels, coarsest first, with what grids cannot hold taken into the weights of all but the finest.

    Even behind bright rays a coarse grid misses P by about `COARSE_ERROR`, and its pixels, which are larger, have more
    photons than the `i0` of the finest grid's: by photons alone dark rays would hardly count. `edges` is that of
    `doubt_edges`.
    """
    finest, changed = levels[-1], []
    for level in levels[:-1]:
        pixels = math.prod(level.geometry.d_detector) / math.prod(finest.geometry.d_detector)
        weights = level.weights.copy()
        even_out(weights, min(COARSE_ERROR**2 * i0 * pixels, MOST_EVEN))
        changed.append(edges_doubted(replace(level, weights=weights), edges))
    return [*changed, finest]


def edges_doubted(data: Data, edges: float) -> Data:
    """Return the data with `doubt_edges` in the weights."""
    weights = data.weights.copy()
    doubt_edges(data.p, weights, edges, data.scatter)
    return replace(data, weights=weights)


def by_photons(data: Data) -> Data:
    """Return the data with the weights of trial fits: by photons alone, not evened out nor lowered at edges."""
    weights = photon_weights(data.p, data.weights > 0)
    weights[data.weights < 0] = -WEIGHT
    return replace(data, weights=weights, error=0.0)


def thinned(data: Data) -> Data:
    """Return every second view where that leaves enough for the grid, else all.

    Enough is π/2 of the voxels across, what parallel views over half a turn need (Kak and Slaney, Computerized
    Tomographic Imaging, 1988, chapter 5). With fewer, streaks between views may change the misfit by more than a wrong
    beam does.
    """
    geometry = data.geometry
    views = np.arange(0, geometry.n_views, 2)
    if views.size < math.pi / 2 * max(geometry.n_voxel[1:]):
        return data
    poses = tuple(tuple(row) for row in geometry.pose_array()[views].tolist())
    geometry = msgspec.structs.replace(geometry, n_views=views.size, angles_deg=None, poses=poses)
    return replace(data, geometry=geometry, p=data.p[views], weights=data.weights[views])


def refined(values: NDArray[np.float32], fine: Geometry) -> NDArray[np.float32]:
    """Interpolate a volume on `coarser`'s grid onto the fine grid that it was made of: [z, y, x]."""
    for axis, n in enumerate(fine.n_voxel):
        last = values.shape[axis] - 1
        at = np.clip((np.arange(n) - 0.5) / 2, 0, last)
        low = at.astype(np.int64)
        share = (at - low).astype(np.float32).reshape([-1 if k == axis else 1 for k in range(3)])
        below, above = values.take(low, axis), values.take(np.minimum(low + 1, last), axis)
        values = np.asarray(below + share * (above - below), np.float32)
    return values


def carve(data: Data, open_below: float, but: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Return the voxels [z, y, x] that some view sees and none shows to be empty, those of `but` left out.

    A voxel is empty where a view has its shadow and p of the pixels around that lies less than `open_below` above that
    of a ray that met nothing. Pixels without weight say nothing. What is left out costs nothing.
    """
    near = np.empty(data.p.shape, np.bool_)
    for shadow, p, weights in zip(near, data.p, data.weights, strict=True):  # a view at a time: p is large
        met = (p - np.float32(data.open) > open_below) | (weights <= 0)
        wide = met.copy()
        wide[1:] |= met[:-1]
        wide[:-1] |= met[1:]
        shadow[...] = wide
        shadow[:, 1:] |= wide[:, :-1]
        shadow[:, :-1] |= wide[:, 1:]
    z, y, x = data.geometry.voxel_centres()
    state = np.zeros(data.geometry.n_voxel, np.int8)
    if but is not None:
        state[but] = LEFT_OUT
    carve_cpu.carve(data.geometry.pose_array(), near, z, y, x, state)
    return state == 1


def never_read(data: Data, geometry: Geometry) -> NDArray[np.bool_]:
    """Return the voxels of a grid, [z, y, x], through which no view has readings: only bounds, or nothing.

    How much they attenuate is then known from below alone.
    """
    dark = np.empty(data.p.shape, np.bool_)
    for shadow, weights in zip(dark, data.weights, strict=True):  # a view at a time: weights are large
        shadow[...] = ndimage.uniform_filter((weights > 0).astype(np.float32), AROUND, mode="nearest") < 0.5
    z, y, x = geometry.voxel_centres()
    state = np.zeros(geometry.n_voxel, np.int8)
    carve_cpu.carve(data.geometry.pose_array(), dark, z, y, x, state)
    return state == 1


def least_met(data: Data) -> float:
    """Return how far p of a ray that met something lies above that of open ones."""
    return max(OPEN / math.sqrt(_open_photons(data)), LEAST_OPEN)


def _open_photons(data: Data) -> float:
    """Estimate the photons of an open pixel from how far p falls below that of open rays, as only noise does: 1/var."""
    p = some_readings(data) - data.open
    below = p[p < 0].astype(np.float64)
    return float(1 / max(np.mean(below**2), 1e-12)) if below.size else 1e12


def some_readings(data: Data) -> NDArray[np.float32]:
    """Return the line integrals of a few views' pixels that count."""
    views = few_views(data.geometry.n_views, VIEWS)
    return data.p[views][data.weights[views] > 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rays:
    """What rays that met something read: exp(p), 1 or more, of a usual and a dark one, and the share that is starved.

    The usual one is the median, and nine tenths are brighter than the dark one.
    """

    usual: float
    dark: float
    starved: float


def evening_error(data: Data, most: float) -> float:
    """Return the error to even out weights by (`even_out`), in variances of an open ray.

    It is the least by whose weights a dark ray counts half as much as a usual one, and no more than `most`. A step's
    length is that of usual rays: what rays of a far smaller weight tell alone is not found in the passes of a fit, and
    smoothed away. Where a dark ray reads as much scatter as primary, what it tells is as doubtful as scatter is, and
    the error is 0; in between (`MOST_SCATTER`, `MOST_STARVED`) it falls evenly.
    """
    rays = rays_met(data)
    error = min(max(rays.dark - rays.usual / SHARE, 0.0) / (1 / SHARE - 1), most)
    scattered = rays.dark * data.scatter
    told = _falling(scattered / (1 - scattered), *MOST_SCATTER) if scattered < 1 else 0.0
    return error * min(told, _falling(rays.starved, *MOST_STARVED))


def _falling(x: float, full: float, none: float) -> float:
    """Return 1 up to `full`, 0 from `none` on, and a straight line in between."""
    return min(max((none - x) / (none - full), 0.0), 1.0)


def rays_met(data: Data) -> Rays:
    """Look at the rays of a few views that met something.

    `usual` and `dark` are of readings where p bends by less than `SMOOTH`, or than noise makes it bend: edges have
    weights of their own (`doubt_edges`), and wire all over an object makes no thick body. Both are 1 where there are
    none. p is that of mean scatter, while weights are by what was read: they may differ by some per cent.
    """
    views = few_views(data.geometry.n_views, VIEWS)
    least, photons = least_met(data) + data.open, _open_photons(data)
    seen, starved, met = [np.empty(0, np.float32)], 0, 0
    for p, weights in zip(data.p[views], data.weights[views], strict=True):
        bounds, hit = weights < 0, (weights != 0) & (p > least)
        read = as_read(p, weights, data.scatter)
        noise = LOUD * np.sqrt(6 * np.exp(np.minimum(read, 80.0)) / photons)  # 1 + 4 + 1 variances of a reading
        smooth = ndimage.maximum_filter(bends(read, weights != 0), 3) < np.maximum(noise, SMOOTH)
        seen.append(read[hit & smooth & ~bounds])
        starved, met = starved + int(np.sum(hit & bounds)), met + int(np.sum(hit))
    every = np.concatenate(seen)
    usual, dark = np.exp(np.quantile(every, (0.5, DARKER)).astype(np.float64)) if every.size else (1.0, 1.0)
    return Rays(usual=max(float(usual), 1.0), dark=max(float(dark), 1.0), starved=starved / max(met, 1))
