"""Line integrals of Gaussians on a flat detector, and their transpose (numba).

The Gaussian exp(−½(x − p)ᵀΣ⁻¹(x − p)) is projected in closed form along the ray through each pixel. With v_c the ray
through its centre, ending on the detector, τ the centre's depth as a share of the detector's, V = v_c · (e_u × e_v)
and J = d(u, v)/dp,

    S = JΣJᵀ + β      C = S⁻¹      Q = δᵀCδ, δ pixels from the centre's shadow
    D = |v_c + du e_u + dv e_v|²_{Σ⁻¹}/|v_c|²_{Σ⁻¹},  E = the same with the unit matrix for Σ⁻¹
    w = |v_c| √(2π det Σ/det S)/(τ²V) √(E/D) exp(−Q/2D)                  EWA: D = E = 1

which follows from completing the square along the ray (the paper's eq. for P is the EWA form). det JΣJᵀ is taken as
the square of a cross product, so nothing cancels. The pixel's own extent is a box of variance β = 1/12 (to second
order), and as |v_c| det Σ^½/(τ²V) is the Gaussian's mass, that stays.
A splat whose EWA form is within `tolerance` of its peak takes that form, by multiplication from row to row.

Shapes are float32 [4, splat] (x, y, z, σ in mm) or [15, splat] (x, y, z, three σ, and R row by row: column k of R is
the axis of σ_k). Images are float32 [channel · v, u + WIDTH]; the last WIDTH columns stay zero, and count as such.
"""

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ctsim.kernels.lanes import (
    WIDTH,
    below,
    div,
    exp,
    fma,
    load,
    mul,
    ramp,
    spread,
    sqrt,
    store,
    total,
)

CHUNKS = 16  # of splats at least, one a task
ROWS = 32  # rows by multiplication before the exponentials are computed again
STEEP = 110.0  # −2 log of the faintest value that multiplication may start from
CHANGE = 50.0  # −2 log of what multiplication may make of a fainter one: e^(25 − 55) of the peak is nothing
UPRIGHT, NARROWEST = 0.8 / WIDTH, 12.5  # C_uv/C_vv, C_vv: up to these a change, (cutoff + 0.8 √C_vv)², stays below it
LARGEST = 1e30  # of a line integral: what is longer is not a splat
# a camera vector: source, detector centre − source, u step, v step, then numbers, and what follows from all these
SOURCE, ACROSS, STEP_U, STEP_V, CUTOFF, TOLERANCE, BOX = 0, 3, 6, 9, 12, 13, 14
DEPTH, DUAL_U, DUAL_V, ORIGIN_U, ORIGIN_V, PEAK = 15, 18, 21, 24, 25, 26
CAMERA = 27
# a footprint: centre (u, v), C, covariance, peak, whether exact, D and E, and the cutoff's reach in u and v
U0, V0, C_UU, C_UV, C_VV, S_UU, S_UV, S_VV, W0, EXACT, D_1, E_1, REACH_U, REACH_V = *range(11), 15, 20, 21
FOOTPRINT = 22


def camera_vectors(poses: NDArray[np.float64], n_detector: tuple[int, int]) -> NDArray[np.float64]:
    """Return the cameras [view, CAMERA] of poses [view, 12]; the caller sets CUTOFF, TOLERANCE and BOX.

    (τ, u, v) of a point c from the source are DEPTH·c, DUAL_U·c/τ − ORIGIN_U and DUAL_V·c/τ − ORIGIN_V.
    """
    n_v, n_u = n_detector
    cameras = np.zeros((len(poses), CAMERA))
    cameras[:, :3], cameras[:, 6:12] = poses[:, :3], poses[:, 6:]
    e_u, e_v = poses[:, 6:9], poses[:, 9:]
    across = poses[:, 3:6] - 0.5 * (n_u - 1) * e_u - 0.5 * (n_v - 1) * e_v - poses[:, :3]
    normal = np.cross(e_u, e_v)
    volume = (across * normal).sum(1, keepdims=True)
    dual_u, dual_v = (np.cross(a, b) / (normal**2).sum(1, keepdims=True) for a, b in ((e_v, normal), (normal, e_u)))
    cameras[:, ACROSS : ACROSS + 3], cameras[:, DEPTH : DEPTH + 3] = across, normal / volume
    cameras[:, DUAL_U : DUAL_U + 3], cameras[:, DUAL_V : DUAL_V + 3] = dual_u, dual_v
    cameras[:, ORIGIN_U], cameras[:, ORIGIN_V] = (across * dual_u).sum(1), (across * dual_v).sum(1)
    cameras[:, PEAK] = math.sqrt(2 * math.pi) / np.abs(volume[:, 0])
    return cameras


