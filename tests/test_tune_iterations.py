"""The tool that chooses how many iterations the methods take."""

import csv
import statistics

import numpy as np
import pytest

from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.tools import tune_iterations
from ctsim.benchmarks.tools.tune_filter import scoring
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError


def test_a_method_that_ended_keeps_its_last_score():
    found = [("s", "a", k, 0.0, 10.0 + k) for k in (1, 2, 3)] + [("t", "a", 1, 0.0, 20.0), ("s", "b", 1, 0.0, 99.0)]
    assert tune_iterations.by_scene(found, "a", 3) == {"s": [11.0, 12.0, 13.0], "t": [20.0, 20.0, 20.0]}


def test_the_best_is_the_first_of_equals_and_enough_is_close_to_it():
    scores = [20.0, 29.94, 29.96, 30.0, 30.0, 25.0]
    assert tune_iterations.best(scores) == 4 and tune_iterations.enough(scores) == 3
    assert tune_iterations.enough([30.0, 29.0]) == 1


@pytest.mark.slow
def test_each_iteration_is_scored_as_a_run_of_as_many(smallest, tmp_path, capsys):
    """`sart` shows its volume on the way, `ibhc` does not and is run for each number."""
    texts = ["sart[relaxation=1.5]", "ibhc"]
    assert tune_iterations.main([str(smallest), str(tmp_path), "3", *texts]) == 0
    with (tmp_path / "iterations.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    scans = [open_scan(folder) for folder in list_scans(smallest)]
    assert [(r["scene"], r["method"], int(r["iterations"])) for r in rows] == [
        (scan.name, text, k) for scan in scans for text in texts for k in (1, 2, 3)
    ]
    for name, more, text in (("sart", {"relaxation": 1.5}, texts[0]), ("ibhc", {}, "ibhc")):
        method = find(name, more | {"iterations": 2})
        alone = scoring(scans[0])(method.reconstruct(scan_for(method, scans[0], "metal")).values)
        watched = next(float(r["psnr3d"]) for r in rows if r["method"] == text and r["iterations"] == "2")
        assert watched == pytest.approx(alone, abs=1e-3)  # scores are rounded to it
    means = [
        statistics.fmean(float(r["psnr3d"]) for r in rows if r["method"] == "ibhc" and r["iterations"] == str(k))
        for k in (1, 2, 3)
    ]
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("ibhc: "))
    assert f"best {np.argmax(means) + 1}, {max(means):.2f} dB" in line and f"{means[2]:.2f} dB after 3" in line


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["data", "out", "5"], "expected DATA, OUT, a number of iterations and methods"),
        (["data", "out", "0", "sart"], "expected DATA, OUT, a number of iterations and methods"),
        (["data", "out", "5", "fdk"], "method 'fdk' has no parameter iterations"),
        (["data", "out", "5", "sart[relaxation=-1]"], "relaxation"),
        (["data", "out", "5", "start"], "did you mean sart"),
    ],
)
def test_a_wrong_command_is_refused(arguments, says):
    with pytest.raises(InputError, match=says):
        tune_iterations.main(arguments)
