"""The page of the methods: what each needs, and its parameters."""

import dataclasses
import inspect
import typing
from collections.abc import Callable
from typing import Any

from ctsim.benchmarks.methods import TABLE, find, resolve
from ctsim.benchmarks.tools.reference import text

HEAD = """# Methods and their parameters

`run-benchmark DATA RESULTS --method NAME` runs a method, and `--set NAME.parameter=value` changes a parameter. A value
is read as JSON, or as text where it is not JSON. [Methods](../explanation/methods.md) explains what the methods do."""


def page() -> str:
    """Return the page as Markdown."""
    rows = [(f"[`{name}`](#{name})", inputs, _first(resolve(target))) for name, (target, inputs) in TABLE.items()]
    summary = text.table(("method", "inputs", "what it does"), rows)
    return "\n\n".join([HEAD, summary, *(section(name) for name in TABLE)])


def section(name: str) -> str:
    """Return heading, description and parameters of one method."""
    method = find(name)
    function = resolve(method.target)
    kind = settings_type(function)
    said = text.field_texts(kind) if kind else {}
    hints = _hints(function)
    rows = [
        (f"`{key}`", _kind(hints.get(key)), "none" if value is None else text.code(value), said.get(key, ""))
        for key, value in method.params.items()
    ]
    parts = [f"## {name}", f"Inputs: {method.inputs}. Function: `{method.target}`.", text.described(function)]
    for base in _bases(kind) if kind else ():
        parts.append(f"`{base.__name__}`: {text.described(base)}")
    if rows:
        parts.append(text.table(("parameter", "value", "default", "meaning"), rows))
    return "\n\n".join(parts)


def settings_type(function: Callable[..., Any]) -> type | None:
    """Return the dataclass that holds a method's parameters, where it has one."""
    inner = inspect.unwrap(function)
    hints = typing.get_type_hints(inner)
    known = (hints[p] for p in list(inspect.signature(inner, follow_wrapped=False).parameters)[1:] if p in hints)
    return next((kind for kind in known if dataclasses.is_dataclass(kind) and isinstance(kind, type)), None)


def _bases(kind: type) -> list[type]:
    """Return a settings type and those it extends, which describe their own fields."""
    return [base for base in kind.__mro__ if dataclasses.is_dataclass(base)]


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    kind = settings_type(function)
    return typing.get_type_hints(kind if kind else inspect.unwrap(function))


def _kind(hint: Any) -> str:
    return "" if hint is None else text.kind_name(hint)


def _first(function: Callable[..., Any]) -> str:
    return text.described(function).partition("\n\n")[0].split(";")[0].rstrip(".") + "."
