"""A row of float32 lanes as one value in numba, so that LLVM keeps a row of pixels in one register.

Numba has no vector type of its own, and its loops over arrays that may alias are not vectorised. A value of
type `lanes` is an LLVM vector: sixteen lanes on processors with AVX-512, eight on others. Where registers are narrower
LLVM splits it.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.core.datamodel.models import PrimitiveModel
from numba.extending import intrinsic, register_model


def _has_avx512() -> bool:
    """Whether numba compiles for registers of 512 bits."""
    told = vars(config)["CPU_FEATURES"]  # NUMBA_CPU_FEATURES, None unless set
    return "+avx512f" in (get_host_cpu_features() if told is None else told)


WIDTH = 16 if _has_avx512() else 8
_FLOATS, _INTS = ir.VectorType(ir.FloatType(), WIDTH), ir.VectorType(ir.IntType(32), WIDTH)
_LARGEST = 115.0  # 2^115 = 4e34: the clamp of exponents keeps results normal float32
_MAGIC = 1.5 * 2.0**23  # added to a float32 it leaves the nearest whole number in the last bits
_NODES = 0.5 * np.cos((np.arange(64) + 0.5) * math.pi / 64)


class Lanes(types.Type):
    """The numba type of a row of float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name="lanes")


lanes = Lanes()


@register_model(Lanes)
class _Model(PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, _FLOATS)


def _same(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * WIDTH)


def _call(builder, name: str, *args):
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f32"), args)


def _spread(builder, number):
    first = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * WIDTH))


def _address(context, builder, array_type, array, row, column):
    """Address of array[row, column … column + WIDTH − 1] of a C-contiguous float32 array; nothing is checked."""
    view = context.make_array(array_type)(context, builder, array)
    at = cgutils.get_item_pointer(context, builder, array_type, view, [row, column], wraparound=False)
    return builder.bitcast(at, _FLOATS.as_pointer())


def _operation(function: Callable[..., Any]) -> Any:
    """Make an intrinsic, whose first argument is numba's own and not the caller's."""
    return intrinsic(function)


@_operation
def load(typingctx, array, row, column):
    """Read array[row, column : column + WIDTH]."""

    def codegen(context, builder, signature, args):
        value = builder.load(_address(context, builder, signature.args[0], *args))
        value.align = 4
        return value

    return lanes(array, types.intp, types.intp), codegen


@_operation
def store(typingctx, array, row, column, value):
    """Write array[row, column : column + WIDTH]."""

    def codegen(context, builder, signature, args):
        written = builder.store(args[3], _address(context, builder, signature.args[0], *args[:3]))
        written.align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes), codegen


@_operation
def spread(typingctx, number):
    """Return a float32 in all lanes."""

    def codegen(context, builder, signature, args):
        return _spread(builder, args[0])

    return lanes(types.float32), codegen


@_operation
def pick(typingctx, array, row, column):
    """Return array[row, column] in all lanes; nothing is checked."""

    def codegen(context, builder, signature, args):
        array_type = signature.args[0]
        view = context.make_array(array_type)(context, builder, args[0])
        at = cgutils.get_item_pointer(context, builder, array_type, view, args[1:], wraparound=False)
        return _spread(builder, builder.load(at))

    return lanes(array, types.intp, types.intp), codegen


