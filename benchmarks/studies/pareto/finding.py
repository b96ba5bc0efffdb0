"""What `run-benchmark pareto` finds: marks of timed runs, the points that their medians make, and their front."""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Any, Literal, TypeVar, cast

import msgspec

from ctsim.benchmarks.engine.record import OK, Found, Record, Task

Part = Literal["simulator", "methods"]
LOWER: dict[str, tuple[str, ...]] = {"simulator": ("rms", "worst", "off_edges"), "methods": ("rmse",)}
"""The values of a part's marks that fronts can be drawn in, the main one first: smaller is better."""
NEAR = 0.05
"""A share by which errors may differ and hardly matter: 0.4 dB."""
ROUNDING = 1e-12  # of products of logarithms, which are below 100
FEWEST = 5
"""Runs of which the range is an interval of 94 %; all of five lie below five others by chance once in 252 times."""
T = TypeVar("T")


class Mark(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One checkpoint of a run: seconds elapsed and the errors reached. `default`: where the method would stop."""

    label: str
    seconds: Annotated[float, msgspec.Meta(gt=0)]
    values: dict[str, float]
    default: bool = False


class TimedRun(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One timed run; `warm_up` are the seconds of the call before it that compiled, if there was one."""

    marks: tuple[Mark, ...] = ()
    warm_up: float | None = None


class Timed(Record[TimedRun], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a run, which has all that a point needs."""

    def __post_init__(self) -> None:
        texts, errors = [self.task.settings.get(key) for key in ("group", "curve", "label")], LOWER.get(self.task.part)
        if errors is None or not all(isinstance(text, str) for text in texts):
            raise ValueError("task: expected a known part, and settings with group, curve and label")
        marks = [mark for run in self.found for mark in run.marks]
        if not all(mark.values.get(error, -1) >= 0 for mark in marks for error in errors):
            raise ValueError(f"marks: expected values {', '.join(errors)}, none of them negative")


@dataclass(frozen=True, kw_only=True)
class Point:
    """A task at one of its marks: the seconds of all rounds, and the errors, which do not differ between rounds.

    Points of a `group` may be compared; a `curve` is a method, or a kind of choice of the simulator.
    """

    task: Task
    part: Part
    group: str
    curve: str
    label: str
    seconds: tuple[float, ...]
    values: dict[str, float]
    default: bool

    @functools.cached_property
    def pair(self) -> tuple[float, float]:
        """Median seconds and error."""
        return median(self.seconds), self.values[LOWER[self.part][0]]

    def costs(self, errors: Sequence[str]) -> tuple[float, ...]:
        """Return the median seconds and these errors."""
        return self.pair[0], *(self.values[error] for error in errors)


def points(records: Sequence[Record[TimedRun]]) -> list[Point]:
    """Make a point of every mark, in the order of their first appearance."""
    marks = [(r.task, mark) for r in records for run in r.found if run.status == OK for mark in run.marks]
    return [
        Point(
            task=(task := of[-1][0]),
            part=cast("Part", task.part),
            group=task.settings["group"],
            curve=task.settings["curve"],
            label=label,
            seconds=tuple(mark.seconds for _, mark in of),
            values=of[-1][1].values,
            default=of[-1][1].default,
        )
        for (_, label), of in parted(marks, lambda m: (m[0].identity, m[1].label)).items()
    ]


def parted(values: Iterable[T], key: Callable[[T], Any]) -> dict[Any, list[T]]:
    """Part values by a key, in the order of first appearance."""
    found: dict[Any, list[T]] = {}
    for value in values:
        found.setdefault(key(value), []).append(value)
    return found


def groups(every: Sequence[Point]) -> list[list[Point]]:
    """Part the points into comparable ones: of one part, scene and group."""
    return list(parted(every, lambda p: (p.part, p.task.case, p.group)).values())


def rivals(of: Sequence[Point], p: Point, errors: Sequence[str]) -> list[Point]:
    """Return the points that beat one: no slower and no worse in any of these errors, and better in one of all."""
    mine = p.costs(errors)
    costs = [(q, q.costs(errors)) for q in of]
    return [q for q, its in costs if its != mine and all(a <= b for a, b in zip(its, mine, strict=True))]


def front(of: Sequence[Point], error: str | None = None) -> list[Point]:
    """Return the points that no other beats in an error, by default the main one; fastest first.

    Of equal points all are on the front.
    """
    errors = [error or LOWER[of[0].part][0]]
    return sorted((p for p in of if not rivals(of, p, errors)), key=lambda p: p.costs(errors))


def knee(of: Sequence[Point]) -> Point | None:
    """Return the point of the front that lies farthest below the chord between its ends, in log-log.

    Scaling either axis moves no point past another, so no normalisation enters. None where no point lies below
    the chord, as for fewer than three, or one is without error.
    """
    on = front(of)
    if min(p.pair[1] for p in on) <= 0:
        return None
    x, y = ([math.log(p.pair[axis]) for p in on] for axis in (0, 1))
    # twice the area of the triangle with the chord: distance times the chord's length, positive below it
    below = [(x[-1] - x[0]) * (y[0] - v) - (x[0] - u) * (y[-1] - y[0]) for u, v in zip(x, y, strict=True)]
    return on[below.index(max(below))] if max(below) > ROUNDING else None


def faster(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether runs of `a` seconds are faster than those of `b` beyond the spread of both.

    The 95 % intervals of their medians do not meet: between order statistics, for any distribution. Fewer than
    `FEWEST` runs tell nothing.
    """
    return min(len(a), len(b)) >= FEWEST and _interval(a)[1] < _interval(b)[0]


def _interval(runs: Sequence[float]) -> tuple[float, float]:
    n, at, below = len(runs), 0, 1  # below: of 2ⁿ equally likely cases, those with at most `at` runs under the median
    while below < 0.025 * 2**n:
        at += 1
        below += math.comb(n, at)
    at = max(at - 1, 0)
    ordered = sorted(runs)
    return ordered[at], ordered[-1 - at]


def enough(of: Sequence[Point]) -> Point:
    """Return the fastest point whose error is within `NEAR` of the least."""
    least = min(p.pair[1] for p in of)
    return min((p for p in of if p.pair[1] <= (1 + NEAR) * least), key=lambda p: p.pair)


def recommended(of: Sequence[Point]) -> Point:
    """Return the setting to take: of methods the fastest near the least error of all.

    Of the simulator's choices it is the knee of the default's own curve, if there is one: its error falls on and on,
    and what other curves differ in shows in another error.
    """
    if of[0].part == "methods":
        return enough(of)
    usual = {p.curve for p in of if p.default}
    mine = [p for p in of if not usual or p.curve in usual]
    return knee(mine) or enough(mine)