@njit(cache=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy", inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy", inline="always")
def _of(camera, at):
    return camera[at], camera[at + 1], camera[at + 2]


@njit(cache=True, error_model="numpy", inline="always")
def _in_axes(shapes, i, a):
    """Return Rᵀ a."""
    out0 = shapes[6, i] * a[0] + shapes[9, i] * a[1] + shapes[12, i] * a[2]
    out1 = shapes[7, i] * a[0] + shapes[10, i] * a[1] + shapes[13, i] * a[2]
    out2 = shapes[8, i] * a[0] + shapes[11, i] * a[1] + shapes[14, i] * a[2]
    return out0, out1, out2


@njit(cache=True, error_model="numpy", inline="always")
def _jacobian(camera, dual, ray, tau):
    """Return the place on the detector, in pixels up to its origin, and its derivative by the position."""
    at, depth = _dot(dual, ray), _of(camera, DEPTH)
    over = 1 / tau
    return at, ((dual[0] - at * depth[0]) * over, (dual[1] - at * depth[1]) * over, (dual[2] - at * depth[2]) * over)


@njit(cache=True, error_model="numpy")
def footprint(shapes, i, camera, fp):
    """Write splat i's footprint in float64; return whether there is one (it lies before the source, and is finite)."""
    c = (shapes[0, i] - camera[SOURCE], shapes[1, i] - camera[SOURCE + 1], shapes[2, i] - camera[SOURCE + 2])
    tau = _dot(c, _of(camera, DEPTH))
    if not tau > 1e-6:
        return False
    over = 1 / tau
    ray = (c[0] * over, c[1] * over, c[2] * over)
    at_u, j_u = _jacobian(camera, _of(camera, DUAL_U), ray, tau)
    at_v, j_v = _jacobian(camera, _of(camera, DUAL_V), ray, tau)
    fp[U0], fp[V0] = at_u - camera[ORIGIN_U], at_v - camera[ORIGIN_V]
    s0 = np.float64(shapes[3, i])
    s1, s2 = s0, s0
    if shapes.shape[0] != 4:
        s1, s2 = np.float64(shapes[4, i]), np.float64(shapes[5, i])
        j_u, j_v = _in_axes(shapes, i, j_u), _in_axes(shapes, i, j_v)
    b_u, b_v = (s0 * j_u[0], s1 * j_u[1], s2 * j_u[2]), (s0 * j_v[0], s1 * j_v[1], s2 * j_v[2])
    crossed, box = _cross(b_u, b_v), camera[BOX]
    s_uu, s_uv, s_vv = _dot(b_u, b_u), _dot(b_u, b_v), _dot(b_v, b_v)
    boxed = _dot(crossed, crossed) + box * (s_uu + s_vv + box)
    s_uu, s_vv = s_uu + box, s_vv + box
    by_det = 1 / boxed
    fp[C_UU], fp[C_UV], fp[C_VV] = s_vv * by_det, -s_uv * by_det, s_uu * by_det
    fp[S_UU], fp[S_UV], fp[S_VV] = s_uu, s_uv, s_vv
    fp[REACH_U], fp[REACH_V] = camera[CUTOFF] * math.sqrt(s_uu), camera[CUTOFF] * math.sqrt(s_vv)
    rr = _dot(ray, ray)
    fp[W0] = camera[PEAK] * s0 * s1 * s2 * (over * over) * math.sqrt(rr * by_det)
    fp[EXACT] = 0.0
    if camera[TOLERANCE] < np.inf:
        _write_depths(shapes, i, camera, ray, fp)
        fp[EXACT] = _departure(fp) > camera[TOLERANCE]
    return 0 < fp[W0] < LARGEST


