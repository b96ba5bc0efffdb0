"""Solids and energies on top of the label volume's path lengths, fused per detector row.

What a pixel's central ray crosses in the label volume is given (`columns_cpu`, `density_cpu`, `bricks_cpu`). Solids are
intersected exactly and replace the volume along their intervals. Pixels that the edge of a solid crosses are
measured again by several rays (`subrays_cpu`). Rows are done in strips, so that neighbours share their pixels' corners;
a strip depends on no other, so results are bitwise equal for any number of threads. Variants of a scan, which differ
in metal or spectrum alone, are measured along the same rays, and each gets what it gets by itself. What runs once a row
is called by address (`ctsim.kernels.once`), so that it is compiled once. Arrays are copied in loops, since assigning to
a slice compiles the making of an error message.
"""

import functools

import numpy as np
from numba import njit, prange

from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels.bricks_cpu import aim, walk
from ctsim.tracer.kernels.ray_cpu import collect, paint, signal, thickness
from ctsim.tracer.kernels.rows_cpu import columns_near, fill_open, seen_in_row, trim
from ctsim.tracer.kernels.solids_cpu import intersect_rays
from ctsim.tracer.kernels.subrays_cpu import (
    ACTIVE,
    BACKGROUND,
    COLUMNS,
    EDGE,
    IMAGES,
    NEAR,
    POSE,
    PRIMS,
    RULES,
    SHADOW,
    VOLUME,
    measure_edges,
)

STRIP = 8  # rows done one after the other: they compute 9 rows of pixel corners instead of 16
ADDRESSES = "UniTuple(int64, 5)"  # of _measure_strip, _corners, _centres, measure_edges and intersect_rays


@compiled_once(PRIMS, SHADOW, ACTIVE, NEAR, POSE, "float64", "float64[:,::1]", "float64[:,::1]", "float64[::1]")
def _corners(prims, shadow, active, near, pose, v, edge_mu, out, hit):
    """Fill `out` [variant, u + 1] with the solids' thickness at the pixel corners at height v (from the centre).

    `hit` [u + 1] is the number of intervals there.
    """
    ray, pair, hits = np.empty(7), np.empty(4), np.empty((2 * active.size, 3))
    middle = (hit.size - 2) / 2
    for u in range(hit.size):
        hit[u] = 0.0
        for j in range(edge_mu.shape[0]):
            out[j, u] = 0.0
        if near[u]:
            aim(pose, u - 0.5 - middle, v, ray)
            n = collect(prims, shadow, active, u - 0.5, ray, pair, hits)
            hit[u] = n
            for j in range(edge_mu.shape[0]):
                out[j, u] = thickness(hits, n, edge_mu, j)


@compiled_once(
    VOLUME,
    f"Tuple(({PRIMS}, {SHADOW}, {ACTIVE}, {NEAR}, float64[:,::1]))",
    *(POSE, "int64", COLUMNS, BACKGROUND, "float32[:,:]", "float64[:,::1]"),
)
def _centres(volume, solids, pose, v, columns, background, lengths, centre):
    """Fill `lengths` [material, column] with a row's central rays, `centre` [variant, u] with solids' thickness."""
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
        n = collect(prims, shadow, active, u, ray, pair, hits)
        for j in range(edge_mu.shape[0]):
            centre[j, u] = thickness(hits, n, edge_mu, j)
        if n > 0:
            t, far = hits[0, 0], hits[0, 1]
            for i in range(1, n):
                t, far = min(t, hits[i, 0]), max(far, hits[i, 1])
            paint(hits, n, pieces, walk(code, slot, pool, density, grid, ray, t, far, pieces), covered, painted)
            for m in range(1, n_m):
                lengths[m, u - first] = max(background[m, u] - covered[m], 0.0) + painted[m]


@njit(cache=True, error_model="numpy")
def _spread(thick, hit, u, centre, bounds):
    """Fill `bounds` [2, variant, u] with the solids' least and largest thickness at a pixel's corners and centre.

    Return whether a solid begins within the pixel: some corners meet more solids than others.
    """
    for j in range(centre.shape[0]):
        a, b, c, d = thick[0, j, u], thick[0, j, u + 1], thick[1, j, u], thick[1, j, u + 1]
        bounds[0, j, u] = min(min(min(a, b), min(c, d)), centre[j, u])
        bounds[1, j, u] = max(max(max(a, b), max(c, d)), centre[j, u])
    a, b, c, d = hit[0, u], hit[0, u + 1], hit[1, u], hit[1, u + 1]
    return not (a == b and b == c and c == d)


