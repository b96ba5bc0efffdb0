"""log(x) of float64 that LLVM vectorises: eight numbers at once instead of one call a number."""

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

_LN2 = math.log(2.0)
# The bits of √½, and those of a mantissa.
_ROOT_HALF, _MANTISSA = np.float64(math.sqrt(0.5)).view(np.int64), np.int64(2**52 - 1)


@intrinsic
def _bits(typingctx, number):
    """Reinterpret a float64 as an int64."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), codegen


@intrinsic
def _number(typingctx, bits):
    """Reinterpret an int64 as a float64."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), codegen


@njit(cache=True, inline="always")
def log(x):
    """Return log(x) of a normal number, to 1e-12 of it or 1e-15, by operations that LLVM does for several at once."""
    bits = _bits(x) - _ROOT_HALF  # pyright: ignore[reportCallIssue]  numba supplies the context
    power = bits >> np.int64(52)
    m = _number((bits & _MANTISSA) + _ROOT_HALF)  # pyright: ignore[reportCallIssue]
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    series = 1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * (1 / 11 + q * (1 / 13 + q / 15)))))
    return np.float64(power) * _LN2 + 2.0 * s * (1.0 + q * series)
