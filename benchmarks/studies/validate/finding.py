"""What `run-benchmark validate` finds: checks, and curves for the figures."""

import math
from typing import Any

import msgspec

from ctsim.benchmarks.engine.record import Found


class Curves(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Lines over one axis, for a group's figure."""

    title: str
    across: str
    up: str
    x: tuple[float, ...]
    lines: dict[str, tuple[float, ...]]

    def __post_init__(self) -> None:
        if any(len(line) != len(self.x) for line in self.lines.values()):
            raise ValueError("lines must have as many values as x")


class Check(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One quantity: what ctsim says, what the reference says, and how far the two may differ.

    `tolerance` is relative where `relative`, None where none can be derived. A `known` deviation is shown as not held
    and does not fail. `source` says where the reference comes from, `why` how the tolerance is derived.
    """

    quantity: str = ""
    unit: str = ""
    ours: float | None = None
    reference: float | None = None
    relative: bool = True
    tolerance: float | None = None
    known: bool = False
    source: str = ""
    why: str = ""
    curves: tuple[Curves, ...] = ()

    def __post_init__(self) -> None:
        if self.relative and self.reference == 0:
            raise ValueError("a relative difference needs a reference that is not 0")
        if self.tolerance is not None and not self.tolerance >= 0:
            raise ValueError("tolerance must not be negative")

    @property
    def difference(self) -> float | None:
        """The difference, relative to the reference where `relative`; None without two numbers."""
        if self.ours is None or self.reference is None:
            return None
        return self.ours / self.reference - 1 if self.relative else self.ours - self.reference

    @property
    def verdict(self) -> str:
        """Whether the difference is within the tolerance, in a word."""
        if self.ours is None:
            return "NO"
        if self.tolerance is None:
            return "–"
        within = self.difference is not None and abs(self.difference) <= self.tolerance
        return "yes" if within else "not held, known" if self.known else "NO"


def check(quantity: str, ours: float, reference: float, *, tolerance: float | None = None, **more: Any) -> Check:
    """Return a check with its verdict; `ours` that is not finite never holds."""
    found = Check(
        quantity=quantity,
        ours=float(ours) if math.isfinite(ours) else None,
        reference=float(reference),
        tolerance=None if tolerance is None else float(tolerance),
        **more,
    )
    return msgspec.structs.replace(found, ok=found.verdict != "NO")