@njit(cache=True, error_model="numpy")
def _measure_row(at, volume, solids, pose, v, span, background, rules, edge, skip, thick, hit, m1, m2):
    """Measure columns span[0]…span[1] of row v.

    `thick` [2, variant, u + 1] and `hit` [2, u + 1] are those of the corners below and above once it is done.
    """
    prims, fat, shadows = solids
    shadow = shadows[v]
    n_m, n_v, n_u = background.shape
    variants = m1.shape[0]
    active = seen_in_row(shadow)
    near = columns_near(shadow, active, n_u)
    edges = active.size > 0 and edge[3] > 1
    for u in range(n_u + 1):
        hit[0, u], hit[1, u] = hit[1, u], 0.0
        for j in range(variants):
            thick[0, j, u], thick[1, j, u] = thick[1, j, u], 0.0
    if edges:
        _corners(at[1], prims, shadow, active, near, pose, v + 0.5 - (n_v - 1) / 2, edge[0], thick[1], hit[1])
    row = background[:, v]
    first, last = trim(row, span, near, skip)
    for j in range(variants):
        fill_open(rules, j, span, (first, last), m1[j, v], m2[j, v])
    if first >= last:
        return
    size, columns = last - first, (first, last, n_v)
    lengths, centre = np.zeros((n_m, size), np.float32), np.zeros((variants, n_u))
    tau, s1, s2 = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    _centres(at[2], volume, (prims, shadow, active, near, edge[0]), pose, v, columns, row, lengths, centre)
    for j in range(variants):
        signal(lengths, size, rules, j, tau, s1, s2)
        for u in range(size):
            m1[j, v, first + u], m2[j, v, first + u] = s1[u], s2[u]
    if edges:
        bounds = np.empty((2, variants, n_u))
        for u in range(first, last):
            # where a solid begins the change is not linear, and less of it matters
            limit = edge[2] if _spread(thick, hit, u, centre, bounds) else edge[1]
            for j in range(variants):
                change = bounds[1, j, u] - bounds[0, j, u]
                centre[j, u] = change if change > limit else 0.0
        found = (prims, fat, shadow, active, near)
        measure_edges(at[3], at[4], volume, found, pose, v, columns, row, rules, edge, centre, bounds, m1, m2)


@compiled_once(
    ADDRESSES,
    VOLUME,
    f"Tuple(({PRIMS}, {PRIMS}, int64[:,:,::1]))",
    *(POSE, "int64", "int64[:,::1]", "float32[:,:,::1]", RULES, EDGE, "boolean", IMAGES, IMAGES),
)
def _measure_strip(at, volume, solids, pose, first, spans, background, rules, edge, skip, m1, m2):
    variants, n_v, n_u = m1.shape
    thick, hit = np.zeros((2, variants, n_u + 1)), np.zeros((2, n_u + 1))
    shadow = solids[2][first]
    active = seen_in_row(shadow)
    if active.size > 0 and edge[3] > 1:
        near = columns_near(shadow, active, n_u)
        v = first - 0.5 - (n_v - 1) / 2
        _corners(at[1], solids[0], shadow, active, near, pose, v, edge[0], thick[1], hit[1])
    for v in range(first, min(first + STRIP, n_v)):
        _measure_row(at, volume, solids, pose, v, spans[v], background, rules, edge, skip, thick, hit, m1, m2)


@njit(parallel=True, cache=True, error_model="numpy")
def _measure_strips(at, volume, solids, pose, order, spans, background, rules, edge, skip, m1, m2):
    for index in prange(order.size):
        _measure_strip(
            at[0], at, volume, solids, pose, order[index] * STRIP, spans, background, rules, edge, skip, m1, m2
        )


def transmit_variants(volume, solids, pose, order, spans, background, rules, edge, skip, m1, m2):
    """Measure one view of several variants: mean signal `m1`, second moment `m2` [variant, v, u] over the open field.

    `volume` is (code, slot, pool, density, grid) of `ctsim.tracer.bricks.Bricks` and `background` [material, v, u]
    (mm, float32) what the central rays cross in it. `solids` is (prims, fat, shadows): primitive rows, their
    inflated twins and the columns in which they are seen (`ctsim.tracer.shadow.inflate` and `cast`). `pose` [12];
    `order` [strip] is the order of work; only columns spans[row] = (from, to) are touched. `rules` is
    (mu [variant, material, node] 1/mm, w1 [variant, node], w2 [variant, node], number of nodes [variant]); `edge` is
    (edge_mu [variant, material], least change of optical thickness that takes sub-rays, the same where a solid begins,
    most sub-rays of a pixel at first, estimated relative error of its signal above which it gets up to `MOST_TIMES` as
    many). Without `skip`, rays that meet nothing are traced, too.
    """
    _measure_strips(_addresses(), volume, solids, pose, order, spans, background, rules, edge, skip, m1, m2)


def transmit_view(volume, solids, pose, order, spans, background, rule, edge, skip, m1, m2):
    """Measure one view of one variant, as `transmit_variants` does: `m1` and `m2` [v, u].

    `rule` is (mu [material, node], w1 [node], w2 [node]); the first of `edge` is edge_mu [material].
    """
    mu, w1, w2 = (np.ascontiguousarray(part)[None] for part in rule)  # a slice of the nodes, too
    rules, edges = (mu, w1, w2, np.array([w1.shape[1]])), (edge[0][None], *edge[1:])
    transmit_variants(volume, solids, pose, order, spans, background, rules, edges, skip, m1[None], m2[None])


@functools.cache
def _addresses():
    called = _measure_strip, _corners, _centres, measure_edges, intersect_rays
    return tuple(function.address() for function in called)


@njit(cache=True, error_model="numpy")
def _replace_row(centres, volume, solids, pose, v, background, lengths):
    prims, _, shadows = solids
    shadow = shadows[v]
    _, n_v, n_u = background.shape
    active = seen_in_row(shadow)
    found = (prims, shadow, active, columns_near(shadow, active, n_u), np.zeros((1, lengths.shape[0])))
    _centres(centres, volume, found, pose, v, (0, n_u, n_v), background[:, v], lengths[:, v], np.zeros((1, n_u)))


@njit(parallel=True, cache=True, error_model="numpy")
def _replace_rows(centres, volume, solids, pose, order, background, lengths):
    for index in prange(order.size):
        _replace_row(centres, volume, solids, pose, order[index], background, lengths)


def replace_view(volume, solids, pose, order, background, lengths):
    """Fill `lengths` [material, v, u] (mm) of the central rays: `background`, but for the solids."""
    _replace_rows(_centres.address(), volume, solids, pose, order, background, lengths)
