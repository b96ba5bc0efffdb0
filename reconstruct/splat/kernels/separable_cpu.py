"""Line integrals of equal round splats that stand in upright runs, and their transpose (numba).

Where the rotation axis and the detector's columns are parallel to z, all splats of one (x, y) have their shadows in the
same detector columns. A run's profile along v is summed first and laid over the few detector columns once. A splat's
shadow is taken as exp(−½ du²/S_uu − ½ dv²/S_vv), of the mass that EWA gives it (`splat_cpu`): the separable footprint
of Long, Fessler and Balter (IEEE Trans. Med. Imaging 29, 2010, doi:10.1109/TMI.2010.2050898) with Gaussians. What it
leaves out is S_uv, of the order of u·v/dsd² of the others.

Where splats are about as far apart as rows, and rows go up with z, a profile has a row in each lane, and splats pass by
in step: the lanes see neighbours, which lie together in memory. Elsewhere, as in a detector counted from the top, most
of that would lie beyond the cutoff, and a profile is summed over pairs of splats, for half as many rows as a register
has lanes. The transpose has splats in the lanes, and rows pass by or come in pairs. Sums stay in registers. Both take
the same pairs of splat and row, since what lies beyond a splat's cutoff is zero.

Splats are ordered by run, z ascending in even steps: `runs` holds xy float64 [run, 2], the starts [run + 1] of runs in
z float32 [1, splat + WIDTH], both mm, and the most splats that a run has. Images are float32
[channel · u, v + WIDTH], transposed and with WIDTH columns of scratch.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.lanes import (
    WIDTH,
    add,
    decay,
    div,
    evens,
    fma,
    load,
    lower,
    mul,
    odds,
    pair,
    pick,
    ramp,
    spread,
    sqrt,
    store,
    sub,
    upper,
)
from ctsim.kernels.once import compiled_once
from ctsim.reconstruct.splat.kernels.splat_cpu import (
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

HALF = WIDTH // 2  # rows, or splats, that are done at a time in pairs, each with two of the other
RUNS = 256  # in a task of the transpose
RUNS_TYPE = "Tuple((float64[:,::1], int64[::1], float32[:,::1], int64))"  # of `runs`, in Numba's words
SLACK = 1e-3  # of a splat and of a row: ranges are wider by that, so that the cutoff alone decides, not rounding
HALF_LOG2E = 0.5 * math.log2(math.e)  # exponents are of 2, which saves a product each
ROW, FALLING, PEAKS, FIRST, SECOND = range(5)  # of a run's table [5, splat]: row, −HALF_LOG2E/S_vv, peak, two channels
LEAD = WIDTH  # places before a table's first splat, and a profile's first row, that lanes may see
MOST = 2 * WIDTH  # neighbours that pass by, at most
SPARSE, DENSE = 0.7, 1.7  # splats a row, within which they pass by in step
# what a run has in common: u, S_uu, v per mm of z, S_vv's two parts, |ray|²'s two, and the peak over √S_vv
U0, S_UU, PER_Z, S_VV, S_VV_2, RAY, RAY_2, W0 = range(8)
PLACE = 8


@njit(cache=True, error_model="numpy")
def _place(camera, x, y, scale, place):
    """Write what a run's splats share; return whether it lies before the source."""
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
    """Return the cutoff in rows of the run's widest shadow."""
    at = max(abs(place[PER_Z] * (z_first - camera[SOURCE + 2])), abs(place[PER_Z] * (z_last - camera[SOURCE + 2])))
    return camera[CUTOFF] * math.sqrt(place[S_VV] + place[S_VV_2] * at * at)


@njit(cache=True, error_model="numpy", inline="always")
def _row(camera, place, z):
    return place[PER_Z] * (z - camera[SOURCE + 2]) - camera[ORIGIN_V]


