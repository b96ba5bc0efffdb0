"""Scenes by the thousand from one table: drawn by number, divided by individual, with metal in view."""

import json
import re
import time
from collections import Counter

import msgspec
import numpy as np
import pytest

from ctsim.benchmarks.make_dataset import main
from ctsim.benchmarks.suites import select
from ctsim.dataset.manifest import read_index
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.notes import metal_share
from ctsim.phantoms.scene import build, parse_suite, scene_id, scene_to_toml, stream_id

TABLE = """
[defaults.scanner]
n_views = 7
n_detector = [12, 14]
n_voxel = [10, 12, 14]

[[scene]]
name = "rods"
seed = 5
count = {count}
scans_each = 2
split = {{ train = 0.8, val = 0.1, test = 0.1 }}
phantom = {{ recipe = "validation", n_voxel = [16, 16, 16] }}
[scene.vary]
"phantom.metal" = ["Fe", "Ti", "Au"]
"phantom.size" = {{ uniform = [50, 60] }}
scanner.tube.kvp = {{ uniform = [80, 140] }}
scanner.i0 = {{ log = [1e4, 1e6] }}
scanner.start_deg = {{ integers = [0, 3] }}
"""


def scenes(count: int):
    return parse_suite(TABLE.format(count=count))


def test_a_scene_is_the_same_for_every_count_and_says_what_was_drawn():
    few, many = scenes(6), scenes(60)
    assert few == many[:6] and [s.name for s in few] == [f"rods-{k:05d}" for k in range(6)]
    assert [s.seed for s in few] == [5, 5, 6, 6, 7, 7]
    assert few[3].drawn.index == 3 and few[3].drawn.table == "rods"
    assert set(few[3].drawn.keys) == {
        "phantom.metal", "phantom.size", "scanner.tube.kvp", "scanner.i0", "scanner.start_deg"
    }  # fmt: skip
    for one in few:
        (again,) = parse_suite(scene_to_toml(one))
        assert again == one and scene_id(again) == scene_id(one)


def test_values_fill_their_ranges():
    found = scenes(2000)
    kvp, i0 = (np.array(x) for x in zip(*((s.scanner.tube.kvp, s.scanner.i0) for s in found), strict=True))
    assert 80 <= kvp.min() < 81 and 139 < kvp.max() <= 140 and i0.min() >= 1e4 and i0.max() <= 1e6
    # a share of n draws has the standard deviation sqrt(p(1-p)/n) = 0.011 at p = 1/2; 5 of them
    assert abs((kvp < 110).mean() - 0.5) < 0.056 and abs((i0 < 1e5).mean() - 0.5) < 0.056
    assert Counter(s.scanner.start_deg for s in found).keys() == {0, 1, 2, 3}
    assert all(n > 500 for n in Counter(s.phantom.metal for s in found).values())  # 667 expected, sigma 21


def test_scans_of_one_individual_share_object_and_geometry():
    found = scenes(40)
    pairs = list(zip(found[::2], found[1::2], strict=True))
    for one, other in pairs:
        assert (one.phantom.size, one.scanner.start_deg, one.seed) == (
            other.phantom.size, other.scanner.start_deg, other.seed
        )  # fmt: skip
        assert one.scanner.i0 != other.scanner.i0 and stream_id(one) != stream_id(other)
    assert any(one.phantom.metal != other.phantom.metal for one, other in pairs)
    assert len({one.phantom.size for one, _ in pairs}) == len(pairs)


def test_no_individual_is_in_two_splits_and_shares_are_met():
    found = scenes(2000) + parse_suite(TABLE.format(count=900).replace('name = "rods"', 'name = "more"'))
    splits: dict[int, set[str]] = {}
    for one in found:
        splits.setdefault(one.seed, set()).add(one.drawn.split)
    assert all(len(names) == 1 for names in splits.values())
    # multiples of the golden ratio: the share of n of them in an interval is off by less than 3·ln(n)/n at any n here
    shares = Counter(one.drawn.split for one in scenes(2000))
    for name, share in {"train": 0.8, "val": 0.1, "test": 0.1}.items():
        assert abs(shares[name] / 2000 - share) < 3 * np.log(1000) / 1000


