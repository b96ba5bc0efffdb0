"""Points of `run-benchmark pareto`: their front and knee, records, what is recommended, and verdicts on defaults."""

import math
import re
from collections import Counter

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import host
from ctsim.benchmarks.studies.pareto import figure as pareto_figure
from ctsim.benchmarks.studies.pareto import study as pareto
from ctsim.benchmarks.studies.pareto import tables as pareto_table
from ctsim.benchmarks.studies.pareto.front import beaten_by, faster, front, knee
from ctsim.benchmarks.studies.pareto.records import (
    VERSION,
    Mark,
    Setting,
    Timed,
    at_knee,
    enough,
    failures,
    latest,
    points,
    read,
    recommended,
    runs,
)
from ctsim.errors import InputError

# few values, so that ties in one coordinate and in both occur
PAIRS = st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=12)


@given(PAIRS)
def test_the_front_is_what_no_other_point_beats(pairs):
    def beats(a, b):
        return a != b and a[0] <= b[0] and a[1] <= b[1]

    found = front(pairs)
    assert sorted(found) == [k for k, p in enumerate(pairs) if not any(beats(q, p) for q in pairs)]
    assert [pairs[k] for k in found] == sorted(pairs[k] for k in found)


@given(PAIRS)
def test_what_beats_a_point_is_the_fastest_that_is_no_worse(pairs):
    for k, (seconds, error) in enumerate(pairs):
        best, share = beaten_by(pairs, k)
        assert pairs[best][0] == min(s for s, e in pairs if e <= error)
        assert share == pairs[best][0] / seconds
        assert (pairs[best] == pairs[k]) == (k in front(pairs))


def test_runs_are_faster_where_the_intervals_of_their_medians_do_not_meet():
    # of fifteen runs the interval lies between the 4th and the 12th: P(B(15, ½) ≤ 3) = 576/2¹⁵ = 0.018, ≤ 4: 0.059
    base = [float(k) for k in range(1, 16)]
    assert not faster(base, [12.0] * 15) and faster(base, [12.1] * 15)
    assert not faster([4.0] * 15, base) and faster([3.9] * 15, base)
    # of five it is their range, and fewer have none that tells anything
    assert not faster([1, 1, 1, 1, 2], [2, 3, 3, 3, 3]) and faster([1, 1, 1, 1, 2], [2.1, 3, 3, 3, 3])
    assert not faster([1], [2]) and not faster([1] * 4, [2] * 9) and faster([1] * 5, [2] * 5)


def curve(x, y):
    """Points whose logarithms are x and y."""
    return [(math.exp(a), math.exp(b)) for a, b in zip(x, y, strict=True)]


def test_the_knee_is_where_a_steep_line_meets_a_flat_one():
    x = np.linspace(0, 10, 21)
    steep_then_flat = np.where(x < 4, -3 * x, -12 - 0.1 * (x - 4))
    pairs = curve(x, steep_then_flat)
    assert knee(pairs) == 8  # x = 4
    # in units of hours and of per mille it is the same point
    assert knee([(s / 3600, 1000 * e) for s, e in pairs]) == 8
    # points off the front do not count, though they lie far below the chord of others
    assert knee([*pairs, (math.exp(11.0), 1.0), (0.5, math.exp(1.0))]) == 8


def test_the_knee_of_a_smooth_curve_is_where_it_runs_along_its_chord():
    # y = exp(−x) on [0, 4] has the slope of its chord, −(1 − exp(−4))/4, at x = −ln((1 − exp(−4))/4)
    x = np.linspace(0, 4, 401)
    at = knee(curve(x, np.exp(-x)))
    assert at is not None
    # half a step of the sampling
    assert x[at] == pytest.approx(-math.log((1 - math.exp(-4)) / 4), abs=0.005 + 1e-9)


def test_without_a_point_below_the_chord_there_is_no_knee():
    x = np.linspace(0, 1, 11)
    for y in (-3 * x, -x - x**2):  # straight, and bulging away from the origin
        assert knee(curve(x, y)) is None
    assert knee([(1.0, 2.0)]) is None
    assert knee([(1.0, 2.0), (2.0, 1.0)]) is None


# --- records -----------------------------------------------------------------------------------------


def setting(label="a", curve="fdk", part="methods", **more):
    fields = {"scene": "s", "data": "d", "group": "counts only", "params": {}, "machine": "m"}
    return Setting(part=part, curve=curve, label=label, **{**fields, **more})


def timed(of, *marks, status="ok", time="t"):
    """A run whose marks are (label, seconds, error)."""
    name = {"simulator": "rms", "methods": "rmse"}[of.part]
    found = tuple(Mark(label=label, seconds=s, values={name: e}) for label, s, e in marks)
    return Timed(setting=of, marks=found, status=status, reason="", host=host(), commit="c", time=time)


def test_seconds_are_medians_over_the_runs_of_a_mark():
    found = [timed(setting(), ("1", s, 0.5), ("2", 2 * s, 0.25)) for s in (3.0, 1.0, 9.0)]
    assert [(p.label, p.pair) for p in points(found)] == [("1", (3.0, 0.5)), ("2", (6.0, 0.25))]