@njit(cache=True, error_model="numpy", inline="always")
def _shadows(camera, place, z, bounds, table):
    """Write the rows, −HALF_LOG2E/S_vv and peaks of a run's splats."""
    source, origin = spread(np.float32(-camera[SOURCE + 2])), spread(np.float32(-camera[ORIGIN_V]))
    per_z, peak = spread(np.float32(place[PER_Z])), spread(np.float32(place[W0]))
    across, along = spread(np.float32(place[S_VV])), spread(np.float32(place[S_VV_2]))
    ray, ray_2 = spread(np.float32(place[RAY])), spread(np.float32(place[RAY_2]))
    one, half = spread(np.float32(1)), spread(np.float32(-HALF_LOG2E))
    for i in range(bounds[0], bounds[1], WIDTH):
        cz = add(load(z, 0, i), source)
        at = mul(per_z, cz)
        over = div(one, fma(mul(at, at), along, across))
        k = LEAD + i - bounds[0]
        store(table, ROW, k, add(at, origin))
        store(table, FALLING, k, mul(half, over))
        store(table, PEAKS, k, mul(peak, sqrt(mul(fma(mul(cz, cz), ray_2, ray), over))))


@njit(cache=True, error_model="numpy", inline="always")
def _columns(camera, place, n_u):
    reach = camera[CUTOFF] * math.sqrt(place[S_UU])
    centre = min(max(place[U0], -1e9), 1e9)
    return max(0, int(math.ceil(centre - reach))), min(n_u, int(math.floor(centre + reach)) + 1)


@njit(cache=True, error_model="numpy", inline="always")
def _gains(camera, place, left, right, gains):
    """Write to gains [1, u − left] what the columns left … right − 1 have of a shadow."""
    falling, least = spread(np.float32(-HALF_LOG2E / place[S_UU])), _least(camera)
    for u in range(left, right, WIDTH):
        t = ramp(np.float32(u - place[U0]))
        store(gains, 0, u - left, decay(mul(mul(t, t), falling), least))


@njit(cache=True, error_model="numpy", inline="always")
def _least(camera):
    """Return the exponent of 2 at the cutoff."""
    return spread(np.float32(-HALF_LOG2E * camera[CUTOFF] * camera[CUTOFF]))


@njit(cache=True, error_model="numpy")
def _window(at, scale, camera, z, bounds, size, place):
    """Place a run; return the half-open ranges of u and v within the detector that it reaches, and its reach in v.

    All are 0 where it throws no shadow on the detector of `size` (v, u).
    """
    n_v, n_u = size
    if not _place(camera, at[0], at[1], scale, place):
        return 0, 0, 0, 0, 0.0
    left, right = _columns(camera, place, n_u)
    ends = z[0, bounds[0]], z[0, bounds[1] - 1]
    reach = _reach_v(camera, place, ends[0], ends[1])
    a, b = _row(camera, place, ends[0]), _row(camera, place, ends[1])
    low = min(max(min(a, b) - reach - SLACK, -1e9), 1e9)
    high = min(max(max(a, b) + reach + SLACK, -1e9), 1e9)
    first, last = max(0, int(math.ceil(low))), min(n_v, int(math.floor(high)) + 1)
    if left >= right or first >= last:
        return 0, 0, 0, 0, 0.0
    return left, right, first, last, reach


@njit(cache=True, error_model="numpy", inline="always")
def _weighted(values, bounds, table):
    """Write a run's values times peaks, and zeros behind."""
    n, half, zero = bounds[1] - bounds[0], WIDTH // 2, spread(np.float32(0))
    whole = n // WIDTH * WIDTH
    for k in range(0, whole, WIDTH):
        a, b = load(values, bounds[0] + k, 0), load(values, bounds[0] + k + half, 0)  # channels in turns
        store(table, FIRST, LEAD + k, mul(evens(a, b), load(table, PEAKS, LEAD + k)))
        store(table, SECOND, LEAD + k, mul(odds(a, b), load(table, PEAKS, LEAD + k)))
    for k in range(whole, n):
        table[FIRST, LEAD + k] = values[bounds[0] + k, 0] * table[PEAKS, LEAD + k]
        table[SECOND, LEAD + k] = values[bounds[0] + k, 1] * table[PEAKS, LEAD + k]
    for k in range(LEAD + n, LEAD + n + WIDTH + MOST, WIDTH):
        store(table, FIRST, k, zero)
        store(table, SECOND, k, zero)


