import re
import sys

import pytest
from conftest import SMALLEST
from run_records import make_record

from ctsim.benchmarks import cli, make_dataset
from ctsim.benchmarks.scores.score import Score
from ctsim.benchmarks.studies.claims import study as reproduce
from ctsim.benchmarks.studies.methods import study
from ctsim.benchmarks.studies.methods.records import Cost

RMSE = {"fdk": 300.0, "limar": 150.0, "nmar": 120.0}
WALL = {"fdk": 1.0, "limar": 2.0, "nmar": 4.0, reproduce.OS_SART: 30.0}


def record(method, seed, *, rmse=None, wall=None, status="ok"):
    score = Score(
        region="", reference="", alignment="", data_range=None, n_voxels=1, values={"rmse": rmse or RMSE.get(method)}
    )
    cost = Cost(wall=wall or WALL[method], cpu=1.0, peak_bytes=1, view_updates=2400, device="cpu")
    return make_record(method, scan=f"s{seed}", seed=seed, status=status, cost=cost, scores={"artefact": score})


def judged(changes=None, seeds=(1, 2, 3)):
    changes = changes or {}
    found = [record(m, s, **changes.get((m, s), {})) for m in WALL for s in seeds]
    return [(claim.holds, claim.found) for claim in reproduce.judged(found)]


def test_claims_that_hold():
    (order, limar, nmar, passes) = judged()
    assert order == (True, "fdk 300.0 ± 0.0, limar 150.0 ± 0.0, nmar 120.0 ± 0.0 HU (3 seeds)")
    assert limar == (True, "2.00 (2.00 to 2.00, 3 scans)") and nmar[0]
    assert passes == (True, "30.0 ± 0.0 s for 2400 view updates")


@pytest.mark.parametrize(
    ("changes", "fails"),
    [
        ({("nmar", 2): {"rmse": 150.1}}, [0]),  # one seed is enough
        ({("limar", 3): {"rmse": 180.0}}, [0]),  # 0.6 of FDK is not below it
        ({("limar", 1): {"wall": 9.0}}, []),  # the median counts
        ({("limar", s): {"wall": 2.6} for s in (1, 2)}, [1]),
        ({("nmar", s): {"wall": 5.1} for s in (1, 2)}, [2]),
        ({(reproduce.OS_SART, 1): {"status": "nonfinite"}}, [3]),
    ],
)
def test_claims_that_do_not(changes, fails):
    assert [k for k, (holds, _) in enumerate(judged(changes)) if not holds] == fails


def test_what_was_not_measured_is_not_said_to_hold():
    assert [c.holds for c in reproduce.judged([])] == [None] * 4
    assert [c.holds for c in reproduce.judged([record("fdk", 1), record("limar", 2)])] == [None] * 4
    assert "not measured" in reproduce.table(reproduce.judged([])).markdown()


def test_a_dry_run_plans_scans_and_lists_runs(tmp_path, capsys):
    suite = tmp_path / "suite.toml"
    suite.write_text(SMALLEST.replace('"smallest"', '"lung-Fe"'), encoding="utf-8")
    words = [*(str(tmp_path / name) for name in ("data", "r")), "--suite", str(suite), "--seeds", "1", "2"]
    before = sorted(tmp_path.iterdir())
    assert reproduce.main([*words, "--dry-run"]) == 0 and sorted(tmp_path.iterdir()) == before
    out = capsys.readouterr().out
    assert "on disk" in out and "on 2 scans to be made and their twins: 0 s" in out
    assert out.rstrip().endswith("never measured: fdk, limar, nmar, os-sart[iterations=10]")
    # one scan is there, and its runs are those of run-benchmark; what is recorded tells of the scan that is not
    assert make_dataset.main([str(suite), str(tmp_path / "data"), "--seeds", "1"]) == 0
    (tmp_path / "r").mkdir()
    for known in (record("fdk", 1, wall=3.0), record("limar", 1, wall=5.0)):
        study.Methods().store(study.Flags(data=tmp_path, results=tmp_path / "r")).append([known])
    capsys.readouterr()
    assert reproduce.main([*words, "--dry-run"]) == 0
    out = capsys.readouterr().out
    # scan and twin, 2 × (3 + 5) s, and what this machine's time of an FDK makes of the others
    assert out.count("already complete") == 1 and re.search(r"total: 8 of 8 runs, [\d.]+ (s|min)", out)
    assert re.search(r"^lung-Fe, seed 1 +limar +2 x 10 s$", out, re.M)
    assert re.search(r"^lung-Fe, seed 1 +nmar +2 x [\d.]+ (s|min)$", out, re.M)
    assert "on 1 scans to be made and their twins: 16 s" in out


@pytest.mark.slow
def test_one_command_makes_the_scans_the_records_and_the_verdict(tmp_path, monkeypatch, capsys):
    suite = tmp_path / "suite.toml"
    suite.write_text(SMALLEST.replace('"smallest"', '"lung-Fe"'), encoding="utf-8")
    given = [tmp_path / "data", tmp_path / "r", "--suite", suite, "--seeds", "1", "2"]
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "reproduce", *map(str, given)])
    code = cli.run_benchmark()
    text = (tmp_path / "r" / "reproduce.md").read_text(encoding="utf-8")
    assert code == (0 if "**no**" not in text else 1) and "not measured" not in text
    assert "(2 seeds)" in text and "120 view updates" in text and "## against" in text and "harm rate" in text
    assert " ± " in next(line for line in text.splitlines() if line.startswith("| metal mask | nmar"))
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--table"])
    assert cli.run_benchmark() == code and (tmp_path / "r" / "reproduce.md").read_text(encoding="utf-8") == text
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "reproduce", str(tmp_path), str(tmp_path / "none"), "--table"])
    assert cli.run_benchmark() == 2 and capsys.readouterr().err.count("\n") == 1
