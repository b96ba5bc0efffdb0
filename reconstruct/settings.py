"""Settings of a method as one frozen value whose fields are the method's keyword parameters."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from ctsim.types import Scan, Volume

S = TypeVar("S")


def keywords(kind: type[S]) -> Callable[[Callable[[Scan, S, str], Volume]], Callable[..., Volume]]:
    """Turn a function of (scan, settings, device) into `reconstruct(scan, *, device="cpu", <fields of kind>)`.

    `kind` is a frozen dataclass with a default for every field, which checks itself. The signature lists its fields, so
    that they can be set by name on the command line.
    """
    fields = [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
        for f in dataclasses.fields(kind)  # pyright: ignore[reportArgumentType]
    ]
    device = inspect.Parameter("device", inspect.Parameter.KEYWORD_ONLY, default="cpu", annotation=str)
    scan = inspect.Parameter("scan", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Scan)
    signature = inspect.Signature([scan, device, *fields], return_annotation=Volume)

    def wrap(function: Callable[[Scan, S, str], Volume]) -> Callable[..., Volume]:
        @functools.wraps(function)
        def method(scan: Scan, *, device: str = "cpu", **given: Any) -> Volume:
            return function(scan, kind(**given), device)

        method.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
        return method

    return wrap