def test_another_split_keeps_the_noise():
    one = scenes(1)[0]
    other = msgspec.structs.replace(one, drawn=msgspec.structs.replace(one.drawn, split="val"))
    assert stream_id(one) == stream_id(other) and scene_id(one) != scene_id(other)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("count = 4", "count = 0", "scene[0].count"),
        ("count = 4\n", "", "scene[0]: scans_each needs count"),
        ("[80, 140]", "[140, 80]", "vary.scanner.tube.kvp: expected a list of values"),
        ("{ log = [1e4, 1e6] }", "{ log = [0, 1e6] }", "vary.scanner.i0: log needs positive ends"),
        ("{ log = [1e4, 1e6] }", "3", "vary.scanner.i0: expected a list"),
        ("{ integers = [0, 3] }", "{ integers = [0.5, 3] }", "integers needs integer ends"),
        ("scanner.i0", "truth.twin", "vary.truth.twin: expected a key of phantom or scanner"),
        ("scanner.i0", "scanner.io", "scene[0].vary.scanner.io: unknown key"),
        ("scanner.i0", "scanner.mas", "scene[0].vary.scanner.mas: unknown key; expected one of preset, n_views"),
        ("scanner.i0", "scanner.mas", "; did you mean scan_mas?"),
        ('"phantom.size"', '"phantom.sice"', "did you mean size?"),
        (
            "scanner.tube.kvp = { uniform",
            "scanner.tube.kvp = { normal",
            "scene[0].vary.scanner.tube.kvp: expected a list of values, or {uniform = [low, high]}, "
            "{log = [low, high]} or {integers = [low, high]} with low < high, got a table of normal",
        ),
        ('"Au"]', '"Aurum"]', "scene[0].phantom.metal"),
        ("train = 0.8", "train = 0.9", "scene[0].split must be positive shares that sum to 1"),
        ("train = 0.8", '"../train" = 0.8', "scene[0].split '../train': expected a name"),
        ("train = 0.8", '"" = 0.8', "scene[0].split '': expected a name"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(old, new, said):
    text = TABLE.format(count=4).replace(old, new)
    if "Aurum" in new:
        text = text.replace("count = 4", "count = 40")
    with pytest.raises(InputError, match=re.escape(said)) as e:
        parse_suite(text, "s.toml")
    assert str(e.value).startswith("s.toml: ") and "\n" not in str(e.value)


def test_a_tube_drawn_as_a_whole_is_drawn_for_every_scan():
    text = TABLE.format(count=24).replace(
        "scanner.tube.kvp = { uniform = [80, 140] }", "scanner.tube = [{ kvp = 80 }, { kvp = 120 }]"
    )
    drawn = [scene.scanner.tube.kvp for scene in parse_suite(text, "s.toml")]
    assert any(a != b for a, b in zip(drawn[::2], drawn[1::2], strict=True))  # two scans of one individual


def test_a_key_that_is_drawn_twice_is_refused():
    for key in ('"scanner.tube.kvp" = [80, 90]', "scanner.tube = [{ kvp = 80 }]"):
        text = TABLE.format(count=4).replace('"phantom.metal"', f'{key}\n"phantom.metal"')
        if "scanner.tube =" in key:
            text = text.replace("scanner.tube.kvp = {", '"scanner.tube.kvp" = {')
        with pytest.raises(InputError, match=r"vary.scanner.tube.*is drawn twice"):
            parse_suite(text, "s.toml")


def test_no_individual_is_in_two_splits_of_two_tables():
    table = TABLE.format(count=40)
    second = table[table.index("[[scene]]") :].replace('name = "rods"', 'name = "more"')
    assert len(parse_suite(table + second, "s.toml")) == 80
    other = second.replace("train = 0.8, val = 0.1, test = 0.1", "train = 0.2, test = 0.8")
    with pytest.raises(InputError, match=r"s.toml: rods-.* \(train\) and more-.* \(test\) are of one individual"):
        parse_suite(table + other, "s.toml")


def test_seeds_do_not_go_with_count():
    with pytest.raises(InputError, match="--seeds: rods-00000 comes from count"):
        select(scenes(2), (), (1, 2))


FAN = """
[[scene]]
name = "slice"
count = 12
phantom = { recipe = "random", n_voxel = [32, 32, 32] }
scanner = { n_views = 9, n_detector = [1, 48], n_voxel = [1, 32, 32] }
"""


def test_one_row_meets_metal_in_every_scene():
    found = parse_suite(FAN)
    for one in found:
        body, geometry = build(one), one.resolve().geometry
        assert metal_share(body, geometry) > 0, one.name
    # without, most slices miss it: random inserts lie anywhere
    bare = [msgspec.structs.replace(one, metal_in_view=False) for one in found]
    assert sum(metal_share(build(one), one.resolve().geometry) == 0 for one in bare) >= 4
    # the slice differs between individuals
    assert len({build(one).off_origin for one in found}) == len(found)


def test_the_slice_of_one_row_is_as_thick_as_the_row_on_the_axis():
    geometry = parse_suite(FAN)[0].resolve().geometry
    assert geometry.d_detector[0] == geometry.d_detector[1]
    assert geometry.d_voxel[0] == pytest.approx(geometry.d_detector[0] * geometry.dso / geometry.dsd, rel=1e-12)
    assert geometry.n_detector[1] * geometry.d_detector[1] < 230  # the machine's panel


def test_metal_that_no_view_can_show_is_refused():
    text = """
name = "beside"
metal_in_view = true
truncated = true
phantom = { recipe = "validation", n_voxel = [16, 16, 16] }
[scanner.geometry]
dso = 250
dsd = 500
n_voxel = [8, 8, 8]
d_voxel = [1, 1, 1]
n_detector = [8, 8]
d_detector = [0.5, 0.5]
off_detector = [59, 0]
n_views = 3
"""
    # rays at least 28.5 mm above the middle on the axis, 26.8 mm at the nearest rods, which end at 25.5 mm
    (one,) = parse_suite(text)
    with pytest.raises(InputError, match="metal_in_view: none of 20 draws of recipe 'validation'"):
        build(one)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many")
    (folder / "s.toml").write_text(
        TABLE.format(count=3).replace("[defaults.scanner]", "[defaults]\ntruth.trace = true\n[defaults.scanner]")
    )
    assert main([str(folder / "s.toml"), str(folder / "data")]) == 0
    return folder


def test_the_index_says_individual_split_share_and_values(data):
    index = read_index(data / "data")
    assert [line.about.individual for line in index.values()] == ["validation-5", "validation-5", "validation-6"]
    for name, line in index.items():
        stored = open_scan(data / "data" / name)
        (scene,) = parse_suite((stored.folder / "scene.toml").read_text())
        assert line.about.drawn == {
            "phantom.metal": scene.phantom.metal,
            "phantom.size": scene.phantom.size,
            "scanner.tube.kvp": scene.scanner.tube.kvp,
            "scanner.i0": scene.scanner.i0,
            "scanner.start_deg": scene.scanner.start_deg,
        }
        assert line.about.split == scene.drawn.split
        assert line.about.metal_share == pytest.approx(stored.array("trace").mean(), rel=1e-12)
    lines = (data / "data" / "index.jsonl").read_bytes().splitlines()
    assert json.loads(lines[0])["about"]["split"] == index["rods-00000"].about.split
    assert main([str(data / "data"), "--verify"]) == 0


def test_a_lost_index_comes_back_with_what_it_said(data):
    path = data / "data" / "index.jsonl"
    before = path.read_bytes()
    path.unlink()
    assert main([str(data / "s.toml"), str(data / "data")]) == 0
    assert path.read_bytes() == before


def test_a_dry_run_of_a_thousand_scenes_plans_one(data, tmp_path, capsys):
    path = tmp_path / "s.toml"
    path.write_text(TABLE.format(count=1000).replace("n_views = 7", "n_views = 360"))
    start = time.process_time()
    assert main([str(path), str(tmp_path / "none"), "--dry-run"]) == 0
    assert time.process_time() - start < 5
    out = capsys.readouterr().out
    assert out.startswith("rods-00000, and 999 more of its table\n") and out.count("(energies)") == 1
    total = re.search(r"total: .*, ([0-9.]+ MB) on disk", out)
    assert total is not None
    assert main([str(path), str(tmp_path / "none"), "--dry-run", "--only", "rods-00007"]) == 0
    assert capsys.readouterr().out.startswith("rods-00007\n")
