"""Scene files: read, refused with a path, round trip, stable identity; whatever is read can be simulated."""

import copy
import functools
import re
import typing
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from ctsim.beam.spectrum import Bowtie, Filter, Tube
from ctsim.beam.spot import FocalSpot
from ctsim.dataset.writer import SceneWriter
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.phantoms.bodies.lung import Lung
from ctsim.phantoms.identity import FIRST_KEYS, identity
from ctsim.phantoms.recipes import BUILDERS, NAMES
from ctsim.phantoms.scanners import MACHINES, ScannerSettings, preset
from ctsim.phantoms.scene import Scene, build, load_suite, parse_suite, scene_id, scene_to_toml, stream_id
from ctsim.plan import make_plan
from ctsim.reconstruct.splat.filtration import USUAL
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views

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


def test_systems_are_one_thorax_in_the_papers_five_cases() -> None:
    scenes = load_suite(SUITES / "systems.toml")
    lung = load_suite(SUITES / "core.toml")[0]
    grid = {"n_voxel": (197,) * 3, "grid_shift": (0.31, 0.17, 0.43)}  # of no method
    thorax, cases = msgspec.structs.replace(lung.phantom, **grid), []
    for one in scenes:
        assert parse_suite(scene_to_toml(one)) == (one,)
        assert (one.phantom, one.seed, one.truth) == (thorax, lung.seed, lung.truth)
        assert one.simulation == Simulation(scatter_error=0.02)
        name, _, equal = one.name.partition("-same-")
        scanner, plain = one.resolve(), lung.resolve()
        assert (scanner.geometry, scanner.noise) == (plain.geometry, plain.noise)
        assert equal or scanner.i0 == plain.i0
        (sheet,) = scanner.tube.filters
        cases.append((scanner.tube.kvp, sheet.material, sheet.thickness, scanner.detector.kind))
        kvp, material, thickness, kind = cases[-1]
        assert name.lower() == f"lung-{kvp:g}kv-{material}{thickness}-{kind}".lower()
        assert scanner.detector.thickness == 0.1
    assert cases == 3 * [  # at equal photons, mAs and kerma
        (90, "Al", 0.5, "gos"),
        (90, "Al", 1.0, "gos"),
        (90, "Al", 0.5, "csi"),
        (120, "Al", 0.5, "gos"),
        (60, "Cu", 0.5, "gos"),
    ]


def test_lookalikes_are_five_objects_with_metal_and_a_twin_without() -> None:
    scenes = load_suite(SUITES / "lookalike.toml")
    recipes = {"walnut": "Fe", "metal_rods": "Al6061", "chicken": "Fe", "bell_pepper": "Al", "broccoli": "Al"}
    assert {s.phantom.recipe: s.phantom.metal for s in scenes} == recipes and len(scenes) == 5
    for one in scenes:
        assert parse_suite(scene_to_toml(one)) == (one,)
        scanner = one.resolve()
        assert scanner.tube == MACHINES["skyscan1273"].tube and scanner.detector == MACHINES["skyscan1273"].detector
        assert (scanner.geometry.n_voxel, scanner.geometry.shape) == ((128, 128, 128), (240, 224, 224))
        small = msgspec.structs.replace(one.phantom, n_voxel=(24, 24, 24))
        body = build(msgspec.structs.replace(one, phantom=small))
        assert one.truth.twin and any(s.metal and s.material == recipes[one.phantom.recipe] for s in body.solids)


