"""Results of `run-benchmark pareto`: marks of timed runs, the points of their medians, and the Pareto front."""

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
"""The errors of each part that a front can be drawn in, the main one first. Smaller is better."""
NEAR = 0.05
"""A relative difference of errors that hardly matters: 0.4 dB."""
ROUNDING = 1e-12  # of products of logarithms, which are below 100
FEWEST = 5
"""With five runs the range is a 94 % interval of the median; five lie below five others by chance in 1 of 252."""
T = TypeVar("T")


class Mark(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One checkpoint of a run: seconds elapsed and the errors reached. `default`: where the method would stop."""

    label: str
    seconds: Annotated[float, msgspec.Meta(gt=0)]
    values: dict[str, float]
    default: bool = False


class TimedRun(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One timed run; `warm_up` has the seconds of the compiling call before it, if there was one."""

    marks: tuple[Mark, ...] = ()
    warm_up: float | None = None


class Timed(Record[TimedRun], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a run, checked to have what a point needs."""

    def __post_init__(self) -> None:
        texts, errors = [self.task.settings.get(key) for key in ("group", "curve", "label")], LOWER.get(self.task.part)
        if errors is None or not all(isinstance(text, str) for text in texts):
            raise ValueError("task: expected a known part, and settings with group, curve and label")
        marks = [mark for run in self.found for mark in run.marks]
        if not all(mark.values.get(error, -1) >= 0 for mark in marks for error in errors):
            raise ValueError(f"marks: expected values {', '.join(errors)}, none of them negative")


@dataclass(frozen=True, kw_only=True)
class Point:
    """A task at one of its marks: the seconds of all rounds, and the errors, which are the same in every round.

    Points of one `group` are comparable; a `curve` is a method, or one kind of setting of the simulator.
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
        """Median seconds and main error."""
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
    """Group values by a key, in the order of first appearance."""
    found: dict[Any, list[T]] = {}
    for value in values:
        found.setdefault(key(value), []).append(value)
    return found


def groups(every: Sequence[Point]) -> list[list[Point]]:
    """Group the comparable points: of one part, scene and group."""
    return list(parted(every, lambda p: (p.part, p.task.case, p.group)).values())


def rivals(of: Sequence[Point], p: Point, errors: Sequence[str]) -> list[Point]:
    """Return the points that dominate `p`: no worse in time and these errors, and better in at least one."""
    mine = p.costs(errors)
    costs = [(q, q.costs(errors)) for q in of]
    return [q for q, its in costs if its != mine and all(a <= b for a, b in zip(its, mine, strict=True))]


def front(of: Sequence[Point], error: str | None = None) -> list[Point]:
    """Return the points that no other dominates in time and an error, by default the main one; fastest first.

    Equal points are all on the front.
    """
    errors = [error or LOWER[of[0].part][0]]
    return sorted((p for p in of if not rivals(of, p, errors)), key=lambda p: p.costs(errors))


def knee(of: Sequence[Point]) -> Point | None:
    """Return the point of the front that lies farthest below the chord between its ends, in log-log.

    Scaling an axis changes no order, so nothing is normalised. None where no point lies below the chord, as for
    fewer than three points, or where an error is 0.
    """
    on = front(of)
    if min(p.pair[1] for p in on) <= 0:
        return None
    x, y = ([math.log(p.pair[axis]) for p in on] for axis in (0, 1))
    # twice the area of the point's triangle with the chord: its distance times a constant, positive below
    below = [(x[-1] - x[0]) * (y[0] - v) - (x[0] - u) * (y[-1] - y[0]) for u, v in zip(x, y, strict=True)]
    return on[below.index(max(below))] if max(below) > ROUNDING else None


def faster(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether runs of `a` seconds are faster than runs of `b` by more than the spread of both.

    True where the 95 % intervals of the medians, between order statistics, do not overlap; holds for any distribution.
    False for fewer than `FEWEST` runs.
    """
    return min(len(a), len(b)) >= FEWEST and _interval(a)[1] < _interval(b)[0]


def _interval(runs: Sequence[float]) -> tuple[float, float]:
    n, at, below = len(runs), 0, 1  # below: how many of 2ⁿ equally likely cases have at most `at` runs under the median
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
    """Return the recommended setting: of methods the fastest point near the least error.

    Of the simulator it is the knee of the default's curve, if there is one: along that curve the error keeps falling,
    and other curves differ in another error.
    """
    if of[0].part == "methods":
        return enough(of)
    usual = {p.curve for p in of if p.default}
    mine = [p for p in of if not usual or p.curve in usual]
    return knee(mine) or enough(mine)
