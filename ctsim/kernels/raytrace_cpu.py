"""One traversal of the label volume gives every material's path length; intensities are fused per row.

Rays run from the source to the pixel. Solids are intersected exactly and replace the background along
their intervals; between them the ray walks the bricks of the label volume (see `ctsim.bricks`). Pixels
that the edge of a solid crosses are measured by several rays and averaged in *intensity*, as a detector
does. Rows are independent, so results are bitwise equal for any number of threads. What runs once a ray is
inlined: a call would count references of its arrays atomically, which costs more than the ray.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.bricks import MIXED, SIDE
from ctsim.kernels.exp_cpu import exp_minus
from ctsim.kernels.solids_cpu import intersect

CODE_BITS = np.uint16(255)
CELLS = SIDE**3
SHIFT = SIDE.bit_length() - 1
FIXED = 2.0**40  # ray parameter as an integer in 2⁻⁴⁰ mm inside a mixed brick
FARTHEST = 1e6  # mm; no ray is longer, and crossings of a parallel plane lie beyond
TINY = 1e-12  # a direction cosine below this counts as parallel to the axis
GOLDEN = 0.6180339887498949
MOST_TIMES = 16  # a primitive thinner than a pixel gets at most this many times the usual sub-rays
FAST = {"contract", "reassoc", "nsz", "arcp"}


@njit(inline="always", error_model="numpy")
def _walk(code, slot, pool, density, grid, ray, t_from, t_to, lengths):
    """Add the background's path lengths between t_from and t_to (mm along the ray) to `lengths`."""
    # positions in voxels; the ray parameter stays in mm
    ox, oy, oz = (ray[0] - grid[6]) * grid[3], (ray[1] - grid[7]) * grid[4], (ray[2] - grid[8]) * grid[5]
    dx, dy, dz = ray[3] * grid[3], ray[4] * grid[4], ray[5] * grid[5]
    dx = TINY if abs(dx) < TINY else dx
    dy = TINY if abs(dy) < TINY else dy
    dz = TINY if abs(dz) < TINY else dz
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    ux, uy, uz = 1 if dx > 0 else 0, 1 if dy > 0 else 0, 1 if dz > 0 else 0
    x0, x1, y0, y1, z0, z1 = -ox * ix, (grid[0] - ox) * ix, -oy * iy, (grid[1] - oy) * iy, -oz * iz, (grid[2] - oz) * iz
    t = max(max(t_from, x0 if ux else x1), max(y0 if uy else y1, z0 if uz else z1))
    end = min(min(t_to, x1 if ux else x0), min(y1 if uy else y0, z1 if uz else z0))
    if not t < end:
        return
    octant = ux + 2 * uy + 4 * uz
    _, mz, my, mx = code.shape
    sx, sy, sz = 2 * ux - 1, 2 * uy - 1, 2 * uz - 1
    step_x = np.int64(min(abs(ix), FARTHEST) * FIXED)
    step_y = np.int64(min(abs(iy), FARTHEST) * FIXED)
    step_z = np.int64(min(abs(iz), FARTHEST) * FIXED)
    scale = 1.0 / SIDE
    bx = min(max(int((ox + dx * t) * scale), 0), mx - 1)
    by = min(max(int((oy + dy * t) * scale), 0), my - 1)
    bz = min(max(int((oz + dz * t) * scale), 0), mz - 1)
    while True:
        entry = code[octant, bz, by, bx]
        label = entry & CODE_BITS
        if label != MIXED:
            # the same label fills the cube of `reach` bricks ahead; `more` is its far end from here
            more = int(entry >> np.uint16(8)) - 1
            tx = ((bx + ux + sx * more) * SIDE - ox) * ix
            ty = ((by + uy + sy * more) * SIDE - oy) * iy
            tz = ((bz + uz + sz * more) * SIDE - oz) * iz
            leave = min(tx, min(ty, tz))
            if leave >= end:
                lengths[label] += end - t
                return
            if leave > t:
                lengths[label] += leave - t
                t = leave
            if more == 0:
                bx += sx if tx == leave else 0
                by += sy if ty == leave else 0
                bz += sz if tz == leave else 0
            else:
                ex, ey, ez = bx + sx * more, by + sy * more, bz + sz * more
                px, py, pz = int((ox + dx * t) * scale), int((oy + dy * t) * scale), int((oz + dz * t) * scale)
                bx = ex + sx if tx == leave else min(max(px, min(bx, ex)), max(bx, ex))
                by = ey + sy if ty == leave else min(max(py, min(by, ey)), max(by, ey))
                bz = ez + sz if tz == leave else min(max(pz, min(bz, ez)), max(bz, ez))
        else:
            base = np.int64(slot[bz, by, bx]) * CELLS
            x = min(max(int(ox + dx * t) - bx * SIDE, 0), SIDE - 1)
            y = min(max(int(oy + dy * t) - by * SIDE, 0), SIDE - 1)
            z = min(max(int(oz + dz * t) - bz * SIDE, 0), SIDE - 1)
            # fixed point: the chain of one step is half as long in integers as in floating point
            cx = np.int64(min((bx * SIDE + x + ux - ox) * ix, FARTHEST) * FIXED)
            cy = np.int64(min((by * SIDE + y + uy - oy) * iy, FARTHEST) * FIXED)
            cz = np.int64(min((bz * SIDE + z + uz - oz) * iz, FARTHEST) * FIXED)
            at, stop = np.int64(t * FIXED), np.int64(end * FIXED)
            cell = base + (z * SIDE + y) * SIDE + x
            while True:
                leave = min(cx, min(cy, cz))
                step = max(min(leave, stop) - at, 0)
                at = max(at, leave)
                if density.size > 0:
                    lengths[pool[cell]] += step * density[cell] * (1.0 / FIXED)
                else:
                    lengths[pool[cell]] += step * (1.0 / FIXED)
                # no branch tells the axes apart: a wrong guess costs more than the additions
                gx, gy, gz = -np.int64(cx == leave), -np.int64(cy == leave), -np.int64(cz == leave)
                x += sx & gx
                y += sy & gy
                z += sz & gz
                cx += step_x & gx
                cy += step_y & gy
                cz += step_z & gz
                if (x | y | z) & ~(SIDE - 1):
                    break
                cell += (sx & gx) + (sy * SIDE & gy) + (sz * SIDE * SIDE & gz)
            t = at * (1.0 / FIXED)
            if at >= stop:
                return
            bx += x >> SHIFT
            by += y >> SHIFT
            bz += z >> SHIFT
        if bx < 0 or by < 0 or bz < 0 or bx >= mx or by >= my or bz >= mz:
            return