def test_headline_scenes_mix_metals_and_coincide_with_no_grid() -> None:
    scenes = {one.name: one for one in load_suite(SUITES / "headline.toml")}
    metals = {
        "thorax-Fe": {"Fe"},
        "hip-CoCr-Ti": {"CoCr", "Ti"},
        "spine-mixed": {"Ti", "CoCr", "W"},
        "jaw-mixed": {"Ti", "amalgam", "Au", "CoCr"},
        "rods-Al-thick": {"Al6061"},
    }
    assert set(scenes) == set(metals)
    others = {s.name for path in SUITES.glob("core*.toml") for s in load_suite(path)}
    for name, one in scenes.items():
        scanner, n = one.resolve(), one.phantom.n_voxel[0]
        assert parse_suite(scene_to_toml(one)) == (one,) and name not in others and one.truth.twin
        assert scanner.scatter.level == 3 and scanner.i0 == 1e5 and scanner.detector.blur is not None
        assert scanner.geometry.shape == (240, 224, 224) and scanner.geometry.n_voxel == (128, 128, 128)
        # the edges of label voxels, in voxels of the method's grid: none falls together with one of its edges
        for fine in (128, 192):
            for shift in one.phantom.grid_shift:
                edges = (np.arange(n + 1) + shift - n / 2) / n * fine + fine / 2
                assert np.abs(edges - np.rint(edges)).min() > 1e-4
        small = msgspec.structs.replace(one.phantom, n_voxel=(32, 32, 32))
        body = build(msgspec.structs.replace(one, phantom=small))
        assert {s.material for s in body.solids if s.metal} == metals[name]
    filters = {name: one.resolve().tube.filters for name, one in scenes.items()}
    assert (Filter(material="Al", thickness=USUAL),) not in filters.values()  # splat starts from this one


def test_identity_is_stable_and_sees_every_change() -> None:
    one = scene()
    assert scene_id(one) == scene_id(scene()) and len(scene_id(one)) == 12
    assert scene_id(one) == scene_id(parse_suite(scene_to_toml(one))[0])
    whole = parse_suite(MINIMAL.replace('"validation"', '"validation", size = 60'))[0]
    assert scene_id(whole) == scene_id(one)  # 60 and 60.0 are the same size
    assert len({scene_id(one), scene_id(scene(seed=1)), scene_id(scene(name="b"))}) == 3


def test_ids_of_scenes_made_before_are_what_they_were() -> None:
    # made by the code before the first later key; datasets and noise streams have these names
    tube = Tube(
        kvp=100.0,
        heel=True,
        filters=(Filter(material="Cu", thickness=0.1),),
        bowtie=Bowtie(center=1.0, edge=4.0, half_angle_deg=9.0),
    )
    machine = ScannerSettings(
        preset="c-arm",
        i0=2e4,
        tube=tube,
        detector=Detector(kind="csi", thickness=0.4),
        noise=Noise(electronic=8.0),
        scatter=Scatter(level=1),
    )
    grid = (96, 96, 96)  # the default at that time
    full = scene(name="a", phantom=Lung(metal="Ti", n_voxel=grid), scanner=machine)
    plain = scene(
        phantom=msgspec.structs.replace(scene().phantom, n_voxel=grid), scanner=ScannerSettings(preset="skyscan1273")
    )
    assert (scene_id(plain), stream_id(plain)) == ("80f9b04bed06", "d9e1e0d59da4")
    assert (scene_id(full), stream_id(full)) == ("c2118d26f899", "cee0d3662a8e")
    suites = {"lung-Fe": ("d883fb1e4e96", "7556d2a12999"), "teeth-Ti": ("110450d6ba50", "eed43024ea85")}
    found = {one.name: (scene_id(one), stream_id(one)) for one in load_suite(SUITES / "quick.toml")}
    assert found | suites == found


def test_a_later_key_is_part_of_an_id_only_where_it_is_used() -> None:
    old = scene(scanner=ScannerSettings(tube=Tube(), detector=Detector()))
    spot = FocalSpot(size=(0.4, 0.4))
    used = scene(scanner=ScannerSettings(tube=Tube(focal_spot=spot), detector=Detector()))
    other = scene(scanner=ScannerSettings(tube=Tube(focal_spot=FocalSpot(size=(0.4, 0.5))), detector=Detector()))
    assert len({stream_id(one) for one in (old, used, other)}) == 3
    assert identity(used.scanner.tube)["focal_spot"] == {"size": (0.4, 0.4)}
    # a key that does not exist yet, in a struct that has an id today
    names = [(f.name, f.type, f.default) for f in msgspec.structs.fields(Filter) if not f.required]
    required = [(f.name, f.type) for f in msgspec.structs.fields(Filter) if f.required]
    later = msgspec.defstruct("Filter", [*required, ("tilt_deg", float, 0.0), *names], kw_only=True)
    flat, tilted = later(material="Al", thickness=0.5), later(material="Al", thickness=0.5, tilt_deg=2.0)
    assert identity(flat) == identity(Filter(material="Al", thickness=0.5)) == {"material": "Al", "thickness": 0.5}
    assert identity((flat,)) == ({"material": "Al", "thickness": 0.5},)
    assert identity((tilted,)) == ({"material": "Al", "thickness": 0.5, "tilt_deg": 2.0},)


