"""The page of beams that splats are not told."""

import math

import msgspec
import numpy as np
import pytest

from ctsim.beam.spectrum import Filter, Tube
from ctsim.benchmarks.suites import load
from ctsim.benchmarks.tools import beams
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.reconstruct.splat import fast


@pytest.mark.parametrize("thickness", [0.0, 0.06, 0.3, 2.0, 9.0])
def test_the_assumed_tube_is_equivalent_to_its_own_filter(thickness):
    filters = (Filter(material="Al", thickness=thickness),) if thickness else ()
    scanner = msgspec.structs.replace(
        load("beams")[0].resolve(),
        tube=Tube(kvp=90.0, filters=filters, model="finkelshtein-pavlova"),
        detector=Detector(kind="gos", thickness=0.2),
    )
    assert beams.equivalent(scanner) == pytest.approx(thickness, rel=0.02)


def test_a_row_says_what_was_found_and_how_it_fares(monkeypatch):
    """Few passes, on a grid of 32, the coarsest that tells a beam: the row is made as the page makes it."""
    asked, reconstruct = [], beams.reconstruct

    def quick(scan, settings):
        asked.append((settings.response, settings.filtration, settings.detector is not None))
        return reconstruct(scan, msgspec.structs.replace(settings, passes=(0, 1), fineness=1.0))

    monkeypatch.setattr(beams, "reconstruct", quick)
    monkeypatch.setattr(fast, "TRIAL", (0, 1))
    scene = next(scene for scene in load("beams") if scene.name == "lung-90kV-Al2.5-GOS")
    small = {"n_voxel": (32, 32, 32), "n_detector": (48, 48), "n_views": 12, "scatter": {"level": 0}}
    scanner = msgspec.convert({**msgspec.to_builtins(scene.scanner), **small}, type(scene.scanner))
    text = beams.page([msgspec.structs.replace(scene, scanner=scanner)])
    assert asked == [("tube", 0.5, False), ("tube", None, False), ("known", None, True), ("tube", None, True)]
    lines = [line for line in text.splitlines() if line.startswith(f"| {scene.name} ")]
    cells, controls = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    assert len(cells) == len(beams.HEAD) and cells[:2] == [scene.name, "1.9"]
    numbers = [float(cell) for cell in cells[3:15]]
    assert all(math.isfinite(number) for number in numbers)
    assert [title.split(":")[0] for title in beams.FARED[1::3]] == ["zero", "hull", "twin-fdk", "fdk"]
    zero, hull, twin, fdk = np.array([float(cell) for cell in controls[1:]]).reshape(4, 3)
    # one value is better than none, and FDK best where the metal never was, of which it then has nothing
    assert zero[0] < hull[0] < twin[0] > fdk[0] and zero[1] > hull[1] > twin[1] < fdk[1]
    assert zero[2] == 0 and hull[2] < 0.1 and twin[2] < 0.1 < fdk[2]


def test_more_than_a_folder_is_refused():
    with pytest.raises(InputError, match="expected the folder of the measured pages or nothing"):
        beams.main(["docs", "more"])
