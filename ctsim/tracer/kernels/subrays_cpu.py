"""Pixels that the edge of a solid crosses, measured by several rays and averaged in *intensity*, as a detector does.

Pixels whose rays disagree get more of them. What differs between the rays of a pixel is the solids, while the volume is
always that of the central ray. The number of rays is a rung of a ladder, so that variants of a scan, whose metal or
spectrum differs, mostly ask for the same rays: each number of rays of a pixel is cast once for all variants.
"""

import numpy as np
from numba import njit

from ctsim.kernels.once import compiled_once
from ctsim.solids import TORUS
from ctsim.tracer.kernels.bricks_cpu import aim, towards, walk
from ctsim.tracer.kernels.ray_cpu import WIDTH, paint, signal_near
from ctsim.tracer.kernels.solids_cpu import intersect, intersect_rays
from ctsim.tracer.shadow import MOST_TIMES

GOLDEN = 0.6180339887498949
ALL_SUBRAYS = 8.5  # a pixel across which the solids' optical thickness changes by 7.5 gets all, others a share
RANGE_SHARE = 0.5  # of the signal's range over the sub-rays: the error of their mean at least, where an edge crosses
LATTICE_ORDER = 4 / 3  # at an edge the mean of n lattice points is off by about n^(-3/4)
RUNGS = np.rint(34 * 2.0 ** np.arange(-4, 17)).astype(np.int64)
"""Numbers of rays that a pixel may get: 2, 4, 8, 17, 34, 68 and so on, each about twice the one before."""
MOST_COMPARED = 4  # intervals of a pixel that are compared for overlaps; more of them mostly overlap, as a wire's
FINITE = {"contract", "reassoc", "nsz", "arcp", "nnan"}  # for sums and ranges of what is never NaN
KEPT = 9  # numbers of rays of a pixel whose path lengths are kept for the other variants

# Numba types of arguments, named as in `raytrace_cpu.transmit_variants`
VOLUME = "Tuple((uint16[:,:,:,::1], int32[:,:,::1], uint8[::1], float32[::1], float64[::1]))"
PRIMS, SHADOW, ACTIVE, NEAR = "float64[:,::1]", "int64[:,::1]", "int64[::1]", "bool_[::1]"
RULES = "Tuple((float32[:,:,::1], float32[:,::1], float32[:,::1], int64[::1]))"
EDGE = "Tuple((float64[:,::1], float64, float64, int64, float64))"
POSE, COLUMNS, BACKGROUND, IMAGES = "float64[::1]", "UniTuple(int64, 3)", "float32[:,:]", "float32[:,:,::1]"


@njit(inline="always", error_model="numpy")
def rung(count, size):
    """Return the least number of rays on the ladder that is at least `count`, at most `size`."""
    k = 0
    while RUNGS[k] < count:
        k += 1
    return min(RUNGS[k], size)


@njit(inline="always", error_model="numpy")
def first_rung(count, size):
    """Return the number of rays on the ladder whose ratio to `count` is nearest to 1, at most `size`."""
    k = 0
    while RUNGS[k + 1] * RUNGS[k] < count * count:
        k += 1
    return min(RUNGS[k], size)