def test_the_defaults_of_later_keys_stay() -> None:
    """An id without such a key means its default: a new key is added here, and no entry ever changes."""
    body = {"grid_shift": (0.0, 0.0, 0.0), "texture": 0.0, "texture_mm": None}
    known = {kind.__name__: body for kind in BUILDERS} | {
        "CtVolume": {**body, "existing_metal": "refuse", "metal_hu": 3000.0},
        "Teeth": {**body, "fillings": 0, "gold_crowns": 0, "bridges": 0},
        "Spine": {**body, "plug": "none"},
        "ScannerSettings": {"scan_kerma": None, "scan_mas": None},
        "Tube": {"falloff": False, "focal_spot": None, "off_focal": None},
        "Detector": {"blur": None, "lag": ()},
        "Scatter": {"grid_ratio": None},
        "Blur": {"tail": 0.0, "tail_fwhm": None},
        "FocalSpot": {"shape": "gaussian", "weights": None},
        "Simulation": {"scatter_error": 0.05, "spot_error": 0.02},
        "Scene": {"drawn": None, "metal_in_view": False},
        "Drawn": {"keys": (), "split": ""},
    }
    found: dict[str, dict] = {}

    def walk(kind) -> None:
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            for item in msgspec.structs.fields(kind):
                if item.encode_name not in FIRST_KEYS.get(kind.__name__, ()) and not item.required:
                    found.setdefault(kind.__name__, {})[item.encode_name] = item.default
                walk(item.type)
        for inner in typing.get_args(kind):
            walk(inner)

    walk(Scene)
    assert found == known


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
        (MINIMAL + "x = " + "[" * 3000 + "]" * 3000, ["nested more than 32 deep"]),
        (MINIMAL + "x = " + "{a=" * 3000 + "1" + "}" * 3000, ["nested more than 32 deep"]),
        (MINIMAL + "[truth." + ".".join("a" * 3000) + "]\nb = 1", ["truth: nested more than 32 deep"]),
        ("[[scene]]\n[scene.truth." + ".".join("a" * 40) + "]", ["scene[0]: nested more than 32 deep"]),
        (MINIMAL + "seed = " + "9" * 5000, ["an integer of thousands of digits"]),
        (MINIMAL + "seed = 0x" + "f" * 5000, ["seed: an integer beyond 64 bits"]),
        (MINIMAL + "scanner = { angles_deg = [0, -9223372036854775809] }", ["scanner.angles_deg[1]: an integer"]),
        ('name = "a"\nphantom = { recipe = "lungs" }', ["phantom.recipe", "lungs"]),
        ('name = "a"\nphantom = { recipe = "lung", vesels = 3 }', ["phantom", "vesels"]),
        ('name = "a"\nphantom = { recipe = "lung", metal = "Unobtainium" }', ["phantom", "Unobtainium"]),
        ('name = "a"\nphantom = { recipe = "lung", size = nan }', ["phantom.size"]),
        ('name = "a/b"\nphantom = { recipe = "lung" }', ["name", "a/b"]),
        ('[[scene]]\nname = "a"\nphantom = { recipe = "lung", ribs = "x" }', ["scene[0].phantom.ribs"]),
        (MINIMAL + "scanner = { geometry = { dso = 1.0 } }", ["scanner.geometry"]),
        (MINIMAL + "scanner = { n_views = 0 }", ["scanner.n_views"]),
        (MINIMAL + 'scanner = { preset = "mri" }', ["scanner.preset", "mri"]),
        (
            MINIMAL + 'scanner = { detector = { kind = "counting", threshold = 90 } }',
            ["detector.threshold", "kvp = 90"],
        ),
    ],
)
def test_bad_files_are_refused_by_file_key_and_expectation(text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        parse_suite(text, "s.toml")
    for word in ["s.toml", *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


RODS = 'recipe = "validation"'
FULL = (
    "dsd = 500.0, n_voxel = [8, 8, 8], d_voxel = [7.5, 7.5, 7.5], d_detector = [2.0, 2.0], n_detector = [80, 80], "
    "n_views = 8"
)


@pytest.mark.parametrize(
    ("text", "key", "words"),
    [
        ('name = "a"', "phantom", ["missing", "recipe", *NAMES]),
        ('name = "a"\nphantom = {}', "phantom.recipe", ["missing", *NAMES]),
        (f"phantom = {{ {RODS} }}", "name", ["missing"]),
        (f'name = "a/b"\nphantom = {{ {RODS} }}', "name", ["letters"]),
        (f'[[scene]]\nname = "a/b"\nphantom = {{ {RODS} }}', "scene[0].name", ["letters"]),
        ('name = "a"\nphantom = { recipe = "potato" }', "phantom.recipe", ["potato", *NAMES]),
        ('name = "a"\nphantom = { recipe = "lungs" }', "phantom.recipe", ["did you mean lung?"]),
        ('name = "a"\nphantom = { recipe = "lung", vesels = 3 }', "phantom.vesels", ["did you mean vessels?", "size"]),
        (f'name = "a"\nphantom = {{ {RODS}, metal = "Unobtainium" }}', "phantom.metal", ["Unobtainium", "known: air"]),
        (MINIMAL + "sede = 1", "sede", ["did you mean seed?", "truth"]),
        (MINIMAL + 'scanner = { noise = { model = "potato" } }', "scanner.noise.model", ["compound", "tigre", "none"]),
        (MINIMAL + 'scanner = { preset = "dentl" }', "scanner.preset", ["did you mean dental?", *MACHINES]),
        (MINIMAL + "scanner = { geometry = { dso = -1.0, " + FULL + " } }", "scanner.geometry.dso", ["0 < dso < dsd"]),
        (MINIMAL + "scanner = { geometry = { dso = 600.0, " + FULL + " } }", "scanner.geometry.dsd", ["0 < dso < dsd"]),
        (MINIMAL + "scanner = { geometry = { " + FULL + " } }", "scanner.geometry.dso", ["missing", "number"]),
        (
            MINIMAL + "scanner = { geometry = { dso = 20.0, " + FULL + " } }",
            "phantom.size",
            ["inside the object", "dso"],
        ),
        (MINIMAL + "scanner = { angles_deg = [0, 1], n_views = 3 }", "scanner.angles_deg", ["2 entries"]),
        (MINIMAL + "scanner = { angles_deg = [0, nan] }", "scanner.angles_deg", ["finite"]),
        (MINIMAL + "scanner = { n_views = 1000000000 }", "scanner.n_views", ["at most 1000000"]),
        (MINIMAL + "scanner = { detector = { threshold = -1 } }", "scanner.detector.threshold", ["at least 0"]),
        (
            MINIMAL + 'scanner = { detector = { kind = "counting", threshold = 90 } }',
            "scanner.detector.threshold",
            ["below tube.kvp"],
        ),
        (
            MINIMAL + 'scanner = { tube = { filters = [{ material = "Al", thickness = -1 }] } }',
            "scanner.tube.filters[0].thickness",
            ["at least 0 mm"],
        ),
        (
            MINIMAL + 'scanner = { tube = { filters = [{ material = "Alu", thickness = 1 }] } }',
            "scanner.tube.filters[0].material",
            ["did you mean", "Al?"],
        ),
        (MINIMAL + "scanner = { tube = { kvp = 12 } }", "scanner.tube.kvp", ["20 to 300"]),
        (
            MINIMAL.replace('"validation"', '"lung", size = 600'),
            "scanner.preset",
            ["inside the object", "phantom.size"],
        ),
        (MINIMAL.replace('"validation"', '"lung", size = 400'), "scanner.preset", ["panel"]),
    ],
)
def test_messages_begin_with_file_and_key_and_say_what_there_is(text: str, key: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        parse_suite(text, "s.toml")
    assert re.match(rf"s\.toml: {re.escape(key)}( |: )", str(caught.value)), caught.value
    for word in words:
        assert word in str(caught.value)
    assert "did you mean" in "".join(words) or "did you mean" not in str(caught.value)


def test_two_scenes_of_one_name_and_missing_files_are_refused(tmp_path: Path) -> None:
    table = '[[scene]]\nname = "a"\nphantom = { recipe = "lung" }\n'
    with pytest.raises(InputError, match="two scenes are named 'a'"):
        parse_suite(table + table)
    with pytest.raises(InputError, match="two scenes are named 'a' and 'A'; names must differ in more than case"):
        parse_suite(table + table.replace('"a"', '"A"'))
    with pytest.raises(InputError, match=r"none\.toml"):
        load_suite(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"binary\.toml"):
        load_suite(tmp_path / "binary.toml")


@pytest.mark.parametrize("name", ["index.jsonl", "INDEX.jsonl", "index.jsonl.new"])
def test_a_name_that_the_data_folder_needs_is_refused(name: str, tmp_path: Path) -> None:
    """The index of scenes, and what it is written to before it takes its place; on some disks in any case."""
    with pytest.raises(InputError, match=re.escape(f"s.toml: name: {name!r} is what the data folder's own index")):
        parse_suite(MINIMAL.replace("rods", name), "s.toml")
    with pytest.raises(InputError, match="data folder's own index"):
        SceneWriter(tmp_path, name, scene_id="a", plan_hash="b", stacks=())
    assert parse_suite(MINIMAL.replace("rods", "index.jsonl-s1"))


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


def test_a_lateral_offset_counts_twice_only_while_every_view_sees_the_axis() -> None:
    # the panel is 160 mm wide, the object's shadow 113 mm: 2·500·tan(asin(27.6/250)) = 111 and its ends' height
    assert parse_suite(full(off_detector=[0.0, 79.0]))
    for changes, words in (
        ({"off_detector": [0.0, 81.0]}, "reaches out of the cone"),
        ({"off_detector": [0.0, 79.0], "arc_deg": 200.0}, "reaches out of the cone"),
        ({"off_detector": [0.0, 500.0]}, "outside the cone of all views"),
    ):
        with pytest.raises(InputError, match=words):
            parse_suite(full(**changes))
    with pytest.raises(InputError, match="outside the cone of all views"):
        parse_suite("truncated = true\n" + full(off_detector=[0.0, 500.0]))
    with pytest.raises(InputError, match="outside the cone of all views"):
        parse_suite('name = "a"\nphantom = { recipe = "lung" }\nscanner = { off_detector = [0, 500.0] }')


@pytest.mark.parametrize("name", MACHINES)
def test_presets_cover_the_object_and_refuse_what_is_too_large(name: str) -> None:
    scanner = preset(name, 90, (96, 96), (64, 64, 64), 60.0)
    assert scanner.geometry.s_voxel == pytest.approx((60.0, 60.0, 60.0))
    assert scanner.geometry.fov_radius >= 0.46 * 60
    assert msgspec.convert({"preset": name, "n_views": 90}, ScannerSettings).resolve(60.0) == scanner
    with pytest.raises(InputError, match="panel"):
        preset(name, 90, (96, 96), (64, 64, 64), 400.0)


def table(needed: dict, **optional) -> st.SearchStrategy[dict]:
    return st.fixed_dictionaries(needed, optional=optional)


SHEETS = st.lists(table({"material": st.sampled_from(["Al", "Cu", "W"]), "thickness": st.floats(0, 3)}), max_size=2)
BOWTIE = table(
    {"center": st.floats(0, 5), "edge": st.floats(0, 60), "half_angle_deg": st.floats(0.1, 89)},
    material=st.sampled_from(["Al", "PMMA", "Cu"]),
)
HEEL = {"heel": st.booleans(), "anode_deg": st.floats(1, 40)}
TUBE = st.one_of(
    table({"kvp": st.floats(20, 300)}, filters=SHEETS, bowtie=BOWTIE, **HEEL),
    table({"kvp": st.floats(10, 500), "model": st.just("finkelshtein-pavlova")}, filters=SHEETS, **HEEL),
    table({"kvp": st.floats(2, 500), "model": st.just("mono")}, **HEEL),
)
COUNTS = {
    "electronic": st.sampled_from([0.0, 5.0, 1e6]),
    "adc_bits": st.just("null") | st.integers(4, 16),
    "adc_fill": st.floats(0.5, 1),
    "pedestal": st.floats(0, 0.4),
    "pattern_residual": st.floats(0, 1),
    "n_flats": st.integers(0, 3),
}
PATTERN = {"fixed_pattern": st.floats(0, 0.3), "dead_fraction": st.floats(0, 0.9)}
NOISE = st.one_of(
    table({}, model=st.sampled_from(["compound", "none"]), **COUNTS, **PATTERN),
    table({"model": st.just("tigre")}, **COUNTS),  # has no pattern
)
SCANNER = table(
    {"n_detector": st.tuples(*[st.integers(4, 12)] * 2), "n_views": st.integers(1, 3), "tube": TUBE, "noise": NOISE},
    preset=st.sampled_from(list(MACHINES)),
    n_voxel=st.tuples(*[st.integers(1, 8)] * 3),
    detector=table(
        {"kind": st.sampled_from(["gos", "csi", "ideal", "counting"])},
        thickness=st.floats(1e-6, 100),
        threshold=st.floats(0, 120),
    ),
    scatter=st.just({}) | table({"level": st.just(1)}, fraction=st.floats(0, 9.99)),
    i0=st.sampled_from([1.0, 1e3, 1e5, 1e12]),
    start_deg=st.floats(-1e3, 1e3),
    arc_deg=st.floats(1, 360),
    off_detector=st.tuples(st.floats(-4, 4), st.floats(-4, 4)),  # some rays still meet the smallest object
    off_origin=st.tuples(*[st.floats(-20, 20)] * 3),
)
PHANTOM = table(
    {
        "recipe": st.sampled_from([name for name in NAMES if name != "ct_volume"]),  # which needs a file
        "n_voxel": st.tuples(*[st.integers(8, 16)] * 3),
    },
    metal=st.sampled_from(["none", "Fe", "Ti", "Al", "CoCr", "Au", "NaI@3.67"]),
    n_inserts=st.integers(0, 16),
    size=st.floats(5, 63),  # what every preset's panel covers
)
SETTINGS = table({}, tolerance=st.floats(1e-7, 0.1), subrays=st.integers(1, 256), skip=st.booleans())
FLAGS = {k: st.booleans() for k in ("twin", "noise_free", "scatter_free", "trace", "metal_path", "paths")}
TRUTH = table({}, mono_kev=st.lists(st.floats(1, 800), max_size=2, unique_by="{:g}".format), **FLAGS)
NAN, INF = float("nan"), float("inf")
# by path in the file: values of which each must be refused with the last part of the path in the message
ABSURD = {
    "seed": [-1, 0.5],
    "name": ["", "a/b"],
    "phantom.metal": ["Xx", ""],
    "phantom.size": [NAN, 0.0, -1.0, 2001.0, INF],
    "phantom.n_voxel": [[0, 8, 8], [8, 8], [8, 8, 4096]],
    "scanner.n_voxel": [[4096, 2048, 2049]],
    "phantom.n_inserts": [-1, 17],
    "phantom.insert_mm": [NAN, 0.0, 40.0],
    "scanner.n_views": [0, 1.5, 10**9],
    "scanner.n_detector": [[0, 4], [4], [9999999, 9999999]],
    "scanner.field_mm": [NAN, 0.0, INF],
    "scanner.arc_deg": [NAN, 0.0, 361.0],
    "scanner.start_deg": [NAN, INF],
    "scanner.off_detector": [[NAN, 0.0], [0.0, 1e300]],
    "scanner.off_origin": [[0.0, INF, 0.0]],
    "scanner.i0": [NAN, 0.0, 1e-300, INF],
    "scanner.scan_mas": [NAN, 0.0, -1.0, 1e-300, INF],
    "scanner.scan_kerma": [NAN, 0.0, -1.0, 1e-300, INF],
    "scanner.tube.kvp": [NAN, 0.0, 501.0],
    "scanner.tube.anode_deg": [NAN, 0.0, 91.0],
    "scanner.tube.filters": [[{"material": "Al", "thickness": t}] for t in (NAN, -1.0)],
    "scanner.tube.bowtie": [{"center": 0.0, "edge": NAN, "half_angle_deg": 9.0}],
    "scanner.detector.thickness": [NAN, 0.0, 5e-324, 101.0],
    "scanner.detector.threshold": [NAN, -1.0],
    "scanner.noise.electronic": [NAN, -1.0, 1e7],
    "scanner.noise.adc_bits": [3, 17],
    "scanner.noise.pedestal": [NAN, 1.0],
    "scanner.noise.dead_fraction": [NAN, 1.0],
    "scanner.scatter.level": [2],
    "scanner.scatter.fraction": [NAN, -1.0, 10.0],
    "simulation.tolerance": [NAN, 0.0],
    "simulation.subrays": [0, 257],
    "truth.mono_kev": [[NAN], [0.0], [60.0, 60.0], [60.0, 60.00001], [INF]],
}
ABSURDITIES = [(path, value) for path, values in ABSURD.items() for value in values]


@pytest.mark.slow
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    plain=table(
        {"name": st.just("x"), "phantom": PHANTOM, "scanner": SCANNER, "simulation": SETTINGS, "truth": TRUTH},
        seed=st.integers(0, 2**63 - 1),
        truncated=st.booleans(),
    ),
    spoilt=st.sampled_from(ABSURDITIES),
)
def test_random_scenes_simulate_or_are_refused_by_the_name_of_a_key(plain: dict, spoilt) -> None:
    check_refusal(plain, *spoilt)
    try:
        one = parse_suite(tomli_w.dumps(plain), "x.toml")[0]
        phantom, machine = build(one), one.resolve()
        plan = make_plan(phantom, machine, one.simulation, one.truth, stream_id(one))
    except InputError as error:
        # an offset that cuts the object off, a threshold above all photons, sheets that let none through
        assert any(key in str(error) for key in ("truncated", "threshold", "filters", "bowtie"))
        assert "\n" not in str(error)
        return
    assert parse_suite(scene_to_toml(one)) == (one,)
    assert phantom.labels.shape == one.phantom.n_voxel
    views = list(simulate_views(plan, phantom, machine))
    assert [k for k, _ in views] == list(range(machine.geometry.n_views))
    # without a pedestal electronic noise goes below zero; P does where scatter outweighs the object
    signed = {"noise_free"} | ({"counts"} if machine.noise.electronic and not machine.noise.has_adc else set())
    for _, images in views:
        assert {name: (i.shape, i.dtype) for name, i in images.items()} == {
            o.name: (o.shape, np.dtype(o.dtype)) for o in plan.outputs
        }
        for name, image in images.items():
            assert np.isfinite(image).all(), name
            # P of air: the weights of an open pixel add up to 1 within a few roundings of float32
            assert name.split("/")[-1] in signed or image.min(initial=0) >= -(2.0**-22), name


@pytest.mark.parametrize(("path", "value"), ABSURDITIES)
def test_absurd_values_are_refused_by_the_name_of_their_key(path: str, value) -> None:
    check_refusal({"name": "x", "phantom": {"recipe": "validation"}}, path, value)


def check_refusal(plain: dict, path: str, value) -> None:
    spoilt = copy.deepcopy(plain)
    *tables, key = path.split(".")
    functools.reduce(lambda t, k: t.setdefault(k, {}), tables, spoilt)[key] = value
    with pytest.raises(InputError) as caught:
        parse_suite(tomli_w.dumps(spoilt), "x.toml")
    assert key in str(caught.value) and "\n" not in str(caught.value)
