"""Exact ray intervals through one primitive, of one ray or of many, for the ray tracer's inner loop.

A ray is first moved to its closest approach to the bounding sphere's centre, so every later number is
of the primitive's own size and nothing cancels over the source distance. The result is that of a ray
moved by no more than a few 1e-13 mm (source up to 1500 mm away). The centre of the bounding sphere is
the local origin (`ctsim.solids.Primitive.row`), which is why the row's offset is not read. Primitives of one interval
are written without loops and calls, so that LLVM turns their branches into choices and does several rays at once.
"""

import math

import numpy as np
from numba import njit

from ctsim.kernels.once import compiled_once
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS

ROW = "float64[::1]"
# Direction components below this are parallel to a face or axis: over 1e3 mm the ray moves by less than 1e-27 mm.
_PARALLEL = 1e-30


@njit(cache=True, error_model="numpy", inline="always")  # always: saves two atomic reference counts
def intersect(prim, ox, oy, oz, dx, dy, dz, out):
    """Intersect a ray with one primitive.

    `prim` is a row of `ctsim.solids.pack` [22]; origin o (mm) and unit direction d are in world x, y, z.
    Pairs t0 < t1 (mm along the ray, possibly negative) go to `out` [≥ 4]; returns the number of
    pairs: 0 or 1, for a torus up to 2.
    """
    px, py, pz = ox - prim[18], oy - prim[19], oz - prim[20]
    shift = -(px * dx + py * dy + pz * dz)
    px += shift * dx
    py += shift * dy
    pz += shift * dz
    if px * px + py * py + pz * pz > prim[21] * prim[21] * (1 + 1e-12):
        return 0
    return _intersect_near(prim, px, py, pz, dx, dy, dz, shift, out)


@compiled_once(ROW, "int64", ROW, "float64[:,::1]", "float64[:,:,::1]")
def intersect_rays(prim, n, source, local, spans):
    """Intersect n rays from one point with a primitive, to the last bit as `intersect` does.

    `source` [≥ 3] is the point (mm) and `local` [10, ≥ n] scratch whose first three rows are unit directions. `spans`
    [pair, 2, ≥ n] gets where each ray enters and leaves (mm along it), of a torus two pairs; a ray misses a pair where
    it does not leave it after it enters.
    """
    kind, a, b, c = int(prim[0]), prim[14], prim[15], prim[16]
    if kind == TORUS:
        _intersect_torus(prim, n, source, local, spans)
        return
    enter, leave = spans[0, 0], spans[0, 1]
    xx, xy, xz, yx, yy, yz = prim[2], prim[3], prim[4], prim[5], prim[6], prim[7]
    zx, zy, zz = prim[8], prim[9], prim[10]
    ox, oy, oz = source[0] - prim[18], source[1] - prim[19], source[2] - prim[20]
    for i in range(n):
        dx, dy, dz = local[0, i], local[1, i], local[2, i]
        shift = -(ox * dx + oy * dy + oz * dz)
        px, py, pz = ox + shift * dx, oy + shift * dy, oz + shift * dz
        local[3, i] = xx * px + xy * py + xz * pz
        local[4, i] = yx * px + yy * py + yz * pz
        local[5, i] = zx * px + zy * py + zz * pz
        local[6, i] = xx * dx + xy * dy + xz * dz
        local[7, i] = yx * dx + yy * dy + yz * dz
        local[8, i] = zx * dx + zy * dy + zz * dz
        local[9, i] = shift
    if kind == ELLIPSOID:
        for i in range(n):
            x, y, z, ex, ey, ez = local[3, i], local[4, i], local[5, i], local[6, i], local[7, i], local[8, i]
            t0, t1 = _ellipsoid(x / a, y / b, z / c, ex / a, ey / b, ez / c)
            enter[i], leave[i] = t0 + local[9, i], t1 + local[9, i]
    elif kind == FRUSTUM:
        for i in range(n):
            x, y, z, ex, ey, ez = local[3, i], local[4, i], local[5, i], local[6, i], local[7, i], local[8, i]
            t0, t1 = _frustum(x, y, z, ex, ey, ez, a, b, c)
            enter[i], leave[i] = t0 + local[9, i], t1 + local[9, i]
    elif kind == CAPSULE:
        for i in range(n):
            x, y, z, ex, ey, ez = local[3, i], local[4, i], local[5, i], local[6, i], local[7, i], local[8, i]
            t0, t1 = _capsule(x, y, z, ex, ey, ez, a, b)
            enter[i], leave[i] = t0 + local[9, i], t1 + local[9, i]
    else:
        for i in range(n):
            x, y, z, ex, ey, ez = local[3, i], local[4, i], local[5, i], local[6, i], local[7, i], local[8, i]
            t0, t1 = _box(x, y, z, ex, ey, ez, a, b, c)
            enter[i], leave[i] = t0 + local[9, i], t1 + local[9, i]


