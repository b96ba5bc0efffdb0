"""Line integrals of Gaussians on a flat detector, and their transpose (numba).

The Gaussian exp(−½(x − p)ᵀΣ⁻¹(x − p)) is projected in closed form along the ray through each pixel. With v_c the ray
through its centre, ending on the detector, τ the centre's depth as a share of the detector's, n_u = v_c × e_u,
n_v = v_c × e_v and α = v_cᵀΣ⁻¹v_c,

    C = τ²/(α det Σ) [n_uᵀΣn_u, n_uᵀΣn_v, n_vᵀΣn_v]      Q = δᵀCδ, δ pixels from the centre's shadow
    D = |v_c + du e_u + dv e_v|²_{Σ⁻¹}/α,  E = the same with the unit matrix for Σ⁻¹
    w = |v_c| √(2π/α) √(E/D) exp(−Q/2D)                  EWA: D = E = 1

which follows from completing the square along the ray (the paper's eq. for P is the EWA form). No determinant is
subtracted, so nothing cancels. The pixel's own extent is a box of variance 1/12, added to C⁻¹ with the mass kept.
A splat whose EWA form is within `tolerance` of its peak takes that form, by multiplication from row to row.

Shapes are float32 [4, splat] (x, y, z, σ in mm) or [15, splat] (x, y, z, three σ, and R row by row: column k of R is
the axis of σ_k). Images are float32 [channel · v, u + 8]; the last 8 columns are scratch.
"""

import math

import numpy as np
from numba import njit, prange

from reconstruct.splat.kernels.lanes import WIDTH, div, exp, fma, load, mul, ramp, spread, sqrt, store, total

CHUNKS = 16  # of splats, each on an image of its own: the sum does not depend on the number of threads
ROWS = 16  # rows by multiplication before the exponentials are taken anew
STEEP = 110.0  # −2 log of the faintest value that multiplication may start from
HALF = np.float32(-0.5)
# a camera vector: source, detector centre − source, u step, v step, then numbers
SOURCE, ACROSS, STEP_U, STEP_V, CUTOFF, TOLERANCE, BOX = 0, 3, 6, 9, 12, 13, 14
# a footprint: centre (u, v), C, covariance and amplitude, whether exact, D and E
U0, V0, C_UU, C_UV, C_VV, S_UU, S_UV, S_VV, W0, EXACT, D_1, E_1 = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 15
FOOTPRINT = 20


