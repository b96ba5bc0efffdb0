"""The page of scatter that splats find."""

import math

import msgspec
import numpy as np
import pytest

from ctsim.benchmarks.suites import load
from ctsim.benchmarks.tools import scatter
from ctsim.errors import InputError


def test_what_is_off_is_of_the_mean_where_it_is_asked_for():
    true, found = np.array([1.0, 3.0, 5.0], np.float32), np.array([2.0, 3.0, 9.0], np.float32)
    assert scatter.off(found, true, np.array([True, True, False])) == "+25 %"
    assert scatter.off(found, true, np.zeros(3, bool)) == "n/a"


def test_a_row_says_what_was_found_and_how_it_fares(monkeypatch):
    """Few passes and a constant, of which the true amount is known: the row is made as the page makes it."""
    asked, reconstruct = [], scatter.reconstruct

    def quick(scan, settings):
        asked.append((settings.scatter, float(scan.counts.double().mean())))
        return reconstruct(scan, msgspec.structs.replace(settings, passes=(0, 1), fineness=1.0))

    monkeypatch.setattr(scatter, "reconstruct", quick)
    scene = next(scene for scene in load("scatter") if scene.name == "lung-Fe-constant")
    small = {
        "n_voxel": (16, 16, 16), "n_detector": (48, 48), "n_views": 12, "scatter": {"level": 1, "fraction": 0.05}
    }  # fmt: skip
    scanner = msgspec.convert({**msgspec.to_builtins(scene.scanner), **small}, type(scene.scanner))
    text = scatter.page([msgspec.structs.replace(scene, scanner=scanner)])
    assert [given for given, _ in asked] == [0.0, None, 0.0]
    assert asked[0][1] == asked[1][1] > asked[2][1]  # the true scatter was taken off the last
    cells = [cell.strip() for cell in text.splitlines()[-1].split("|")[1:-1]]
    assert len(cells) == len(scatter.HEAD) and cells[0] == scene.name
    assert float(cells[1]) == pytest.approx(50, rel=0.05) and float(cells[2]) == pytest.approx(50, rel=0.1)
    assert all(abs(float(cell.removesuffix(" %"))) < 10 for cell in cells[3:7] if cell != "n/a")
    assert all(math.isfinite(float(cell)) for cell in cells[7:])


def test_more_than_a_folder_is_refused():
    with pytest.raises(InputError, match="expected the folder of the measured pages or nothing"):
        scatter.main(["docs", "more"])
