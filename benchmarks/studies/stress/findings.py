"""What a row of the stress suite found, in words, and how a row is carried out.

A row fails where a number exceeds its limit and where anything is raised or warned of.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError


@dataclass(slots=True)
class Findings:
    """What a row found, in words; `wrong` is what is not as expected."""

    said: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "; ".join([*(f"NOT EXPECTED: {words}" for words in self.wrong), *self.said])

    def say(self, words: str, *, holds: bool = True) -> None:
        """Note something that was found, and whether it was expected."""
        (self.said if holds else self.wrong).append(words)

    def at_most(self, what: str, value: float, limit: float) -> None:
        """Note a number that must not exceed its limit; one that is not a number does."""
        holds = bool(value <= limit)
        self.say(f"{what} {value:.2g}" + ("" if holds else f", limit {limit:.2g}"), holds=holds)

    def finite(self, what: str, values: NDArray[Any]) -> None:
        """Note values that are not finite."""
        if not (fine := np.isfinite(values)).all():
            self.say(f"{int((~fine).sum())} of {fine.size} values of {what} are not finite", holds=False)

    def same(self, what: str, one: NDArray[Any], other: NDArray[Any]) -> None:
        """Note whether two arrays are equal to the last bit."""
        equal = one.shape == other.shape and np.array_equal(one, other)
        self.say(f"{what} {'equal to the last bit' if equal else 'differ'}", holds=equal)

    def refused(self, words: str, call: Callable[[], object]) -> None:
        """Note whether `call` raises an InputError whose sentence holds `words`."""
        try:
            call()
        except InputError as error:
            self.say(f"refused: {error}", holds=words in str(error))
        else:
            self.say(f"not refused, expected an InputError with {words!r}", holds=False)


def carry_out(run: Callable[[Findings], None]) -> tuple[Findings, float]:
    """Return what `run` finds and the seconds it took; exceptions and warnings, also numpy's, are not expected."""
    found, began = Findings(), time.perf_counter()
    with warnings.catch_warnings(record=True) as caught, np.errstate(divide="warn", over="warn", invalid="warn"):
        warnings.simplefilter("always")
        try:
            run(found)
        except Exception as error:  # an exception of any kind is a finding
            found.say(" ".join(f"{type(error).__name__}: {error}".split()), holds=False)
    for text in dict.fromkeys(f"{w.category.__name__}: {w.message}" for w in caught):
        found.say(text, holds=False)
    return found, time.perf_counter() - began