@njit(cache=True, error_model="numpy", inline="always")
def _write_depths(shapes, i, camera, ray, fp):
    """Write the coefficients of D and E, which are the same for round splats."""
    e_u, e_v = _of(camera, STEP_U), _of(camera, STEP_V)
    _write_quadratic(ray, e_u, e_v, fp, E_1)
    if shapes.shape[0] != 4:
        s = (np.float64(shapes[3, i]), np.float64(shapes[4, i]), np.float64(shapes[5, i]))
        x, y, z = _in_axes(shapes, i, ray), _in_axes(shapes, i, e_u), _in_axes(shapes, i, e_v)
        x, y, z = (
            (x[0] / s[0], x[1] / s[1], x[2] / s[2]),
            (y[0] / s[0], y[1] / s[1], y[2] / s[2]),
            (z[0] / s[0], z[1] / s[1], z[2] / s[2]),
        )
        _write_quadratic(x, y, z, fp, D_1)
    else:
        for k in range(5):
            fp[D_1 + k] = fp[E_1 + k]


@njit(cache=True, error_model="numpy", inline="always")
def _write_quadratic(x, y, z, fp, at):
    """Write the coefficients of |x + du y + dv z|²/|x|² − 1."""
    over = 1 / _dot(x, x)
    fp[at], fp[at + 1] = 2 * over * _dot(x, y), 2 * over * _dot(x, z)
    fp[at + 2], fp[at + 3], fp[at + 4] = over * _dot(y, y), 2 * over * _dot(y, z), over * _dot(z, z)


@njit(cache=True, error_model="numpy", inline="always")
def _departure(fp):
    """Bound what EWA leaves out within the cutoff, as a share of the peak.

    |d log w| ≤ ½|D/E − 1| + ½Q|D − 1|, and ½Q exp(−½Q) ≤ 1/e.
    """
    u, v = fp[REACH_U], fp[REACH_V]
    ratio = abs(fp[D_1] - fp[E_1]) * u + abs(fp[D_1 + 1] - fp[E_1 + 1]) * v
    ratio += abs(fp[D_1 + 2] - fp[E_1 + 2]) * u * u + abs(fp[D_1 + 3] - fp[E_1 + 3]) * u * v
    ratio += abs(fp[D_1 + 4] - fp[E_1 + 4]) * v * v
    shift = abs(fp[D_1]) * u + abs(fp[D_1 + 1]) * v + fp[D_1 + 2] * u * u + abs(fp[D_1 + 3]) * u * v
    return 0.5 * ratio + (shift + fp[D_1 + 4] * v * v) / math.e


@njit(cache=True, error_model="numpy", inline="always")
def _columns(fp, n_u):
    """Return the half-open range of columns within the cutoff."""
    half = min(fp[REACH_U], 1e9)
    centre = min(max(fp[U0], -1e9), 1e9)
    return max(0, int(math.ceil(centre - half))), min(n_u, int(math.floor(centre + half)) + 1)


@njit(cache=True, error_model="numpy", inline="always")
def _rows(fp, column, cutoff, n_v):
    """Return the half-open range of rows within the cutoff in one of the columns `column` … `column` + WIDTH − 1."""
    a = column - fp[U0]
    b = a + (WIDTH - 1)
    near = a if a > 0 else (b if b < 0 else 0.0)
    left = cutoff * cutoff - near * near / fp[S_UU]
    if left <= 0:
        return 0, 0
    half, slope = math.sqrt(left / fp[C_VV]), fp[S_UV] / fp[S_UU]
    low = min(max(fp[V0] + max(min(slope * a, slope * b) - half, -fp[REACH_V]), -1e9), 1e9)
    high = min(max(fp[V0] + min(max(slope * a, slope * b) + half, fp[REACH_V]), -1e9), 1e9)
    return max(0, int(math.ceil(low))), min(n_v, int(math.floor(high)) + 1)


@njit(cache=True, error_model="numpy", inline="always")
def _q(fp, du, dv):
    return fp[C_UU] * du * du + 2 * fp[C_UV] * du * dv + fp[C_VV] * dv * dv


@njit(cache=True, error_model="numpy", inline="always")
def _is_steep(fp, column, first, last):
    """Whether a value in this block is too faint to be reached by multiplication; Q is greatest at a corner.

    Faint lanes do no harm where they stay faint: Q = du²/S_uu + C_vv (dv − ridge)², and only the latter changes.
    """
    if abs(fp[C_UV]) <= UPRIGHT * fp[C_VV] and fp[C_VV] < NARROWEST:
        return False
    a, b, low, high = column - fp[U0], column - fp[U0] + (WIDTH - 1), first - fp[V0], last - 1 - fp[V0]
    if max(_q(fp, a, low), _q(fp, b, low), _q(fp, a, high), _q(fp, b, high)) <= STEEP:
        return False
    lean = fp[C_UV] / fp[C_VV]
    furthest = max(abs(low + lean * a), abs(low + lean * b), abs(high + lean * a), abs(high + lean * b))
    return fp[C_VV] * furthest * furthest > CHANGE


