"""What keeps runs apart that share a process: each has its own view of the data and leaves nothing behind."""

import contextlib
import dataclasses
import gc
import os
import random
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ctsim.types import Scan

Setting = tuple[Callable[[], Any], Callable[[Any], object]]


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Put back, when the block ends, what a process has one of: the work folder, threads, defaults, random states.

    The environment and the filters of warnings are among it. What a block imports or starts stays.
    """
    settings = _settings()
    before, environment = [get() for get, _ in settings], dict(os.environ)
    with warnings.catch_warnings(), np.errstate():
        try:
            yield
        finally:
            for (get, put), value in zip(settings, before, strict=True):
                with contextlib.suppress(OSError):  # a folder that is gone
                    if get() != value:
                        put(value)
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]
            os.environ.update({k: v for k, v in environment.items() if os.environ.get(k) != v})


def _settings() -> tuple[Setting, ...]:
    import numba
    import torch

    numpy_state, torch_state = np.random.get_state, torch.get_rng_state
    return (
        (_folder, os.chdir),
        (numba.get_num_threads, numba.set_num_threads),
        (torch.get_num_threads, torch.set_num_threads),
        (torch.get_default_device, lambda to: torch.set_default_device(None if to.type == "cpu" else to)),
        (torch.get_default_dtype, torch.set_default_dtype),
        (torch.is_grad_enabled, torch.set_grad_enabled),
        (torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
        (random.getstate, random.setstate),
        (lambda: _plain(numpy_state()), np.random.set_state),
        (lambda: torch_state().tolist(), lambda state: torch.set_rng_state(torch.tensor(state, dtype=torch.uint8))),
        (sys.getrecursionlimit, sys.setrecursionlimit),
        (lambda: signal.getsignal(signal.SIGINT), lambda handler: signal.signal(signal.SIGINT, handler)),
        (gc.isenabled, lambda enabled: gc.enable() if enabled else gc.disable()),
        (lambda: sys.stdout, lambda stream: setattr(sys, "stdout", stream)),
        (lambda: sys.stderr, lambda stream: setattr(sys, "stderr", stream)),
    )


def _folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:
        return ""


def _plain(state: Any) -> tuple[Any, ...]:
    name, keys, *rest = state
    return name, keys.tolist(), *rest


def changed(scan: "Scan", fresh: "Scan") -> list[str]:
    """Return the names of the parts of a scan that are not those of `fresh`, bit by bit."""
    names = [field.name for field in dataclasses.fields(scan)]
    return [name for name in names if not _same(getattr(scan, name), getattr(fresh, name))]


def _same(one: Any, other: Any) -> bool:
    import torch

    if not (isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor)):
        return type(one) is type(other) and one == other
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    # a view at a time: the comparison takes an array of truths; as bytes: NaN is equal to itself
    pairs = zip(one.detach().numpy(), other.detach().numpy(), strict=True)
    return all(np.array_equal(_bytes(a), _bytes(b)) for a, b in pairs)


def _bytes(array: Any) -> Any:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)
