import math
import multiprocessing
import os
import re
import shlex
import signal
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
import pareto_ends
import pytest
import torch
import tyro
from conftest import SMALLEST
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import (
    cli,
    lines,
    pareto,
    pareto_figure,
    pareto_jobs,
    pareto_methods,
    pareto_simulator,
    pareto_suite,
    pareto_table,
)
from benchmarks.host import host
from benchmarks.limited import Limited
from benchmarks.methods import TABLE
from benchmarks.pareto_front import beaten_by, faster, front, knee
from benchmarks.pareto_records import (
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
from benchmarks.peer_cases import relative
from ctsim.errors import InputError
from ctsim.settings import Simulation
from ctsim.types import Volume

# few values, so that ties in one coordinate and in both occur
SUITE = pareto_suite.load(None)
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
    # of five it is their range, and one run has no spread
    assert not faster([1, 1, 1, 1, 2], [2, 3, 3, 3, 3]) and faster([1, 1, 1, 1, 2], [2.1, 3, 3, 3, 3])
    assert faster([1], [2]) and not faster([1], [1])


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


def pretended(name, **kinds):
    """Jobs by their choice's name."""
    tried = [pareto_ends.Tried(label, kind) for label, kind in kinds.items()]
    return {job.choice.label: job for job in pareto_jobs.jobs(pareto_ends.Scene, (name,), tried, "m")}


def test_each_setting_runs_once_a_round_and_a_resumed_command_goes_on(monkeypatch):
    monkeypatch.setattr(pareto_jobs, "use_threads", lambda threads: None)
    jobs = pretended("rounds", a="x", b="x", c="y", d="y")
    calls = pareto_ends.CALLS
    calls.clear()
    # a has had one run already, so the first round is that of the others
    done = Counter({jobs["a"].setting.identity: 1})
    found = list(pareto.rounds(list(jobs.values()), 3, done, lambda job: pareto_jobs.do(2, job)))
    assert calls == ["open rounds", "warm x", "b", "warm y", "c", "d", "a", "b", "a", "b"]
    assert {(t.setting.label, t.status, t.reason) for t in found if t.status != "ok"} == {
        ("c", "diverged", "so"),
        ("d", "out_of_memory", "MemoryError: no room"),
    }
    assert [(t.setting.label, t.warm_up) for t in found if t.warm_up is not None] == [("b", 0.5), ("c", 0.5)]


def test_a_run_that_overstays_is_one_row_and_the_next_warms_up_again():
    jobs = pretended("hung", a="x", e="x")
    with Limited(60) as process:
        first, second = (pareto_jobs.within(process, 1, jobs["a"]) for _ in range(2))
        assert (first.warm_up, second.warm_up) == (0.5, None)
        assert first.marks[0].values["threads"] == 1
        process.seconds = 0.2
        hung = pareto_jobs.within(process, 1, jobs["e"])
        assert (hung.status, hung.reason, hung.marks) == ("timeout", "did not end within 0.2 s", ())
        process.seconds = 60
        assert pareto_jobs.within(process, 1, jobs["a"]) == first


# --- what is measured --------------------------------------------------------------------------------


def suite_file(tmp_path, *tables):
    """Flags for a suite of the smallest scene and these tables."""
    (tmp_path / "scenes.toml").write_text(SMALLEST, encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text("\n".join(['[dataset]\nsuite = "scenes.toml"', *tables]), encoding="utf-8")
    return path


def tuned(scan, *, device, strength=2, iterations=4):
    raise NotImplementedError


def test_the_bundled_suite_has_every_method_and_the_defaults_of_all():
    assert [listed.name for listed in SUITE.method] == list(TABLE)
    for name in TABLE:
        found = pareto_methods.efforts(SUITE, name)
        curves = {e.curve for e in found}
        assert [sum(e.default for e in found if e.curve == curve) for curve in curves] == [1] * len(curves), name
        assert len({(e.curve, e.label) for e in found}) == len(found), name
    runs = pareto_methods.efforts(SUITE, "splat")
    assert {e.curve for e in runs} == {"splat", "splat paper", "splat r2"}
    assert len({e.kind for e in runs}) == len(runs)  # each is compiled before its clock starts
    assert [e.label for e in pareto_methods.efforts(SUITE, "fdk")] == ["defaults"]
    assert [e.method.overrides for e in pareto_methods.efforts(SUITE, "cgls")] == [{"iterations": 30}]
    choices = pareto_simulator.choices(SUITE.simulator)
    for group in {c.group for c in choices}:
        assert any(c.default for c in choices if c.group == group), group
    assert len({(c.curve, c.label) for c in choices}) == len(choices)
    usual = [c for c in choices if c.default and c.simulation == Simulation() and c.grid is None]
    assert len(usual) == 2  # of the projections, and without scatter


def test_a_file_of_ones_own_says_what_is_measured_and_leaves_the_rest_as_it_is(tmp_path):
    mine = f"{__name__}:tuned"
    path = suite_file(
        tmp_path,
        "[iterations]\nstops = [1, 4]\ntimes = 3",
        f"[[method]]\nname = '{mine}'\nparameter = 'strength'\nvalues = [1, 2, [3, 4]]",
        "[[method.run]]\ncurve = 'both'\nlabel = 'long'\nset = { strength = 9, iterations = 50 }",
        "[[method]]\nname = 'cgls'\ntimes = 5",
    )
    suite = pareto_suite.load(path)
    assert suite.simulator == SUITE.simulator
    assert suite.dataset.suite == str(tmp_path / "scenes.toml") and suite.dataset.scenes == ()
    found = pareto_methods.efforts(suite, mine)
    assert [(e.curve, e.label, e.method.overrides, e.default, e.watched) for e in found] == [
        (mine, "strength 2", {"strength": 2}, True, False),
        (mine, "strength 1", {"strength": 1}, False, False),
        (mine, "strength 3 + 4", {"strength": [3, 4]}, False, False),
        ("both", "long", {"strength": 9, "iterations": 50}, True, True),
    ]
    assert [e.label for e in pareto_methods.efforts(suite, "cgls")] == ["75 iterations"]
    # what is not listed goes by its iterations
    assert [e.label for e in pareto_methods.efforts(suite, "sirt")] == ["300 iterations"]
    assert [e.label for e in pareto_methods.efforts(SUITE, mine)] == ["8 iterations"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[dataset", "mine.toml: not TOML"),
        (
            "[[scene]]\nname = 'a'",
            "mine.toml: scene: unknown key; expected one of dataset, iterations, method, simulator",
        ),
        ("[dataset]\nsuite = 'none'", "mine.toml: dataset.suite: none: neither a TOML file nor a bundled suite"),
        (
            "[dataset]\nsuite = 'quick'\nscenes = ['a']",
            "mine.toml: dataset.scenes: there is no 'a', expected one of lung-Fe",
        ),
        ("[iterations]\ntimes = 2", "mine.toml: iterations.stops: missing; expected a list"),
        ("[iterations]\ntimes = 2\nstops = [1, 0]", "mine.toml: iterations.stops[1]: Expected `int` >= 1"),
        ("[[method]]\nname = 'fdk'\nvalue = [3]", "mine.toml: method[0].value: unknown key; expected one of name"),
        (
            "[[method]]\nname = 'ibhc'\nvalues = [3]",
            "mine.toml: method[0].parameter and values: expected both or neither",
        ),
        ("[[method]]\nname = 'fdk'\n[[method]]\nname = 'fdk'", "mine.toml: method: two curves are called 'fdk'"),
        ("[[method]]\nname = 'fdc'", "mine.toml: there is no method 'fdc'"),
        ("[[method]]\nname = 'fdk'\ntimes = 3", "mine.toml: method 'fdk' has no default iterations"),
        (
            "[[method]]\nname = 'ibhc'\nparameter = 'size'\nvalues = [1]",
            "mine.toml: method 'ibhc' has no parameter 'size'",
        ),
        (
            "[simulator]\nside = 16\nviews = 9\ntolerances = [1e-3, 1.0]\nsubrays = []\ngrids = []\nlevels = []",
            "mine.toml: simulator.tolerances[1]: Expected `float` <= 0.1",
        ),
        (
            "[simulator]\nside = 16\nviews = 9\ntolerances = []\nsubrays = []\ngrids = []\nlevels = [2]",
            "mine.toml: simulator.levels[0]: Invalid enum value 2",
        ),
    ],
)
def test_a_file_that_is_wrong_is_said_in_one_sentence(text, says, tmp_path, monkeypatch, capsys):
    path, out = tmp_path / "mine.toml", tmp_path / "out"
    path.write_text(text, encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "pareto", str(out), "--suite", str(path)])
    assert cli.run_benchmark() == 2
    said = capsys.readouterr().err.strip()
    assert f"{tmp_path}/{says}" in said and "\n" not in said and not out.exists()


# --- methods -----------------------------------------------------------------------------------------


def slow(scan, *, device, iterations=2):
    """Take 5 s to begin, 1 s an iteration and 2 s to end, on the test's clock."""
    from reconstruct.watch import Stopwatch

    CLOCK[0] += 5
    watch = Stopwatch()
    for k in range(iterations):
        CLOCK[0] += 1
        watch.show(k, lambda: np.zeros(scan.geometry.n_voxel, np.float32))
    CLOCK[0] += 2
    return Volume(values=torch.full(scan.geometry.n_voxel, 0.01))


CLOCK = [0.0]


def test_the_clock_leaves_out_scoring_and_counts_what_begins_and_ends_a_run(smallest, monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: CLOCK[0])
    monkeypatch.setitem(TABLE, "slow", (f"{__name__}:slow", "counts only"))
    (folder,) = (path for path in smallest.iterdir() if (path / "scene.toml").exists())
    bench = pareto_methods.Bench(folder, (1, 2, 3))

    def score(volume):
        CLOCK[0] += 100
        return {"rmse": float(volume.mean())}

    monkeypatch.setattr(bench, "values", score)
    (effort,) = pareto_methods.efforts(SUITE, "slow")
    marks = bench.run(effort)
    assert [(m.label, m.seconds, m.default) for m in marks] == [
        ("1 iteration", 8.0, False),
        ("2 iterations", 9.0, True),
        ("3 iterations", 10.0, False),
        ("4 iterations", 11.0, False),
    ]
    # the last has the volume that was returned
    assert [m.values["rmse"] for m in marks] == pytest.approx([0, 0, 0, 0.01])


def test_methods_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pareto, "use_threads", lambda threads: None)  # the threads of this process are not ours to set
    out = tmp_path / "out"
    common = [str(out), "--suite", str(suite_file(tmp_path)), "--part", "methods", "--repeats", "2"]
    chosen = ["--method", "fdk", "--method", "cgls", "--method", "limar"]

    def left():
        assert pareto.main([*common, *chosen, "--dry-run"]) == 0
        rows = capsys.readouterr().out.splitlines()[1:-1]
        return {row.split()[2]: int(row.split()[3]) for row in rows}

    assert left() == {"fdk": 2, "cgls": 2, "limar": 2} and not out.exists()
    assert pareto.main([*common, *chosen]) == 0
    text = capsys.readouterr().out
    assert "### methods, smallest: counts only" in text and "### methods, smallest: metal mask" in text
    first = (out / "pareto.jsonl").read_bytes()
    assert len(first.splitlines()) == 6
    assert left() == {"fdk": 0, "cgls": 0, "limar": 0}
    assert pareto.main([*common, *chosen]) == 0 and pareto.main([*common, "--table"]) == 0
    assert (out / "pareto.jsonl").read_bytes() == first
    every = (out / "pareto.md").read_text(encoding="utf-8").split("every point", 1)[1]
    for default in ("fdk | defaults", "cgls | 15 iterations", "limar | defaults"):
        assert every.count(f"| {default} (default) |") == 1
    assert (out / "pareto.png").read_bytes().startswith(b"\x89PNG")