@njit(cache=True, error_model="numpy")
def _intersect_torus(prim, n, source, local, spans):
    pair = np.empty(4)
    for i in range(n):
        x, y, z = local[0, i], local[1, i], local[2, i]
        pairs = intersect(prim, source[0], source[1], source[2], x, y, z, pair)
        for k in range(2):
            spans[k, 0, i], spans[k, 1, i] = (pair[2 * k], pair[2 * k + 1]) if k < pairs else (np.inf, -np.inf)


@njit(cache=True, error_model="numpy")
def inside(prim, x, y, z):
    """Tell whether the world point (mm) is in the primitive; its surface counts as inside."""
    px, py, pz = x - prim[18], y - prim[19], z - prim[20]
    kind = int(prim[0])
    lx = prim[2] * px + prim[3] * py + prim[4] * pz
    ly = prim[5] * px + prim[6] * py + prim[7] * pz
    lz = prim[8] * px + prim[9] * py + prim[10] * pz
    a, b, c = prim[14], prim[15], prim[16]
    if kind == ELLIPSOID:
        return (lx / a) ** 2 + (ly / b) ** 2 + (lz / c) ** 2 <= 1
    if kind == BOX:
        return abs(lx) <= a and abs(ly) <= b and abs(lz) <= c
    if kind == FRUSTUM:
        if abs(lz) > a:
            return False
        radius = 0.5 * (b + c) + 0.5 * (c - b) * (lz / a)
        return lx * lx + ly * ly <= radius * radius
    if kind == CAPSULE:
        over = max(abs(lz) - a, 0.0)
        return lx * lx + ly * ly + over * over <= b * b
    return _ring(a, b, math.sqrt(lx * lx + ly * ly), lz) <= 0


@njit(cache=True, error_model="numpy")
def _intersect_near(prim, px, py, pz, dx, dy, dz, shift, out):
    """Intersect the ray p + (t − shift)·d, p relative to the primitive's centre and closest to it."""
    kind = int(prim[0])
    x = prim[2] * px + prim[3] * py + prim[4] * pz
    y = prim[5] * px + prim[6] * py + prim[7] * pz
    z = prim[8] * px + prim[9] * py + prim[10] * pz
    ex = prim[2] * dx + prim[3] * dy + prim[4] * dz
    ey = prim[5] * dx + prim[6] * dy + prim[7] * dz
    ez = prim[8] * dx + prim[9] * dy + prim[10] * dz
    a, b, c = prim[14], prim[15], prim[16]
    if kind == ELLIPSOID:
        t0, t1 = _ellipsoid(x / a, y / b, z / c, ex / a, ey / b, ez / c)
    elif kind == FRUSTUM:
        t0, t1 = _frustum(x, y, z, ex, ey, ez, a, b, c)
    elif kind == CAPSULE:
        t0, t1 = _capsule(x, y, z, ex, ey, ez, a, b)
    elif kind == BOX:
        t0, t1 = _box(x, y, z, ex, ey, ez, a, b, c)
    else:
        n = _torus(x, y, z, ex, ey, ez, a, b, out)
        for i in range(2 * n):
            out[i] += shift
        return n
    if not t0 < t1:
        return 0
    out[0] = t0 + shift
    out[1] = t1 + shift
    return 1


@njit(cache=True, error_model="numpy", inline="always")
def _slab(p, e, half):
    """Interval in which |p + t·e| ≤ half; (inf, -inf) if empty."""
    if abs(e) < _PARALLEL:
        if abs(p) > half:
            return np.inf, -np.inf
        return -np.inf, np.inf
    inverse = 1 / e
    t0, t1 = (-half - p) * inverse, (half - p) * inverse
    return min(t0, t1), max(t0, t1)


@njit(cache=True, error_model="numpy", inline="always")
def _box(x, y, z, ex, ey, ez, a, b, c):
    """Interval in |x| ≤ a, |y| ≤ b, |z| ≤ c."""
    x0, x1 = _slab(x, ex, a)
    y0, y1 = _slab(y, ey, b)
    z0, z1 = _slab(z, ez, c)
    return max(x0, max(y0, z0)), min(x1, min(y1, z1))