@_operation
def pair(typingctx, array, row, column):
    """Return array[row, column] and array[row, column + 1] in turns; nothing is checked."""

    def codegen(context, builder, signature, args):
        two = ir.VectorType(ir.FloatType(), 2)
        value = builder.load(builder.bitcast(_address(context, builder, signature.args[0], *args), two.as_pointer()))
        value.align = 4
        return builder.shuffle_vector(value, value, ir.Constant(_INTS, [0, 1] * (WIDTH // 2)))

    return lanes(array, types.intp, types.intp), codegen


@_operation
def ramp(typingctx, first):
    """Return first, first + 1, … in the lanes."""

    def codegen(context, builder, signature, args):
        return builder.fadd(_spread(builder, args[0]), ir.Constant(_FLOATS, [float(k) for k in range(WIDTH)]))

    return lanes(types.float32), codegen


@_operation
def below(typingctx, first, limit):
    """Return 1 in the lanes k with first + k < limit, and 0 in the others."""

    def codegen(context, builder, signature, args):
        inside = []
        for k in range(WIDTH):
            at = builder.add(args[0], ir.Constant(args[0].type, k))
            inside.append(builder.uitofp(builder.icmp_signed("<", at, args[1]), ir.FloatType()))
        value = ir.Constant(_FLOATS, ir.Undefined)
        for k, one in enumerate(inside):
            value = builder.insert_element(value, one, ir.Constant(ir.IntType(32), k))
        return value

    return lanes(types.intp, types.intp), codegen


def _binary(instruction: str, doc: str):
    @_operation
    def operation(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return getattr(builder, instruction)(*args)

        return lanes(lanes, lanes), codegen

    operation.__doc__ = doc
    return operation


add = _binary("fadd", "a + b")
sub = _binary("fsub", "a − b")
mul = _binary("fmul", "a · b")
div = _binary("fdiv", "a / b")


@_operation
def fma(typingctx, a, b, c):
    """Return a·b + c, rounded once."""

    def codegen(context, builder, signature, args):
        return _call(builder, "fma", *args)

    return lanes(lanes, lanes, lanes), codegen


@_operation
def positive(typingctx, a):
    """Return max(a, 0), and NaN where a is."""

    def codegen(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered("<", args[0], _same(0.0)), _same(0.0), args[0])

    return lanes(lanes), codegen


@_operation
def where_positive(typingctx, a, b):
    """Return b where a > 0 or NaN, else 0."""

    def codegen(context, builder, signature, args):
        return builder.select(builder.fcmp_unordered(">", args[0], _same(0.0)), args[1], _same(0.0))

    return lanes(lanes, lanes), codegen


@_operation
def sqrt(typingctx, a):
    """Return √a."""

    def codegen(context, builder, signature, args):
        return _call(builder, "sqrt", *args)

    return lanes(lanes), codegen


def _power_of_two(builder, y, degree: int):
    """Return 2^y for |y| below 126, anything beyond.

    2^f on [−½, ½] is a Chebyshev fit in float64, rounded: its relative error is below 2e-8 with degree 6, 4e-6 with 4.
    """
    fit = np.polynomial.Polynomial.fit(_NODES, 2.0**_NODES, degree, domain=[-0.5, 0.5]).convert().coef
    shifted = builder.fadd(y, _same(_MAGIC))
    f = builder.fsub(y, builder.fsub(shifted, _same(_MAGIC)))
    power = _same(fit[-1])
    for c in fit[-2::-1]:
        power = _call(builder, "fma", power, f, _same(c))
    whole = builder.shl(builder.bitcast(shifted, _INTS), ir.Constant(_INTS, [23] * WIDTH))
    return builder.bitcast(builder.add(builder.bitcast(power, _INTS), whole), _FLOATS)


@_operation
def exp(typingctx, a):
    """Return eᵃ with a clamped to ±79; relative error below 2e-7 + 6e-8·|a|."""

    def codegen(context, builder, signature, args):
        y = builder.fmul(args[0], _same(math.log2(math.e)))
        y = _call(builder, "maxnum", _call(builder, "minnum", y, _same(_LARGEST)), _same(-_LARGEST))
        return _power_of_two(builder, y, 6)

    return lanes(lanes), codegen


@_operation
def decay(typingctx, a, least):
    """Return 2ᵃ for a up to 115, and 0 where a is below `least`, which is −115 or more; relative error below 4e-6."""

    def codegen(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered(">=", *args), _power_of_two(builder, args[0], 4), _same(0.0))

    return lanes(lanes, lanes), codegen


def _shuffled(which: list[int], doc: str):
    @_operation
    def operation(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return builder.shuffle_vector(*args, ir.Constant(_INTS, which))

        return lanes(lanes, lanes), codegen

    operation.__doc__ = doc
    return operation


_TURNS = [k + far for k in range(WIDTH) for far in (0, WIDTH)]
evens = _shuffled([*range(0, 2 * WIDTH, 2)], "Every second lane of a and on through b, from the first.")
odds = _shuffled([*range(1, 2 * WIDTH, 2)], "Every second lane of a and on through b, from the second.")
lower = _shuffled(_TURNS[:WIDTH], "The lanes of a and b in turns, the first half.")
upper = _shuffled(_TURNS[WIDTH:], "The lanes of a and b in turns, the second half.")


@_operation
def total(typingctx, a):
    """Return the sum of the lanes, by halves."""

    def codegen(context, builder, signature, args):
        value, n = args[0], WIDTH
        while n > 1:
            n //= 2
            kind = ir.VectorType(ir.IntType(32), n)
            low, high = (ir.Constant(kind, list(range(k, k + n))) for k in (0, n))
            halves = [builder.shuffle_vector(value, value, which) for which in (low, high)]
            value = builder.fadd(*halves)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(lanes), codegen
