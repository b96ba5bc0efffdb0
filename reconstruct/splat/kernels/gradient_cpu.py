"""Gradients of a loss in a splat's densities, place, log scales and quaternion, in the EWA form (numba).

With g_c = dLoss/dL_c on the detector, G = Σ ρ_c g_c and δ as in `splat_cpu`, eight sums over the shadow say it all:
S_c = Σ w g_c, and the moments M_0, M_1, M_2 of w·G with 1, δ and δδᵀ. As log w = log W − ½ δᵀCδ with C = (S + β)⁻¹
and W ∝ det Σ^½ |c| τ⁻³ det C^½,

    dLoss/dρ_c = S_c      dLoss/d(u, v) = C M_1      dLoss/dS = P = ½ (C M_2 C − M_0 C)

and with B = J R diag(s), S = BBᵀ, the rest is the chain rule: dLoss/dJ = 2 P B diag(s) Rᵀ, dLoss/dlog s_k =
2 b_kᵀP b_k + M_0, and a turn dR = [ω]× R has dLoss/dω = Σ_k r_k × 2 s_k JᵀP b_k.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.lanes import WIDTH, add, fma, load, mul, ramp, spread, total
from ctsim.reconstruct.splat.kernels.splat_cpu import (
    C_UU,
    C_UV,
    C_VV,
    CHUNKS,
    CUTOFF,
    DEPTH,
    DUAL_U,
    DUAL_V,
    FOOTPRINT,
    LARGEST,
    ROWS,
    SOURCE,
    U0,
    V0,
    W0,
    _columns,
    _cross,
    _dot,
    _in_axes,
    _is_steep,
    _jacobian,
    _of,
    _rows,
    _start,
    footprint,
)

# moments of a splat: S_a, S_b, M_0, M_1 and M_2
S_A, S_B, M_0, M_U, M_V, M_UU, M_UV, M_VV = range(8)
MOMENTS = 8
# a gradient: densities, position, log scales, quaternion, and the length of that of the place on the detector
DENSITY, POSITION, SCALE, QUATERNION, CENTRE = 0, 2, 5, 8, 12
GRADIENT = 13


@njit(cache=True, error_model="numpy")
def read_moments(fp, values, images, cutoff, n_u, out):
    """Write the eight sums over images [channel · v, u + WIDTH] of one or two channels."""
    n_c = values.shape[0]
    n_v = images.shape[0] // n_c
    left, right = _columns(fp, n_u)
    fall = spread(np.float32(math.exp(-fp[C_VV])))
    a, b = spread(values[0]), spread(values[n_c - 1])
    zero = spread(np.float32(0))
    sum_a, sum_b, sum_u, sum_v, sum_uu, sum_uv, sum_vv = zero, zero, zero, zero, zero, zero, zero
    for column in range(left, right, WIDTH):
        low, high = _rows(fp, column, cutoff, n_v)
        by_rows = not _is_steep(fp, column, low, high)
        in_a, in_b, in_v, in_vv = zero, zero, zero, zero
        for start in range(low, high, ROWS if by_rows else 1):
            g, r = _start(fp, column, start - fp[V0], n_u)
            for v in range(start, min(start + ROWS, high) if by_rows else start + 1):
                dv = spread(np.float32(v - fp[V0]))
                here = mul(g, load(images, v, column))
                in_a = add(in_a, here)
                loss = mul(a, here)
                if n_c == 2:
                    there = mul(g, load(images, n_v + v, column))
                    in_b = add(in_b, there)
                    loss = fma(b, there, loss)
                first = mul(loss, dv)
                in_v = add(in_v, first)
                in_vv = fma(first, dv, in_vv)
                g = mul(g, r)
                r = mul(r, fall)
        du = ramp(np.float32(column - fp[U0]))
        first = mul(du, fma(b, in_b, mul(a, in_a)))
        sum_a, sum_b, sum_v, sum_vv = add(sum_a, in_a), add(sum_b, in_b), add(sum_v, in_v), add(sum_vv, in_vv)
        sum_u, sum_uu, sum_uv = add(sum_u, first), fma(first, du, sum_uu), fma(in_v, du, sum_uv)
    w0 = fp[W0]
    out[S_A], out[S_B] = w0 * total(sum_a), w0 * total(sum_b)
    out[M_0] = values[0] * out[S_A] + (values[n_c - 1] * out[S_B] if n_c == 2 else 0.0)
    out[M_U], out[M_V] = w0 * total(sum_u), w0 * total(sum_v)
    out[M_UU], out[M_UV], out[M_VV] = w0 * total(sum_uu), w0 * total(sum_uv), w0 * total(sum_vv)


@njit(cache=True, error_model="numpy", inline="always")
def _turned(shapes, i, a):
    """Return R a."""
    out0 = shapes[6, i] * a[0] + shapes[7, i] * a[1] + shapes[8, i] * a[2]
    out1 = shapes[9, i] * a[0] + shapes[10, i] * a[1] + shapes[11, i] * a[2]
    out2 = shapes[12, i] * a[0] + shapes[13, i] * a[1] + shapes[14, i] * a[2]
    return out0, out1, out2


@njit(cache=True, error_model="numpy", inline="always")
def _spread_gradient(fp, m):
    """Return P = ½ (C M_2 C − M_0 C) as uu, uv, vv."""
    c_uu, c_uv, c_vv = fp[C_UU], fp[C_UV], fp[C_VV]
    a_uu, a_uv = m[M_UU] * c_uu + m[M_UV] * c_uv, m[M_UU] * c_uv + m[M_UV] * c_vv
    a_vu, a_vv = m[M_UV] * c_uu + m[M_VV] * c_uv, m[M_UV] * c_uv + m[M_VV] * c_vv
    p_uu = c_uu * a_uu + c_uv * a_vu - m[M_0] * c_uu
    p_uv = c_uu * a_uv + c_uv * a_vv - m[M_0] * c_uv
    p_vv = c_uv * a_uv + c_vv * a_vv - m[M_0] * c_vv
    return 0.5 * p_uu, 0.5 * p_uv, 0.5 * p_vv


@njit(cache=True, error_model="numpy")
def write_gradient(shapes, i, quaternion, camera, fp, m, out):
    """Turn the eight sums `m` into the gradient `out` [GRADIENT], by the chain rule; quaternion is of any length."""
    depth, dual_u, dual_v = _of(camera, DEPTH), _of(camera, DUAL_U), _of(camera, DUAL_V)
    c = (shapes[0, i] - camera[SOURCE], shapes[1, i] - camera[SOURCE + 1], shapes[2, i] - camera[SOURCE + 2])
    tau = _dot(c, depth)
    ray = (c[0] / tau, c[1] / tau, c[2] / tau)
    at_u, j_u = _jacobian(camera, dual_u, ray, tau)
    at_v, j_v = _jacobian(camera, dual_v, ray, tau)
    p_uu, p_uv, p_vv = _spread_gradient(fp, m)
    is_round = shapes.shape[0] == 4
    s0 = np.float64(shapes[3, i])
    s = (s0, s0, s0) if is_round else (s0, np.float64(shapes[4, i]), np.float64(shapes[5, i]))
    in_u, in_v = (j_u, j_v) if is_round else (_in_axes(shapes, i, j_u), _in_axes(shapes, i, j_v))
    b_u, b_v = (s[0] * in_u[0], s[1] * in_u[1], s[2] * in_u[2]), (s[0] * in_v[0], s[1] * in_v[1], s[2] * in_v[2])
    # rows of 2 P B, then of dLoss/dJ
    t_u = (
        2 * (p_uu * b_u[0] + p_uv * b_v[0]),
        2 * (p_uu * b_u[1] + p_uv * b_v[1]),
        2 * (p_uu * b_u[2] + p_uv * b_v[2]),
    )
    t_v = (
        2 * (p_uv * b_u[0] + p_vv * b_v[0]),
        2 * (p_uv * b_u[1] + p_vv * b_v[1]),
        2 * (p_uv * b_u[2] + p_vv * b_v[2]),
    )
    n_u, n_v = (s[0] * t_u[0], s[1] * t_u[1], s[2] * t_u[2]), (s[0] * t_v[0], s[1] * t_v[1], s[2] * t_v[2])
    turn = (0.0, 0.0, 0.0)
    if not is_round:
        # in the splat's axes: column k of RᵀdLoss/dR is s_k Jᵀ2Pb_k, and e_k × summed over k
        x = (in_u[1] * n_u[2] - in_u[2] * n_u[1]) + (in_v[1] * n_v[2] - in_v[2] * n_v[1])
        y = (in_u[2] * n_u[0] - in_u[0] * n_u[2]) + (in_v[2] * n_v[0] - in_v[0] * n_v[2])
        z = (in_u[0] * n_u[1] - in_u[1] * n_u[0]) + (in_v[0] * n_v[1] - in_v[1] * n_v[0])
        turn = _turned(shapes, i, (-x, -y, -z))
        n_u, n_v = _turned(shapes, i, n_u), _turned(shapes, i, n_v)
    out[DENSITY], out[DENSITY + 1] = m[S_A], m[S_B]
    m_u, m_v = fp[C_UU] * m[M_U] + fp[C_UV] * m[M_V], fp[C_UV] * m[M_U] + fp[C_VV] * m[M_V]
    out[CENTRE] = math.sqrt(m_u * m_u + m_v * m_v)
    along_u, along_v = _dot(n_u, depth), _dot(n_v, depth)
    by_tau = 2 * (at_u * along_u + at_v * along_v) - _dot(n_u, dual_u) - _dot(n_v, dual_v)
    by_tau = by_tau / (tau * tau) - 3 * m[M_0] / tau
    cc = _dot(c, c)
    for k in range(3):
        placed = m_u * j_u[k] + m_v * j_v[k] - (along_u * dual_u[k] + along_v * dual_v[k]) / (tau * tau)
        out[POSITION + k] = placed + by_tau * depth[k] + m[M_0] * c[k] / cc
        out[SCALE + k] = b_u[k] * t_u[k] + b_v[k] * t_v[k] + m[M_0]
    _write_quaternion(quaternion, turn, out)


@njit(cache=True, error_model="numpy", inline="always")
def _write_quaternion(q, turn, out):
    """Write 2 (0, turn) q/|q|², the gradient in q of a loss whose gradient in a turn is `turn`."""
    w, v = np.float64(q[0]), (np.float64(q[1]), np.float64(q[2]), np.float64(q[3]))
    crossed, twice = _cross(turn, v), 2 / (w * w + _dot(v, v))
    out[QUATERNION] = -twice * _dot(turn, v)
    for k in range(3):
        out[QUATERNION + 1 + k] = twice * (w * turn[k] + crossed[k])


@njit(cache=True, error_model="numpy")
def _gradient_chunk(shapes, values, quaternions, bounds, camera, image, out):
    fp, m = np.empty(FOOTPRINT), np.empty(MOMENTS)
    n_u = image.shape[1] - WIDTH
    for i in range(bounds[0], bounds[1]):
        if not footprint(shapes, i, camera, fp):
            continue
        if not abs(values[i, 0]) * fp[W0] + abs(values[i, values.shape[1] - 1]) * fp[W0] < LARGEST:
            continue
        read_moments(fp, values[i], image, camera[CUTOFF], n_u, m)
        write_gradient(shapes, i, quaternions[i], camera, fp, m, out[i])


@njit(cache=True, error_model="numpy", parallel=True)
def gradient(shapes, values, quaternions, camera, image, out):
    """Write the gradients of splats in one view, out float32 [splat, GRADIENT], which must be zero.

    Values [splat, channel] are the densities, image [channel · v, u + WIDTH] is dLoss/dL of one or two channels. The
    camera's tolerance must be infinite.
    Round splats take any quaternions but zero and get 0 for them.
    """
    n = values.shape[0]
    chunks = max(CHUNKS, n // 4096)
    for c in prange(chunks):
        bounds = (c * n // chunks, (c + 1) * n // chunks)
        _gradient_chunk(shapes, values, quaternions, bounds, camera, image, out)
