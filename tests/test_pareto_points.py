"""Points of `run-benchmark pareto`: their front and knee, records, what is recommended, and verdicts on defaults."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctsim.benchmarks.engine.host import host
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.pareto import results
from ctsim.benchmarks.studies.pareto.finding import (
    Mark,
    Point,
    Timed,
    TimedRun,
    enough,
    faster,
    front,
    knee,
    points,
    recommended,
    rivals,
)
from ctsim.benchmarks.studies.pareto.study import VERSION, Flags, Pareto
from ctsim.errors import InputError

# few values, so that ties in one coordinate and in both occur
PAIRS = st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=12)


def made(pairs):
    """Points of one group with these seconds and errors."""
    names = {"task": task(), "part": "methods", "group": "g", "curve": "c", "default": False}
    return [Point(label=str(k), seconds=(t,), values={"rmse": e}, **names) for k, (t, e) in enumerate(pairs)]


@given(PAIRS)
def test_the_front_is_what_no_other_point_beats(pairs):
    def beats(a, b):
        return a != b and a[0] <= b[0] and a[1] <= b[1]

    found = [p.pair for p in front(made(pairs))]
    assert found == sorted(p for p in pairs if not any(beats(q, p) for q in pairs))


@given(PAIRS)
def test_what_beats_a_point_is_no_slower_and_no_worse(pairs):
    every = made(pairs)
    on = front(every)
    for p, (seconds, error) in zip(every, pairs, strict=True):
        better = rivals(every, p, ["rmse"])
        assert [q.pair for q in better] == [
            (s, e) for s, e in pairs if s <= seconds and e <= error and (s < seconds or e < error)
        ]
        assert (p in on) == (not better)


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


def at_knee(pairs):
    """The index of the knee, None without one."""
    found = knee(made(pairs))
    return found and int(found.label)


def test_the_knee_is_where_a_steep_line_meets_a_flat_one():
    x = np.linspace(0, 10, 21)
    steep_then_flat = np.where(x < 4, -3 * x, -12 - 0.1 * (x - 4))
    pairs = curve(x, steep_then_flat)
    assert at_knee(pairs) == 8  # x = 4
    # in units of hours and of per mille it is the same point
    assert at_knee([(s / 3600, 1000 * e) for s, e in pairs]) == 8
    # points off the front do not count, though they lie far below the chord of others
    assert at_knee([*pairs, (math.exp(11.0), 1.0), (0.5, math.exp(1.0))]) == 8


def test_the_knee_of_a_smooth_curve_is_where_it_runs_along_its_chord():
    # y = exp(−x) on [0, 4] has the slope of its chord, −(1 − exp(−4))/4, at x = −ln((1 − exp(−4))/4)
    x = np.linspace(0, 4, 401)
    at = at_knee(curve(x, np.exp(-x)))
    assert at is not None
    # half a step of the sampling
    assert x[at] == pytest.approx(-math.log((1 - math.exp(-4)) / 4), abs=0.005 + 1e-9)


def test_without_a_point_below_the_chord_there_is_no_knee():
    x = np.linspace(0, 1, 11)
    for y in (-3 * x, -x - x**2):  # straight, and bulging away from the origin
        assert at_knee(curve(x, y)) is None
    assert at_knee([(1.0, 2.0)]) is None
    assert at_knee([(1.0, 2.0), (2.0, 1.0)]) is None
    assert at_knee([(1.0, 2.0), (1.5, 1.0), (2.0, 0.0)]) is None  # an error of 0 has no logarithm


# --- records -----------------------------------------------------------------------------------------


def task(label="a", curve="fdk", part="methods", case="s", **more):
    settings = {"group": "counts only", "curve": curve, "label": label}
    fields = {"data": "d", "machine": "m", "version": VERSION, **more}
    return Task(study="pareto", part=part, case=case, subject=f"{curve}, {label}", settings=settings, **fields)


def timed(of, *marks, status="ok", reason=""):
    """A record of a run whose marks are (label, seconds, error)."""
    names = {"simulator": ("rms", "worst", "off_edges"), "methods": ("rmse",)}[of.part]
    found = tuple(Mark(label=label, seconds=s, values=dict.fromkeys(names, e)) for label, s, e in marks)
    return record(of, TimedRun(ok=status == "ok", marks=found, status=status, reason=reason))


def record(of, run):
    return Timed(task=of, found=(run,), host=host(), commit="c", time="2026-01-01T00:00:00+00:00")


def shown(records, tmp_path):
    """What a table shows of these records."""
    given = Flags(results=tmp_path)
    return Pareto().shown([r for r in records if Pareto().shows(r.task, given)])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"curve":"fdk",', "", "expected a known part, and settings with group, curve and label"),
        ('"part":"methods"', '"part":"peers"', "expected a known part"),
        ('"rmse"', '"rms"', "expected values rmse"),
        ('"marks"', '"mark"', "unknown field"),
        ('"rmse":2.0', '"rmse":-2.0', "expected values rmse, none of them negative"),
        ('"label":"1","seconds":1.0', '"label":"1","seconds":-1.0', "Expected `float` > 0.0"),
    ],
)
def test_a_record_without_what_a_point_needs_is_refused_in_one_sentence(old, new, says, tmp_path):
    store = Pareto().store(Flags(results=tmp_path))
    store.append([timed(task(), ("1", 1.0, 2.0))])
    assert store.read() == [timed(task(), ("1", 1.0, 2.0))]
    text = store.path.read_text("utf-8")
    assert old in text
    store.path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=f"line 1: expected a record of run-benchmark pareto: .*{says}"):
        store.read()


def test_seconds_are_medians_over_the_runs_of_a_mark(tmp_path):
    found = [timed(task(), ("1", s, 0.5), ("2", 2 * s, 0.25)) for s in (3.0, 1.0, 9.0)]
    assert [(p.label, p.pair) for p in points(shown(found, tmp_path))] == [("1", (3.0, 0.5)), ("2", (6.0, 0.25))]
    # a run ends with its last mark
    assert Pareto().took(found[0], Flags(results=tmp_path)) == 6.0


def test_a_table_shows_the_newest_code_on_the_last_machine(tmp_path):
    old, new, other = task(code="1"), task(code="2"), task("b", machine="another")
    found = [timed(other, ("b", 1, 1)), timed(old, ("a", 1, 1)), timed(new, ("a", 2, 1)), timed(new, ("a", 4, 1))]
    now = points(shown(found, tmp_path))
    assert [p.seconds for p in now] == [(2.0, 4.0)]
    # what an older version measured says nothing, not even where
    older = task(machine="elsewhere", version=VERSION - 1)
    assert points(shown([*found, timed(older, ("a", 9, 1))], tmp_path)) == now
    # another scene may have been measured elsewhere
    elsewhere = task("c", case="t", machine="another")
    assert len(shown([timed(elsewhere, ("c", 1, 1)), *found], tmp_path)) == 3


def test_only_what_never_ended_well_is_a_failure(tmp_path):
    bad, good = task("bad"), task("good")
    found = [timed(bad, status="error", reason="so"), timed(good, status="error"), timed(good, ("good", 1, 1))]
    assert results.summary(shown(found, tmp_path))[-1].csv().splitlines()[1:] == ["fdk,bad,error,so"]
    assert "not measured" not in said(found[1:], tmp_path)


def test_recommended_are_near_the_least_error_for_methods_and_the_knee_for_the_simulator():
    marks = [(str(k), 2.0**k, e) for k, e in enumerate((1.0, 0.1, 0.052, 0.0505, 0.05))]
    method, simulator = (points([timed(task(part=part), *marks)]) for part in ("methods", "simulator"))
    assert (recommended(method).label, enough(method).label) == ("2", "2")  # 0.052 is within 5 % of 0.05
    assert recommended(simulator) is knee(simulator)
    assert recommended(simulator).label == "1"


# --- the table ---------------------------------------------------------------------------------------


def said(records, tmp_path):
    """The tables that are printed, as Markdown."""
    return "\n".join(table.markdown() for table in Pareto().tables(shown(records, tmp_path), Flags(results=tmp_path)))


def test_a_protocol_that_was_not_asked_for_has_no_column(tmp_path):
    for scores, shown_there in (({}, False), ({"aligned": 31.5}, True)):
        marks = (Mark(label="a", seconds=1.0, values={"rmse": 0.5, "psnr3d": 30.0, **scores}),)
        tables = results.every_point([record(task(), TimedRun(marks=marks))])
        tables += results.summary([record(task(), TimedRun(marks=marks))])
        assert [("| aligned (dB) |" in t.markdown(), "| 31.50 |" in t.markdown()) for t in tables[:2]] == [
            (shown_there, shown_there)
        ] * 2


def simulated(*rows):
    """Records of defaults whose rows are (label, seconds of the rounds, rms, worst)."""
    found = []
    for label, rounds, rms, worst in rows:
        values = {"rms": rms, "worst": worst, "off_edges": 1.0}
        marks = [Mark(label=label, seconds=seconds, default=True, values=values) for seconds in rounds]
        found += [record(task(label, part="simulator", curve="x"), TimedRun(marks=(mark,))) for mark in marks]
    return found


def verdicts(*rows):
    """The verdicts on such defaults."""
    found = simulated(*rows)
    assert results.figure(points(found)).axes
    notes = [note for table in results.summary(found) for note in table.notes if note.startswith("Default")]
    return [re.fullmatch("Default x, .: in relative RMS of P (.*); in all errors at once (.*).", s) for s in notes]


def test_a_bar_in_a_title_ends_no_cell(tmp_path):
    rows = [line for line in said(simulated(("a", [1], 0.5, 0.5)), tmp_path).splitlines() if line.startswith("| curve")]
    # curve, setting, s, three errors, knee: eight bars around seven cells
    assert len(re.findall(r"(?<!\\)\|", rows[0])) == 8 and "worst \\|ΔP\\| off" in rows[0]


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
