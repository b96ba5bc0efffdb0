"""What `run-benchmark pareto` finds: marks of timed runs, and the points that their medians make."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal, cast

import msgspec

from ctsim.benchmarks.engine.record import OK, Found, Record, Task
from ctsim.benchmarks.studies.pareto.front import Pair, knee

Part = Literal["simulator", "methods"]
LOWER: dict[str, tuple[str, ...]] = {"simulator": ("rms", "worst", "off_edges"), "methods": ("rmse",)}
"""The values of a part's marks that fronts can be drawn in, the main one first: smaller is better."""
NEAR = 0.05
"""A share by which errors may differ and hardly matter: 0.4 dB."""


class Mark(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One checkpoint of a run: seconds elapsed and the errors reached. `default`: where the method would stop."""

    label: str
    seconds: float
    values: dict[str, float]
    default: bool = False


class Run(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One timed run; `warm_up` are the seconds of the call before it that compiled, if there was one."""

    marks: tuple[Mark, ...] = ()
    warm_up: float | None = None


class Timed(Record[Run], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a run, which has all that a point needs."""

    def __post_init__(self) -> None:
        texts, errors = [self.task.settings.get(key) for key in ("group", "curve", "label")], LOWER.get(self.task.part)
        if errors is None or not all(isinstance(text, str) for text in texts):
            raise ValueError("task: expected a known part, and settings with group, curve and label")
        if not all(mark.values.keys() >= {*errors} for run in self.found for mark in run.marks):
            raise ValueError(f"marks: expected values {', '.join(errors)}")


class Ended(RuntimeError):
    """A run ended without a result to score: its status and the reason."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(f"{status}: {reason}")
        self.status, self.reason = status, reason


@dataclass(frozen=True, slots=True, kw_only=True)
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

    @property
    def pair(self) -> Pair:
        """Median seconds and error."""
        return median(self.seconds), self.values[LOWER[self.part][0]]


def points(records: Sequence[Record[Run]]) -> list[Point]:
    """Make a point of every mark, in the order of their first appearance."""
    marks: dict[tuple[str, str], list[tuple[Task, Mark]]] = {}
    for record in records:
        for mark in (mark for run in record.found if run.status == OK for mark in run.marks):
            marks.setdefault((record.task.identity, mark.label), []).append((record.task, mark))
    return [
        Point(
            task=(task := of[-1][0]),
            part=cast("Part", task.part),
            group=task.settings["group"],
            curve=task.settings["curve"],
            label=label,
            seconds=tuple(m.seconds for _, m in of),
            values=of[-1][1].values,
            default=of[-1][1].default,
        )
        for (_, label), of in marks.items()
    ]


def groups(every: Sequence[Point]) -> list[list[Point]]:
    """Part the points into comparable ones: of one part, scene and group."""
    found: dict[tuple[str, str, str], list[Point]] = {}
    for p in every:
        found.setdefault((p.part, p.task.case, p.group), []).append(p)
    return list(found.values())


def curves(group: Sequence[Point]) -> dict[str, list[Point]]:
    """Part a group's points by method or kind of choice."""
    return {c: [p for p in group if p.curve == c] for c in dict.fromkeys(p.curve for p in group)}


def enough(of: Sequence[Point]) -> Point:
    """Return the fastest point whose error is within `NEAR` of the least."""
    least = min(p.pair[1] for p in of)
    return min((p for p in of if p.pair[1] <= (1 + NEAR) * least), key=lambda p: p.pair)


def at_knee(of: Sequence[Point]) -> Point | None:
    """Return the knee of the points' front."""
    at = knee([p.pair for p in of])
    return None if at is None else of[at]


def recommended(of: Sequence[Point]) -> Point:
    """Return the setting to take: of methods the fastest near the least error of all.

    Of the simulator's choices it is the knee of the default's own curve, if there is one: its error falls on and on,
    and what other curves differ in shows in another error.
    """
    if of[0].part == "methods":
        return enough(of)
    usual = {p.curve for p in of if p.default}
    mine = [p for p in of if not usual or p.curve in usual]
    return at_knee(mine) or enough(mine)