def test_what_fails_or_overstays_is_a_row_with_its_reason_and_is_tried_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pareto, "use_threads", lambda threads: None)
    command = [str(tmp_path), "--suite", str(suite_file(tmp_path)), "--part", "methods", "--repeats", "2"]
    chosen = ["--method", "pareto_ends:fails", "--method", "fdk"]
    # a process cannot even start in that time
    assert pareto.main([*command, *chosen, "--seconds", "0.01"]) == 1
    text = capsys.readouterr().out
    for name in ("pareto_ends:fails", "fdk"):
        assert f"| {name} | defaults | timeout | did not end within 0.01 s |" in text
    assert pareto.main([*command, *chosen]) == 1
    text = capsys.readouterr().out
    assert "| pareto_ends:fails | defaults | error | ValueError: no such luck |" in text and "timeout" not in text
    statuses = [(t.setting.curve, t.status) for t in read(tmp_path / "pareto.jsonl")]
    failed = [("pareto_ends:fails", "timeout"), ("fdk", "timeout"), ("pareto_ends:fails", "error")]
    assert statuses == [*failed, ("fdk", "ok"), ("fdk", "ok")]


def test_ctrl_c_ends_a_run_with_its_process_and_keeps_the_records(tmp_path, monkeypatch):
    monkeypatch.setattr(pareto, "use_threads", lambda threads: None)
    path = tmp_path / "out" / "pareto.jsonl"

    def interrupt():
        while not path.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    chosen = ["--part", "methods", "--method", "fdk", "--method", "pareto_ends:hangs", "--repeats", "1"]
    with pytest.raises(KeyboardInterrupt):
        pareto.main([str(path.parent), "--suite", str(suite_file(tmp_path)), *chosen])
    assert [t.setting.curve for t in read(path)] == ["fdk"]
    assert not multiprocessing.active_children()


