"""The polychromatic response of many pixels at once, float32; `response_reference` says what is computed.

Exponents are taken relative to the node of smallest b, so that they are differences of attenuations from the
start and lose no digits behind metal, and shifted by each pixel's smallest, so that nothing underflows. log η_k
is part of the exponent: a node of no weight is one that never gets through.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from ctsim.tracer.kernels.exp_cpu import as_float, exp_minus

BLOCK = 256  # pixels whose intermediate sums stay in the L1 cache
CHUNK = 4096  # pixels of one task; sums over pixels are taken chunk by chunk, for any number of threads
FAST = {"contract", "reassoc", "nsz", "arcp"}
LN2 = np.float32(np.log(2.0))
THIRD, FIFTH, SEVENTH, NINTH = (np.float32(1 / n) for n in (3, 5, 7, 9))
ROOT_HALF = np.int32(np.float32(np.sqrt(0.5)).view(np.int32))


@intrinsic
def _bits(typingctx, number):
    """Reinterpret a float32 as an int32."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), codegen


@njit(inline="always")
def _log(x):
    """Return log(x) of a normal positive float32, vectorised; absolute error below 2e-7·max(1, log x)."""
    shifted = _bits(x) - ROOT_HALF  # pyright: ignore[reportCallIssue]  numba supplies the context
    exponent = shifted >> np.int32(23)
    mantissa = as_float((shifted & np.int32(0x007FFFFF)) + ROOT_HALF)  # pyright: ignore[reportCallIssue]
    f = mantissa - np.float32(1)
    s = f / (np.float32(2) + f)  # log m = 2·artanh(s), |s| ≤ 0.172: the first term left out is below 1e-9
    s2 = s * s
    series = np.float32(1) + s2 * (THIRD + s2 * (FIFTH + s2 * (SEVENTH + s2 * NINTH)))
    return np.float32(exponent) * LN2 + np.float32(2) * s * series


@njit(cache=True)
def _prepare(a, b, eta):
    """Return a, b (float32) less those of the node of smallest b that has weight, −log η, and that node's a and b."""
    first = -1
    for k in range(eta.size):
        if eta[k] > 0 and (first < 0 or b[k] < b[first]):
            first = k
    cost = np.empty(eta.size, np.float32)
    for k in range(eta.size):
        cost[k] = -np.log(eta[k]) if eta[k] > 0 else np.inf
    relative_a, relative_b = (a - a[first]).astype(np.float32), (b - b[first]).astype(np.float32)
    return relative_a, relative_b, cost, np.float32(a[first]), np.float32(b[first])


@njit(inline="always")
def _smallest(nodes, la, lb, n, low):
    """Fill `low` with each pixel's smallest exponent."""
    da, db, cost = nodes
    for i in range(n):
        low[i] = da[0] * la[i] + db[0] * lb[i] + cost[0]
    for k in range(1, cost.size):
        for i in range(n):
            low[i] = min(low[i], da[k] * la[i] + db[k] * lb[i] + cost[k])


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _block(nodes, offset, pixels, out, scratch):
    """Evaluate up to BLOCK pixels: `pixels` (la, lb) into `out` (p, dp_da, dp_db).

    No loop writes more than two arrays: with three, LLVM gives up proving them distinct and does not vectorise.
    """
    da, db, cost = nodes
    a0, b0 = offset
    la, lb = pixels
    p, dp_da, dp_db = out
    low, total, part = scratch
    n = la.size
    _smallest(nodes, la, lb, n, low)
    for i in range(n):
        total[i] = 0
        dp_da[i] = 0
        dp_db[i] = 0
    for k in range(cost.size):
        a_k, b_k, c_k = da[k], db[k], cost[k]
        for i in range(n):
            e = exp_minus(a_k * la[i] + b_k * lb[i] + c_k - low[i])
            part[i] = e
            total[i] += e
        for i in range(n):
            dp_da[i] += a_k * part[i]
            dp_db[i] += b_k * part[i]
    for i in range(n):
        p[i] = (a0 * la[i] + b0 * lb[i]) + (low[i] - _log(total[i]))
    for i in range(n):
        part[i] = np.float32(1) / total[i]
    for i in range(n):
        dp_da[i] = a0 + dp_da[i] * part[i]
        dp_db[i] = b0 + dp_db[i] * part[i]


@njit(parallel=True, cache=True, error_model="numpy")
def _evaluate(nodes, offset, la, lb, p, dp_da, dp_db):
    n = la.size
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        scratch = (np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32))
        for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n), BLOCK):
            last = min(first + BLOCK, n)
            out = (p[first:last], dp_da[first:last], dp_db[first:last])
            _block(nodes, offset, (la[first:last], lb[first:last]), out, scratch)


def evaluate(a, b, eta, la, lb):
    """Return P and its derivatives in la and lb, each float32 [pixel]; `la`, `lb` float32 [pixel]."""
    da, db, cost, a0, b0 = _prepare(a, b, eta)
    p, dp_da, dp_db = np.empty_like(la), np.empty_like(la), np.empty_like(la)
    _evaluate((da, db, cost), (a0, b0), la, lb, p, dp_da, dp_db)
    return p, dp_da, dp_db


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _block_sums(nodes, la, lb, g, scratch, sums):
    """Add up to BLOCK pixels' g·q_k to `sums` [node]."""
    da, db, cost = nodes
    low, total, parts = scratch
    n = la.size
    _smallest(nodes, la, lb, n, low)
    for i in range(n):
        total[i] = 0
    for k in range(cost.size):
        a_k, b_k, c_k = da[k], db[k], cost[k]
        for i in range(n):
            e = exp_minus(a_k * la[i] + b_k * lb[i] + c_k - low[i])
            parts[k, i] = e
            total[i] += e
    for i in range(n):
        total[i] = g[i] / total[i]
    for k in range(cost.size):
        partial = 0.0
        for i in range(n):
            partial += np.float64(parts[k, i]) * np.float64(total[i])
        sums[k] += partial


@njit(parallel=True, cache=True, error_model="numpy")
def _sums(nodes, la, lb, g, by_chunk):
    n, n_nodes = la.size, nodes[2].size
    for chunk in prange(by_chunk.shape[0]):
        scratch = (np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty((n_nodes, BLOCK), np.float32))
        for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n), BLOCK):
            last = min(first + BLOCK, n)
            _block_sums(nodes, la[first:last], lb[first:last], g[first:last], scratch, by_chunk[chunk])


def theta_sums(a, b, eta, la, lb, g):
    """Return Σ over pixels of g·dP/dη_k, float64 [node], bitwise equal for any number of threads; `g` float32 [pixel].

    η is not renormalised; a node of no weight gets 0.
    """
    da, db, cost, _, _ = _prepare(a, b, eta)
    by_chunk = np.zeros(((la.size + CHUNK - 1) // CHUNK, eta.size))
    _sums((da, db, cost), la, lb, g, by_chunk)
    total = np.zeros(eta.size)
    for partial in by_chunk:
        total += partial
    return np.divide(-total, eta, out=np.zeros(eta.size), where=eta > 0)