@njit(cache=True, error_model="numpy", inline="always")
def _filled(values, first, last):
    """Return the part of a run between its outermost splats that are not 0: a body's air costs nothing."""
    while first < last and values[first, 0] == 0 and values[first, 1] == 0:
        first += 1
    while last > first and values[last - 1, 0] == 0 and values[last - 1, 1] == 0:
        last -= 1
    return first, last


@njit(cache=True, error_model="numpy", inline="always")
def _pairs(span, n):
    """Return how many pairs hold all that a span of a row of n holds, wherever it begins."""
    return (min(int(math.floor(span)) + 1, n) + 1) // 2


@njit(cache=True, error_model="numpy", inline="always")
def _start(first, n, pairs):
    """Return where pairs begin that reach from `first` on: further in at the ends of a row of n."""
    return max(0, min(int(math.ceil(min(max(first, -1e9), 1e9))), n - 2 * pairs))


@njit(cache=True, error_model="numpy", inline="always")
def _paired(a, b):
    """Return the sums of the pairs of lanes of a and on through b."""
    return add(evens(a, b), odds(a, b))


@njit(cache=True, error_model="numpy", inline="always")
def _passing(step, wide):
    """Return how far before the first lane's place to begin, and how many neighbours then pass by every lane.

    They are those within `wide` of a lane's place. Places are `step` neighbours apart, so that they drift from the
    lanes by `step` − 1 each.
    """
    drift = (WIDTH - 1) * (step - 1)
    return wide - min(drift, 0.0), int(math.floor(2 * wide + abs(drift))) + 1


@njit(cache=True, error_model="numpy", inline="always")
def _in_step(a_row, n):
    """Return whether neighbours pass by where there are `a_row` splats to a row, `n` of them to each lane."""
    return SPARSE <= a_row <= DENSE and n <= MOST


@njit(cache=True, error_model="numpy", inline="always")
def _begin(first, n):
    """Return the integer from which what passes by begins: not before −WIDTH, nor beyond n, where nothing is missed."""
    return int(math.ceil(min(max(first, -WIDTH), n)))


@njit(cache=True, error_model="numpy", inline="always")
def _lay(a, b, gains, left, right, v, image, n_u):
    """Add a profile's rows from v on, of both channels, to the columns of a shadow."""
    for u in range(left, right):
        g = pick(gains, 0, u - left)
        store(image, u, v, fma(g, a, load(image, u, v)))
        store(image, n_u + u, v, fma(g, b, load(image, n_u + u, v)))


