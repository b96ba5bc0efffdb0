"""Line integrals of equal round splats that stand in upright columns, and their transpose (numba).

Where the rotation axis and the detector's columns are parallel to z, all splats of one (x, y) have their shadows in the
same detector columns. A column's profile along v is summed first, one row of Gaussians a splat, and laid over the few
detector columns once. A splat's shadow is taken as exp(−½ du²/S_uu − ½ dv²/S_vv), of the mass that EWA gives it
(`splat_cpu`): the separable footprint of Long, Fessler and Balter (IEEE Trans. Med. Imaging 29, 2010,
doi:10.1109/TMI.2010.2050898) with Gaussians. What it leaves out is S_uv, of the order of u·v/dsd² of the others.

Splats are ordered by column, z ascending: `xy` [column, 2], `starts` [column + 1] into `z` [splat], mm. Images are
float32 [channel · u, v + 32], transposed and with 16 columns of scratch on either side.
"""

import math

import numpy as np
from numba import njit, prange

from reconstruct.splat.kernels.lanes import WIDTH, exp, fma, load, mul, ramp, spread, store, total
from reconstruct.splat.kernels.splat_cpu import (
    BOX,
    CUTOFF,
    DEPTH,
    DUAL_U,
    DUAL_V,
    LARGEST,
    ORIGIN_U,
    ORIGIN_V,
    PEAK,
    SOURCE,
)

PAD = 16
WIDEST = PAD / 2 - 1.0  # reach in rows up to which a shadow fits the scratch columns; the caller sees to it
COLUMNS = 256  # in a task of the transpose
# what a column has in common: u, S_uu, v per mm of z, S_vv's two parts, |ray|²'s two, and the peak over √S_vv
U0, S_UU, PER_Z, S_VV, S_VV_2, RAY, RAY_2, W0 = range(8)
PLACE = 8


@njit(cache=True, error_model="numpy")
def _place(camera, x, y, scale, place):
    """Write what a column's splats share; return whether it lies before the source."""
    cx, cy = x - camera[SOURCE], y - camera[SOURCE + 1]
    tau = cx * camera[DEPTH] + cy * camera[DEPTH + 1]
    if not tau > 1e-6:
        return False
    over, variance = 1 / tau, scale * scale
    at = (cx * camera[DUAL_U] + cy * camera[DUAL_U + 1]) * over
    jx, jy = (camera[DUAL_U] - at * camera[DEPTH]) * over, (camera[DUAL_U + 1] - at * camera[DEPTH + 1]) * over
    place[U0] = at - camera[ORIGIN_U]
    place[S_UU] = variance * (jx * jx + jy * jy) + camera[BOX]
    place[PER_Z] = camera[DUAL_V + 2] * over
    place[S_VV] = variance * place[PER_Z] * place[PER_Z] + camera[BOX]
    place[S_VV_2] = variance * (camera[DEPTH] * camera[DEPTH] + camera[DEPTH + 1] * camera[DEPTH + 1]) * over * over
    place[RAY], place[RAY_2] = (cx * cx + cy * cy) * over * over, over * over
    place[W0] = camera[PEAK] * scale * variance * over * over / math.sqrt(place[S_UU])
    return place[W0] < LARGEST


@njit(cache=True, error_model="numpy", inline="always")
def _reach_v(camera, place, z_first, z_last):
    """Return the cutoff in rows of the column's widest shadow."""
    at = max(abs(place[PER_Z] * (z_first - camera[SOURCE + 2])), abs(place[PER_Z] * (z_last - camera[SOURCE + 2])))
    return min(camera[CUTOFF] * math.sqrt(place[S_VV] + place[S_VV_2] * at * at), WIDEST)


@njit(cache=True, error_model="numpy", inline="always")
def _shadow(camera, place, z):
    """Return a splat's row, −1/(2 S_vv) and peak."""
    cz = z - camera[SOURCE + 2]
    at = place[PER_Z] * cz
    over = 1 / (place[S_VV] + place[S_VV_2] * at * at)
    return at - camera[ORIGIN_V], -0.5 * over, place[W0] * math.sqrt((place[RAY] + place[RAY_2] * cz * cz) * over)


@njit(cache=True, error_model="numpy", inline="always")
def _columns(camera, place, n_u):
    reach = camera[CUTOFF] * math.sqrt(place[S_UU])
    centre = min(max(place[U0], -1e9), 1e9)
    return max(0, int(math.ceil(centre - reach))), min(n_u, int(math.floor(centre + reach)) + 1)


@njit(cache=True, error_model="numpy", inline="always")
def _gain(place, u):
    du = u - place[U0]
    return np.float32(math.exp(-0.5 * du * du / place[S_UU]))


@njit(cache=True, error_model="numpy")
def _window(at, scale, camera, z, bounds, size, place):
    """Place a column; return the half-open ranges of u and v within the detector that it reaches, and its reach in v.

    All are 0 where it throws no shadow on the detector of `size` (v, u).
    """
    n_v, n_u = size
    if not _place(camera, at[0], at[1], scale, place):
        return 0, 0, 0, 0, 0.0
    left, right = _columns(camera, place, n_u)
    reach = _reach_v(camera, place, z[bounds[0]], z[bounds[1] - 1])
    a, _, _ = _shadow(camera, place, z[bounds[0]])
    b, _, _ = _shadow(camera, place, z[bounds[1] - 1])
    low = min(max(min(a, b) - reach, -1e9), 1e9)
    high = min(max(max(a, b) + reach, -1e9), 1e9)
    first, last = max(0, int(math.ceil(low))), min(n_v, int(math.floor(high)) + 1)
    if left >= right or first >= last:
        return 0, 0, 0, 0, 0.0
    return left, right, first, last, reach