def test_a_torn_last_line_costs_one_run_and_nothing_after_it(tmp_path):
    path = tmp_path / "pareto.jsonl"
    lines.append(path, *(timed(setting(label), (label, 1.0, 1.0)) for label in "ab"))
    path.write_bytes(path.read_bytes()[:-20])
    assert [t.setting.label for t in read(path)] == ["a"]
    lines.append(path, timed(setting("c"), ("c", 1.0, 1.0)))
    assert [t.setting.label for t in read(path)] == ["a", "c"]
    path.write_text('{"setting": 1}\n')
    with pytest.raises(InputError, match="line 1: expected a record of run-benchmark pareto"):
        read(path)


def test_a_table_shows_the_newest_code_on_the_last_machine():
    old, new, other = setting(code="1"), setting(code="2"), setting("b", machine="another")
    found = [timed(other, ("b", 1, 1)), timed(old, ("a", 1, 1)), timed(new, ("a", 2, 1)), timed(new, ("a", 4, 1))]
    assert [p.seconds for p in points(latest(found))] == [(2.0, 4.0)]
    # what an older version measured says nothing, not even where
    older = setting(machine="elsewhere", version=VERSION - 1)
    assert points(latest([*found, timed(older, ("a", 9, 1))])) == points(latest(found))
    # another scene may have been measured elsewhere
    elsewhere = setting("c", scene="t", machine="another")
    assert len(latest([timed(elsewhere, ("c", 1, 1)), *found])) == 3
    assert runs(found) == Counter({old.identity: 1, new.identity: 2, other.identity: 1})


def test_only_what_never_ended_well_is_a_failure():
    bad, good = setting("bad"), setting("good")
    found = [timed(bad, status="error"), timed(good, status="error"), timed(good, ("good", 1, 1))]
    assert [t.setting.label for t in failures(found)] == ["bad"]


def test_recommended_are_near_the_least_error_for_methods_and_the_knee_for_the_simulator():
    marks = [(str(k), 2.0**k, e) for k, e in enumerate((1.0, 0.1, 0.052, 0.0505, 0.05))]
    method, simulator = (points([timed(setting(part=part), *marks)]) for part in ("methods", "simulator"))
    assert (recommended(method).label, enough(method).label) == ("2", "2")  # 0.052 is within 5 % of 0.05
    assert recommended(simulator) is at_knee(simulator)
    assert recommended(simulator).label == "1"


# --- the table ---------------------------------------------------------------------------------------


def verdicts(*rows):
    """The verdicts on defaults whose rows are (label, seconds of the rounds, rms, worst)."""
    found = []
    for label, rounds, rms, worst in rows:
        values = {"rms": rms, "worst": worst, "off_edges": 1.0}
        for seconds in rounds:
            mark = Mark(label=label, seconds=seconds, default=True, values=values)
            of = timed(setting(label, part="simulator", curve="x"))
            found.append(msgspec.structs.replace(of, marks=(mark,)))
    assert pareto_figure.draw(points(found)).axes
    said = [line for line in pareto_table.summary(found).splitlines() if line.startswith("- Default")]
    return [re.fullmatch("- Default x, .: in relative RMS of P (.*); in all errors at once (.*).", s) for s in said]


def test_verdicts_name_what_beats_a_default():
    # e is a again; b is as good as a but slower; c is better than all; d is beaten in rms alone
    of = [("a", 1, 0.5, 0.5), ("b", 2, 0.5, 0.5), ("c", 4, 0.1, 0.4), ("d", 5, 0.2, 0.3), ("e", 1, 0.5, 0.5)]
    on = "on the front"
    by_a = "off the front (x, a has 0.50 of the time)"
    by_c = "off the front (x, c has 0.80 of the time and 0.50 of the relative RMS of P)"
    found = verdicts(*((label, [seconds] * 5, *errors) for label, seconds, *errors in of))
    assert [verdict.groups() for verdict in found] == [(on, on), (by_a, by_a), (on, on), (by_c, on), (on, on)]


def test_a_default_is_off_the_front_only_beyond_the_spread_of_its_rounds():
    usual = ("b", [1.0, 1.02, 1.04, 1.06, 1.08], 0.1, 0.5)

    def verdict(rounds, rms):
        return verdicts(usual, ("a", rounds, rms, 0.5))[0].group(1)

    within = "on the front within the spread of the rounds (x, a has"
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.1).startswith(within)
    assert verdict([0.9, 0.95, 0.97, 0.98, 0.99], 0.1).startswith("off the front (x, a has")
    # an error that is far less needs no time to be saved
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.096).startswith(within)
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.095).startswith("off the front")
    assert verdict([0.9, 0.95, 0.97, 0.98, 0.99], 0.11) == "on the front"


def test_records_of_other_machines_are_taken_over_and_the_table_shows_the_last(tmp_path, capsys):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder, machine, seconds, day in ((here, "m", 1.0, 1), (there, "n", 7.0, 2)):
        folder.mkdir()
        record = timed(setting(machine=machine), ("a", seconds, 1.0), time=f"2026-01-0{day}T00:00:00+00:00")
        lines.append(folder / "pareto.jsonl", record)
    both = [*read(here / "pareto.jsonl"), *read(there / "pareto.jsonl")]
    for taken in (1, 0):
        assert pareto.main([str(here), "--collect", str(there)]) == 0
        said = capsys.readouterr()
        assert f"{there}: {taken} records taken over" in said.err
        assert "| fdk | a | 7 |" in said.out and "| fdk | a | 1 |" not in said.out
    assert read(here / "pareto.jsonl") == both
    assert sorted(path.name for path in here.iterdir()) == ["pareto.jsonl", "pareto.md", "pareto.png"]
