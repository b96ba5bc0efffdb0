"""exp(−x) that LLVM vectorises: sixteen float32 lanes instead of one call a number."""

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

LOG2E = np.float32(math.log2(math.e))
# 2^f on [−½, ½], Chebyshev fit of degree 6 in float64, rounded; relative error below 2e-8
_NODES = 0.5 * np.cos((np.arange(64) + 0.5) * math.pi / 64)
C0, C1, C2, C3, C4, C5, C6 = (
    np.float32(c) for c in np.polynomial.Polynomial.fit(_NODES, 2.0**_NODES, 6, domain=[-0.5, 0.5]).convert().coef
)
LARGEST = np.float32(80.0)  # exp(−80) = 1.8e-35 is still a normal float32


@intrinsic
def as_float(typingctx, bits):
    """Reinterpret an int32 as a float32."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@njit(inline="always")
def exp_minus(x):
    """Return exp(−x) in float32 for x ≥ 0, with x clamped at 80; relative error below 4e-7·max(1, x/4)."""
    y = -min(x, LARGEST) * LOG2E
    whole = np.float32(np.floor(y + np.float32(0.5)))
    f = y - whole
    p = C0 + f * (C1 + f * (C2 + f * (C3 + f * (C4 + f * (C5 + f * C6)))))
    return p * as_float((np.int32(whole) + np.int32(127)) << np.int32(23))  # pyright: ignore[reportCallIssue]  numba supplies the context
