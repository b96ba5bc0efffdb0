"""The tool that chooses the filter of FDK and its kin."""

import csv

import pytest

from ctsim.benchmarks.tools import tune_filter
from ctsim.errors import InputError
from ctsim.reconstruct.filters import WINDOWS


def test_one_filter_has_the_greatest_mean_over_scenes_and_methods():
    found = [("s", "a", "hann", 1.0, 10.0), ("t", "a", "hann", 1.0, 30.0), ("s", "b", "hann", 1.0, 26.0)]
    assert tune_filter.mean_scores(found, ["a"]) == {("hann", 1.0): 20.0}
    assert tune_filter.mean_scores(found, ["a", "b"]) == {("hann", 1.0): 22.0}


@pytest.mark.slow
def test_the_table_has_every_filter_and_the_best_is_printed(smallest, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tune_filter, "FILTERS", [("ram-lak", 1.0), ("hann", 0.5), ("hann", 1.0)])
    assert tune_filter.main([str(smallest), str(tmp_path), "fdk", "limar"]) == 0
    with (tmp_path / "filter.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["method"], r["window"], float(r["cutoff"])) for r in rows] == [
        (m, *f) for m in ("fdk", "limar") for f in tune_filter.FILTERS
    ]
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["fdk", "limar", "fdk, limar"]
    best = max(rows[:3], key=lambda r: float(r["psnr3d"]))
    assert f"fdk: {best['window']} {float(best['cutoff']):g}, {float(best['psnr3d']):.2f} dB" in lines[0]


def test_the_grid_is_every_window_at_every_cutoff():
    assert len(set(tune_filter.FILTERS)) == len(WINDOWS) * len(tune_filter.CUTOFFS)
    with pytest.raises(InputError, match="expected DATA, OUT and the names of methods"):
        tune_filter.main(["data"])
