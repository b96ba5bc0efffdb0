"""Line integrals of equal round splats that stand in upright columns, and their transpose (numba).

Where the rotation axis and the detector's columns are parallel to z, all splats of one (x, y) have their shadows in the
same detector columns. A column's profile along v is summed first, one row of Gaussians a splat, and laid over the few
detector columns once. A splat's shadow is taken as exp(−½ du²/S_uu − ½ dv²/S_vv), of the mass that EWA gives it
(`splat_cpu`): the separable footprint of Long, Fessler and Balter (IEEE Trans. Med. Imaging 29, 2010,
doi:10.1109/TMI.2010.2050898) with Gaussians. What it leaves out is S_uv, of the order of u·v/dsd² of the others.

Splats are ordered by column, z ascending: `columns` holds xy float64 [column, 2], the starts [column + 1] of columns in
z float32 [1, splat + 8], both mm, and the most splats that a column has. Images are
float32 [channel · u, v + 32], transposed and with 16 columns of scratch on either side.
"""

import math

import numpy as np
from numba import njit, prange

from reconstruct.splat.kernels.lanes import WIDTH, add, div, exp, fma, load, mul, ramp, spread, sqrt, store, total
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
def _row(camera, place, z):
    return place[PER_Z] * (z - camera[SOURCE + 2]) - camera[ORIGIN_V]


@njit(cache=True, error_model="numpy", inline="always")
def _shadows(camera, place, z, bounds, table):
    """Write the rows, −1/(2 S_vv) and peaks of a column's splats: table [3, splat of the column]."""
    source, origin = spread(np.float32(-camera[SOURCE + 2])), spread(np.float32(-camera[ORIGIN_V]))
    per_z, peak = spread(np.float32(place[PER_Z])), spread(np.float32(place[W0]))
    across, along = spread(np.float32(place[S_VV])), spread(np.float32(place[S_VV_2]))
    ray, ray_2 = spread(np.float32(place[RAY])), spread(np.float32(place[RAY_2]))
    one, half = spread(np.float32(1)), spread(np.float32(-0.5))
    for i in range(bounds[0], bounds[1], WIDTH):
        cz = add(load(z, 0, i), source)
        at = mul(per_z, cz)
        over = div(one, fma(mul(at, at), along, across))
        store(table, 0, i - bounds[0], add(at, origin))
        store(table, 1, i - bounds[0], mul(half, over))
        store(table, 2, i - bounds[0], mul(peak, sqrt(mul(fma(mul(cz, cz), ray_2, ray), over))))


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
    ends = z[0, bounds[0]], z[0, bounds[1] - 1]
    reach = _reach_v(camera, place, ends[0], ends[1])
    a, b = _row(camera, place, ends[0]), _row(camera, place, ends[1])
    low = min(max(min(a, b) - reach, -1e9), 1e9)
    high = min(max(max(a, b) + reach, -1e9), 1e9)
    first, last = max(0, int(math.ceil(low))), min(n_v, int(math.floor(high)) + 1)
    if left >= right or first >= last:
        return 0, 0, 0, 0, 0.0
    return left, right, first, last, reach


@njit(cache=True, error_model="numpy")
def _forward_view(columns, values, scale, camera, image):
    xy, starts, z, tallest = columns
    n_u, n_v = image.shape[0] // 2, image.shape[1] - 2 * PAD
    place, profile = np.empty(PLACE), np.empty((2, image.shape[1]), np.float32)
    table, gains = np.empty((3, tallest + WIDTH), np.float32), np.empty(n_u, np.float32)
    for column in range(xy.shape[0]):
        bounds = (starts[column], starts[column + 1])
        left, right, low, high, reach = _window(xy[column], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        for v in range(profile.shape[1]):
            profile[0, v] = profile[1, v] = 0
        _shadows(camera, place, z, bounds, table)
        for i in range(bounds[0], bounds[1]):
            k = i - bounds[0]
            row, falling, peak = table[0, k], table[1, k], table[2, k]
            if not -reach <= row <= n_v - 1 + reach:
                continue
            first, last = int(math.ceil(row - reach)), int(math.floor(row + reach))
            a, b = spread(values[i, 0] * peak), spread(values[i, 1] * peak)
            for start in range(first, last + 1, WIDTH):
                t = ramp(np.float32(start) - row)
                g = exp(mul(mul(t, t), spread(falling)))
                at = start + PAD
                store(profile, 0, at, fma(g, a, load(profile, 0, at)))
                store(profile, 1, at, fma(g, b, load(profile, 1, at)))
        for u in range(left, right):
            gains[u] = _gain(place, u)
        for v in range(low + PAD, high + PAD, WIDTH):
            a, b = load(profile, 0, v), load(profile, 1, v)
            for u in range(left, right):
                g = spread(gains[u])
                store(image, u, v, fma(g, a, load(image, u, v)))
                store(image, n_u + u, v, fma(g, b, load(image, n_u + u, v)))


@njit(cache=True, error_model="numpy", parallel=True)
def forward(columns, values, scale, cameras, images):
    """Project values [splat, 2] onto views, one a thread: images [view, 2 · u, v + 32] must be zero."""
    for view in prange(cameras.shape[0]):
        _forward_view(columns, values, scale, cameras[view], images[view])


@njit(cache=True, error_model="numpy")
def _backward_columns(chosen, columns, scale, camera, image, sums):
    xy, starts, z, tallest = columns
    n_u, n_v = image.shape[0] // 2, image.shape[1] - 2 * PAD
    place, profile = np.empty(PLACE), np.zeros((2, image.shape[1]), np.float32)
    table = np.empty((3, tallest + WIDTH), np.float32)
    gains, zero = np.empty(n_u, np.float32), spread(np.float32(0))
    for column in range(chosen[0], chosen[1]):
        bounds = (starts[column], starts[column + 1])
        left, right, low, high, reach = _window(xy[column], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        for v in range(profile.shape[1]):
            profile[0, v] = profile[1, v] = 0
        for u in range(left, right):
            gains[u] = _gain(place, u)
        for v in range(low + PAD, high + PAD, WIDTH):
            a, b = zero, zero
            for u in range(left, right):
                g = spread(gains[u])
                a = fma(g, load(image, u, v), a)
                b = fma(g, load(image, n_u + u, v), b)
            store(profile, 0, v, a)
            store(profile, 1, v, b)
        _shadows(camera, place, z, bounds, table)
        for i in range(bounds[0], bounds[1]):
            k = i - bounds[0]
            row, falling, peak = table[0, k], table[1, k], table[2, k]
            if not -reach <= row <= n_v - 1 + reach:
                continue
            first, last = int(math.ceil(row - reach)), int(math.floor(row + reach))
            a, b = zero, zero
            for start in range(first, last + 1, WIDTH):
                t = ramp(np.float32(start) - row)
                g = exp(mul(mul(t, t), spread(falling)))
                at = start + PAD
                a = fma(g, load(profile, 0, at), a)
                b = fma(g, load(profile, 1, at), b)
            sums[i, 0] += peak * total(a)
            sums[i, 1] += peak * total(b)


@njit(cache=True, error_model="numpy", parallel=True)
def backward(columns, scale, cameras, images, sums):
    """Apply the transpose: sums [splat, 2] += Σ w·images over all pixels of images [view, 2 · u, v + 32]."""
    n = columns[0].shape[0]
    for task in prange((n + COLUMNS - 1) // COLUMNS):
        chosen = (task * COLUMNS, min((task + 1) * COLUMNS, n))
        for view in range(cameras.shape[0]):
            _backward_columns(chosen, columns, scale, cameras[view], images[view], sums)
