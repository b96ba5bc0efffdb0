"""Solids and energies on top of the label volume's path lengths, fused per detector row.

What a pixel's central ray crosses in the label volume is given (`columns_cpu`, `density_cpu`, `bricks_cpu`). Solids are
intersected exactly and replace the volume along their intervals. Pixels that the edge of a solid crosses are
measured by several rays and averaged in *intensity*, as a detector does, and by more where these disagree; what
differs between those rays is the solids, while the volume is always that of the central ray. Rows are done in strips,
so that neighbours share their pixels' corners; a strip depends on no other, so results are bitwise equal for any
number of threads. What runs once a ray is inlined: a call would count references of its arrays atomically, which
costs more than the ray. What runs once a row is called by address (`ctsim.kernels.once`), so that it is compiled
once. Arrays are copied in loops, since assigning to a slice compiles the making of an error message.
"""

import functools

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.bricks_cpu import add_pieces, aim, walk
from ctsim.tracer.kernels.exp_cpu import exp_minus
from ctsim.tracer.kernels.rows_cpu import columns_near, fill_open, seen_in_row, trim
from ctsim.tracer.kernels.solids_cpu import intersect
from ctsim.tracer.shadow import MOST_TIMES

STRIP = 8  # rows done one after the other: they compute 9 rows of pixel corners instead of 16
GOLDEN = 0.6180339887498949
ALL_SUBRAYS = 8.5  # a pixel across which the solids' optical thickness changes by 7.5 gets all, others a share
RANGE_SHARE = 0.5  # of the signal's range over the sub-rays: the error of their mean at least, where an edge crosses
LATTICE_ORDER = 4 / 3  # at an edge the mean of n lattice points is off by about n^(-3/4)
FAST = {"contract", "reassoc", "nsz", "arcp"}

# Numba types of arguments, named as in `transmit_view`
ADDRESSES = "UniTuple(int64, 4)"  # of _measure_strip, _corners, _centres and _edges
VOLUME = "Tuple((uint16[:,:,:,::1], int32[:,:,::1], uint8[::1], float32[::1], float64[::1]))"
PRIMS, SHADOW, ACTIVE, NEAR = "float64[:,::1]", "int64[:,::1]", "int64[::1]", "bool_[::1]"
RULE = "Tuple((float32[:,::1], float32[::1], float32[::1]))"
EDGE = "Tuple((float64[::1], float64, float64, int64, float64))"
POSE, COLUMNS, BACKGROUND = "float64[::1]", "UniTuple(int64, 3)", "float32[:,:]"