# --- simulator ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench():
    return pareto_simulator.Bench(side=16, views=4)


def test_the_reference_is_converged_where_the_choices_are_not(bench):
    best = bench.converged(pareto_simulator.FINER, pareto_simulator.FINEST)
    half = bench.converged(pareto_simulator.FINER // 2, pareto_simulator.FINEST)
    plain, default, finest = (
        bench.run(pareto_simulator.Choice(curve="c", label=str(n), simulation=Simulation(subrays=n)))[0].values["rms"]
        for n in (1, Simulation().subrays, 233)
    )
    # a quarter of the rays moves the reference by less than what the finest choice is off it
    assert relative(half, best) < finest < default < plain


def test_errors_are_those_of_p(bench):
    exact, calm = bench._reference
    assert calm.any() and not calm.all()
    assert bench.errors(exact.astype(np.float32))["worst"] < 1e-6 * exact.max()  # float32
    scattered = -np.log(np.exp(-exact) + 0.02).astype(np.float32)
    assert bench.errors(scattered, 0.02)["worst"] < 1e-6 * exact.max()
    off = exact.copy()
    at = tuple(np.argwhere(~calm)[0])
    off[at] += 0.5
    found = bench.errors(off.astype(np.float32))
    assert found["worst"] == pytest.approx(0.5, abs=1e-5) and found["off_edges"] < 1e-5
    # one pixel of 0.5 among all
    assert found["rms"] == pytest.approx(0.5 / math.sqrt((exact**2).sum()), rel=1e-4)


def test_scatter_is_judged_with_scatter(bench):
    off, on = (
        bench.run(pareto_simulator.Choice(curve=pareto_simulator.SCATTER, label=str(k), level=k))[0].values["rms"]
        for k in (0, pareto_simulator.HIGHEST)
    )
    plain = bench.run(pareto_simulator.Choice(curve="c", label="c"))[0].values["rms"]
    # scatter fills up the darkest pixels, whose error leads, so it can but lessen what edges leave; without it P is off
    assert on < 2 * plain < off


def test_simulator_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pareto, "use_threads", lambda threads: None)
    choices = "tolerances = [1e-4]\nsubrays = [4]\ngrids = [1.5]\nlevels = [0, 1]"
    path = suite_file(tmp_path, f"[simulator]\nside = 16\nviews = 2\n{choices}")
    assert pareto.main([str(tmp_path), "--suite", str(path), "--part", "simulator", "--repeats", "1"]) == 0
    text = capsys.readouterr().out
    assert "### simulator, rods: exact solids (16² pixels, 2 views)" in text
    # each default has its verdict in each error: of solids, of voxels, of scatter
    verdicts = [line for line in text.splitlines() if line.startswith("- Default ")]
    assert len(verdicts) == 3
    assert all(line.count("the front") == 2 for line in verdicts)
    # a scanner with scatter is simulated with it: no other level is as good
    assert any(line.startswith("- Default scatter, level 1") and line.count("on the front") == 2 for line in verdicts)
    assert "body in voxels, metal exact, 24³ labels" in text


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
    lines = [line for line in pareto_table.summary(found).splitlines() if line.startswith("- Default")]
    return [re.fullmatch("- Default x, .: in relative RMS of P (.*); in all errors at once (.*).", s) for s in lines]


