"""What a method says of its result, as its record keeps it: numbers, words, and lists and dicts of them.

An array, a tensor or any other object is left out, and so is an entry of more than `LONGEST` bytes of JSON. A list
that holds one is left out whole, for its places mean something; a dict loses that entry, and is left out where it
loses all. What is not finite becomes None.
"""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from ctsim.benchmarks.studies.methods import intermediates

LONGEST = 10_000
ELSEWHERE = ("view_updates", intermediates.KEY)
"""Entries that a run keeps already: in its cost, and beside its volume."""


def kept(details: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a volume's details that a record keeps, as they are when it is read again."""
    found: dict[str, Any] = {}
    for name, value in _entries(details).items():
        try:
            line = msgspec.json.encode({name: value})  # null where a number is not finite
            if name not in ELSEWHERE and len(line) <= LONGEST:
                found |= msgspec.json.decode(line)
        except (ValueError, msgspec.MsgspecError):  # half a surrogate pair, or an integer of thousands of digits
            continue
    return found


def _entries(given: Mapping[Any, Any]) -> dict[str, Any]:
    found = {}
    for name, value in given.items():
        try:
            found[_word(name)] = _plain(value)
        except TypeError:
            continue
    return found


def _word(value: object) -> str:
    """Return a string without what a subclass adds; raises TypeError for anything else."""
    return str.__str__(value)  # pyright: ignore[reportArgumentType]


def _plain(value: object) -> Any:
    """Return a value in the types of JSON; raises TypeError where it has none."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value)
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        found = _entries(value)
        if value and not found:
            raise TypeError("a record keeps none of its entries")
        return found
    return _word(value)
