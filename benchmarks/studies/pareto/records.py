"""Records of `run-benchmark pareto`: one JSON line per timed run, and the points that their medians make.

A line holds one run of one setting; a method that can be watched leaves a mark after each of several iterations
of one run. Runs of a setting are counted by its identity, so a command that was stopped goes on where it was.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import msgspec

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import Host
from ctsim.benchmarks.studies.methods.records import OK
from ctsim.benchmarks.studies.pareto.front import Pair, knee

NAME, WHAT = "pareto.jsonl", "a record of run-benchmark pareto"
VERSION = 2
"""Part of every identity: a change of what is measured counts it up."""

Part = Literal["simulator", "methods"]
ERROR: dict[Part, str] = {"simulator": "rms", "methods": "rmse"}
"""The value of a mark that a part's fronts are drawn in."""


NEAR = 0.05
"""A share by which errors may differ and hardly matter: 0.4 dB."""


class Setting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What determines a run: a part, a scene (`data` is its content's hash), and a choice with its parameters.

    `curve` is a method or a kind of choice of the simulator, `label` the choice; points are compared within `group`,
    which is what methods need beside the counts.
    `code` hashes the sources, `machine` is processor and threads: times of another one are measured anew.
    """

    part: Part
    scene: str
    data: str
    group: str
    curve: str
    label: str
    params: dict[str, Any]
    code: str = ""
    machine: str = ""
    version: int = VERSION

    @property
    def identity(self) -> str:
        """SHA-256 over all fields."""
        return hashlib.sha256(msgspec.json.encode(self, order="sorted")).hexdigest()


class Mark(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a run had reached after so many seconds; `values` are errors by name, `default` says that it is one."""

    label: str
    seconds: float
    values: dict[str, float]
    default: bool = False


class Timed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One timed run of a setting; `warm_up` are the seconds of the call before it that compiled, if there was one."""

    setting: Setting
    marks: tuple[Mark, ...] = ()
    status: str = OK
    reason: str = ""
    warm_up: float | None = None
    host: Host
    commit: str
    time: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A setting at one of its marks: all runs' seconds, and the errors, which do not differ between runs."""

    setting: Setting
    label: str
    seconds: tuple[float, ...]
    values: dict[str, float]
    default: bool

    @property
    def pair(self) -> Pair:
        """Median seconds and error."""
        return median(self.seconds), self.values[ERROR[self.setting.part]]


def read(path: Path) -> list[Timed]:
    """Read the records of a pareto file (see `lines.read`)."""
    return lines.read(path, Timed, WHAT)


def runs(found: Sequence[Timed]) -> Counter[str]:
    """Count the runs of each identity that ended well."""
    return Counter(t.setting.identity for t in found if t.status == OK)


def latest(found: Sequence[Timed]) -> list[Timed]:
    """Keep what a table shows: of each choice the runs of its newest identity, on the machine its scene was last on."""
    known = [t for t in found if t.setting.version == VERSION]
    ended = sorted(known, key=lambda t: t.status == OK)  # a failure says nothing where there is a time
    machine = {(t.setting.part, t.setting.scene): t.setting.machine for t in ended}
    mine = [t for t in known if t.setting.machine == machine[t.setting.part, t.setting.scene]]
    newest = {_place(t.setting): t.setting.identity for t in mine}
    return [t for t in mine if newest[_place(t.setting)] == t.setting.identity]


def _place(setting: Setting) -> tuple[str, ...]:
    return setting.part, setting.scene, setting.curve, setting.label


def points(found: Sequence[Timed]) -> list[Point]:
    """Make a point of every mark, in the order of their first appearance."""
    held: dict[tuple[str, str], list[tuple[Setting, Mark]]] = {}
    for timed in found:
        if timed.status == OK:
            for mark in timed.marks:
                held.setdefault((timed.setting.identity, mark.label), []).append((timed.setting, mark))
    return [
        Point(
            setting=marks[-1][0],
            label=label,
            seconds=tuple(m.seconds for _, m in marks),
            values=marks[-1][1].values,
            default=marks[-1][1].default,
        )
        for (_, label), marks in held.items()
    ]


def failures(found: Sequence[Timed]) -> list[Timed]:
    """Return the last record of every setting that has no run that ended well."""
    well = runs(found)
    last = {t.setting.identity: t for t in found}
    return [t for identity, t in last.items() if not well[identity]]


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
    if of[0].setting.part == "methods":
        return enough(of)
    usual = {p.setting.curve for p in of if p.default}
    mine = [p for p in of if not usual or p.setting.curve in usual]
    return at_knee(mine) or enough(mine)
