import functools
import sys

import pytest
from conftest import SMALLEST
from msgspec.structs import replace
from run_records import changed

from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.studies import ablation
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.paper import tables as paper_tables
from ctsim.benchmarks.suites import load as load_suite
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError

pytestmark = pytest.mark.slow

STUB = """
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import reconstruct as fdk


def reconstruct(scan, *, steps=0, response="", basis="", nodes=0, e_max=0.0, tube=None, detector=None):
    if (tube is None) == (response == "known"):
        raise AssertionError("only a known response is told the beam")
    if response == "gmm":
        raise InputError("this one has no mixtures")
    return fdk(scan)
"""
TABLES = {'name = "smallest"': "[defaults]", "[phantom]": "[defaults.phantom]", "[scanner]": "[defaults.scanner]"}
LUNG, BROCCOLI = "ablation-lung-Fe", "ablation-broccoli-Al"
BASE = {"steps": 2000}


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """`run-benchmark ablation` on tiny scans of the suite's names, with a method that takes the splat's parameters."""
    (tmp_path / "stub_splat.py").write_text(STUB, encoding="utf-8")
    tiny = "".join(f'\n[[scene]]\nname = "{scene.name}"\n' for scene in load_suite("ablation"))
    defaults = SMALLEST
    for one, many in TABLES.items():
        defaults = defaults.replace(one, many)
    (tmp_path / "tiny.toml").write_text(defaults + tiny, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    for name in ("splat-paper", "splat-r2"):
        monkeypatch.setitem(methods.TABLE, name, ("stub_splat:reconstruct", methods.COUNTS_ONLY))

    @functools.cache
    def load(suite):
        return load_suite("tiny.toml" if suite == "ablation" else suite)

    monkeypatch.setattr("ctsim.benchmarks.make_dataset.work.load", load)
    monkeypatch.setattr(paper_tables, "_scenes", load)
    paper_tables.identities.cache_clear()
    yield lambda *more: run(monkeypatch, capsys, more)
    paper_tables.identities.cache_clear()
    sys.modules.pop("stub_splat", None)


def run(monkeypatch, capsys, more):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "ablation", "data", "results", *more])
    code = cli.run_benchmark()
    return code, capsys.readouterr()


def label(**params):
    return methods.Method(name="splat-paper", target="", inputs="", params={}, overrides={**BASE, **params}).label


def test_a_run_that_rows_share_is_listed_once_with_all_of_them():
    found = {(v.scene, v.label): v for v in ablation.variants()}
    assert len(found) == len(ablation.variants())
    shared = found[LUNG, label()]
    assert shared.rows == ("1: Our model", "5: Baseline with both", "6: 15", "7: Lung, Ours")
    assert {v.params["response"] for v in found.values() if "response" in v.params} >= {
        *("gmm", "free", "hinge", "tube", "known"),
    }
    assert {v.params["nodes"] for v in found.values() if "nodes" in v.params} == {7, 15, 31, 63}
    assert {v.params["e_max"] for v in found.values() if "e_max" in v.params} == {60.0, 120.0, 150.0}


def test_every_row_runs_and_no_two_are_the_same(smallest):
    """A few steps of each on a small scan; where the volumes agree to the bit, a parameter changed nothing."""
    stored = open_scan(list_scans(smallest)[0])
    found: dict[bytes, str] = {}
    for method in ablation.methods_of(ablation.variants()).values():
        short = methods.find(method.name, {**method.overrides, "steps": 3, "n_splats": 200})
        volume = short.reconstruct(stored.scan)
        assert volume.status == "ok" and volume.values.any()
        assert found.setdefault(volume.values.numpy().tobytes(), method.label) == method.label


def test_one_table_needs_its_own_rows_only():
    (baseline, *_) = ablation.variants((7,))
    assert (baseline.method, baseline.params) == ("splat-r2", {"steps": 3000}) and baseline.scene == BROCCOLI
    assert len(ablation.variants((7,))) == 6
    assert {v.scene for v in ablation.variants((9,))} == {BROCCOLI, *(f"{BROCCOLI}-{k}kV" for k in (60, 120, 150))}