@njit(cache=True, error_model="numpy", inline="always")
def _ellipsoid(x, y, z, ex, ey, ez):
    """Interval in the unit sphere (coordinates already divided by the semi-axes)."""
    norm = 1 / (ex * ex + ey * ey + ez * ez)
    s = -(x * ex + y * ey + z * ez) * norm
    x, y, z = x + s * ex, y + s * ey, z + s * ez
    rest = 1 - (x * x + y * y + z * z)
    if rest <= 0:
        return np.inf, -np.inf
    half = math.sqrt(rest * norm)
    return s - half, s + half


@njit(cache=True, error_model="numpy", inline="always")
def _frustum(x, y, z, ex, ey, ez, h, r0, r1):
    """Interval in |z| ≤ h, x² + y² ≤ g(z)², g linear from r0 to r1.

    A·t² + 2B·t + C ≤ 0 inside the double cone; the slab keeps the right nappe. The discriminant
    B² − AC equals |g·e − g'·p|² − (p × e)² in the xy plane, which does not cancel.
    """
    t0, t1 = _slab(z, ez, h)
    slope = (r1 - r0) / (2 * h)
    g, dg = 0.5 * (r0 + r1) + slope * z, slope * ez
    wx, wy, cross = g * ex - dg * x, g * ey - dg * y, x * ey - y * ex
    qa = ex * ex + ey * ey - dg * dg
    qb = x * ex + y * ey - g * dg
    qc = x * x + y * y - g * g
    disc = wx * wx + wy * wy - cross * cross
    q = math.sqrt(max(disc, 0.0))
    q = -qb - q if qb > 0 else q - qb
    ta, tb = q / qa, qc / q
    low, high = min(ta, tb), max(ta, tb)
    if qa == 0:  # one root only: ta or tb is infinite
        low, high = (-np.inf, tb) if qb > 0 else (tb, np.inf)
    if qa < 0:  # steeper than the cone: inside beyond the root on the nappe that widens along the ray
        low, high = (high, np.inf) if dg > 0 else (-np.inf, low)
    if abs(q) < _PARALLEL:  # along a cylinder's axis, or a tangent on a cone
        low, high = (-np.inf, np.inf) if qc <= 0 else (np.inf, -np.inf)
    if disc <= 0 and qa > 0:
        low, high = np.inf, -np.inf
    return max(t0, low), min(t1, high)


@njit(cache=True, error_model="numpy", inline="always")
def _capsule(x, y, z, ex, ey, ez, h, r):
    """Interval in the points nearer than r to the segment |z| ≤ h on the axis."""
    a = ex * ex + ey * ey
    cross = x * ey - y * ex
    disc = r * r * a - cross * cross
    b, half, inverse = x * ex + y * ey, math.sqrt(max(disc, 0.0)), 1 / a
    t0, t1, empty = (-b - half) * inverse, (half - b) * inverse, disc <= 0
    if a < _PARALLEL:
        t0, t1, empty = -np.inf, np.inf, x * x + y * y >= r * r
    # Where the infinite cylinder is entered or left beyond an end, that end's ball decides; one that is missed has no
    # length, and the ray has not come between the ends.
    z0, z1 = z + t0 * ez, z + t1 * ez
    s0, half0 = _ball(x, y, z - math.copysign(h, z0), ex, ey, ez, r)
    s1, half1 = _ball(x, y, z - math.copysign(h, z1), ex, ey, ez, r)
    t0, t1 = s0 - half0 if abs(z0) > h else t0, s1 + half1 if abs(z1) > h else t1
    return (np.inf, -np.inf) if empty else (t0, t1)


@njit(cache=True, error_model="numpy", inline="always")
def _ball(x, y, z, ex, ey, ez, r):
    """Middle and half length of the interval in a ball of radius r about the origin; half is 0 on a miss."""
    s = -(x * ex + y * ey + z * ez)
    x, y, z = x + s * ex, y + s * ey, z + s * ez
    return s, math.sqrt(max(r * r - (x * x + y * y + z * z), 0.0))


@njit(cache=True, error_model="numpy")
def _ring(major, minor, rho, z):
    """Squared distance to the ring less minor²: negative inside the torus."""
    return (rho - major) ** 2 + (z - minor) * (z + minor)


