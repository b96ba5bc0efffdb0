"""`run-benchmark methods`: the methods with their inputs, and what --set may say to each."""

import sys
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import tyro

from ctsim.benchmarks.methods import TABLE, find, parameters, resolve

WIDEST = 24  # characters of a default that others are aligned with


@dataclass(frozen=True)
class Flags:
    """List the methods, what they need, and their parameters with defaults, bounds and units."""

    method: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")]] = ()
    """Only these methods, or module:function of your own (default: all of the table)."""


def main(arguments: list[str]) -> int:
    """Print the list; return 0."""
    given = tyro.cli(Flags, prog="run-benchmark methods", args=arguments)
    sys.stdout.write("\n".join(described(name) for name in given.method or TABLE))
    return 0


def described(name: str) -> str:
    """Describe a method: a line with its inputs, and one for each parameter."""
    method = find(name)
    known = parameters(name, resolve(method.target))
    defaults = {key: _default(method.params[key]) for key in known}
    widths = [max((len(t) for t in texts if len(t) <= WIDEST), default=0) for texts in (known, defaults.values())]
    lines = [f"{name}: {method.inputs}"]
    for key, parameter in known.items():
        meaning = f"; {parameter.meaning}" if parameter.meaning else ""
        lines.append(f"  {key:{widths[0]}}  {defaults[key]:{widths[1]}}  {parameter.expected}{meaning}")
    return "\n".join(lines) + "\n"


def _default(value: Any) -> str:
    """Write a default as --set takes it."""
    if value == float("inf"):
        return "no limit"
    return value or '""' if isinstance(value, str) else msgspec.json.encode(value).decode()