def test_the_scenes_are_those_that_the_rows_speak_of():
    scenes = {scene.name: scene for scene in load_suite("ablation")}
    assert set(scenes) == {v.scene for v in ablation.variants()}
    for name, kvp in ((LUNG, 90), (BROCCOLI, 90), *((f"{BROCCOLI}-{k}kV", k) for k in (60, 120, 150))):
        assert scenes[name].resolve().tube.kvp == kvp
        assert [(f.material, f.thickness) for f in scenes[name].resolve().tube.filters] == [("Al", 0.5)]
    assert scenes[LUNG].phantom.metal == "Fe" and len({s.resolve().geometry for s in scenes.values()}) == 1


def test_rows_become_records_and_what_failed_is_tried_again(command, tmp_path):
    code, shown = command("--table", "1", "--table", "7")
    found = records.read(tmp_path / "results")
    runs = ablation.variants((1, 7))
    assert {(r.run.scene, r.label) for r in found} == {(v.scene, v.label) for v in runs} and len(found) == len(runs)
    assert {r.run.variant for r in found} == {"metal"}
    assert code == 1
    assert [r.label for r in found if r.status == "error"] == [label(response="gmm")]
    assert "## Table 1." in shown.out and "## Table 7." in shown.out and "## Table 3." not in shown.out
    text = (tmp_path / "results" / "ablation.md").read_text(encoding="utf-8")
    (mixture,) = [line for line in text.splitlines() if line.startswith("| GMM ")]
    assert mixture.split("|")[3].strip() == "error" and "InputError: this one has no mixtures" in text
    ours = next(line for line in text.splitlines() if line.startswith("| Our model |"))
    score = next(r.scores["paper"].values["psnr3d"] for r in found if (r.run.scene, r.label) == (LUNG, label()))
    assert f"{score:.2f}" in ours
    assert command("--table", "1", "--table", "7")[0] == 1
    again = records.read(tmp_path / "results")
    assert [r.label for r in again[len(found) :]] == [label(response="gmm")]
    assert (tmp_path / "results" / "table.md").exists()


def test_limit_and_workers_are_those_of_run_benchmark(command, monkeypatch):
    asked = []

    def stopped(study, tasks, known, given):
        asked.append((len(tasks), given.seconds, given.workers, given.anchor))
        raise InputError("stopped here")

    monkeypatch.setattr(ablation, "measure_all", stopped)
    code, shown = command("--table", "9", "--seconds", "7", "--workers", "2")
    assert code == 2 and "stopped here" in shown.err
    assert asked == [(len(ablation.variants((9,))), 7.0, 2, False)]


def test_a_dry_run_prints_rows_and_cost_and_writes_nothing(command, tmp_path):
    code, shown = command("--dry-run", "--table", "7")
    assert code == 0 and not (tmp_path / "data").exists() and not (tmp_path / "results").exists()
    seconds = 3 * (2000 * ablation.SECONDS["splat-paper"] + 3000 * ablation.SECONDS["splat-r2"])
    assert f"total: 6 of 6 runs, {ablation.human_time(seconds)}" in shown.out
    assert "scans to be made first: ablation-broccoli-Al ablation-lung-Fe ablation-teeth-Ti" in shown.out
    assert command("--table", "7")[0] == 0
    code, shown = command("--dry-run", "--table", "7", "--table", "5")
    lines = [line for line in shown.out.splitlines() if LUNG in line]
    assert code == 0 and len(lines) == 3 and all("  5: " in line and "7:" not in line for line in lines)
    assert "total: 3 of 9 runs" in shown.out and "scans to be made" not in shown.out


def test_the_cost_of_a_step_is_what_records_say():
    from test_paper_tables import record

    found = [record("splat-paper", LUNG, wall=50.0, params=BASE), record("splat-paper", LUNG, wall=70.0, params=BASE)]
    found[0] = changed(found[0], cost=replace(found[0].cost, warm_up=30.0))
    # (50 + 30) and 70 s for 2000 steps, the median between them
    assert ablation._rates(found) == ablation.SECONDS | {"splat-paper": pytest.approx(75 / 2000)}


@pytest.mark.parametrize(
    "arguments",
    [
        ("--table", "3"),
        ("--table", "3", "--dry-run"),
        ("--seconds", "-1"),
        ("--seconds", "-1", "--dry-run"),
        ("--workers", "0"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(command, arguments):
    code, shown = command(*arguments)
    assert code == 2 and shown.err.splitlines()[-1].startswith("run-benchmark ablation: ")
    assert shown.err.count("run-benchmark ablation") == 1 and "Traceback" not in shown.err