def test_verdicts_name_what_beats_a_default():
    # e is a again; b is as good as a but slower; c is better than all; d is beaten in rms alone
    of = [("a", [1], 0.5, 0.5), ("b", [2], 0.5, 0.5), ("c", [4], 0.1, 0.4), ("d", [5], 0.2, 0.3), ("e", [1], 0.5, 0.5)]
    on = "on the front"
    by_a, by_c = (f"off {on[3:]} (x, {k} is no worse in {n} of the time)" for k, n in (("a", "0.50"), ("c", "0.80")))
    assert [found.groups() for found in verdicts(*of)] == [(on, on), (by_a, by_a), (on, on), (by_c, on), (on, on)]


def test_a_default_is_off_the_front_only_beyond_the_spread_of_its_rounds():
    usual = ("b", [1.0, 1.02, 1.04, 1.06, 1.08], 0.1, 0.5)

    def verdict(rounds, rms):
        return verdicts(usual, ("a", rounds, rms, 0.5))[0].group(1)

    within = "on the front within the spread of the rounds (x, a is no worse in"
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.1).startswith(within)
    assert verdict([0.9, 0.95, 0.97, 0.98, 0.99], 0.1).startswith("off the front (x, a is no worse in")
    # an error that is far less needs no time to be saved
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.096).startswith(within)
    assert verdict([0.9, 0.98, 1.0, 1.01, 1.05], 0.095).startswith("off the front")
    assert verdict([0.9, 0.95, 0.97, 0.98, 0.99], 0.11) == "on the front"