@njit(cache=True, error_model="numpy")
def _torus(x, y, z, ex, ey, ez, major, minor, out):
    """Intervals in a torus, to `out`; returns their number.

    With p ⊥ e the implicit function is a depressed quartic t⁴ + α·t² + β·t + γ; the roots of its
    derivative isolate the crossings, which are then found on the ring distance, where thin rings do
    not cancel.
    """
    m2 = x * x + y * y + z * z
    alpha = 2 * (m2 + (major - minor) * (major + minor)) - 4 * major * major * (ex * ex + ey * ey)
    beta = -8 * major * major * (x * ex + y * ey)
    reach = math.sqrt(max((major + minor) ** 2 - m2, 0.0)) * (1 + 1e-9) + 1e-9 * (major + minor)
    low, middle, high = _stationary(alpha, beta)
    if math.isnan(high):  # one minimum
        if _ring_at(x, y, z, ex, ey, ez, major, minor, low)[0] >= 0:
            return 0
        out[0] = _cross(x, y, z, ex, ey, ez, major, minor, low, -reach)
        out[1] = _cross(x, y, z, ex, ey, ez, major, minor, low, reach)
        return 1
    if _ring_at(x, y, z, ex, ey, ez, major, minor, middle)[0] < 0:
        out[0] = _cross(x, y, z, ex, ey, ez, major, minor, middle, -reach)
        out[1] = _cross(x, y, z, ex, ey, ez, major, minor, middle, reach)
        return 1
    n = 0
    if _ring_at(x, y, z, ex, ey, ez, major, minor, low)[0] < 0:
        out[0] = _cross(x, y, z, ex, ey, ez, major, minor, low, -reach)
        out[1] = _cross(x, y, z, ex, ey, ez, major, minor, low, middle)
        n = 1
    if _ring_at(x, y, z, ex, ey, ez, major, minor, high)[0] < 0:
        out[2 * n] = _cross(x, y, z, ex, ey, ez, major, minor, high, middle)
        out[2 * n + 1] = _cross(x, y, z, ex, ey, ez, major, minor, high, reach)
        n += 1
    return n


@njit(cache=True, error_model="numpy")
def _stationary(alpha, beta):
    """Ascending roots of 4t³ + 2α·t + β; with a single one the other two are NaN."""
    p, q = alpha / 6, beta / 8  # t³ + 3p·t + 2q = 0
    disc = q * q + p * p * p
    if disc >= 0:
        u = np.cbrt(abs(q) + math.sqrt(disc))
        if u == 0:
            return 0.0, np.nan, np.nan
        t = -math.copysign(u - p / u, q)
        return _polish(t, p, q), np.nan, np.nan
    root = math.sqrt(-p)
    angle = math.acos(min(max(-q / (root * root * root), -1.0), 1.0)) / 3
    cos, sin = math.cos(angle), math.sin(angle) * math.sqrt(3.0)
    low, middle, high = -root * (cos + sin), root * (sin - cos), 2 * root * cos
    return _polish(low, p, q), _polish(middle, p, q), _polish(high, p, q)


@njit(cache=True, error_model="numpy")
def _polish(t, p, q):
    """One guarded Newton step on t³ + 3p·t + 2q."""
    slope = 3 * (t * t + p)
    step = (t * (t * t + 3 * p) + 2 * q) / slope
    if abs(step) < 1e-6 * abs(t):
        return t - step
    return t


@njit(cache=True, error_model="numpy")
def _ring_at(x, y, z, ex, ey, ez, major, minor, t):
    """Value and slope of the ring function at t along the ray."""
    x, y, z = x + t * ex, y + t * ey, z + t * ez
    rho = math.sqrt(x * x + y * y)
    slope = 2 * z * ez
    if rho > 0:
        slope += 2 * (rho - major) * (x * ex + y * ey) / rho
    return _ring(major, minor, rho, z), slope


@njit(cache=True, error_model="numpy")
def _cross(x, y, z, ex, ey, ez, major, minor, t_in, t_out):
    """Crossing between t_in (inside) and t_out (outside) by Newton steps kept inside the bracket."""
    if _ring_at(x, y, z, ex, ey, ez, major, minor, t_out)[0] <= 0:
        return t_out
    t = 0.5 * (t_in + t_out)
    for _ in range(200):
        value, slope = _ring_at(x, y, z, ex, ey, ez, major, minor, t)
        if value < 0:
            t_in = t
        else:
            t_out = t
        new = t - value / slope if slope != 0 else np.inf
        if not min(t_in, t_out) < new < max(t_in, t_out):
            new = 0.5 * (t_in + t_out)
        if abs(new - t) <= 4e-16 * (major + minor):
            return new
        t = new
    return t
