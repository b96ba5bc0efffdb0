"""The page of scatter that splats find."""

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


def test_a_page_says_what_was_found_and_how_methods_and_controls_fare(monkeypatch):
    """Few passes and a constant, of which the true amount is known: the row is made as the page makes it."""
    asked, find = [], scatter.find

    def quick(name, told):
        asked.append((name, told["scatter"]))
        return find(name, {**told, "passes": [0, 1], "fineness": 1.0} if name == "splat" else told)

    monkeypatch.setattr(scatter, "find", quick)
    scene = next(scene for scene in load("scatter") if scene.name == "lung-Fe-constant")
    small = {
        "n_voxel": (16, 16, 16), "n_detector": (48, 48), "n_views": 12, "scatter": {"level": 1, "fraction": 0.05}
    }  # fmt: skip
    scanner = msgspec.convert({**msgspec.to_builtins(scene.scanner), **small}, type(scene.scanner))
    text = scatter.page([msgspec.structs.replace(scene, scanner=scanner)])
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if scene.name in line]
    (found, psnr, controls, core) = rows[-4:]
    heads = (scatter.HEAD, scatter.PSNR, scatter.CONTROLS, scatter.CORES)
    assert [len(row) for row in (found, psnr, controls, core)] == [len(head) for head in heads]
    assert [float(cell) for cell in found[1:4]] == pytest.approx([50, 50, 50], rel=0.1)
    assert all(abs(float(cell.removesuffix(" %"))) < 10 for cell in found[4:] if cell != "n/a")
    told = [given for name, given in asked if name == "fdk"]
    assert told[0] == told[3] == 0 and told[1] == pytest.approx(0.05, rel=0.1) and told[2] == "found"
    assert asked[16:] == [("twin-fdk", 0), ("twin-fdk", "found")]
    assert [name for name, _ in asked[:16]] == [name for name in scatter.METHODS for _ in scatter.TOLD]
    for k in range(0, len(psnr) - 1, 4):  # a constant is a constant, however it is found, and worth knowing
        left, constant, field, true = map(float, psnr[1 + k : 5 + k])
        assert constant == pytest.approx(field, abs=0.2) and true == pytest.approx(field, abs=1)
        assert left != field
    assert all(0 < float(cell) < 2 for cell in core[1:])
    zero, *hulls, left, taken = map(float, controls[1:])
    # one value is better than none, a picture without metal better still, and what is taken off changes both
    assert zero < min(hulls) and max(hulls) < min(left, taken) and hulls[0] != hulls[1] and left != taken
    assert float(psnr[5]) < left  # FDK, scatter left in, with the metal and without


def test_more_than_a_folder_is_refused():
    with pytest.raises(InputError, match="expected the folder of the measured pages or nothing"):
        scatter.main(["docs", "more"])
