"""Scene files: read, refused with a path, round trip, stable identity, impossible geometry by name."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctsim.errors import InputError
from ctsim.settings import Truth
from phantoms.recipes import NAMES
from phantoms.scanners import MACHINES, ScannerSettings, preset
from phantoms.scene import Scene, build, load_suite, parse_suite, scene_id, scene_to_toml, stream_id

SUITES = Path(__file__).parent.parent / "benchmarks" / "suites"

MINIMAL = """
name = "rods"
phantom = { recipe = "validation" }
"""


def scene(**changes) -> Scene:
    return msgspec.structs.replace(parse_suite(MINIMAL)[0], **changes)


@pytest.mark.parametrize("suite", ["quick", "core", "paper"])
def test_suites_load_and_round_trip(suite: str) -> None:
    scenes = load_suite(SUITES / f"{suite}.toml")
    assert [s.name for s in scenes] == ["lung-Fe", "teeth-Ti", "broccoli-Al"]
    for one in scenes:
        assert parse_suite(scene_to_toml(one)) == (one,)
        assert one.resolve().i0 == 1e5
        assert one.resolve().geometry.fov_radius >= 0.46 * one.phantom.size


def test_identity_is_stable_and_sees_every_change() -> None:
    one = scene()
    assert scene_id(one) == scene_id(scene()) and len(scene_id(one)) == 12
    assert scene_id(one) == scene_id(parse_suite(scene_to_toml(one))[0])
    whole = parse_suite(MINIMAL.replace('"validation"', '"validation", size = 60'))[0]
    assert scene_id(whole) == scene_id(one)  # 60 and 60.0 are the same size
    assert len({scene_id(one), scene_id(scene(seed=1)), scene_id(scene(name="b"))}) == 3


def test_more_truth_keeps_the_noise() -> None:
    more = scene(truth=Truth(noise_free=True))
    assert scene_id(more) != scene_id(scene())
    assert stream_id(more) == stream_id(scene())
    assert stream_id(scene(seed=1)) != stream_id(scene())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = ", ["s.toml", "not TOML"]),
        ("", ["s.toml", "no scenes"]),
        ("scene = []", ["no scenes"]),
        ("[extra]", ["unknown key 'extra'"]),
        (MINIMAL + "sede = 1", ["s.toml", "sede"]),
        ('name = "a"\nphantom = { recipe = "lungs" }', ["phantom.recipe", "lungs"]),
        ('name = "a"\nphantom = { recipe = "lung", vesels = 3 }', ["phantom", "vesels"]),
        ('name = "a"\nphantom = { recipe = "lung", metal = "Unobtainium" }', ["phantom", "Unobtainium"]),
        ('name = "a"\nphantom = { recipe = "lung", size = nan }', ["phantom.size"]),
        ('name = "a/b"\nphantom = { recipe = "lung" }', ["name", "a/b"]),
        ('[[scene]]\nname = "a"\nphantom = { recipe = "lung", ribs = "x" }', ["scene[0].phantom.ribs"]),
        (MINIMAL + "scanner = { geometry = { dso = 1.0 } }", ["scanner.geometry"]),
        (MINIMAL + "scanner = { n_views = 0 }", ["scanner.n_views"]),
        (MINIMAL + 'scanner = { preset = "mri" }', ["scanner.preset", "mri"]),
    ],
)
def test_bad_files_are_refused_by_file_key_and_expectation(text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        parse_suite(text, "s.toml")
    for word in ["s.toml", *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_scenes_of_one_name_and_missing_files_are_refused(tmp_path: Path) -> None:
    table = '[[scene]]\nname = "a"\nphantom = { recipe = "lung" }\n'
    with pytest.raises(InputError, match="two scenes are named 'a'"):
        parse_suite(table + table)
    with pytest.raises(InputError, match=r"none\.toml"):
        load_suite(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"binary\.toml"):
        load_suite(tmp_path / "binary.toml")


def test_a_value_left_empty_survives_the_round_trip() -> None:
    quiet = parse_suite(MINIMAL + 'scanner = { noise = { adc_bits = "null" } }')[0]
    assert quiet.resolve().noise.adc_bits is None
    assert parse_suite(scene_to_toml(quiet)) == (quiet,)


def full(**changes) -> str:
    values = {"dso": 250.0, "dsd": 500.0, "d_detector": [2.0, 2.0], "off_detector": [0.0, 0.0], **changes}
    keys = ", ".join(f"{k} = {v}" for k, v in values.items())
    rest = "n_voxel = [8, 8, 8], d_voxel = [7.5, 7.5, 7.5], n_detector = [80, 80], n_views = 8"
    return MINIMAL + f"scanner = {{ geometry = {{ {keys}, {rest} }} }}\n"


def test_impossible_geometry_is_refused_by_name() -> None:
    assert parse_suite(full())[0].resolve().geometry.dso == 250.0
    for changes, words in (
        ({"dso": 20.0}, "source lies inside the object"),
        ({"off_origin": [0.0, 0.0, 240.0]}, "source lies inside the reconstructed volume"),
        ({"off_detector": [0.0, 5000.0], "arc_deg": 90.0}, "outside the cone of all views"),
        ({"d_detector": [0.5, 0.5]}, "reaches out of the cone"),
    ):
        with pytest.raises(InputError, match=words):
            parse_suite(full(**changes))
    assert parse_suite("truncated = true\n" + full(d_detector=[0.5, 0.5]))[0].truncated


@pytest.mark.parametrize("name", MACHINES)
def test_presets_cover_the_object_and_refuse_what_is_too_large(name: str) -> None:
    scanner = preset(name, 90, (96, 96), (64, 64, 64), 60.0)
    assert scanner.geometry.s_voxel == pytest.approx((60.0, 60.0, 60.0))
    assert scanner.geometry.fov_radius >= 0.46 * 60
    assert ScannerSettings(preset=name, n_views=90).resolve(60.0) == scanner
    with pytest.raises(InputError, match="panel"):
        preset(name, 90, (96, 96), (64, 64, 64), 400.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    recipe=st.sampled_from(NAMES),
    n=st.tuples(*[st.integers(1, 20)] * 3),
    size=st.floats(-1, 300),
    metal=st.sampled_from(["none", "Fe", "Ti", "Al", "CoCr", "NaI@3.67", "nonsense"]),
    inserts=st.integers(-1, 18),
    seed=st.integers(0, 2**63 - 1),
    machine=st.sampled_from(["skyscan1273", "dental", "c-arm"]),
)
def test_random_scenes_build_or_are_refused_by_input_error(recipe, n, size, metal, inserts, seed, machine) -> None:
    text = (
        f'name = "x"\nseed = {seed}\nscanner = {{ preset = "{machine}" }}\nphantom = {{ recipe = "{recipe}", '
        f'n_voxel = {list(n)}, size = {size!r}, metal = "{metal}", n_inserts = {inserts} }}'
    )
    try:
        one = parse_suite(text, "x.toml")[0]
        phantom = build(one)
    except InputError as error:
        assert str(error)
        return
    assert parse_suite(scene_to_toml(one)) == (one,)
    assert phantom.labels.shape == n
    again = build(one)
    assert np.array_equal(phantom.labels, again.labels) and phantom.solids == again.solids