@njit(inline="always", error_model="numpy")
def _grazes(fat, shadow, active, u, ray, pair):
    """Return how many times the usual sub-rays a primitive needs that can hide between a pixel's corners."""
    times = 0
    for p in active:
        near = fat[p, 0] >= 0 and shadow[p, 0] <= u <= shadow[p, 1]
        if near and intersect(fat[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair) > 0:
            times = max(times, int(fat[p, 1]))
    return times


@njit(cache=True, fastmath=FINITE, error_model="numpy")
def _sums(s1, s2, count, sums):
    """Fill `sums` with the least and largest s1, the sums of even and odd ones, and the sum of s2; none may be NaN."""
    darkest, brightest, even, odd, second = s1[0], s1[0], 0.0, 0.0, 0.0
    for i in range(count):
        darkest, brightest = min(darkest, s1[i]), max(brightest, s1[i])
        second += s2[i]
    for i in range(count // 2):
        even += s1[2 * i]
        odd += s1[2 * i + 1]
    if count % 2:
        even += s1[count - 1]
    sums[0], sums[1], sums[2], sums[3], sums[4] = darkest, brightest, even, odd, second


@njit(cache=True, error_model="numpy")
def _uncertainty(sums, count, seen, k, bounds, j, u):
    """Estimate the relative error of the mean of `count` sub-rays, of `sums` as `_sums` fills them.

    seen[k, j] is the solids' (least, largest) thickness along them and bounds[:, j, u] that at the pixel's corners and
    centre: where the bounds lie beyond, there is something brighter or darker that no sub-ray met. Half the difference
    of the means of even and odd sub-rays can be small by chance; a share of the signal's range / count cannot.
    """
    darkest, brightest, even, odd = sums[0], sums[1], sums[2], sums[3]
    least, largest, low, high = seen[k, j, 0], seen[k, j, 1], bounds[0, j, u], bounds[1, j, u]
    if low < least:  # nothing is brighter than the open field
        brightest = min(brightest * np.exp(min(least - low, 80.0)), max(1.0, brightest))
    if high > largest:
        darkest *= np.exp(largest - high)
    halves = abs(even / (count - count // 2) - odd / (count // 2)) / 2
    return max(halves, RANGE_SHARE * (brightest - darkest) / count) * count / (even + odd)


@njit(inline="always", error_model="numpy")
def _collect(solids, pose, column, count, work, met):
    """Cast a pixel's sub-rays at the primitives seen near its column; return the number of intervals met.

    Of interval k, in paint order, `spans` [k, 2, ray] gets where rays enter and leave it before they reach the detector
    (∞, −∞ where they miss it), and `made` [k] its material. `solid` [material, ray] gets the length in all intervals of
    a material, `met` [material] 1 where there are any and 0 elsewhere. `local` [11, ray] has the rays' directions in
    its first rows and their lengths (mm) in the last.
    """
    rays_at, prims, shadow, active = solids
    local, spans, made, solid = work
    met[:] = 0.0
    n = 0
    for p in active:
        if column + 0.5 < shadow[p, 0] or column - 0.5 > shadow[p, 1]:
            continue
        intersect_rays(rays_at, prims[p], count, pose, local, spans[n:])
        m, first = int(prims[p, 1]), n
        for k in range(first, first + (2 if prims[p, 0] == TORUS else 1)):
            hits = 0
            for i in range(count):
                enter, leave = max(spans[k, 0, i], 0.0), min(spans[k, 1, i], local[10, i])
                hit = spans[k, 1, i] > spans[k, 0, i] and leave > enter
                spans[n, 0, i], spans[n, 1, i] = (enter, leave) if hit else (np.inf, -np.inf)
                hits += hit
            if hits == 0:
                continue
            for i in range(count):
                solid[m, i] = (solid[m, i] if met[m] else 0.0) + max(spans[n, 1, i] - spans[n, 0, i], 0.0)
            met[m], made[n] = 1.0, m
            n += 1
    return n


@njit(cache=True, fastmath=FINITE, error_model="numpy")
def _seen(solid, met, count, edge_mu, total, seen):
    """Fill `seen` [variant, 2] with the least and largest optical thickness of the solids along `count` rays."""
    for j in range(edge_mu.shape[0]):
        for i in range(count):
            total[i] = 0.0
        for m in range(met.size):
            if met[m]:
                for i in range(count):
                    total[i] += edge_mu[j, m] * solid[m, i]
        least, largest = total[0], total[0]
        for i in range(count):
            least, largest = min(least, total[i]), max(largest, total[i])
        seen[j, 0], seen[j, 1] = least, largest


@njit(cache=True, fastmath=FINITE, error_model="numpy")
def _reach(spans, n, count):
    """Return where the first ray enters one of the n intervals and where the last one leaves one."""
    t, far = np.inf, -np.inf
    for k in range(n):
        for i in range(count):
            t, far = min(t, spans[k, 0, i]), max(far, spans[k, 1, i])
    return t, far


@njit(inline="always", error_model="numpy")
def _overlap(spans, n, count):
    """Say whether any ray is in two of the n intervals at once."""
    both = 0
    for k in range(n):
        for other in range(k):
            for i in range(count):
                both += min(spans[k, 1, i], spans[other, 1, i]) > max(spans[k, 0, i], spans[other, 0, i])
    return both > 0


@njit(inline="always", error_model="numpy")
def _order(met, pieces, n_pieces, marks, order):
    """Fill `order` with the materials but air, those that are `met` or in pieces first; return how many these are."""
    for m in range(met.size):
        marks[m] = met[m]
    for k in range(n_pieces):
        marks[int(pieces[k, 1])] = 1.0
    few, last = 0, order.size
    for m in range(1, met.size):
        if marks[m]:
            order[few] = m
            few += 1
        else:
            last -= 1
            order[last] = m
    return few


@njit(inline="always", error_model="numpy")
def _paint_apart(spans, n, volume, count, background, materials, total, lengths):
    """Fill path `lengths` [material, ray] of rays that are in no two of the n intervals at once."""
    pieces, n_pieces = volume
    order, few, met, solid = materials
    for c in range(few):
        m = order[c]
        for i in range(count):
            total[i] = 0.0
        for piece in range(1, n_pieces):  # the first one is air
            if int(pieces[piece, 1]) == m:
                begin, end, dense = pieces[piece - 1, 0], pieces[piece, 0], pieces[piece, 2]
                for k in range(n):
                    for i in range(count):
                        total[i] += dense * max(min(end, spans[k, 1, i]) - max(begin, spans[k, 0, i]), 0.0)
        for i in range(count):
            lengths[m, i] = max(background[m] - total[i], 0.0) + (solid[m, i] if met[m] else 0.0)


@njit(inline="always", error_model="numpy")
def _cast(volume, solids, pose, at, count, background, edge_mu, work, lengths, order, seen):
    """Trace `count` sub-rays of a pixel: fill their path `lengths` [material, ray], and return in how many they differ.

    `order` gets the materials, those in which the rays differ first; of the others only the first ray's are filled.
    `seen` [variant, 2] gets the solids' least and largest thickness along them. `at` is (v, u) from the detector's
    centre, in pixels, and the column. What the solids replace is taken from the pixel's central ray, as is the rest of
    the volume.
    """
    code, slot, pool, density, grid = volume
    collecting, painting, met, total = work
    local, spans, made, solid = collecting
    ray, hits, covered, painted, pieces = painting
    v, u, column = at
    n_m = background.shape[0]
    for i in range(count):
        # a golden-section lattice has `count` distinct positions along u and along v
        du, dv = (i + 0.5) / count - 0.5, (i * GOLDEN + 0.5) % 1.0 - 0.5
        local[0, i], local[1, i], local[2, i], local[10, i] = towards(pose, u + du, v + dv)
    n = _collect(solids, pose, column, count, collecting, met)
    _seen(solid, met, count, edge_mu, total, seen)
    t, far = _reach(spans, n, count)
    aim(pose, u, v, ray)
    n_pieces = walk(code, slot, pool, density, grid, ray, t, far, pieces) if t < far else 0
    few = _order(met, pieces, n_pieces, painted, order)
    for c in range(few, n_m - 1):
        lengths[order[c], 0] = background[order[c], column]
    if n > MOST_COMPARED or _overlap(spans, n, count):
        for i in range(count):
            found = 0
            for k in range(n):
                if spans[k, 1, i] > spans[k, 0, i]:
                    hits[found, 0], hits[found, 1], hits[found, 2] = spans[k, 0, i], spans[k, 1, i], made[k]
                    found += 1
            if found:
                paint(hits, found, pieces, n_pieces, covered, painted)
            for c in range(few):
                m = order[c]
                rest = max(background[m, column] - covered[m], 0.0) + painted[m] if found else background[m, column]
                lengths[m, i] = rest
        return few
    _paint_apart(spans, n, (pieces, n_pieces), count, background[:, column], (order, few, met, solid), total, lengths)
    return few


@compiled_once(
    "int64",
    VOLUME,
    f"Tuple(({PRIMS}, {PRIMS}, {SHADOW}, {ACTIVE}, {NEAR}))",
    *(POSE, "int64", COLUMNS, BACKGROUND, RULES, EDGE, "float64[:,::1]", "float64[:,:,::1]", IMAGES, IMAGES),
)
def measure_edges(rays_at, volume, solids, pose, v, columns, background, rules, edge, changes, bounds, m1, m2):
    """Measure again, by several rays each, the pixels of row v that the edge of a solid crosses.

    A pixel whose mean is uncertain by more than the tolerance is measured again by more rays. `rays_at` is the address
    of `intersect_rays`.
    """
    prims, fat, shadow, active, near = solids
    edge_mu, _, _, most, tolerance = edge
    first, last, n_v = columns
    n_m, n_u = background.shape
    size, variants = most * MOST_TIMES, edge_mu.shape[0]
    # the path lengths of the numbers of rays that the pixel was measured by so far
    kept = 1 if variants == 1 else KEPT
    whole = -(-size // WIDTH) * WIDTH
    lengths, seen, counts = np.zeros((kept, n_m, whole), np.float32), np.empty((kept, variants, 2)), np.empty(kept)
    orders, few = np.zeros((kept, max(n_m - 1, 1)), np.int64), np.zeros(kept, np.int64)  # air, where nothing else is
    tau, s1, s2 = np.empty(whole, np.float32), np.empty(whole, np.float32), np.empty(whole, np.float32)
    same, sums = np.empty(rules[1].shape[1], np.float32), np.empty(5)
    grid, ray, pair, n = volume[4], np.empty(7), np.empty(4), 2 * active.size + 1
    collecting = np.empty((11, size)), np.empty((n, 2, size)), np.empty(n), np.empty((n_m, size))
    pieces = np.empty((int(grid[0] + grid[1] + grid[2]) + 8, 3))
    painting = ray, np.empty((n, 3)), np.empty(n_m), np.empty(n_m), pieces
    work = collecting, painting, np.empty(n_m), np.empty(size)
    traced = rays_at, prims, shadow, active
    thin = False
    for p in active:
        thin |= fat[p, 0] >= 0
    for u in range(first, last):
        if not near[u]:
            continue
        times, casts = 0, 0
        at = v - (n_v - 1) / 2, u - (n_u - 1) / 2, u
        if thin:
            aim(pose, at[1], at[0], ray)
            times = _grazes(fat, shadow, active, u, ray, pair)
        for j in range(variants):
            change = changes[j, u]
            if times == 0 and change == 0:
                continue
            share = min(1.0, (1.0 + change) / ALL_SUBRAYS)
            count = most * times if times else first_rung(max(2, int(most * share)), size)
            while True:
                k = 0
                while k < min(casts, kept) and counts[k] != count:
                    k += 1
                if k == min(casts, kept):  # not cast yet, or no longer kept
                    k = casts % kept
                    few[k] = _cast(
                        volume, traced, pose, at, count, background, edge_mu, work, lengths[k], orders[k], seen[k]
                    )
                    counts[k] = count
                    casts += 1
                signal_near(lengths, k, count, orders, few[k], rules, j, same, tau, s1, s2)
                _sums(s1, s2, count, sums)
                excess = _uncertainty(sums, count, seen, k, bounds, j, u) / tolerance
                if excess <= 1.0 or count == size:
                    break
                # the estimate sharpens with the rays, so a step is fourfold at most
                count = rung(int(count * min(max(excess, 1.2) ** LATTICE_ORDER, 4.0)) + 1, size)
            m1[j, v, u], m2[j, v, u] = (sums[2] + sums[3]) / count, sums[4] / count
