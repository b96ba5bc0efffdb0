"""Functions that kernels call by address, so that they are compiled once.

Numba links every compiled function into its caller and optimises it again there: what a parallel kernel calls is
optimised once for each level of calls and three more times for the parallel loop. A function that callers know by its
address only, an integer argument, is optimised once, however deep it lies. Such a call is never inlined and costs some
nanoseconds, so it is for rows and blocks, not for rays.
"""

import functools
from collections.abc import Callable
from typing import Any

from numba import njit, types
from numba.core import cgutils, sigutils
from numba.core.errors import TypingError
from numba.extending import intrinsic


def compiled_once(*arguments: str, **options: Any) -> Callable[[Callable], Any]:
    """Compile the decorated function, which returns nothing, for these Numba types of its arguments.

    It has one specialisation. Compiled code calls it as `f(address, *arguments)`; the address is `f.address()`, which
    compiles or loads the function when first asked. `f.compiled` is Numba's dispatcher.
    """

    def decorate(function: Callable) -> Any:
        compiled = njit(cache=True, error_model="numpy", **options)(function)

        @functools.cache
        def declared() -> Any:
            return sigutils.normalize_signature(f"void({', '.join(arguments)})")[0]

        @intrinsic
        def call(typingctx, address, *given):
            wanted: Any = declared()
            if len(given) != len(wanted) or not all(map(typingctx.can_convert, given, wanted)):
                raise TypingError(f"{function.__name__} takes {wanted}, got {given}")
            packed: Any = types.BaseTuple.from_types(wanted)
            return types.void(types.int64, packed), _by_address

        @functools.cache
        def address() -> int:
            compiled.compile(declared())
            found = compiled.overloads[declared()]
            return found.library.get_pointer_to_function(found.fndesc.llvm_func_name)

        made: Any = call
        made.address, made.compiled = address, compiled
        return made

    return decorate


def _by_address(context, builder, signature, values):
    """Emit the call of a function of Numba's calling convention, and pass on its exception."""
    wanted = tuple(signature.args[1])
    kind = context.call_conv.get_function_type(types.void, wanted).as_pointer()
    function = builder.inttoptr(values[0], kind)
    unpacked = cgutils.unpack_tuple(builder, values[1], len(wanted))
    status, _ = context.call_conv.call_function(builder, function, types.void, wanted, unpacked)
    with cgutils.if_unlikely(builder, status.is_error):
        context.call_conv.return_status_propagate(builder, status)
    return context.get_dummy_value()