@njit(cache=True, error_model="numpy")
def _forward_view(xy, starts, z, values, scale, camera, image):
    n_u, n_v = image.shape[0] // 2, image.shape[1] - 2 * PAD
    place, profile = np.empty(PLACE), np.empty((2, image.shape[1]), np.float32)
    for column in range(xy.shape[0]):
        bounds = (starts[column], starts[column + 1])
        left, right, low, high, reach = _window(xy[column], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        for v in range(profile.shape[1]):
            profile[0, v] = profile[1, v] = 0
        for i in range(bounds[0], bounds[1]):
            row, falling, peak = _shadow(camera, place, z[i])
            if not -reach <= row <= n_v - 1 + reach:
                continue
            first, last = int(math.ceil(row - reach)), int(math.floor(row + reach))
            a, b = spread(np.float32(values[i, 0] * peak)), spread(np.float32(values[i, 1] * peak))
            for start in range(first, last + 1, WIDTH):
                t = ramp(np.float32(start - row))
                g = exp(mul(mul(t, t), spread(np.float32(falling))))
                at = start + PAD
                store(profile, 0, at, fma(g, a, load(profile, 0, at)))
                store(profile, 1, at, fma(g, b, load(profile, 1, at)))
        for u in range(left, right):
            g = spread(_gain(place, u))
            for v in range(low + PAD, high + PAD, WIDTH):
                store(image, u, v, fma(g, load(profile, 0, v), load(image, u, v)))
                store(image, n_u + u, v, fma(g, load(profile, 1, v), load(image, n_u + u, v)))


@njit(cache=True, error_model="numpy", parallel=True)
def forward(xy, starts, z, values, scale, cameras, images):
    """Project values [splat, 2] onto views, one a thread: images [view, 2 · u, v + 32] must be zero."""
    for view in prange(cameras.shape[0]):
        _forward_view(xy, starts, z, values, scale, cameras[view], images[view])


@njit(cache=True, error_model="numpy")
def _backward_columns(columns, xy, starts, z, scale, camera, image, sums):
    n_u, n_v = image.shape[0] // 4, image.shape[1] - 2 * PAD
    place, profile = np.empty(PLACE), np.zeros((4, image.shape[1]), np.float32)
    gains, zero = np.empty(n_u, np.float32), spread(np.float32(0))
    for column in range(columns[0], columns[1]):
        bounds = (starts[column], starts[column + 1])
        left, right, low, high, reach = _window(xy[column], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        for v in range(profile.shape[1]):
            profile[0, v] = profile[1, v] = profile[2, v] = profile[3, v] = 0
        for u in range(left, right):
            gains[u] = _gain(place, u)
        for v in range(low + PAD, high + PAD, WIDTH):
            s0, s1, s2, s3 = zero, zero, zero, zero
            for u in range(left, right):
                g = spread(gains[u])
                s0 = fma(g, load(image, u, v), s0)
                s1 = fma(g, load(image, n_u + u, v), s1)
                s2 = fma(g, load(image, 2 * n_u + u, v), s2)
                s3 = fma(g, load(image, 3 * n_u + u, v), s3)
            store(profile, 0, v, s0)
            store(profile, 1, v, s1)
            store(profile, 2, v, s2)
            store(profile, 3, v, s3)
        for i in range(bounds[0], bounds[1]):
            row, falling, peak = _shadow(camera, place, z[i])
            if not -reach <= row <= n_v - 1 + reach:
                continue
            first, last = int(math.ceil(row - reach)), int(math.floor(row + reach))
            s0, s1, s2, s3 = zero, zero, zero, zero
            for start in range(first, last + 1, WIDTH):
                t = ramp(np.float32(start - row))
                g = exp(mul(mul(t, t), spread(np.float32(falling))))
                at = start + PAD
                s0 = fma(g, load(profile, 0, at), s0)
                s1 = fma(g, load(profile, 1, at), s1)
                s2 = fma(g, load(profile, 2, at), s2)
                s3 = fma(g, load(profile, 3, at), s3)
            w = np.float32(peak)
            sums[i, 0] += w * total(s0)
            sums[i, 1] += w * total(s1)
            sums[i, 2] += w * total(s2)
            sums[i, 3] += w * total(s3)


@njit(cache=True, error_model="numpy", parallel=True)
def backward(xy, starts, z, scale, cameras, images, sums):
    """Apply the transpose: sums [splat, 4] += Σ w·images over all pixels of images [view, 4 · u, v + 32]."""
    n = xy.shape[0]
    for task in prange((n + COLUMNS - 1) // COLUMNS):
        columns = (task * COLUMNS, min((task + 1) * COLUMNS, n))
        for view in range(cameras.shape[0]):
            _backward_columns(columns, xy, starts, z, scale, cameras[view], images[view], sums)
