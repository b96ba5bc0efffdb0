"""The page of beams that splats are not told."""

import math

import msgspec
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
    cells = [cell.strip() for cell in text.splitlines()[-1].split("|")[1:-1]]
    assert len(cells) == len(beams.HEAD) and cells[:2] == [scene.name, "1.9"]
    numbers = [float(cell) for cell in cells[3:15]]
    assert all(math.isfinite(number) for number in numbers)


def test_more_than_a_folder_is_refused():
    with pytest.raises(InputError, match="expected the folder of the measured pages or nothing"):
        beams.main(["docs", "more"])
