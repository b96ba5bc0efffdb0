import math
import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pareto_ends
import pytest
import torch
from conftest import SMALLEST
from test_pareto_points import task, timed

from ctsim.benchmarks import cli, suites
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.process import Process, Stopped
from ctsim.benchmarks.methods import CONTROLS, TABLE, find
from ctsim.benchmarks.oracles import measured_pixel, relative
from ctsim.benchmarks.scores.protocol import evaluate
from ctsim.benchmarks.studies.pareto import measure
from ctsim.benchmarks.studies.pareto import study as pareto
from ctsim.benchmarks.studies.pareto import suite as pareto_suite
from ctsim.benchmarks.studies.pareto.suite import Choice
from ctsim.settings import Simulation
from ctsim.types import Volume

SUITE = pareto_suite.load(None)
FLAGS = pareto.Flags(results=Path("nowhere"))


def read(folder):
    return pareto.Pareto().store(pareto.Flags(results=folder)).read()


def test_a_scene_has_all_its_rounds_before_the_next_and_a_resumed_command_goes_on():
    tasks = [task(label, case=case, place=(place, 0)) for place, (label, case) in enumerate(["ax", "bx", "cy"])]
    tasks = [msgspec.structs.replace(t, place=("xy".index(t.case), k)) for k, t in enumerate(tasks)]
    # a has had one run already, so the first round is that of the others
    left = pareto.Pareto().pending(tasks, [timed(tasks[0], ("a", 1, 1))], FLAGS)
    assert "".join(t.settings["label"] for t in left) == "babab" + "ccc"


def test_a_scene_is_opened_once_and_each_kind_of_choice_warmed_up_once():
    calls = pareto_ends.CALLS
    calls.clear()
    found = {}
    for label, kind in ("bx", "cy", "dy", "ax", "bx"):
        found[label] = measure.timed(pareto_ends.Scene, ("rounds",), pareto_ends.Tried(label, kind), kind)
        assert found[label].warm_up == (0.5 if len(calls) in (3, 5) else None)
    assert calls == ["open rounds", "warm x", "b", "warm y", "c", "d", "a", "b"]
    assert {label: (run.ok, run.status, run.reason) for label, run in found.items()} == {
        "a": (True, "ok", ""),
        "b": (True, "ok", ""),
        "c": (False, "diverged", "so"),
        "d": (False, "out_of_memory", "MemoryError: no room"),
    }


@pytest.mark.slow
def test_the_run_after_one_that_overstayed_warms_up_again():
    def timed_there(process, label, seconds=60.0):
        tried = pareto_ends.Tried(label, "x")
        return process.run(measure.timed, pareto_ends.Scene, ("hung",), tried, "x", seconds=seconds)

    with Process() as process:
        first, second = (timed_there(process, "a") for _ in range(2))
        assert (first.warm_up, second.warm_up) == (0.5, None)
        with pytest.raises(Stopped):
            timed_there(process, "e", 0.2)
        assert timed_there(process, "a") == first


@pytest.mark.slow
@pytest.mark.parametrize("loaded", ["", "import numba, torch"])
def test_threads_are_set_before_and_after_the_kernels_are_loaded(loaded):
    code = f"""
import sys
from ctsim.benchmarks.engine import host
{loaded}
host.use_threads(1)
assert ("numba" in sys.modules) == bool({loaded!r})
assert host.machine().endswith(", 1 threads")
import numba, torch
assert numba.get_num_threads() == torch.get_num_threads() == 1
"""
    free = {name: value for name, value in os.environ.items() if name not in host.THREADS.values()}
    subprocess.run([sys.executable, "-c", code], env=free, check=True, timeout=300)


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
    methods = [name for name, (_, inputs) in TABLE.items() if inputs not in CONTROLS]
    assert [listed.name for listed in SUITE.method] == methods
    for name in methods:
        found = pareto_suite.efforts(SUITE, name)
        published = name in ("splat-paper", "splat-r2")  # whose own steps are hours
        assert [e.curve for e in found if e.default is not published] == [name]
        assert len({(e.curve, e.label) for e in found}) == len(found), name  # each is compiled before its clock starts
    assert [e.label for e in pareto_suite.efforts(SUITE, "fdk")] == ["defaults"]
    assert [e.changes for e in pareto_suite.efforts(SUITE, "cgls")] == [{"iterations": 30}]
    choices = pareto_suite.choices(SUITE.simulator)
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
    found = pareto_suite.efforts(suite, mine)
    assert [(e.curve, e.label, e.changes, e.default, e.watched) for e in found] == [
        (mine, "strength 2", {"strength": 2}, True, False),
        (mine, "strength 1", {"strength": 1}, False, False),
        (mine, "strength 3 + 4", {"strength": [3, 4]}, False, False),
        ("both", "long", {"strength": 9, "iterations": 50}, False, True),
    ]
    assert [e.label for e in pareto_suite.efforts(suite, "cgls")] == ["50 iterations"]
    # what is not listed goes by its iterations
    assert [e.label for e in pareto_suite.efforts(suite, "sirt")] == ["129 iterations"]
    assert [e.label for e in pareto_suite.efforts(SUITE, mine)] == ["8 iterations"]