@njit(cache=True, error_model="numpy", inline="always")
def _value(fp, column, t, dv):
    """Return √(E/D) exp(−Q/2D), or exp(−Q/2) for a splat in its EWA form, in the lanes."""
    falling = mul(t, spread(np.float32(-0.5 * fp[C_UU])))
    q = fma(falling, t, spread(np.float32(-0.5 * dv * dv / fp[S_VV])))
    if fp[EXACT] == 0:
        return exp(q)
    du = ramp(np.float32(column - fp[U0]))
    d, e = _quadratic(fp, D_1, du, dv), _quadratic(fp, E_1, du, dv)
    return mul(sqrt(div(e, d)), exp(div(q, d)))


@njit(cache=True, error_model="numpy", inline="always")
def _quadratic(fp, at, du, dv):
    along = fma(du, spread(np.float32(fp[at + 2])), spread(np.float32(fp[at] + fp[at + 3] * dv)))
    return fma(along, du, spread(np.float32(1 + (fp[at + 1] + fp[at + 4] * dv) * dv)))


@njit(cache=True, error_model="numpy", inline="always")
def _start(fp, column, dv, n_u):
    """Return the values of a row and what takes them to the next: g, r with g ← g·r, r ← r·exp(−C_vv).

    With t = du − dv·S_uv/S_vv, Q = C_uu t² + dv²/S_vv: a sum of squares, in which a thin splat's terms do not cancel.
    """
    t = ramp(np.float32(column - fp[U0] - dv * fp[S_UV] / fp[S_VV]))
    r = exp(fma(t, spread(np.float32(-fp[C_UV])), spread(np.float32(-dv / fp[S_VV] - 0.5 * fp[C_VV]))))
    return mul(below(column, n_u), _value(fp, column, t, dv)), r


