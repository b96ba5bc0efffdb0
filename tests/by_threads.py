"""What a function returns with one thread and with several."""

from collections.abc import Callable
from typing import TypeVar

import numba
import pytest

T = TypeVar("T")


def one_and_several(function: Callable[[], T]) -> tuple[T, T]:
    """Call a function with one thread of the kernels, and with as many as there are cores; skip where that is one.

    Tests themselves share the cores, so that `numba.get_num_threads()` is often 1: it says nothing to compare with it.
    """
    before, most = numba.get_num_threads(), numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
    if most < 2:
        pytest.skip("one core")
    try:
        numba.set_num_threads(1)
        one = function()
        numba.set_num_threads(most)
        return one, function()
    finally:
        numba.set_num_threads(before)