def test_settings_are_tuned_one_at_a_time_from_the_defaults():
    suite = pareto_suite.load(Path(suites.__file__).with_name("tune-settings.toml"))
    assert suite.dataset.aligned and {scene.name for scene in suites.load(suite.dataset.suite)} > {"tune-Fe-64"}
    for listed in suite.method:
        first, *others = pareto_suite.efforts(suite, listed.name)
        usual = find(listed.name).params
        longest = 2 * usual["iterations"] if "iterations" in usual else None
        assert first.default and first.params.get("iterations") == longest
        for effort in others:
            (key,) = effort.changes.keys() - {"iterations"}
            assert effort.changes[key] != usual[key] and effort.params.get("iterations") == longest
            assert effort.curve.startswith(f"{listed.name}, {key} ")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[dataset", "mine.toml: not TOML"),
        ("x = " + "[" * 3000 + "]" * 3000, "mine.toml: nested more than 32 deep"),
        ("[iterations]\nstops = [1]\ntimes = " + "9" * 5000, "mine.toml: an integer of thousands of digits"),
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
            "mine.toml: ibhc.size: unknown parameter; expected one of panel, scatter, window, cutoff, tube",
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
    from ctsim.reconstruct.watch import Stopwatch

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
    bench = measure.MethodBench(folder)

    def score(volume):
        CLOCK[0] += 100
        return {"rmse": float(volume.mean())}

    monkeypatch.setattr(bench, "values", score)
    (effort,) = pareto_suite.efforts(SUITE, "slow")
    effort = msgspec.structs.replace(effort, stops=(1, 2, 3))
    marks = bench.run(effort).marks
    told = bench.run(msgspec.structs.replace(effort, default=False)).marks
    assert not any(m.default for m in told) and [m.label for m in told] == [m.label for m in marks]
    assert [(m.label, m.seconds, m.default) for m in marks] == [
        ("1 iteration", 8.0, False),
        ("2 iterations", 9.0, True),
        ("3 iterations", 10.0, False),
        ("4 iterations", 11.0, False),
    ]
    # the last has the volume that was returned
    assert [m.values["rmse"] for m in marks] == pytest.approx([0, 0, 0, 0.01])


def test_volumes_are_scored_under_aligned_where_that_is_asked_for(smallest):
    (folder,) = (path for path in smallest.iterdir() if (path / "scene.toml").exists())
    plain, bench = measure.MethodBench(folder), measure.MethodBench(folder, True)
    volume = 0.5 * bench.truth.references["effective"]
    volume[::2] += 0.001
    scores = evaluate(volume, bench.truth)
    assert plain.values(volume) == {k: scores["tissue"].values[k] for k in ("rmse", "psnr3d")}
    assert bench.values(volume) == plain.values(volume) | {"aligned": scores["aligned"].values["psnr3d"]}
    volume[0, 0, 0] = np.inf
    assert not bench.values(volume)


@pytest.mark.slow
def test_methods_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(host, "use_threads", lambda threads: None)  # the threads of this process are not ours to set
    out = tmp_path / "out"
    common = [str(out), "--suite", str(suite_file(tmp_path)), "--part", "methods", "--repeats", "2"]
    chosen = [part for name in ("fdk", "cgls", "limar", "pareto_ends:fails") for part in ("--method", name)]

    def left():
        capsys.readouterr()
        assert pareto.main([*common, *chosen, "--dry-run"]) == 0
        rows = capsys.readouterr().out.splitlines()[:-1]
        return {row.split()[2]: int(row.split()[3]) if " x " in row else 1 for row in rows}

    assert left() == {"fdk": 2, "cgls": 2, "limar": 2, "pareto_ends:fails": 2} and not out.exists()
    assert pareto.main([*common, *chosen]) == 1
    text = capsys.readouterr().out
    assert "## methods, smallest: counts only" in text and "## methods, smallest: metal mask" in text
    assert "| pareto_ends:fails | defaults | error | ValueError: no such luck |" in text
    tried = [(r.task.settings["curve"], r.finished) for r in read(out)]
    whole = [("fdk", True), ("cgls", True), ("limar", True)]
    assert tried == [*whole, ("pareto_ends:fails", False), *whole]  # what fails is not tried again at once
    first = (out / "pareto.jsonl").read_bytes()
    assert left() == {"pareto_ends:fails": 2}
    assert pareto.main([*common, *chosen[:-2]]) == 0 and pareto.main([*common, "--table"]) == 0
    assert (out / "pareto.jsonl").read_bytes() == first
    every = (out / "pareto.md").read_text(encoding="utf-8").split("every point", 1)[1]
    for default in ("fdk | defaults", "cgls | 10 iterations", "limar | defaults"):
        assert every.count(f"| {default} (default) |") == 1
    assert (out / "pareto.png").read_bytes().startswith(b"\x89PNG")
    # other protocols and other data of the scene are measured
    mine = tmp_path / "mine.toml"
    mine.write_text(mine.read_text("utf-8") + "\naligned = true", encoding="utf-8")
    assert left() == {"fdk": 2, "cgls": 2, "limar": 2, "pareto_ends:fails": 2}
    mine.write_text(mine.read_text("utf-8").replace("\naligned = true", ""), encoding="utf-8")
    (folder,) = (path for path in (out / "data").iterdir() if path.is_dir())
    manifest = folder / "manifest.json"
    manifest.write_text(re.sub('("content_hash": ")....', r"\1ffff", manifest.read_text("utf-8")), encoding="utf-8")
    assert left() == {"fdk": 2, "cgls": 2, "limar": 2, "pareto_ends:fails": 2}


# --- simulator ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench():
    return measure.SimulatorBench(side=16, views=4)


def test_the_reference_is_converged_where_the_choices_are_not(bench):
    best, _ = bench.reference
    half = measured_pixel(bench.phantom, bench.scanner, bench.checked, finer=measure.FINER // 2, subrays=measure.FINEST)
    plain, default, finest = (
        bench.run(Choice(curve="c", label=str(n), simulation=Simulation(subrays=n))).marks[0].values["rms"]
        for n in (1, Simulation().subrays, 233)
    )
    # a quarter of the rays moves the reference by less than what the finest choice is off it
    assert relative(half, best) < finest < default < plain


def test_errors_are_those_of_p(bench):
    exact, calm = bench.reference
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


def test_scatter_is_judged_with_scatter(bench, monkeypatch):
    monkeypatch.setattr(measure, "LONG", 0.05)
    off, on = (
        bench.run(Choice(group=pareto_suite.SCATTER, curve=pareto_suite.SCATTER, label=str(k), level=k))
        .marks[0]
        .values["rms"]
        for k in (0, pareto_suite.HIGHEST)
    )
    plain = bench.run(Choice(curve="c", label="c")).marks[0].values["rms"]
    # scatter fills up the darkest pixels, whose error leads, so it can but lessen what edges leave; without it P is off
    assert on < 2 * plain < off


@pytest.mark.slow
def test_simulator_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(host, "use_threads", lambda threads: None)
    monkeypatch.setattr(measure, "LONG", 0.05)
    choices = "tolerances = [1e-4]\nsubrays = [4]\ngrids = [1.0]\nlevels = [0, 1, 3]"
    path = suite_file(tmp_path, f"[simulator]\nside = 16\nviews = 2\n{choices}")
    assert pareto.main([str(tmp_path), "--suite", str(path), "--part", "simulator", "--repeats", "1"]) == 0
    text = capsys.readouterr().out
    assert "## simulator, rods: exact solids (16² pixels, 2 views)" in text
    # each default has its verdict in each error: of solids, of voxels, of scatter
    verdicts = [line for line in text.splitlines() if line.startswith("- Default ")]
    assert len(verdicts) == 3
    assert all(line.count("the front") == 2 for line in verdicts)
    # a scanner with scatter is simulated with it: no other level is as good
    assert any(line.startswith("- Default scatter, level 3") and line.count("on the front") == 2 for line in verdicts)
    assert "body in voxels, metal exact, 16³ labels" in text


# --- the command -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--threads", "0"], "--threads must be at least 1, got 0"),
        (
            ["--scene", "teeth"],
            "--scene 'teeth': there is no such scene, expected one of simulator: rods; methods: lung-Fe",
        ),
        (["--part", "simulator", "--scene", "lung-Fe"], "expected one of simulator: rods"),
        (["--method", "fdc"], "there is no method 'fdc'"),
    ],
)
def test_bad_input_is_said_in_one_sentence(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(host, "use_threads", lambda threads: None)
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "pareto", str(tmp_path / "out"), *arguments])
    assert cli.run_benchmark() == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said and not (tmp_path / "out").exists()


def test_the_page_gives_a_file_that_works(tmp_path):
    page = Path(__file__).parents[1] / "docs" / "how-to" / "measure-time-against-error.md"
    path = tmp_path / "mine.toml"
    path.write_text("\n".join(re.findall(r"^    (.*)$", page.read_text(encoding="utf-8"), re.M)), encoding="utf-8")
    assert [listed.name for listed in pareto_suite.load(path).method] == ["splat", "my_lab.net:reconstruct"]