@njit(cache=True, error_model="numpy")
def add_splat(fp, values, i, cutoff, image, n_u, rows):
    """Add values[i, c]·w to the image of every channel, one or two, in the half-open range of rows.

    Multiplication starts again where rows are multiples of ROWS, which `rows` must be, too.
    """
    n_c = values.shape[1]
    n_v = image.shape[0] // n_c
    first, last = values[i, 0] * fp[W0], values[i, n_c - 1] * fp[W0]
    if not abs(first) + abs(last) < LARGEST:
        return
    left, right = _columns(fp, n_u)
    fall = exp(spread(np.float32(-fp[C_VV])))
    a, b = spread(np.float32(first)), spread(np.float32(last))
    for column in range(left, right, WIDTH):
        low, high = _rows(fp, column, cutoff, n_v)
        by_rows = fp[EXACT] == 0 and not _is_steep(fp, column, low, high)
        start, high = max(low, rows[0]), min(high, rows[1])
        while start < high:
            stop = min((start // ROWS + 1) * ROWS, high) if by_rows else start + 1
            g, r = _start(fp, column, start - fp[V0], n_u)
            for v in range(start, stop):
                store(image, v, column, fma(g, a, load(image, v, column)))
                if n_c == 2:
                    store(image, n_v + v, column, fma(g, b, load(image, n_v + v, column)))
                g = mul(g, r)
                r = mul(r, fall)
            start = stop


@njit(cache=True, error_model="numpy")
def read_splat(fp, images, cutoff, n_u, sums, i):
    """Add Σ w·image of every channel, at most four, to sums[i]."""
    n_c = sums.shape[1]
    n_v = images.shape[0] // n_c
    left, right = _columns(fp, n_u)
    fall = exp(spread(np.float32(-fp[C_VV])))
    zero = spread(np.float32(0))
    s0, s1, s2, s3 = zero, zero, zero, zero
    for column in range(left, right, WIDTH):
        low, high = _rows(fp, column, cutoff, n_v)
        by_rows = fp[EXACT] == 0 and not _is_steep(fp, column, low, high)
        for start in range(low, high, ROWS if by_rows else 1):
            g, r = _start(fp, column, start - fp[V0], n_u)
            for v in range(start, min(start + ROWS, high) if by_rows else start + 1):
                s0 = fma(g, load(images, v, column), s0)
                if n_c > 1:
                    s1 = fma(g, load(images, n_v + v, column), s1)
                if n_c > 2:
                    s2 = fma(g, load(images, 2 * n_v + v, column), s2)
                if n_c > 3:
                    s3 = fma(g, load(images, 3 * n_v + v, column), s3)
                g = mul(g, r)
                r = mul(r, fall)
    sums[i, 0] += np.float32(fp[W0]) * total(s0)
    if n_c > 1:
        sums[i, 1] += np.float32(fp[W0]) * total(s1)
    if n_c > 2:
        sums[i, 2] += np.float32(fp[W0]) * total(s2)
    if n_c > 3:
        sums[i, 3] += np.float32(fp[W0]) * total(s3)


@njit(cache=True, error_model="numpy")
def _footprints(shapes, camera, n_v, bounds, table, reach):
    for i in range(bounds[0], bounds[1]):
        reach[i, 0], reach[i, 1] = 0, 0
        if footprint(shapes, i, camera, table[i]):
            half, centre = table[i, REACH_V], table[i, V0]
            reach[i, 0] = max(0.0, centre - half)
            reach[i, 1] = max(0.0, min(n_v, centre + half + 1))


@njit(cache=True, error_model="numpy")
def _add_band(table, reach, values, cutoff, band, image):
    for i in range(values.shape[0]):
        if reach[i, 0] < band[1] and reach[i, 1] > band[0]:
            add_splat(table[i], values, i, cutoff, image, image.shape[1] - WIDTH, band)


@njit(cache=True, error_model="numpy", parallel=True)
def forward_view(shapes, values, camera, table, reach, image, tasks):
    """Project onto one view by all threads, in `tasks` bands of rows; `image` must be zero.

    Table, float64 [splat, FOOTPRINT], and reach, int32 [splat, 2], are scratch. As bands begin at multiples of ROWS,
    their number changes no bit.
    """
    n, n_v = values.shape[0], image.shape[0] // values.shape[1]
    for c in prange(CHUNKS):
        _footprints(shapes, camera, n_v, (c * n // CHUNKS, (c + 1) * n // CHUNKS), table, reach)
    blocks = (n_v + ROWS - 1) // ROWS
    bands = min(tasks, blocks)
    for k in prange(bands):
        band = (k * blocks // bands * ROWS, min((k + 1) * blocks // bands * ROWS, n_v))
        _add_band(table, reach, values, camera[CUTOFF], band, image)


@njit(cache=True, error_model="numpy")
def _forward_all(shapes, values, camera, image):
    n_v, n_u = image.shape[0] // values.shape[1], image.shape[1] - WIDTH
    fp = np.empty(FOOTPRINT)
    for i in range(values.shape[0]):
        if footprint(shapes, i, camera, fp):
            add_splat(fp, values, i, camera[CUTOFF], image, n_u, (0, n_v))


@njit(cache=True, error_model="numpy", parallel=True)
def forward_views(shapes, values, cameras, images):
    """Project onto many views, one a thread: images [view, channel · v, u + WIDTH] must be zero."""
    for view in prange(cameras.shape[0]):
        _forward_all(shapes, values, cameras[view], images[view])


@njit(cache=True, error_model="numpy")
def _backward_chunk(shapes, bounds, cameras, images, n_u, sums):
    fp = np.empty(FOOTPRINT)
    for view in range(cameras.shape[0]):
        camera, stack = cameras[view], images[view]
        for i in range(bounds[0], bounds[1]):
            if footprint(shapes, i, camera, fp):
                read_splat(fp, stack, camera[CUTOFF], n_u, sums, i)


@njit(cache=True, error_model="numpy", parallel=True)
def backward_views(shapes, cameras, images, sums):
    """Apply the transpose: sums [splat, channel] += Σ w·images over images [view, channel · v, u + WIDTH]."""
    n = sums.shape[0]
    chunks = max(CHUNKS, n // 4096)
    for c in prange(chunks):
        bounds = (c * n // chunks, (c + 1) * n // chunks)
        _backward_chunk(shapes, bounds, cameras, images, images.shape[2] - WIDTH, sums)
