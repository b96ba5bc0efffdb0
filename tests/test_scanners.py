"""Presets: a machine has the effects of a real one, a scene's changes keep them, and "ideal" has none."""

from importlib import resources
from types import MappingProxyType

import msgspec
import pytest

import ctsim
from ctsim.beam.spectrum import Tube
from ctsim.benchmarks.studies.detect import suite as detect
from ctsim.detector.panel import Blur
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.phantoms.recipes import Lung
from ctsim.phantoms.scanners import KEPT, MACHINES, ScannerSettings
from ctsim.phantoms.scene import Scene, parse_suite, scene_to_toml
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
    assert scanner.scatter == Scatter(level=level)  # without the machine's grid, as a `Scatter` is whole
    assert scanner.tube == MACHINES[name].tube and scanner.detector == MACHINES[name].detector


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ('preset = "dental"\ntube = { kvp = 110.0 }', ("Al 2.5", 110.0, "csi", 0.5, None)),
        ('preset = "c-arm"\ntube = { anode_deg = 9.0 }', ("Al 2.5 Cu 0.1", 100.0, "csi", 0.6, 10.0)),
        (
            'preset = "c-arm"\ntube = { filters = [{ material = "Cu", thickness = 0.3 }] }',
            ("Cu 0.3", 100.0, "csi", 0.6, 10.0),
        ),
        ('preset = "dental"\ntube = { filters = [] }', ("", 90.0, "csi", 0.5, None)),
        ('preset = "dental"\ndetector = { thickness = 0.3 }', ("Al 2.5", 90.0, "csi", 0.3, None)),
        ('preset = "dental"\ndetector = { kind = "gos" }', ("Al 2.5", 90.0, "gos", 0.1, None)),
        ('preset = "dental"\ndetector = { kind = "csi" }', ("Al 2.5", 90.0, "csi", 0.5, None)),
        ('preset = "c-arm"\nscatter = { level = 3 }', ("Al 2.5 Cu 0.1", 100.0, "csi", 0.6, None)),
        ('preset = "c-arm"\nscatter = { grid_ratio = "null" }', ("Al 2.5 Cu 0.1", 100.0, "csi", 0.6, None)),
        ('preset = "c-arm"\nscatter = { grid_ratio = 6.0 }', ("Al 2.5 Cu 0.1", 100.0, "csi", 0.6, 6.0)),
        ('preset = "c-arm"\nscatter = { level = 1, fraction = 0.1 }', ("Al 2.5 Cu 0.1", 100.0, "csi", 0.6, None)),
        ("tube = { kvp = 60.0 }", ("Al 0.5", 60.0, "gos", 0.1, None)),
    ],
)
def test_a_part_keeps_what_of_the_preset_it_does_not_state(given, expected):
    text = f'name = "s"\nphantom = {{ recipe = "lung", metal = "Fe" }}\n[scanner]\n{given}\n'
    (scene,) = parse_suite(text)
    machine = scene.resolve()
    sheets = " ".join(f"{f.material} {f.thickness:g}" for f in machine.tube.filters)
    found = sheets, machine.tube.kvp, machine.detector.kind, machine.detector.thickness, machine.scatter.grid_ratio
    assert found == expected
    assert parse_suite(scene_to_toml(scene)) == (scene,)  # which states all of it
    under = f'[defaults.phantom]\nrecipe = "lung"\nmetal = "Fe"\n[[scene]]\nname = "s"\n[scene.scanner]\n{given}\n'
    assert parse_suite(under) == (scene,)


def test_a_voltage_that_is_drawn_keeps_the_filters_of_the_preset():
    text = """
[[scene]]
name = "s"
count = 2
phantom = { recipe = "lung", metal = "Fe" }
scanner = { preset = "dental" }
vary = { "scanner.tube.kvp" = { uniform = [80.0, 110.0] } }
"""
    tubes = [scene.resolve().tube for scene in parse_suite(text)]
    assert len({tube.kvp for tube in tubes}) == 2
    assert {(f.material, f.thickness) for tube in tubes for f in tube.filters} == {("Al", 2.5)}


@pytest.mark.parametrize(
    "given",
    ["tube = 3", 'tube = "x"', "detector = []", "scatter = [1]", "preset = []\ntube = {}", 'preset = "x"\ntube = {}'],
)
def test_a_part_of_another_type_is_refused_as_before(given):
    with pytest.raises(InputError, match=r"scanner\.(tube|detector|scatter|preset)"):
        parse_suite(f'name = "s"\nphantom = {{ recipe = "lung" }}\n[scanner]\n{given}\n')


def test_presets_differ_in_nothing_that_a_scene_would_lose():
    later = {"tube": {"focal_spot", "off_focal", "falloff"}, "detector": {"blur", "lag"}, "scatter": set()}
    for machine in MACHINES.values():
        for part, keys in KEPT.items():
            own = getattr(machine, part)
            plain = type(own)()
            differs = {name for name in own.__struct_fields__ if getattr(own, name) != getattr(plain, name)}
            assert differs <= {*keys, *later[part]}


@pytest.mark.parametrize("scatter", [Scatter(level=3), Scatter(level=3, grid_ratio=4.0), Scatter()])
def test_a_scene_made_in_python_is_read_back_as_it_is(scatter):
    scanner = ScannerSettings(preset="c-arm", tube=Tube(), detector=Detector(), scatter=scatter)
    scene = Scene(name="s", phantom=Lung(metal="Fe"), scanner=scanner)
    assert parse_suite(scene_to_toml(scene)) == (scene,)
    assert scene.resolve().tube.filters == Tube().filters


@pytest.mark.parametrize("tube", [{"kvp": 110.0}, MappingProxyType({"kvp": 110.0})])
def test_a_scene_of_dicts_keeps_the_preset_as_a_file_does(tube):
    scene = ctsim.new_scene(name="s", phantom={"recipe": "lung"}, scanner={"preset": "dental", "tube": tube})
    assert (scene.resolve().tube.kvp, scene.resolve().tube.filters) == (110.0, MACHINES["dental"].tube.filters)


def test_a_scene_of_lesions_keeps_the_preset_too(tmp_path):
    file = tmp_path / "own.toml"
    bundled = resources.files("ctsim.benchmarks.suites").joinpath("detect.toml").read_text(encoding="utf-8")
    file.write_text(bundled.replace('preset = "c-arm"', 'preset = "c-arm", tube = { kvp = 80.0 }'), encoding="utf-8")
    tubes = [one.scanner.resolve(one.phantom.size).tube for one in detect.load(file)]
    assert any(tube.kvp == 80.0 and tube.filters == MACHINES["c-arm"].tube.filters for tube in tubes)


def test_labels_have_a_prime_number_by_default():
    (n,) = set(Lung().n_voxel)
    assert n > 96 and all(n % k for k in range(2, n))
