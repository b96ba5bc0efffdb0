"""Presets: a machine has the effects of a real one, a scene's changes keep them, and "ideal" has none."""

import msgspec
import pytest

from ctsim.beam.spectrum import Tube
from ctsim.detector.panel import Blur
from ctsim.detector.response import Detector
from ctsim.phantoms.scanners import MACHINES, ScannerSettings
from ctsim.phantoms.scene import parse_suite
from ctsim.scatter import Scatter

REAL = [name for name in MACHINES if name != "ideal"]


def resolved(**settings):
    return msgspec.convert(settings, ScannerSettings).resolve(60.0)


@pytest.mark.parametrize("name", REAL)
def test_a_machine_has_focal_spot_falloff_blur_and_scatter(name):
    scanner = resolved(preset=name)
    assert scanner.tube.focal_spot is not None and scanner.tube.falloff
    assert scanner.detector.blur is not None
    assert scanner.scatter.level == 3
    # a micro-CT stops for each view; the others turn on, and only an interventional machine has a grid
    assert bool(scanner.detector.lag) == (name != "skyscan1273")
    assert (scanner.scatter.grid_ratio is not None) == (scanner.tube.off_focal is not None) == (name == "c-arm")


def test_ideal_is_the_default_and_has_none():
    scanner = resolved(preset="ideal")
    assert scanner == resolved()
    (scene,) = parse_suite('name = "a"\nphantom = { recipe = "lung" }')
    assert scene.resolve() == scanner
    tube, detector = scanner.tube, scanner.detector
    assert (tube.focal_spot, tube.off_focal, tube.falloff) == (None, None, False)
    assert (detector.blur, detector.lag, scanner.scatter) == (None, (), Scatter(level=0))


@pytest.mark.parametrize("name", MACHINES)
def test_a_change_of_tube_or_detector_keeps_the_rest_of_the_machine(name):
    machine = resolved(preset=name)
    scanner = resolved(
        preset=name,
        tube={"kvp": 70.0, "filters": [{"material": "Cu", "thickness": 0.2}]},
        detector={"kind": "csi", "thickness": 0.3},
    )
    tube, detector = scanner.tube, scanner.detector
    assert (tube.kvp, tube.filters[0].material, detector.kind, detector.thickness) == (70.0, "Cu", "csi", 0.3)
    for key in ("focal_spot", "off_focal", "falloff"):
        assert getattr(tube, key) == getattr(machine.tube, key)
    assert (detector.blur, detector.lag) == (machine.detector.blur, machine.detector.lag)
    assert scanner.scatter == machine.scatter


def test_what_a_scene_states_wins():
    tube = {"focal_spot": {"size": [0.2, 0.3]}, "off_focal": {"share": 0.1, "fwhm": 5.0}}
    detector = {"kind": "csi", "blur": {"fwhm": 0.5}, "lag": [{"share": 0.1, "decay": 0.5}]}
    scanner = resolved(preset="c-arm", tube=tube, detector=detector)
    assert scanner.tube == msgspec.convert(tube | {"falloff": True}, Tube)
    assert scanner.detector == msgspec.convert(detector, Detector)


def test_lag_and_glare_of_a_preset_can_be_left_out():
    detector = {"kind": "csi", "thickness": 0.6, "blur": {"fwhm": 0.37}, "lag": [{"share": 0.0, "decay": 0.0}]}
    got = resolved(preset="c-arm", detector=detector).detector
    assert got.lag == () and got.blur == Blur(fwhm=0.37)


def test_a_counting_detector_has_no_light_to_spread():
    detector = resolved(preset="c-arm", detector={"kind": "counting"}).detector
    assert detector == Detector(kind="counting") and detector.blur is None and not detector.lag


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("level", [0, 1])
def test_a_scene_sets_the_level_of_scatter(name, level):
    scanner = resolved(preset=name, scatter={"level": level})
    assert scanner.scatter == Scatter(level=level)  # without the machine's grid
    assert scanner.tube == MACHINES[name].tube and scanner.detector == MACHINES[name].detector