@njit(inline="always", error_model="numpy")
def _collect(prims, shadow, active, u, ray, pair, hits):
    """List the intervals of the active primitives near column u as (enter, leave, material); return how many."""
    n = 0
    for p in active:
        if u < shadow[p, 0] or u > shadow[p, 1]:
            continue
        for i in range(intersect(prims[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * i], 0.0), min(pair[2 * i + 1], ray[6])
            if leave > enter:
                hits[n, 0], hits[n, 1], hits[n, 2] = enter, leave, prims[p, 1]
                n += 1
    return n


@njit(inline="always", error_model="numpy")
def _paint(hits, n, pieces, n_pieces, covered, painted):
    """Set a ray's path lengths in the n solids hit, in paint order, and in the volume's pieces that they replace."""
    covered[:] = 0.0
    painted[:] = 0.0
    t, far = hits[0, 0], hits[0, 1]
    for i in range(1, n):
        t, far = min(t, hits[i, 0]), max(far, hits[i, 1])
    while t < far:
        # the topmost interval that covers t decides, until it ends or one painted later begins
        top, until = -1, far
        for i in range(n):
            if hits[i, 0] <= t < hits[i, 1]:
                top = i
        if top >= 0:
            until = hits[top, 1]
        for i in range(top + 1, n):
            if t < hits[i, 0] < until:
                until = hits[i, 0]
        if top >= 0:
            painted[int(hits[top, 2])] += until - t
            add_pieces(pieces, n_pieces, t, until, covered)
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


@njit(inline="always", error_model="numpy")
def _grazes(fat, shadow, active, u, ray, pair):
    """Return how many times the usual sub-rays a primitive needs that can hide between a pixel's corners."""
    times = 0
    for p in active:
        near = fat[p, 0] >= 0 and shadow[p, 0] <= u <= shadow[p, 1]
        if near and intersect(fat[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair) > 0:
            times = max(times, int(fat[p, 1]))
    return times


@compiled_once(PRIMS, SHADOW, ACTIVE, NEAR, POSE, "float64", "float64[::1]", "float64[::1]", "float64[::1]")
def _corners(prims, shadow, active, near, pose, v, edge_mu, out, hit):
    """Fill `out` [u + 1] with the solids' thickness at the pixel corners at height v (from the detector's centre).

    `hit` [u + 1] is the number of intervals there.
    """
    ray, pair, hits = np.empty(7), np.empty(4), np.empty((2 * active.size, 3))
    middle = (out.size - 2) / 2
    for u in range(out.size):
        out[u], hit[u] = 0.0, 0.0
        if near[u]:
            aim(pose, u - 0.5 - middle, v, ray)
            n = _collect(prims, shadow, active, u - 0.5, ray, pair, hits)
            out[u], hit[u] = _thickness(hits, n, edge_mu), n


@compiled_once(
    VOLUME,
    f"Tuple(({PRIMS}, {SHADOW}, {ACTIVE}, {NEAR}, float64[::1]))",
    *(POSE, "int64", COLUMNS, BACKGROUND, "float32[:,:]", "float64[::1]"),
)
def _centres(volume, solids, pose, v, columns, background, lengths, centre):
    """Fill `lengths` [material, column] with the central rays of a row and `centre` [u] with the solids' thickness."""
    prims, shadow, active, near, edge_mu = solids
    first, last, n_v = columns
    n_m, n_u = background.shape
    for m in range(1, n_m):
        for u in range(first, last):
            lengths[m, u - first] = background[m, u]
    code, slot, pool, density, grid = volume
    ray, pair, hits = np.empty(7), np.empty(4), np.empty((2 * active.size + 1, 3))
    covered, painted, pieces = np.empty(n_m), np.empty(n_m), np.empty((int(grid[0] + grid[1] + grid[2]) + 8, 3))
    for u in range(first, last):
        if not near[u]:
            continue
        aim(pose, u - (n_u - 1) / 2, v - (n_v - 1) / 2, ray)
        n = _collect(prims, shadow, active, u, ray, pair, hits)
        centre[u] = _thickness(hits, n, edge_mu)
        if n > 0:
            t, far = hits[0, 0], hits[0, 1]
            for i in range(1, n):
                t, far = min(t, hits[i, 0]), max(far, hits[i, 1])
            _paint(hits, n, pieces, walk(code, slot, pool, density, grid, ray, t, far, pieces), covered, painted)
            for m in range(1, n_m):
                lengths[m, u - first] = max(background[m, u] - covered[m], 0.0) + painted[m]


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
def _cast(volume, solids, pose, at, count, background, edge_mu, work):
    """Trace `count` sub-rays of a pixel: fill their path lengths, return the solids' (least, largest) thickness.

    `at` is (v, u) from the detector's centre, in pixels, and the column. What the solids replace is taken from the
    pixel's central ray, as is the rest of the volume.
    """
    prims, shadow, active = solids
    code, slot, pool, density, grid = volume
    lengths, hits, found, ray, pair, covered, painted, pieces = work
    v, u, column = at
    n_m = background.shape[0]
    t, far, thinnest, thickest = np.inf, -np.inf, np.inf, 0.0
    for i in range(count):
        # a golden-section lattice has `count` distinct positions along u and along v
        du, dv = (i + 0.5) / count - 0.5, (i * GOLDEN + 0.5) % 1.0 - 0.5
        aim(pose, u + du, v + dv, ray)
        found[i] = _collect(prims, shadow, active, column + du, ray, pair, hits[i])
        for k in range(found[i]):
            t, far = min(t, hits[i, k, 0]), max(far, hits[i, k, 1])
        thickness = _thickness(hits[i], found[i], edge_mu)
        thinnest, thickest = min(thinnest, thickness), max(thickest, thickness)
    aim(pose, u, v, ray)
    n_pieces = walk(code, slot, pool, density, grid, ray, t, far, pieces) if t < far else 0
    for i in range(count):
        if found[i]:
            _paint(hits[i], found[i], pieces, n_pieces, covered, painted)
            for m in range(1, n_m):
                lengths[m, i] = max(background[m, column] - covered[m], 0.0) + painted[m]
        else:
            for m in range(1, n_m):
                lengths[m, i] = background[m, column]
    return thinnest, thickest


@compiled_once(
    VOLUME,
    f"Tuple(({PRIMS}, {PRIMS}, {SHADOW}, {ACTIVE}, {NEAR}))",
    *(POSE, "int64", COLUMNS, BACKGROUND, RULE, EDGE, "float64[::1]", "float64[:,::1]", "float32[::1]", "float32[::1]"),
)
def _edges(volume, solids, pose, v, columns, background, rule, edge, changes, bounds, m1, m2):
    """Measure again, by several rays each, the pixels of a row that the edge of a solid crosses.

    A pixel whose mean is uncertain by more than the tolerance is measured again by more rays.
    """
    prims, fat, shadow, active, near = solids
    mu, w1, w2 = rule
    edge_mu, _, _, most, tolerance = edge
    first, last, n_v = columns
    n_m, n_u = background.shape
    size = most * MOST_TIMES
    lengths, hits = np.zeros((n_m, size), np.float32), np.empty((size, 2 * active.size + 1, 3))
    tau, s1, s2 = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    ray, pair, found = np.empty(7), np.empty(4), np.empty(size, np.int64)
    grid = volume[4]
    covered, painted, pieces = np.empty(n_m), np.empty(n_m), np.empty((int(grid[0] + grid[1] + grid[2]) + 8, 3))
    work = lengths, hits, found, ray, pair, covered, painted, pieces
    thin = False
    for p in active:
        thin |= fat[p, 0] >= 0
    for u in range(first, last):
        if not near[u]:
            continue
        times = 0
        at = v - (n_v - 1) / 2, u - (n_u - 1) / 2, u
        if thin:
            aim(pose, at[1], at[0], ray)
            times = _grazes(fat, shadow, active, u, ray, pair)
        if times == 0 and changes[u] == 0:
            continue
        count = most * times if times else max(2, int(most * min(1.0, (1.0 + changes[u]) / ALL_SUBRAYS)))
        while True:
            seen = _cast(volume, (prims, shadow, active), pose, at, count, background, edge_mu, work)
            _signal(lengths, count, mu, w1, w2, tau, s1, s2)
            excess = _uncertainty(s1, count, seen, bounds[:, u]) / tolerance
            if excess <= 1.0 or count == size:
                break
            # the estimate sharpens with the rays, so a step is fourfold at most
            count = min(int(count * min(max(excess, 1.2) ** LATTICE_ORDER, 4.0)) + 1, size)
        m1[u], m2[u] = s1[:count].mean(), s2[:count].mean()


@njit(cache=True, error_model="numpy")
def _measure_row(at, volume, solids, pose, v, span, background, rule, edge, skip, corners, m1, m2):
    """Measure columns span[0]…span[1] of row v; `corners` [4, u + 1] are those below and above once it is done."""
    prims, fat, shadows = solids
    shadow = shadows[v]
    mu, w1, w2 = rule
    n_m, n_v, n_u = background.shape
    active = seen_in_row(shadow)
    near = columns_near(shadow, active, n_u)
    edges = active.size > 0 and edge[3] > 1
    for u in range(n_u + 1):
        corners[0, u], corners[2, u] = corners[1, u], corners[3, u]
        corners[1, u], corners[3, u] = 0.0, 0.0
    if edges:
        _corners(at[1], prims, shadow, active, near, pose, v + 0.5 - (n_v - 1) / 2, edge[0], corners[1], corners[3])
    row = background[:, v]
    first, last = trim(row, span, near, skip)
    fill_open(rule, span, (first, last), m1[v], m2[v])
    if first >= last:
        return
    size, columns = last - first, (first, last, n_v)
    lengths, centre = np.zeros((n_m, size), np.float32), np.zeros(n_u)
    tau, s1, s2 = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    _centres(at[2], volume, (prims, shadow, active, near, edge[0]), pose, v, columns, row, lengths, centre)
    _signal(lengths, size, mu, w1, w2, tau, s1, s2)
    for u in range(size):
        m1[v, first + u], m2[v, first + u] = s1[u], s2[u]
    if edges:
        bounds = np.empty((2, n_u))
        for u in range(first, last):
            a, b, c, d = corners[0, u], corners[0, u + 1], corners[1, u], corners[1, u + 1]
            bounds[0, u] = min(min(min(a, b), min(c, d)), centre[u])
            bounds[1, u] = max(max(max(a, b), max(c, d)), centre[u])
            change = bounds[1, u] - bounds[0, u]
            a, b, c, d = corners[2, u], corners[2, u + 1], corners[3, u], corners[3, u + 1]
            # where a solid begins the change is not linear, and less of it matters
            limit = edge[1] if a == b and b == c and c == d else edge[2]
            centre[u] = change if change > limit else 0.0
        found = (prims, fat, shadow, active, near)
        _edges(at[3], volume, found, pose, v, columns, row, rule, edge, centre, bounds, m1[v], m2[v])


@compiled_once(
    ADDRESSES,
    VOLUME,
    f"Tuple(({PRIMS}, {PRIMS}, int64[:,:,::1]))",
    *(POSE, "int64", "int64[:,::1]", "float32[:,:,::1]", RULE, EDGE, "boolean", "float32[:,::1]", "float32[:,::1]"),
)
def _measure_strip(at, volume, solids, pose, first, spans, background, rule, edge, skip, m1, m2):
    n_v, n_u = m1.shape
    corners = np.zeros((4, n_u + 1))
    shadow = solids[2][first]
    active = seen_in_row(shadow)
    if active.size > 0 and edge[3] > 1:
        near = columns_near(shadow, active, n_u)
        v = first - 0.5 - (n_v - 1) / 2
        _corners(at[1], solids[0], shadow, active, near, pose, v, edge[0], corners[1], corners[3])
    for v in range(first, min(first + STRIP, n_v)):
        _measure_row(at, volume, solids, pose, v, spans[v], background, rule, edge, skip, corners, m1, m2)


@njit(parallel=True, cache=True, error_model="numpy")
def _measure_strips(at, volume, solids, pose, order, spans, background, rule, edge, skip, m1, m2):
    for index in prange(order.size):
        _measure_strip(
            at[0], at, volume, solids, pose, order[index] * STRIP, spans, background, rule, edge, skip, m1, m2
        )


def transmit_view(volume, solids, pose, order, spans, background, rule, edge, skip, m1, m2):
    """Measure one view: mean signal `m1` and second moment `m2` [v, u] relative to the open field.

    `volume` is (code, slot, pool, density, grid) of `ctsim.tracer.bricks.Bricks` and `background` [material, v, u]
    (mm, float32) what the central rays cross in it. `solids` is (prims, fat, shadows): primitive rows, their
    inflated twins and the columns in which they are seen (`ctsim.tracer.shadow.inflate` and `cast`). `pose` [12];
    `order` [strip] is the order of work; only columns spans[row] = (from, to) are touched. `rule` is
    (mu [material, node] 1/mm, w1 [node], w2 [node]); `edge` is (edge_mu [material], least change of
    optical thickness that takes sub-rays, the same where a solid begins, most sub-rays of a pixel at first, estimated
    relative error of its signal above which it gets up to `MOST_TIMES` as many). Without `skip`, rays that
    meet nothing are traced, too.
    """
    rule = np.ascontiguousarray(rule[0]), *rule[1:]  # a slice of the nodes, too
    _measure_strips(_addresses(), volume, solids, pose, order, spans, background, rule, edge, skip, m1, m2)


@functools.cache
def _addresses():
    return _measure_strip.address(), _corners.address(), _centres.address(), _edges.address()


@njit(cache=True, error_model="numpy")
def _replace_row(centres, volume, solids, pose, v, background, lengths):
    prims, _, shadows = solids
    shadow = shadows[v]
    _, n_v, n_u = background.shape
    active = seen_in_row(shadow)
    found = (prims, shadow, active, columns_near(shadow, active, n_u), np.zeros(lengths.shape[0]))
    _centres(centres, volume, found, pose, v, (0, n_u, n_v), background[:, v], lengths[:, v], np.zeros(n_u))


@njit(parallel=True, cache=True, error_model="numpy")
def _replace_rows(centres, volume, solids, pose, order, background, lengths):
    for index in prange(order.size):
        _replace_row(centres, volume, solids, pose, order[index], background, lengths)


def replace_view(volume, solids, pose, order, background, lengths):
    """Fill `lengths` [material, v, u] (mm) of the central rays: `background`, but for the solids."""
    _replace_rows(_centres.address(), volume, solids, pose, order, background, lengths)