# --- the command -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--repeats", "0"], "--repeats and --threads must be at least 1, got 0 and 2"),
        (
            ["--scene", "teeth"],
            "--scene 'teeth': there is no such scene, expected one of simulator: rods; methods: lung-Fe",
        ),
        (["--part", "simulator", "--scene", "lung-Fe"], "expected one of simulator: rods"),
        (["--method", "fdc"], "there is no method 'fdc'"),
        (["--table"], "there are no records"),
        (["--collect", "nowhere"], "--collect nowhere: there are no records, expected a folder with pareto.jsonl"),
        (["--part", "methods", "--seconds", "0"], "seconds must be positive, got 0"),
    ],
)
def test_bad_input_is_said_in_one_sentence(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pareto, "use_threads", lambda threads: None)
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "pareto", str(tmp_path / "out"), *arguments])
    assert cli.run_benchmark() == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said and not (tmp_path / "out").exists()


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


def test_the_page_gives_commands_and_a_file_that_work(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "pareto.md").read_text(encoding="utf-8")
    found = re.findall(r"^    run-benchmark pareto (.*)$", text, re.M)
    assert len(found) >= 3
    for line in found:
        tyro.cli(pareto.Arguments, args=shlex.split(line, comments=True))
    path = tmp_path / "mine.toml"
    path.write_text("\n".join(re.findall(r"^    (?!run-benchmark)(.*)$", text, re.M)), encoding="utf-8")
    assert [listed.name for listed in pareto_suite.load(path).method] == ["splat", "my_lab.net:reconstruct"]
