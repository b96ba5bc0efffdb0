"""Pixels that the edge of a solid crosses, measured by several rays and averaged in *intensity*, as a detector does.

Pixels whose rays disagree get more of them. What differs between the rays of a pixel is the solids, while the volume is
always that of the central ray. The number of rays is a rung of a ladder, so that variants of a scan, whose metal or
spectrum differs, mostly ask for the same rays: each number of rays of a pixel is cast once for all variants.
"""

import numpy as np
from numba import njit

from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.bricks_cpu import aim, walk
from ctsim.tracer.kernels.ray_cpu import collect, paint, signal, thickness
from ctsim.tracer.kernels.solids_cpu import intersect
from ctsim.tracer.shadow import MOST_TIMES

GOLDEN = 0.6180339887498949
ALL_SUBRAYS = 8.5  # a pixel across which the solids' optical thickness changes by 7.5 gets all, others a share
RANGE_SHARE = 0.5  # of the signal's range over the sub-rays: the error of their mean at least, where an edge crosses
LATTICE_ORDER = 4 / 3  # at an edge the mean of n lattice points is off by about n^(-3/4)
RUNGS = np.rint(34 * 2.0 ** np.arange(-4, 17)).astype(np.int64)
"""Numbers of rays that a pixel may get: 2, 4, 8, 17, 34, 68 and so on, each about twice the one before."""
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


@njit(cache=True, error_model="numpy")
def _uncertainty(signal, count, seen, bounds):
    """Estimate the relative error of the mean of `count` sub-rays.

    `seen` is the solids' (least, largest) thickness along them and `bounds` that at the pixel's corners and centre:
    where the bounds lie beyond, there is something brighter or darker that no sub-ray met. Half the difference of the
    means of even and odd sub-rays can be small by chance; a share of the signal's range / count cannot.
    """
    darkest, brightest, even, odd = signal[0], signal[0], 0.0, 0.0
    for i in range(count):
        darkest, brightest = min(darkest, signal[i]), max(brightest, signal[i])
        if i % 2:
            odd += signal[i]
        else:
            even += signal[i]
    if bounds[0] < seen[0]:  # nothing is brighter than the open field
        brightest = min(brightest * np.exp(min(seen[0] - bounds[0], 80.0)), max(1.0, brightest))
    if bounds[1] > seen[1]:
        darkest *= np.exp(seen[1] - bounds[1])
    halves = abs(even / (count - count // 2) - odd / (count // 2)) / 2
    return max(halves, RANGE_SHARE * (brightest - darkest) / count) * count / (even + odd)


@njit(inline="always", error_model="numpy")
def _cast(volume, solids, pose, at, count, background, edge_mu, work, lengths, seen):
    """Trace `count` sub-rays of a pixel: fill their path `lengths` [material, ray].

    `seen` [variant, 2] gets the solids' least and largest thickness along them. `at` is (v, u) from the detector's
    centre, in pixels, and the column. What the solids replace is taken from the pixel's central ray, as is the rest of
    the volume.
    """
    prims, shadow, active = solids
    code, slot, pool, density, grid = volume
    hits, found, ray, pair, covered, painted, pieces = work
    v, u, column = at
    n_m = background.shape[0]
    t, far = np.inf, -np.inf
    for j in range(edge_mu.shape[0]):
        seen[j, 0], seen[j, 1] = np.inf, 0.0
    for i in range(count):
        # a golden-section lattice has `count` distinct positions along u and along v
        du, dv = (i + 0.5) / count - 0.5, (i * GOLDEN + 0.5) % 1.0 - 0.5
        aim(pose, u + du, v + dv, ray)
        found[i] = collect(prims, shadow, active, column + du, ray, pair, hits[i])
        for k in range(found[i]):
            t, far = min(t, hits[i, k, 0]), max(far, hits[i, k, 1])
        for j in range(edge_mu.shape[0]):
            through = thickness(hits[i], found[i], edge_mu, j)
            seen[j, 0], seen[j, 1] = min(seen[j, 0], through), max(seen[j, 1], through)
    aim(pose, u, v, ray)
    n_pieces = walk(code, slot, pool, density, grid, ray, t, far, pieces) if t < far else 0
    for i in range(count):
        if found[i]:
            paint(hits[i], found[i], pieces, n_pieces, covered, painted)
            for m in range(1, n_m):
                lengths[m, i] = max(background[m, column] - covered[m], 0.0) + painted[m]
        else:
            for m in range(1, n_m):
                lengths[m, i] = background[m, column]


@compiled_once(
    VOLUME,
    f"Tuple(({PRIMS}, {PRIMS}, {SHADOW}, {ACTIVE}, {NEAR}))",
    *(POSE, "int64", COLUMNS, BACKGROUND, RULES, EDGE, "float64[:,::1]", "float64[:,:,::1]", IMAGES, IMAGES),
)
def measure_edges(volume, solids, pose, v, columns, background, rules, edge, changes, bounds, m1, m2):
    """Measure again, by several rays each, the pixels of row v that the edge of a solid crosses.

    A pixel whose mean is uncertain by more than the tolerance is measured again by more rays.
    """
    prims, fat, shadow, active, near = solids
    edge_mu, _, _, most, tolerance = edge
    first, last, n_v = columns
    n_m, n_u = background.shape
    size, variants = most * MOST_TIMES, edge_mu.shape[0]
    # the path lengths of the numbers of rays that the pixel was measured by so far
    kept = 1 if variants == 1 else KEPT
    lengths, seen, counts = np.zeros((kept, n_m, size), np.float32), np.empty((kept, variants, 2)), np.empty(kept)
    tau, s1, s2 = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    hits, ray, pair, found = (
        np.empty((size, 2 * active.size + 1, 3)),
        np.empty(7),
        np.empty(4),
        np.empty(size, np.int64),
    )
    grid = volume[4]
    covered, painted, pieces = np.empty(n_m), np.empty(n_m), np.empty((int(grid[0] + grid[1] + grid[2]) + 8, 3))
    work = hits, found, ray, pair, covered, painted, pieces
    traced = prims, shadow, active
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
                    _cast(volume, traced, pose, at, count, background, edge_mu, work, lengths[k], seen[k])
                    counts[k] = count
                    casts += 1
                signal(lengths[k], count, rules, j, tau, s1, s2)
                excess = _uncertainty(s1, count, seen[k, j], bounds[:, j, u]) / tolerance
                if excess <= 1.0 or count == size:
                    break
                # the estimate sharpens with the rays, so a step is fourfold at most
                count = rung(int(count * min(max(excess, 1.2) ** LATTICE_ORDER, 4.0)) + 1, size)
            m1[j, v, u], m2[j, v, u] = s1[:count].mean(), s2[:count].mean()