@njit(cache=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
def _scaled(shapes, i, a, inverse):
    """Return diag(s) Rᵀ a, or diag(1/s) Rᵀ a."""
    out0 = shapes[6, i] * a[0] + shapes[9, i] * a[1] + shapes[12, i] * a[2]
    out1 = shapes[7, i] * a[0] + shapes[10, i] * a[1] + shapes[13, i] * a[2]
    out2 = shapes[8, i] * a[0] + shapes[11, i] * a[1] + shapes[14, i] * a[2]
    s0, s1, s2 = np.float64(shapes[3, i]), np.float64(shapes[4, i]), np.float64(shapes[5, i])
    if inverse:
        return out0 / s0, out1 / s1, out2 / s2
    return out0 * s0, out1 * s1, out2 * s2


@njit(cache=True)
def footprint(shapes, i, camera, fp):
    """Write splat i's footprint in float64; return whether there is one (it lies before the source, and is finite)."""
    e_u = (camera[STEP_U], camera[STEP_U + 1], camera[STEP_U + 2])
    e_v = (camera[STEP_V], camera[STEP_V + 1], camera[STEP_V + 2])
    across = (camera[ACROSS], camera[ACROSS + 1], camera[ACROSS + 2])
    normal = _cross(e_u, e_v)
    c = (shapes[0, i] - camera[SOURCE], shapes[1, i] - camera[SOURCE + 1], shapes[2, i] - camera[SOURCE + 2])
    tau = _dot(c, normal) / _dot(across, normal)
    if not tau > 1e-6:
        return False
    ray = (c[0] / tau, c[1] / tau, c[2] / tau)
    off = (ray[0] - across[0], ray[1] - across[1], ray[2] - across[2])
    uu, uv, vv = _dot(e_u, e_u), _dot(e_u, e_v), _dot(e_v, e_v)
    a, b, gram = _dot(off, e_u), _dot(off, e_v), uu * vv - uv * uv
    fp[U0], fp[V0] = (a * vv - b * uv) / gram, (b * uu - a * uv) / gram
    n_u, n_v = _cross(ray, e_u), _cross(ray, e_v)
    if shapes.shape[0] == 4:
        weight = 1 / np.float64(shapes[3, i]) ** 2
        x, y, z, scale = ray, e_u, e_v, weight
        c_scale = tau * tau * weight / _dot(ray, ray)
    else:
        x, y, z = _scaled(shapes, i, ray, True), _scaled(shapes, i, e_u, True), _scaled(shapes, i, e_v, True)
        n_u, n_v = _scaled(shapes, i, n_u, False), _scaled(shapes, i, n_v, False)
        scale = 1.0
        volume = np.float64(shapes[3, i]) * shapes[4, i] * shapes[5, i]
        c_scale = tau * tau / (_dot(x, x) * volume * volume)
    xx = _dot(x, x)
    c_uu, c_uv, c_vv = c_scale * _dot(n_u, n_u), c_scale * _dot(n_u, n_v), c_scale * _dot(n_v, n_v)
    # det C = |n_u × n_v|² c_scale², and n_u × n_v = (v_c · (e_u × e_v)) v_c up to Σ: nothing is subtracted
    crossed = _cross(n_u, n_v)
    det = c_scale * c_scale * _dot(crossed, crossed)
    s_uu, s_uv, s_vv = c_vv / det + camera[BOX], -c_uv / det, c_uu / det + camera[BOX]
    boxed = s_uu * s_vv - s_uv * s_uv
    fp[C_UU], fp[C_UV], fp[C_VV] = s_vv / boxed, -s_uv / boxed, s_uu / boxed
    fp[S_UU], fp[S_UV], fp[S_VV] = s_uu, s_uv, s_vv
    fp[W0] = math.sqrt(2 * math.pi / (xx * scale) * _dot(ray, ray) / (det * boxed))
    fp[D_1], fp[D_1 + 1] = 2 * _dot(x, y) / xx, 2 * _dot(x, z) / xx
    fp[D_1 + 2], fp[D_1 + 3], fp[D_1 + 4] = _dot(y, y) / xx, 2 * _dot(y, z) / xx, _dot(z, z) / xx
    rr = _dot(ray, ray)
    fp[E_1], fp[E_1 + 1] = 2 * _dot(ray, e_u) / rr, 2 * _dot(ray, e_v) / rr
    fp[E_1 + 2], fp[E_1 + 3], fp[E_1 + 4] = uu / rr, 2 * uv / rr, vv / rr
    fp[EXACT] = _departure(fp, camera[CUTOFF]) > camera[TOLERANCE]
    return math.isfinite(fp[W0] + fp[U0] + fp[V0]) and boxed > 0


@njit(cache=True, inline="always")
def _departure(fp, cutoff):
    """Bound what EWA leaves out within the cutoff, as a share of the peak.

    |d log w| ≤ ½|D/E − 1| + ½Q|D − 1|, and ½Q exp(−½Q) ≤ 1/e.
    """
    u, v = cutoff * math.sqrt(fp[S_UU]), cutoff * math.sqrt(fp[S_VV])
    ratio = abs(fp[D_1] - fp[E_1]) * u + abs(fp[D_1 + 1] - fp[E_1 + 1]) * v
    ratio += abs(fp[D_1 + 2] - fp[E_1 + 2]) * u * u + abs(fp[D_1 + 3] - fp[E_1 + 3]) * u * v
    ratio += abs(fp[D_1 + 4] - fp[E_1 + 4]) * v * v
    shift = abs(fp[D_1]) * u + abs(fp[D_1 + 1]) * v + fp[D_1 + 2] * u * u + abs(fp[D_1 + 3]) * u * v
    return 0.5 * ratio + (shift + fp[D_1 + 4] * v * v) / math.e


@njit(cache=True, inline="always")
def _columns(fp, cutoff, n_u):
    """Return the half-open range of columns within the cutoff."""
    half = min(cutoff * math.sqrt(fp[S_UU]), 1e9)
    centre = min(max(fp[U0], -1e9), 1e9)
    return max(0, int(math.ceil(centre - half))), min(n_u, int(math.floor(centre + half)) + 1)


@njit(cache=True, inline="always")
def _rows(fp, column, cutoff, n_v):
    """Return the half-open range of rows within the cutoff in one of the columns `column` … `column` + 7."""
    a = column - fp[U0]
    b = a + (WIDTH - 1)
    near = a if a > 0 else (b if b < 0 else 0.0)
    left = cutoff * cutoff - near * near / fp[S_UU]
    if left <= 0:
        return 0, 0
    half, slope = math.sqrt(left / fp[C_VV]), fp[S_UV] / fp[S_UU]
    low = min(max(fp[V0] + min(slope * a, slope * b) - half, -1e9), 1e9)
    high = min(max(fp[V0] + max(slope * a, slope * b) + half, -1e9), 1e9)
    return max(0, int(math.ceil(low))), min(n_v, int(math.floor(high)) + 1)


@njit(cache=True, inline="always")
def _q(fp, du, dv):
    return fp[C_UU] * du * du + 2 * fp[C_UV] * du * dv + fp[C_VV] * dv * dv


@njit(cache=True, inline="always")
def _is_steep(fp, column, first, last):
    """Whether a value in this block is too faint to be reached by multiplication; Q is greatest at a corner."""
    a, b, low, high = column - fp[U0], column - fp[U0] + (WIDTH - 1), first - fp[V0], last - 1 - fp[V0]
    return max(_q(fp, a, low), _q(fp, b, low), _q(fp, a, high), _q(fp, b, high)) > STEEP


@njit(cache=True, inline="always")
def _value(fp, du, dv):
    """Return √(E/D) exp(−Q/2D), or exp(−Q/2) for a splat in its EWA form, in eight lanes."""
    along = fma(du, spread(np.float32(fp[C_UU])), spread(np.float32(2 * fp[C_UV] * dv)))
    q = mul(spread(HALF), fma(along, du, spread(np.float32(fp[C_VV] * dv * dv))))
    if fp[EXACT] == 0:
        return exp(q)
    d, e = _quadratic(fp, D_1, du, dv), _quadratic(fp, E_1, du, dv)
    return mul(sqrt(div(e, d)), exp(div(q, d)))


@njit(cache=True, inline="always")
def _quadratic(fp, at, du, dv):
    along = fma(du, spread(np.float32(fp[at + 2])), spread(np.float32(fp[at] + fp[at + 3] * dv)))
    return fma(along, du, spread(np.float32(1 + (fp[at + 1] + fp[at + 4] * dv) * dv)))


@njit(cache=True, inline="always")
def _start(fp, du, dv):
    """Return the values of a row and what takes them to the next: g, r with g ← g·r, r ← r·exp(−C_vv)."""
    r = exp(fma(du, spread(np.float32(-fp[C_UV])), spread(np.float32(-fp[C_VV] * (dv + 0.5)))))
    return _value(fp, du, dv), r


@njit(cache=True)
def add_splat(fp, values, cutoff, image, n_u):
    """Add values[c]·w to the image of every channel; return the rows that were touched, half-open."""
    n_c = values.shape[0]
    n_v = image.shape[0] // n_c
    first, last = n_v, 0
    left, right = _columns(fp, cutoff, n_u)
    fall = exp(spread(np.float32(-fp[C_VV])))
    a = spread(np.float32(values[0] * fp[W0]))
    b = spread(np.float32(values[n_c - 1] * fp[W0]))
    for column in range(left, right, WIDTH):
        low, high = _rows(fp, column, cutoff, n_v)
        if low >= high:
            continue
        first, last = min(first, low), max(last, high)
        du = ramp(np.float32(column - fp[U0]))
        by_rows = fp[EXACT] == 0 and not _is_steep(fp, column, low, high)
        for start in range(low, high, ROWS if by_rows else 1):
            g, r = _start(fp, du, start - fp[V0])
            for v in range(start, min(start + ROWS, high) if by_rows else start + 1):
                store(image, v, column, fma(g, a, load(image, v, column)))
                if n_c == 2:
                    store(image, n_v + v, column, fma(g, b, load(image, n_v + v, column)))
                g = mul(g, r)
                r = mul(r, fall)
    return first, last


@njit(cache=True)
def read_splat(fp, images, cutoff, n_u, sums):
    """Add Σ w·image of every channel, at most four, to `sums`."""
    n_c = sums.shape[0]
    n_v = images.shape[0] // n_c
    left, right = _columns(fp, cutoff, n_u)
    fall = exp(spread(np.float32(-fp[C_VV])))
    zero = spread(np.float32(0))
    s0, s1, s2, s3 = zero, zero, zero, zero
    for column in range(left, right, WIDTH):
        low, high = _rows(fp, column, cutoff, n_v)
        du = ramp(np.float32(column - fp[U0]))
        by_rows = fp[EXACT] == 0 and not _is_steep(fp, column, low, high)
        for start in range(low, high, ROWS if by_rows else 1):
            g, r = _start(fp, du, start - fp[V0])
            for v in range(start, min(start + ROWS, high) if by_rows else start + 1):
                s0 = fma(g, load(images, v, column), s0)
                if n_c > 1:
                    s1 = fma(g, load(images, n_v + v, column), s1)
                if n_c > 2:
                    s2 = fma(g, load(images, 2 * n_v + v, column), s2)
                    s3 = fma(g, load(images, 3 * n_v + v, column), s3)
                g = mul(g, r)
                r = mul(r, fall)
    sums[0] += np.float32(fp[W0]) * total(s0)
    if n_c > 1:
        sums[1] += np.float32(fp[W0]) * total(s1)
    if n_c > 2:
        sums[2] += np.float32(fp[W0]) * total(s2)
        sums[3] += np.float32(fp[W0]) * total(s3)


@njit(cache=True)
def _forward_chunk(shapes, values, bounds, camera, image, n_u):
    first, last = image.shape[0], 0
    fp = np.empty(FOOTPRINT)
    for i in range(bounds[0], bounds[1]):
        if footprint(shapes, i, camera, fp):
            low, high = add_splat(fp, values[i], camera[CUTOFF], image, n_u)
            first, last = min(first, low), max(last, high)
    return first, last


@njit(cache=True)
def _backward_chunk(shapes, bounds, cameras, images, n_u, sums):
    fp = np.empty(FOOTPRINT)
    for view in range(cameras.shape[0]):
        for i in range(bounds[0], bounds[1]):
            if footprint(shapes, i, cameras[view], fp):
                read_splat(fp, images[view], cameras[view, CUTOFF], n_u, sums[i])


@njit(cache=True, parallel=True)
def forward_view(shapes, values, camera, scratch, image):
    """Project onto one view: values [splat, channel], scratch [CHUNKS, channel · v, u + 8], image the same of one."""
    n_c, n = values.shape[1], values.shape[0]
    n_v, n_u = image.shape[0] // n_c, image.shape[1] - WIDTH
    touched = np.zeros((CHUNKS, 2), np.int64)
    for c in prange(CHUNKS):
        bounds = (c * n // CHUNKS, (c + 1) * n // CHUNKS)
        first, last = _forward_chunk(shapes, values, bounds, camera, scratch[c], n_u)
        touched[c, 0], touched[c, 1] = first, last
    for v in prange(n_v):
        for k in range(n_c):
            _collect_row(touched, scratch, v, k * n_v + v, image)


@njit(cache=True)
def _collect_row(touched, scratch, v, row, image):
    """Add the chunks' rows in their order, and clear them for the next view."""
    image[row] = 0
    for c in range(CHUNKS):
        if touched[c, 0] <= v < touched[c, 1]:
            image[row] += scratch[c, row]
            scratch[c, row] = 0


@njit(cache=True, parallel=True)
def forward_views(shapes, values, cameras, images):
    """Project onto many views, one a thread: images [view, channel · v, u + 8] must be zero."""
    for view in prange(cameras.shape[0]):
        whole = (0, values.shape[0])
        _forward_chunk(shapes, values, whole, cameras[view], images[view], images.shape[2] - WIDTH)


@njit(cache=True, parallel=True)
def backward_views(shapes, cameras, images, sums):
    """Apply the transpose: sums [splat, channel] += Σ w·images over all pixels of images [view, channel · v, u + 8]."""
    n = sums.shape[0]
    chunks = max(CHUNKS, n // 4096)
    for c in prange(chunks):
        bounds = (c * n // chunks, (c + 1) * n // chunks)
        _backward_chunk(shapes, bounds, cameras, images, images.shape[2] - WIDTH, sums)
