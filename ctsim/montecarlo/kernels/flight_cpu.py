"""How far a photon flies through bricks and solids, and how much is in its way, compiled.

A photon flies through blocks of voxels. In a block it meets tentative collisions at the rate of the block's greatest
attenuation, and one is real with the share that the material at its place has of it (Woodcock 1965); solids have
exact boundaries instead, so that metal slows nothing else.
"""

import math

import numpy as np
from numba import njit

from ctsim.kernels.laws_cpu import E_MIN, PER_STEP, uniform
from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.bricks_cpu import CELLS, CODE_BITS, MIXED, SIDE, walk
from ctsim.tracer.kernels.ray_cpu import paint
from ctsim.tracer.kernels.solids_cpu import intersect

FARTHEST = 1e30
EDGE = 1e-9  # of a block: a photon that enters the grid may lie this far outside it by rounding


@njit(cache=True, error_model="numpy", inline="always")
def _label(code, slot, pool, density, grid, x, y, z):
    """Return the label of a place in the volume and its relative density; 0 outside."""
    i, j, k = (x - grid[6]) * grid[3], (y - grid[7]) * grid[4], (z - grid[8]) * grid[5]
    label, relative = 0, np.float32(1.0)
    if 0 <= i < grid[0] and 0 <= j < grid[1] and 0 <= k < grid[2]:
        ix, iy, iz = int(i), int(j), int(k)
        bz, by, bx = iz // SIDE, iy // SIDE, ix // SIDE
        label = np.int64(code[0, bz, by, bx] & CODE_BITS)
        if label == MIXED:
            cell = np.int64(slot[bz, by, bx]) * CELLS + ((iz % SIDE) * SIDE + iy % SIDE) * SIDE + ix % SIDE
            label = np.int64(pool[cell])
            if density.size > 0:
                relative = density[cell]
    return label, relative


@njit(cache=True, error_model="numpy", inline="always")
def _crossed(prims, first, listed, block, ray, start, pair, seen, hits, n):
    """Add the parts (enter, leave, number, material) of a ray beyond `start` in a block's solids to the n known ones.

    Each solid is intersected once in a flight, however many blocks it reaches into: `seen` marks those that were.
    """
    for k in range(first[block], first[block + 1]):
        number = listed[k]
        if seen[number]:
            continue
        seen[number] = 1
        prim = prims[number]
        for i in range(intersect(prim, ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * i], start), pair[2 * i + 1]
            if leave > enter:
                hits[n, 0], hits[n, 1], hits[n, 2], hits[n, 3] = enter, leave, number, prim[1]
                n += 1
    return n


@njit(cache=True, error_model="numpy", inline="always")
def _within(hits, n, t, end):
    """Return the material of the solid painted last at t, 0 where there is none, and where that ends at the latest."""
    m, until, last = 0, end, -1.0
    for k in range(n):
        if hits[k, 0] <= t < hits[k, 1]:
            if hits[k, 2] > last:
                last, m = hits[k, 2], np.int64(hits[k, 3])
            until = min(until, hits[k, 1])
        elif hits[k, 0] > t:
            until = min(until, hits[k, 0])
    return m, until


@njit(cache=True, error_model="numpy", inline="always")
def _attenuations(mu, m, i, part, relative, found):
    for k in range(3):
        found[k] = (mu[m, i, k] + part * (mu[m, i + 1, k] - mu[m, i, k])) * relative


