"""The sum of Gaussians on a voxel grid, and its transpose (numba).

With x = (z, y, x) in voxels from the centre and Σ = LLᵀ in that order, ξ = L⁻¹x gives the exponent −½|ξ|² as a sum of
squares, so nothing cancels: a slice knows ξ_z, a row ξ_y, and along the row ξ_x is linear. A voxel that is a box adds
1/12 to each of Σ's diagonal, to second order, and the peak falls so that the mass stays. Rows end where |ξ| reaches
the cutoff, or up to WIDTH − 1 voxels later.

Shapes are those of `splat_cpu`. Volumes are float32 [channel · z · y, x + WIDTH]; the last WIDTH columns are scratch,
and zero where they are read. A grid vector is (voxel size z, y, x in mm, centre of voxel 0 z, y, x in mm, cutoff,
variance of a box in voxels²).
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.lanes import WIDTH, exp, fma, load, mul, ramp, spread, store, total
from ctsim.reconstruct.splat.kernels.splat_cpu import CHUNKS, LARGEST

SLABS = 16  # at most this many slabs of slices; a task adds splats to a slab in their order
HALF = np.float32(-0.5)
# a blob: centre z, y, x in voxels, L by rows, peak
Z0, Y0, X0, L_ZZ, L_YZ, L_YY, L_XZ, L_XY, L_XX, W0 = range(10)
BLOB = 10


@njit(cache=True, error_model="numpy", inline="always")
def _covariance(shapes, i, grid, a, b):
    """Return Σ_ab in voxels², a and b of z, y, x."""
    if shapes.shape[0] == 4:
        s = np.float64(shapes[3, i])
        return s * s / (grid[a] * grid[b]) if a == b else 0.0
    value = 0.0
    for k in range(3):
        s = np.float64(shapes[3 + k, i])
        value += s * s * shapes[6 + 3 * (2 - a) + k, i] * shapes[6 + 3 * (2 - b) + k, i]
    return value / (grid[a] * grid[b])


@njit(cache=True, error_model="numpy")
def blob(shapes, i, grid, out):
    """Write splat i's centre and Cholesky factor in voxels, in float64; return whether it is finite and has extent."""
    box = grid[7]
    for k in range(3):
        out[k] = (shapes[2 - k, i] - grid[3 + k]) / grid[k]
    zz = _covariance(shapes, i, grid, 0, 0) + box
    l_zz = math.sqrt(zz)
    l_yz = _covariance(shapes, i, grid, 1, 0) / l_zz
    l_xz = _covariance(shapes, i, grid, 2, 0) / l_zz
    l_yy = math.sqrt(_covariance(shapes, i, grid, 1, 1) + box - l_yz * l_yz)
    l_xy = (_covariance(shapes, i, grid, 2, 1) - l_xz * l_yz) / l_yy
    l_xx = math.sqrt(_covariance(shapes, i, grid, 2, 2) + box - l_xz * l_xz - l_xy * l_xy)
    out[L_ZZ], out[L_YZ], out[L_YY] = l_zz, l_yz, l_yy
    out[L_XZ], out[L_XY], out[L_XX] = l_xz, l_xy, l_xx
    out[W0] = 1.0
    if box > 0:
        s0 = np.float64(shapes[3, i])
        s1, s2 = s0, s0
        if shapes.shape[0] != 4:
            s1, s2 = np.float64(shapes[4, i]), np.float64(shapes[5, i])
        out[W0] = abs(s0 * s1 * s2) / (grid[0] * grid[1] * grid[2] * l_zz * l_yy * l_xx)
    extent = l_zz * l_yy * l_xx
    return 0 < extent < LARGEST and 0 < out[W0] <= 1.001 and abs(out[0]) + abs(out[1]) + abs(out[2]) < LARGEST


@njit(cache=True, error_model="numpy", inline="always")
def _range(centre, half, low, high):
    """Return the half-open range of the voxels low … high − 1 within half of centre."""
    first, last = min(max(centre - half, -1e9), 1e9), min(max(centre + half, -1e9), 1e9)
    return max(low, int(math.ceil(first))), min(high, int(math.floor(last)) + 1)


@njit(cache=True, error_model="numpy", inline="always")
def _row(b, xi_z, y, left, n_x):
    """Return ξ_y² + ξ_z², and the half-open range of x within the cutoff, whose square is `left` + ξ_z²."""
    xi_y = (y - b[Y0] - b[L_YZ] * xi_z) / b[L_YY]
    centre = b[X0] + b[L_XZ] * xi_z + b[L_XY] * xi_y
    first, last = _range(centre, b[L_XX] * math.sqrt(max(0.0, left - xi_y * xi_y)), 0, n_x)
    return xi_z * xi_z + xi_y * xi_y, centre, first, last