@njit(inline="always", error_model="numpy")
def _aim(pose, u, v, ray):
    """Fill `ray` with the source, the unit direction to detector position (u, v), and the distance."""
    dx = pose[3] + u * pose[6] + v * pose[9] - pose[0]
    dy = pose[4] + u * pose[7] + v * pose[10] - pose[1]
    dz = pose[5] + u * pose[8] + v * pose[11] - pose[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    ray[0], ray[1], ray[2] = pose[0], pose[1], pose[2]
    ray[3], ray[4], ray[5] = dx / length, dy / length, dz / length
    ray[6] = length


@njit(inline="always", error_model="numpy")
def _collect(prims, rects, active, u, ray, pair, hits):
    """List the intervals of the active primitives near column u as (enter, leave, material); return how many."""
    n = 0
    for p in active:
        if u < rects[p, 2] or u > rects[p, 3]:
            continue
        for i in range(intersect(prims[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * i], 0.0), min(pair[2 * i + 1], ray[6])
            if leave > enter:
                hits[n, 0], hits[n, 1], hits[n, 2] = enter, leave, prims[p, 1]
                n += 1
    return n


@njit(inline="always", error_model="numpy")
def _add_lengths(code, slot, pool, density, grid, ray, hits, n, lengths):
    """Add one ray's path length in every material: solids in paint order over the background."""
    t = 0.0
    while t < ray[6]:
        # the topmost interval that covers t decides, until it ends or one painted later begins
        top, until = -1, ray[6]
        for i in range(n):
            if hits[i, 0] <= t < hits[i, 1]:
                top = i
        if top >= 0:
            until = hits[top, 1]
        for i in range(top + 1, n):
            if t < hits[i, 0] < until:
                until = hits[i, 0]
        if top >= 0:
            lengths[int(hits[top, 2])] += until - t
        else:
            _walk(code, slot, pool, density, grid, ray, t, until, lengths)
        t = until


@njit(inline="always", error_model="numpy")
def _thickness(hits, n, edge_mu):
    """Optical thickness of the solids alone; overlaps count twice, since only its change matters."""
    total = 0.0
    for i in range(n):
        total += (hits[i, 1] - hits[i, 0]) * edge_mu[int(hits[i, 2])]
    return total


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _signal(lengths, n, mu, w1, w2, tau, s1, s2):
    """Sum the nodes: s1 = Σ w1·exp(−Σ mu·L) and s2 likewise, for n rays at once."""
    for i in range(n):
        s1[i] = 0
        s2[i] = 0
    for k in range(w1.size):
        for i in range(n):
            tau[i] = 0
        for m in range(mu.shape[0]):
            mu_mk = mu[m, k]
            for i in range(n):
                tau[i] += mu_mk * lengths[m, i]
        for i in range(n):
            e = exp_minus(tau[i])
            s1[i] += w1[k] * e
            s2[i] += w2[k] * e


@njit(cache=True, error_model="numpy")
def _active(rects, v):
    """Return the indices of the primitives whose shadow may reach row v."""
    out = np.empty(rects.shape[0], np.int64)
    n = 0
    for p in range(rects.shape[0]):
        if rects[p, 0] <= v <= rects[p, 1]:
            out[n] = p
            n += 1
    return out[:n]


@njit(cache=True, error_model="numpy")
def _corners(prims, rects, active, pose, v, shift, edge_mu, out):
    """Fill `out` [2, u + 1] with the solids' thickness at the pixel corners below and above row v."""
    ray, pair, hits = np.empty(7), np.empty(4), np.empty((2 * active.size, 3))
    for side in range(2):
        for u in range(out.shape[1]):
            out[side, u] = 0.0
        for p in active:
            for u in range(max(int(rects[p, 2]), 0), min(int(rects[p, 3]) + 2, out.shape[1])):
                if out[side, u] == 0.0:
                    _aim(pose, u - 0.5 - shift[1], v + side - 0.5 - shift[0], ray)
                    n = _collect(prims, rects, active, u - 0.5, ray, pair, hits)
                    out[side, u] = _thickness(hits, n, edge_mu) + 1e-300  # marks the corner as done


@njit(inline="always", error_model="numpy")
def _grazes(fat, rects, active, u, ray, pair):
    """Return how many times the usual sub-rays a primitive needs that can hide between a pixel's corners."""
    times = 0
    for p in active:
        near = fat[p, 0] >= 0 and rects[p, 2] <= u <= rects[p, 3]
        if near and intersect(fat[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair) > 0:
            times = max(times, int(fat[p, 1]))
    return times


@njit(inline="always", error_model="numpy")
def _add_row(grid_arrays, prims, rects, active, u, ray, scratch, layer, lengths, column):
    """Write one ray's path lengths into column `column` of `lengths` [material, ray]; return its intervals."""
    code, slot, pool, density, grid = grid_arrays
    pair, hits, row = scratch
    n = _collect(prims, rects, active, u, ray, pair, hits)
    row[:] = 0.0
    _add_lengths(code, slot, pool, density, grid, ray, hits, n, row)
    row[-1] += layer
    for m in range(1, row.size):
        lengths[m, column] = row[m]
    return n


@njit(cache=True, error_model="numpy")
def _measure_row(bricks, solids, pose, v, span, extra, rule, edge, m1, m2):
    """Measure columns span[0]…span[1] of row v: central rays first, then the pixels on an edge again."""
    code, slot, pool, density, grid, _ = bricks
    arrays = (code, slot, pool, density, grid)
    prims, fat, rects = solids
    mu, w1, w2 = rule
    edge_mu, threshold, most = edge
    n_v, n_u = m1.shape
    shift = ((n_v - 1) / 2, (n_u - 1) / 2)
    first, last = span[0], span[1]
    size = max(last - first, most * MOST_TIMES)
    lengths = np.zeros((mu.shape[0], size), np.float32)
    tau, s1, s2 = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    active = _active(rects, v)
    ray, pair, hits = np.empty(7), np.empty(4), np.empty((2 * active.size + 1, 3))
    scratch = (pair, hits, np.zeros(mu.shape[0]))
    centre, corners = np.zeros(n_u), np.zeros((2, n_u + 1))
    for u in range(first, last):
        _aim(pose, u - shift[1], v - shift[0], ray)
        layer = extra[v, u] if extra.size else 0.0
        n = _add_row(arrays, prims, rects, active, u, ray, scratch, layer, lengths, u - first)
        centre[u] = _thickness(hits, n, edge_mu)
    _signal(lengths, last - first, mu, w1, w2, tau, s1, s2)
    for u in range(first, last):
        m1[v, u], m2[v, u] = s1[u - first], s2[u - first]
    if active.size == 0 or most < 2:
        return
    _corners(prims, rects, active, pose, v, shift, edge_mu, corners)
    for u in range(first, last):
        a, b, c, d = corners[0, u], corners[0, u + 1], corners[1, u], corners[1, u + 1]
        change = max(max(max(a, b), max(c, d)), centre[u]) - min(min(min(a, b), min(c, d)), centre[u])
        _aim(pose, u - shift[1], v - shift[0], ray)
        times = _grazes(fat, rects, active, u, ray, pair)
        if times == 0 and change <= threshold:
            continue
        count = most * times if times else int(min(float(most), 4.0 + 4.0 * change))
        layer = extra[v, u] if extra.size else 0.0
        for i in range(count):
            # a golden-section lattice has `count` distinct positions along u and along v
            du, dv = (i + 0.5) / count - 0.5, (i * GOLDEN + 0.5) % 1.0 - 0.5
            _aim(pose, u + du - shift[1], v + dv - shift[0], ray)
            _add_row(arrays, prims, rects, active, u + du, ray, scratch, layer, lengths, i)
        _signal(lengths, count, mu, w1, w2, tau, s1, s2)
        mean1, mean2 = 0.0, 0.0
        for i in range(count):
            mean1 += s1[i]
            mean2 += s2[i]
        m1[v, u], m2[v, u] = mean1 / count, mean2 / count


@njit(parallel=True, cache=True, error_model="numpy")
def transmit_view(bricks, solids, pose, order, spans, extra, rule, edge, m1, m2):
    """Measure one view: mean signal `m1` and second moment `m2` [v, u] relative to the open field.

    `solids` is (prims, fat, rects): primitive rows; their inflated twins, with kind −1 where not thin and
    how many times the usual sub-rays in the material's place; and their shadows (v from, to, u from, to).
    `pose` [12]; `order` [row] is the order of work; only columns spans[row] = (from, to) are touched.
    `extra` [v, u] is a length (mm) in the last material that every ray crosses, or empty. `rule` is
    (mu [material, node] 1/mm, w1 [node], w2 [node]); `edge` is (edge_mu [material], threshold in optical
    thickness, most sub-rays a pixel).
    """
    for index in prange(order.size):
        v = order[index]
        if spans[v, 1] > spans[v, 0]:
            _measure_row(bricks, solids, pose, v, spans[v], extra, rule, edge, m1, m2)


@njit(cache=True, error_model="numpy")
def _trace_row(bricks, solids, pose, v, span, lengths):
    code, slot, pool, density, grid, _ = bricks
    prims, _, rects = solids
    n_materials, n_v, n_u = lengths.shape
    active = _active(rects, v)
    ray, scratch = np.empty(7), (np.empty(4), np.empty((2 * active.size + 1, 3)), np.zeros(n_materials))
    arrays = (code, slot, pool, density, grid)
    for u in range(span[0], span[1]):
        _aim(pose, u - (n_u - 1) / 2, v - (n_v - 1) / 2, ray)
        _add_row(arrays, prims, rects, active, u, ray, scratch, 0.0, lengths[:, v], u)


@njit(parallel=True, cache=True, error_model="numpy")
def trace_view(bricks, solids, pose, order, spans, lengths):
    """Fill `lengths` [material, v, u] (mm) along the rays to the pixel centres of one view."""
    for index in prange(order.size):
        v = order[index]
        if spans[v, 1] > spans[v, 0]:
            _trace_row(bricks, solids, pose, v, spans[v], lengths)