@njit(cache=True, error_model="numpy", inline="always")
def fly(volume, prims, blocks, mu, energy, ray, pair, seen, hits, rng, found):
    """Move a photon to its next collision; fill `found` with the attenuations, return the material, -1 if it leaves."""
    kind, most, first, listed, frame = blocks
    code, slot, pool, density, grid = volume
    mz, my, mx = kind.shape
    x, y, z, dx, dy, dz = ray[0], ray[1], ray[2], ray[3], ray[4], ray[5]
    wx, wy, wz = frame[3], frame[4], frame[5]
    lx, ly, lz = frame[0] - x, frame[1] - y, frame[2] - z
    ix = 1.0 / dx if abs(dx) > 1e-12 else FARTHEST
    iy = 1.0 / dy if abs(dy) > 1e-12 else FARTHEST
    iz = 1.0 / dz if abs(dz) > 1e-12 else FARTHEST
    ux, uy, uz = 1 if ix > 0 else 0, 1 if iy > 0 else 0, 1 if iz > 0 else 0
    t = max((lx + (1 - ux) * mx * wx) * ix, (ly + (1 - uy) * my * wy) * iy)
    t = max(max(t, (lz + (1 - uz) * mz * wz) * iz), 0.0)
    bx, by, bz = (dx * t - lx) / wx, (dy * t - ly) / wy, (dz * t - lz) / wz
    if min(bx, min(by, bz)) < -EDGE or bx > mx + EDGE or by > my + EDGE or bz > mz + EDGE:
        return -1
    bx, by, bz = min(max(int(bx), 0), mx - 1), min(max(int(by), 0), my - 1), min(max(int(bz), 0), mz - 1)
    sx, sy, sz = 2 * ux - 1, 2 * uy - 1, 2 * uz - 1
    tx, ty, tz = (lx + (bx + ux) * wx) * ix, (ly + (by + uy) * wy) * iy, (lz + (bz + uz) * wz) * iz
    jx, jy, jz = wx * abs(ix), wy * abs(iy), wz * abs(iz)
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    part = np.float32(place - i)
    left = -math.log(uniform(rng))
    seen[:] = 0
    n = 0
    while True:
        near = min(tx, min(ty, tz))
        block = (bz * my + by) * mx + bx
        if first[block + 1] > first[block]:
            n = _crossed(prims, first, listed, block, ray, t, pair, seen, hits, n)
        while t < near:
            m, until = _within(hits, n, t, near)
            if m > 0:
                _attenuations(mu, m, i, part, np.float32(1.0), found)
                rate = found[0] + found[1] + found[2]
            else:
                rate = most[kind[bz, by, bx], i]
            if rate * (until - t) < left:
                left -= rate * (until - t)
                t = until
                continue
            t += left / rate
            px, py, pz = x + dx * t, y + dy * t, z + dz * t
            if m == 0:
                m, relative = _label(code, slot, pool, density, grid, px, py, pz)
                _attenuations(mu, m, i, part, relative, found)
                if uniform(rng) * rate >= found[0] + found[1] + found[2]:
                    left = -math.log(uniform(rng))
                    continue
            ray[0], ray[1], ray[2] = px, py, pz
            return m
        if tx == near:
            bx += sx
            tx += jx
            if bx < 0 or bx >= mx:
                return -1
        elif ty == near:
            by += sy
            ty += jy
            if by < 0 or by >= my:
                return -1
        else:
            bz += sz
            tz += jz
            if bz < 0 or bz >= mz:
                return -1


VOLUME = "Tuple((uint16[:,:,:,::1], int32[:,:,::1], uint8[::1], float32[::1], float64[::1]))"
_WORK = "Tuple((float64[::1], float64[::1], float64[::1], float64[:,::1], float64[:,::1], float64[::1]))"


@compiled_once(VOLUME, "float64[:,::1]", "float32[:,:,::1]", "float64", "float64[::1]", _WORK)
def depth(volume, prims, mu, energy, ray, work):
    """Set `ray[7]` to the optical thickness from a ray's start to its end, `ray[6]` mm along it."""
    lengths, covered, painted, pieces, hits, pair = work
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    part = place - i
    n = walk(volume[0], volume[1], volume[2], volume[3], volume[4], ray, 0.0, ray[6], pieces)
    lengths[:] = 0.0
    t = 0.0
    for k in range(n):
        if pieces[k, 0] > t:
            lengths[int(pieces[k, 1])] += (pieces[k, 0] - t) * pieces[k, 2]
            t = pieces[k, 0]
    hit = 0
    for p in range(prims.shape[0]):
        for k in range(intersect(prims[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * k], 0.0), min(pair[2 * k + 1], ray[6])
            if leave > enter:
                hits[hit, 0], hits[hit, 1], hits[hit, 2] = enter, leave, prims[p, 1]
                hit += 1
    if hit > 0:
        paint(hits, hit, pieces, n, covered, painted)
        for m in range(1, lengths.size):
            lengths[m] = max(lengths[m] - covered[m], 0.0) + painted[m]
    tau = 0.0
    for m in range(1, lengths.size):
        if lengths[m] > 0:
            low = mu[m, i, 0] + mu[m, i, 1] + mu[m, i, 2]
            high = mu[m, i + 1, 0] + mu[m, i + 1, 1] + mu[m, i + 1, 2]
            tau += (low + part * (high - low)) * lengths[m]
    ray[7] = tau