@njit(cache=True, error_model="numpy", inline="always")
def _value(b, square, centre, x):
    """Return exp(−½|ξ|²) in `WIDTH` voxels of a row."""
    xi = mul(ramp(np.float32(x - centre)), spread(np.float32(1 / b[L_XX])))
    along = mul(xi, spread(HALF))
    return exp(fma(along, xi, spread(np.float32(-0.5 * square))))


@njit(cache=True, error_model="numpy", inline="always")
def _slice(b, z, cutoff, n_y):
    """Return ξ_z, what of the cutoff's square is left, and the half-open range of y."""
    xi_z = (z - b[Z0]) / b[L_ZZ]
    left = max(0.0, cutoff * cutoff - xi_z * xi_z)
    first, last = _range(b[Y0] + b[L_YZ] * xi_z, b[L_YY] * math.sqrt(left), 0, n_y)
    return xi_z, left, first, last


@njit(cache=True, error_model="numpy")
def add_blob(b, values, cutoff, slices, size, volume):
    """Add values[c]·exp(−½|ξ|²) to the channels of the volume in the half-open range of slices."""
    n_z, n_y, n_x = size
    z_low, z_high = _range(b[Z0], cutoff * b[L_ZZ], slices[0], slices[1])
    for c in range(values.shape[0]):
        peak = values[c] * b[W0]
        if not abs(peak) < LARGEST:
            continue
        a = spread(np.float32(peak))
        for z in range(z_low, z_high):
            xi_z, left, y_low, y_high = _slice(b, z, cutoff, n_y)
            for y in range(y_low, y_high):
                square, centre, x_low, x_high = _row(b, xi_z, y, left, n_x)
                row = (c * n_z + z) * n_y + y
                for x in range(x_low, x_high, WIDTH):
                    g = _value(b, square, centre, x)
                    store(volume, row, x, fma(g, a, load(volume, row, x)))


@njit(cache=True, error_model="numpy")
def read_blob(b, cutoff, size, volume, sums):
    """Add Σ volume·exp(−½|ξ|²) of every channel to `sums`."""
    n_z, n_y, n_x = size
    z_low, z_high = _range(b[Z0], cutoff * b[L_ZZ], 0, n_z)
    for c in range(sums.shape[0]):
        s = spread(np.float32(0))
        for z in range(z_low, z_high):
            xi_z, left, y_low, y_high = _slice(b, z, cutoff, n_y)
            for y in range(y_low, y_high):
                square, centre, x_low, x_high = _row(b, xi_z, y, left, n_x)
                for x in range(x_low, x_high, WIDTH):
                    s = fma(_value(b, square, centre, x), load(volume, (c * n_z + z) * n_y + y, x), s)
        sums[c] += np.float32(b[W0]) * total(s)


@njit(cache=True, error_model="numpy")
def _slices(shapes, bounds, grid, n_z, reach):
    b = np.empty(BLOB)
    for i in range(bounds[0], bounds[1]):
        reach[i, 0], reach[i, 1] = 0, 0
        if blob(shapes, i, grid, b):
            reach[i, 0], reach[i, 1] = _range(b[Z0], grid[6] * b[L_ZZ], 0, n_z)


@njit(cache=True, error_model="numpy")
def _add_slab(shapes, values, grid, reach, slices, size, volume):
    b = np.empty(BLOB)
    for i in range(values.shape[0]):
        if reach[i, 0] < slices[1] and reach[i, 1] > slices[0]:
            blob(shapes, i, grid, b)
            add_blob(b, values[i], grid[6], slices, size, volume)


@njit(cache=True, error_model="numpy")
def _read_chunk(shapes, bounds, grid, size, volume, sums):
    b = np.empty(BLOB)
    for i in range(bounds[0], bounds[1]):
        if blob(shapes, i, grid, b):
            read_blob(b, grid[6], size, volume, sums[i])


@njit(cache=True, error_model="numpy", parallel=True)
def voxelise(shapes, values, grid, size, volume):
    """Add values [splat, channel] times Gaussians to the volume; size is (n_z, n_y, n_x)."""
    n, n_z = values.shape[0], size[0]
    reach = np.empty((n, 2), np.int32)
    for c in prange(CHUNKS):
        _slices(shapes, (c * n // CHUNKS, (c + 1) * n // CHUNKS), grid, n_z, reach)
    slabs = min(SLABS, n_z)
    for k in prange(slabs):
        _add_slab(shapes, values, grid, reach, (k * n_z // slabs, (k + 1) * n_z // slabs), size, volume)


@njit(cache=True, error_model="numpy", parallel=True)
def voxelise_adjoint(shapes, grid, size, volume, sums):
    """Apply the transpose: sums [splat, channel] += Σ volume·Gaussian over the voxels."""
    n = sums.shape[0]
    chunks = max(CHUNKS, n // 4096)
    for c in prange(chunks):
        _read_chunk(shapes, (c * n // chunks, (c + 1) * n // chunks), grid, size, volume, sums)
