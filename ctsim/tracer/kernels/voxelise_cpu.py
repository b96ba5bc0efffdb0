"""Volume averages on a grid: of a label volume by box overlap, of solids by anti-aliased sub-cells.

Volumes are [z, y, x]; a grid is given as its first voxel centre and its pitch, (z, y, x) in mm.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM


@njit(parallel=True, cache=True)
def average(labels, density, table, first, weights, counts, out):
    """Average table[label]·density over each target voxel into `out`; density may have size 0.

    Along axis a target voxel i overlaps the source voxels first[a][i] + 0…counts[a][i]−1 by the shares
    weights[a][i, :] of its own size.
    """
    dense = density.size > 0
    for z in prange(out.shape[0]):
        for y in range(out.shape[1]):
            for x in range(out.shape[2]):
                total = 0.0
                for k in range(counts[0][z]):
                    for j in range(counts[1][y]):
                        share = weights[0][z, k] * weights[1][y, j]
                        for i in range(counts[2][x]):
                            at = (first[0][z] + k, first[1][y] + j, first[2][x] + i)
                            value = table[labels[at]] * share * weights[2][x, i]
                            total += value * density[at] if dense else value
                out[z, y, x] = total


@njit(inline="always")
def _shares(labels, first, weights, counts, at, share):
    """Set `share` [material] to how much of target voxel `at` (z, y, x) each label's material fills; return the body's.

    Both are those that `average` makes of a table of zeros with a one, and of ones with a zero for air.
    """
    z, y, x = at
    share[:] = 0.0
    body = 0.0
    for k in range(counts[0][z]):
        for j in range(counts[1][y]):
            plane = weights[0][z, k] * weights[1][y, j]
            for i in range(counts[2][x]):
                label = labels[first[0][z] + k, first[1][y] + j, first[2][x] + i]
                value = plane * weights[2][x, i]
                share[label] += value
                if label:
                    body += value
    return body


@njit(parallel=True, cache=True)
def dominant(labels, n_materials, first, weights, counts, out):
    """Set `out` [z, y, x] uint8 to the label that fills most of each target voxel, the lowest of equals.

    The overlaps are those of `average`. Air is what the others leave. Shares are compared in float32.
    """
    for z in prange(out.shape[0]):
        share = np.empty(n_materials)
        for y in range(out.shape[1]):
            for x in range(out.shape[2]):
                body = _shares(labels, first, weights, counts, (z, y, x), share)
                most = min(max(np.float32(1) - np.float32(body), np.float32(0)), np.float32(1))
                best = 0
                for m in range(1, n_materials):
                    if np.float32(share[m]) > most:
                        best, most = m, np.float32(share[m])
                out[z, y, x] = best


@njit(parallel=True, cache=True)
def shares_at(labels, first, weights, counts, shape, index, out):
    """Fill `out` [k, material] float32 with the share of each material in the target voxels `index` (flat)."""
    for k in prange(index.size):
        share = np.empty(out.shape[1])
        at = (index[k] // (shape[1] * shape[2]), index[k] // shape[2] % shape[1], index[k] % shape[2])
        body = _shares(labels, first, weights, counts, at, share)
        out[k, 0] = min(max(np.float32(1) - np.float32(body), np.float32(0)), np.float32(1))
        for m in range(1, out.shape[1]):
            out[k, m] = share[m]


@njit(cache=True, error_model="numpy")
def _local(prim, x, y, z):
    px, py, pz = x - prim[18], y - prim[19], z - prim[20]
    return (
        prim[2] * px + prim[3] * py + prim[4] * pz,
        prim[5] * px + prim[6] * py + prim[7] * pz,
        prim[8] * px + prim[9] * py + prim[10] * pz,
    )


@njit(cache=True, error_model="numpy")
def bound(prim, x, y, z):
    """Return a signed lower bound of the distance to the surface (1-Lipschitz, negative inside), mm."""
    x, y, z = _local(prim, x, y, z)
    kind, a, b, c = int(prim[0]), prim[14], prim[15], prim[16]
    if kind == ELLIPSOID:
        return (math.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2) - 1) * min(a, b, c)
    if kind == BOX:
        return max(abs(x) - a, abs(y) - b, abs(z) - c)
    rho = math.sqrt(x * x + y * y)
    if kind == FRUSTUM:
        slope = (c - b) / (2 * a)
        side = (rho - 0.5 * (b + c) - slope * z) / math.sqrt(1 + slope * slope)
        return max(abs(z) - a, side)
    if kind == CAPSULE:
        over = max(abs(z) - a, 0.0)
        return math.sqrt(rho * rho + over * over) - b
    return math.sqrt((rho - a) ** 2 + z * z) - b


@njit(cache=True, error_model="numpy")
def _ramp(s, width):
    """Share of a cell of the given width below a face at signed distance s from its centre."""
    return min(max(0.5 - s / width, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def _between(p, half, width):
    """Share of the stretch p ± width/2 within ± half."""
    return max(min(p + 0.5 * width, half) - max(p - 0.5 * width, -half), 0.0) / width


@njit(cache=True, error_model="numpy")
def _round(distance, radius, width, curvature):
    """Share of a cell within `radius`; the cell's mean distance exceeds its centre's by curvature·w²/24."""
    s = distance - radius + curvature * width * width / (24 * max(distance, 0.5 * width))
    return _ramp(s, width) * min(1.0, (2 * radius / width) ** 2)


@njit(cache=True, error_model="numpy")
def share(prim, x, y, z, width):
    """Return the share of a cell of the given width, centred at (x, y, z), that the primitive fills."""
    x, y, z = _local(prim, x, y, z)
    kind, a, b, c = int(prim[0]), prim[14], prim[15], prim[16]
    if kind == BOX:
        return _between(x, a, width) * _between(y, b, width) * _between(z, c, width)
    if kind == ELLIPSOID:
        f = math.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
        slope = math.sqrt((x / (a * a)) ** 2 + (y / (b * b)) ** 2 + (z / (c * c)) ** 2)
        if f * f < 1e-12 or slope == 0:
            return _round(0.0, min(a, b, c), width, 2.0)
        distance = f * f / slope  # f scaled by 1/|∇f|
        return _round(distance, distance / f, width, 2.0)
    rho = math.sqrt(x * x + y * y)
    if kind == FRUSTUM:
        slope = (c - b) / (2 * a)
        tilt = 1 / math.sqrt(1 + slope * slope)
        radius = max(0.5 * (b + c) + slope * z, 0.0)
        return _between(z, a, width) * _round(rho * tilt, radius * tilt, width, 1.0)
    if kind == CAPSULE:
        over = max(abs(z) - a, 0.0)
        return _round(math.sqrt(rho * rho + over * over), b, width, 2.0 if over > 0 else 1.0)
    return _round(math.sqrt((rho - a) ** 2 + z * z), b, width, 1.0)


@njit(cache=True)
def _span(centre, radius, start, pitch, n):
    """Return voxels low…high−1 of an axis that a stretch centre ± radius may touch."""
    low = math.floor((centre - radius - start) / pitch + 0.5)
    high = math.floor((centre + radius - start) / pitch + 0.5) + 1
    return max(int(low), 0), min(int(high), n)


@njit(parallel=True, cache=True)
def mark(prims, start, pitch, touched):
    """Set `touched` [z, y, x] uint8 to 1 where a primitive may have a part of the voxel."""
    nz, ny, nx = touched.shape
    reach = 0.5 * math.sqrt(pitch[0] ** 2 + pitch[1] ** 2 + pitch[2] ** 2)
    for k in prange(nz):
        z = start[0] + k * pitch[0]
        for p in range(prims.shape[0]):
            prim = prims[p]
            if abs(z - prim[20]) > prim[21] + 0.5 * pitch[0]:
                continue
            y0, y1 = _span(prim[19], prim[21], start[1], pitch[1], ny)
            x0, x1 = _span(prim[18], prim[21], start[2], pitch[2], nx)
            for j in range(y0, y1):
                for i in range(x0, x1):
                    x, y = start[2] + i * pitch[2], start[1] + j * pitch[1]
                    if touched[k, j, i] == 0 and bound(prim, x, y, z) < reach:
                        touched[k, j, i] = 1


@compiled_once(
    *("int64", "float64[:,::1]", "int64[::1]", "float64[::1]", "float64[::1]", "UniTuple(int64, 3)"),
    *("UniTuple(int64, 3)", "int64[::1]", "int64[::1]", "boolean[::1]", "float32[:,::1]"),
)
def _cover_slice(k, prims, channel, start, pitch, cells, shape, index, first, sought, out):
    _, ny, nx = shape
    reach = 0.5 * math.sqrt(pitch[0] ** 2 + pitch[1] ** 2 + pitch[2] ** 2)
    dz, dy, dx = pitch[0] / cells[0], pitch[1] / cells[1], pitch[2] / cells[2]
    width = (dz * dy * dx) ** (1 / 3)
    unit = 1.0 / (cells[0] * cells[1] * cells[2])
    row_prims = np.empty(prims.shape[0], np.int64)
    crossing = np.empty(prims.shape[0], np.int64)
    total = np.empty(out.shape[1])
    z, row, n_row = start[0] + k * pitch[0], -1, 0
    for m in range(first[k], first[k + 1]):
        j, i = (index[m] // nx) % ny, index[m] % nx
        y, x = start[1] + j * pitch[1], start[2] + i * pitch[2]
        if j != row:
            row, n_row = j, 0
            for p in range(prims.shape[0] - 1, -1, -1):
                gap_z = max(abs(z - prims[p, 20]) - 0.5 * pitch[0], 0.0)
                gap_y = max(abs(y - prims[p, 19]) - 0.5 * pitch[1], 0.0)
                if gap_z * gap_z + gap_y * gap_y <= prims[p, 21] ** 2:
                    row_prims[n_row] = p
                    n_row += 1
        n, full = 0, -1
        for r in range(n_row):
            p = row_prims[r]
            if abs(x - prims[p, 18]) > prims[p, 21] + 0.5 * pitch[2]:
                continue
            distance = bound(prims[p], x, y, z)
            if distance <= -reach:
                full = channel[p]
                break
            if distance < reach:
                crossing[n] = p
                n += 1
        if n == 0:
            if full >= 0:
                out[m, full] = 1.0
                if sought[full]:
                    return
            continue
        total[:] = 0.0
        for kk in range(cells[0]):
            sz = z - 0.5 * pitch[0] + (kk + 0.5) * dz
            for jj in range(cells[1]):
                sy = y - 0.5 * pitch[1] + (jj + 0.5) * dy
                for ii in range(cells[2]):
                    sx = x - 0.5 * pitch[2] + (ii + 0.5) * dx
                    left = unit
                    for r in range(n):
                        p = crossing[r]
                        part = left * share(prims[p], sx, sy, sz, width)
                        total[channel[p]] += part
                        left -= part
                        if left <= 0:
                            break
                    if full >= 0:
                        total[full] += left
        found = np.float32(0)
        for r in range(total.size):  # not by a slice: its error message takes a second to compile
            out[m, r] = total[r]
            found += out[m, r] * sought[r]
        if found >= 0.5:
            return


@njit(parallel=True, cache=True)
def _cover_slices(slice_, prims, channel, start, pitch, cells, shape, index, first, sought, out):
    for k in prange(shape[0]):
        _cover_slice(slice_, k, prims, channel, start, pitch, cells, shape, index, first, sought, out)


def cover(prims, channel, start, pitch, cells, shape, index, first, sought, out):
    """Fill `out` [k, channel] with the share of each listed voxel that each channel is seen in.

    `index` [k] are ascending flat voxel numbers, `first` [nz + 1] where each slice begins in them;
    `channel` [primitive] and `cells` (z, y, x) the sub-cells of a voxel. A later primitive covers an
    earlier one in every sub-cell. A slice is left at the first voxel that `sought` [channel] fill by half.
    """
    _cover_slices(_cover_slice.address(), prims, channel, start, pitch, cells, shape, index, first, sought, out)
