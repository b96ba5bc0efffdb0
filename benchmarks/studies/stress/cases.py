"""What a case of the stress suite is, and how one is carried out.

A case says what it found against an oracle. It fails where a number exceeds its limit, where anything is raised or
warned of, and, in `stress_worker`, where its process dies or does not end.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError

FULL, SHORT = 24, 16  # voxels along a side
SIMULATOR, SPLATS = "simulator", "splat kernels"  # subjects beside the methods


@dataclass(slots=True)
class Findings:
    """What a case found, in words; `wrong` is what is not as expected."""

    said: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One row: `run(side, findings)` carries it out on grids of so many voxels a side.

    `subject` is what is put under stress: SIMULATOR, SPLATS or the name of a method. `code` hashes the sources that
    decide the result.
    """

    name: str
    subject: str
    what: str
    expected: str
    run: Callable[[int, Findings], None]
    code: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a case ended: as expected or not, what was found, and the seconds it took."""

    ok: bool
    found: str
    seconds: float = 0.0


def carry_out(case: Case, side: int) -> Outcome:
    """Carry out a case in this process; an exception and every warning, those of numpy included, are failures."""
    findings, began = Findings(), time.perf_counter()
    with warnings.catch_warnings(record=True) as caught, np.errstate(divide="warn", over="warn", invalid="warn"):
        warnings.simplefilter("always")
        try:
            case.run(side, findings)
        except Exception as error:  # whatever is raised is the finding
            findings.say(" ".join(f"{type(error).__name__}: {error}".split()), holds=False)
    for text in dict.fromkeys(f"{w.category.__name__}: {w.message}" for w in caught):
        findings.say(text, holds=False)
    found = "; ".join([*(f"NOT EXPECTED: {w}" for w in findings.wrong), *findings.said])
    return Outcome(ok=not findings.wrong, found=found, seconds=time.perf_counter() - began)