@compiled_once(RUNS_TYPE, "float32[:,::1]", "float64", "float64[::1]", "float32[:,::1]")
def _forward_view(runs, values, scale, camera, image):
    xy, starts, z, tallest = runs
    n_u, n_v = image.shape[0] // 2, image.shape[1] - WIDTH
    place, least, zero = np.empty(PLACE), _least(camera), spread(np.float32(0))
    twice = lower(ramp(np.float32(0)), ramp(np.float32(0)))
    table, gains = np.zeros((5, tallest + 2 * WIDTH + MOST), np.float32), np.empty((1, n_u + WIDTH), np.float32)
    for run in range(xy.shape[0]):
        bounds = _filled(values, starts[run], starts[run + 1])
        if bounds[0] == bounds[1]:
            continue
        left, right, low, high, reach = _window(xy[run], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        _shadows(camera, place, z, bounds, table)
        _weighted(values, bounds, table)
        _gains(camera, place, left, right, gains)
        n, lowest = bounds[1] - bounds[0], _row(camera, place, z[0, bounds[0]])
        highest = _row(camera, place, z[0, bounds[1] - 1])
        a_row = (n - 1) / (highest - lowest) if highest != lowest else 0.0  # splats, of either sign
        wide = abs(a_row) * (reach + SLACK) + SLACK
        before, passing = _passing(a_row, wide)
        if _in_step(a_row, passing):
            for v in range(low, high, WIDTH):
                first = LEAD + _begin((v - lowest) * a_row - before, n)
                rows, a, b = ramp(np.float32(v)), zero, zero
                for k in range(first, first + passing):
                    t = sub(rows, load(table, ROW, k))
                    g = decay(mul(mul(t, t), load(table, FALLING, k)), least)
                    a = fma(g, load(table, FIRST, k), a)
                    b = fma(g, load(table, SECOND, k), b)
                _lay(a, b, gains, left, right, v, image, n_u)
            continue
        wide += abs(a_row) * 0.5 * (HALF - 1)
        pairs = _pairs(2 * wide, n)
        for v in range(low, high, WIDTH):
            middle = (v + 0.5 * (HALF - 1) - lowest) * a_row
            k = LEAD + _start(middle - wide, n, pairs)
            m = LEAD + _start(middle + HALF * a_row - wide, n, pairs)
            rows, later = add(twice, spread(np.float32(v))), add(twice, spread(np.float32(v + HALF)))
            a, b, c, d = zero, zero, zero, zero
            for _ in range(pairs):
                t = sub(rows, pair(table, ROW, k))
                g = decay(mul(mul(t, t), pair(table, FALLING, k)), least)
                a = fma(g, pair(table, FIRST, k), a)
                b = fma(g, pair(table, SECOND, k), b)
                t = sub(later, pair(table, ROW, m))
                g = decay(mul(mul(t, t), pair(table, FALLING, m)), least)
                c = fma(g, pair(table, FIRST, m), c)
                d = fma(g, pair(table, SECOND, m), d)
                k, m = k + 2, m + 2
            _lay(_paired(a, c), _paired(b, d), gains, left, right, v, image, n_u)


@njit(cache=True, error_model="numpy", parallel=True)
def _forward_views(forward_view, runs, values, scale, cameras, images):
    for view in prange(cameras.shape[0]):
        _forward_view(forward_view, runs, values, scale, cameras[view], images[view])


def forward(runs, values, scale, cameras, images):
    """Project values [splat, 2] onto views, one a thread: images [view, 2 · u, v + WIDTH] must be zero."""
    _forward_views(_forward_view.address(), runs, values, scale, cameras, images)


@njit(cache=True, error_model="numpy", inline="always")
def _add_runs_own(table, bounds, sums):
    """Add both channels of a run's table to the sums of its splats."""
    n, half = bounds[1] - bounds[0], WIDTH // 2
    whole = n // WIDTH * WIDTH
    for k in range(0, whole, WIDTH):
        a, b, at = load(table, FIRST, LEAD + k), load(table, SECOND, LEAD + k), bounds[0] + k
        store(sums, at, 0, add(lower(a, b), load(sums, at, 0)))  # channels in turns
        store(sums, at + half, 0, add(upper(a, b), load(sums, at + half, 0)))
    for k in range(whole, n):
        sums[bounds[0] + k, 0] += table[FIRST, LEAD + k]
        sums[bounds[0] + k, 1] += table[SECOND, LEAD + k]


@njit(cache=True, error_model="numpy", inline="always")
def _topmost(table, k, n):
    """Return the least row of `HALF` splats from k on."""
    return min(table[ROW, LEAD + min(k, n - 1)], table[ROW, LEAD + min(k + HALF, n) - 1])


@compiled_once("UniTuple(int64, 2)", RUNS_TYPE, "float64", "float64[::1]", "float32[:,::1]", "float32[:,::1]")
def _backward_runs(chosen, runs, scale, camera, image, sums):
    xy, starts, z, tallest = runs
    n_u, n_v = image.shape[0] // 2, image.shape[1] - WIDTH
    place, profile = np.empty(PLACE), np.zeros((2, LEAD + n_v + WIDTH + MOST), np.float32)
    least, zero, one, two = _least(camera), spread(np.float32(0)), spread(np.float32(1)), spread(np.float32(2))
    twice = lower(ramp(np.float32(0)), ramp(np.float32(0)))
    turns = sub(ramp(np.float32(0)), add(twice, twice))  # 0, 1, 0, 1, …
    table, gains = np.zeros((5, tallest + 2 * WIDTH + MOST), np.float32), np.empty((1, n_u + WIDTH), np.float32)
    for run in range(chosen[0], chosen[1]):
        bounds = (starts[run], starts[run + 1])
        left, right, low, high, reach = _window(xy[run], scale, camera, z, bounds, (n_v, n_u), place)
        if left >= right:
            continue
        _gains(camera, place, left, right, gains)
        for v in range(low, high, WIDTH):
            a, b = zero, zero
            for u in range(left, right):
                g = pick(gains, 0, u - left)
                a = fma(g, load(image, u, v), a)
                b = fma(g, load(image, n_u + u, v), b)
            store(profile, 0, LEAD + v, a)
            store(profile, 1, LEAD + v, b)
        _shadows(camera, place, z, bounds, table)
        n = bounds[1] - bounds[0]
        spacing = (table[ROW, LEAD + n - 1] - table[ROW, LEAD]) / max(n - 1, 1)  # of either sign
        before, passing = _passing(spacing, reach + 2 * SLACK)
        if spacing > 0 and _in_step(1 / spacing, passing):
            for k in range(LEAD, LEAD + n, WIDTH):  # rows beyond low … high are another run's, times 0
                first = _begin(table[ROW, k] - before, n_v)
                rows, falling, here = load(table, ROW, k), load(table, FALLING, k), ramp(np.float32(first))
                a, b = zero, zero
                for v in range(LEAD + first, LEAD + first + passing):
                    t = sub(here, rows)
                    g = decay(mul(mul(t, t), falling), least)
                    a = fma(g, load(profile, 0, v), a)
                    b = fma(g, load(profile, 1, v), b)
                    here = add(here, one)
                store(table, FIRST, k, mul(a, load(table, PEAKS, k)))
                store(table, SECOND, k, mul(b, load(table, PEAKS, k)))
            _add_runs_own(table, bounds, sums)
            continue
        pairs = _pairs((HALF - 1) * abs(spacing) + 2 * reach + 4 * SLACK, high - low)
        for k in range(0, n, WIDTH):
            v = low + _start(_topmost(table, k, n) - reach - SLACK - low, high - low, pairs)
            w = low + _start(_topmost(table, k + HALF, n) - reach - SLACK - low, high - low, pairs)
            rows, falling = load(table, ROW, LEAD + k), load(table, FALLING, LEAD + k)
            later, steep = upper(rows, rows), upper(falling, falling)
            rows, falling = lower(rows, rows), lower(falling, falling)
            here, there = add(spread(np.float32(v)), turns), add(spread(np.float32(w)), turns)
            v, w = LEAD + v, LEAD + w
            a, b, c, d = zero, zero, zero, zero
            for _ in range(pairs):
                t = sub(here, rows)
                g = decay(mul(mul(t, t), falling), least)
                a = fma(g, pair(profile, 0, v), a)
                b = fma(g, pair(profile, 1, v), b)
                t = sub(there, later)
                g = decay(mul(mul(t, t), steep), least)
                c = fma(g, pair(profile, 0, w), c)
                d = fma(g, pair(profile, 1, w), d)
                v, w, here, there = v + 2, w + 2, add(here, two), add(there, two)
            store(table, FIRST, LEAD + k, mul(_paired(a, c), load(table, PEAKS, LEAD + k)))
            store(table, SECOND, LEAD + k, mul(_paired(b, d), load(table, PEAKS, LEAD + k)))
        _add_runs_own(table, bounds, sums)


@njit(cache=True, error_model="numpy", parallel=True)
def _backward_tasks(backward_runs, runs, scale, cameras, images, sums):
    n, starts = runs[0].shape[0], runs[1]
    for task in prange((n + RUNS - 1) // RUNS):
        chosen = (task * RUNS, min((task + 1) * RUNS, n))
        for i in range(starts[chosen[0]], starts[chosen[1]]):
            sums[i, 0] = sums[i, 1] = 0
        for view in range(cameras.shape[0]):
            _backward_runs(backward_runs, chosen, runs, scale, cameras[view], images[view], sums)


def backward(runs, scale, cameras, images, sums):
    """Apply the transpose: write to sums [splat, 2] Σ w·images over all pixels of images [view, 2 · u, v + WIDTH]."""
    _backward_tasks(_backward_runs.address(), runs, scale, cameras, images, sums)
