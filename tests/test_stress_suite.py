"""Scenes of the stress suite as TOML says them, and methods of the user's own on them."""

import dataclasses
import re
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from test_imports import SLOW, loaded

from ctsim.benchmarks.studies.stress import methods as stress_methods
from ctsim.benchmarks.studies.stress import study
from ctsim.benchmarks.studies.stress.scans import Findings, changed, example
from ctsim.benchmarks.studies.stress.suite import (
    RODS,
    Circle,
    Filled,
    Magnified,
    OfSide,
    Rounded,
    Scene,
    Turned,
    Twice,
    load,
)
from ctsim.errors import InputError

SIDE = 8
HEAD = '[[scene]]\nname = "own"\nwhat = "a scan of my own"\n'
METHOD = """
import torch
from ctsim.types import Status, Volume

INPUTS = "nothing"
seen = []

def skip(scan):
    return "one view is not enough" if scan.geometry.n_views == 1 else None

def half(scan, *, device="cpu"):
    seen.append(scan)
    return Volume(values=torch.full(scan.geometry.n_voxel, 0.01))

def given_the_mask(scan, *, device="cpu", mask="oracle"):
    return half(scan)

def runaway(scan, *, device="cpu"):
    values = torch.full(scan.geometry.n_voxel, 1e6)
    return Volume(values=values, status=Status.DIVERGED, reason="values ran away")

def resigned(scan, *, device="cpu"):
    return Volume(values=torch.zeros(scan.geometry.n_voxel), status=Status.ERROR, reason="no idea")
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of the user's in the working directory."""
    (tmp_path / "my_lab.py").write_text(METHOD, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield "my_lab:half"
    sys.modules.pop("my_lab", None)


def read(tmp_path, text):
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    return load(tmp_path / "own.toml")


# --- what a file says --------------------------------------------------------------------------------


def test_what_a_scene_leaves_out_is_usual(tmp_path):
    (scene,) = read(tmp_path, HEAD)
    where = scene.scanner.resolve(SIDE).geometry
    assert scene.near and scene.methods and scene.like is None
    assert where == Circle().resolve(SIDE) and where.d_voxel == (7.5,) * 3 and where.s_detector == (150.0, 150.0)
    usual = example(scene, SIDE).scan
    assert len(RODS) == 3
    for rods in ('"water"', '{ material = "water", radius = 24.0 }'):
        (named,) = read(tmp_path, HEAD + f'rods = [{rods}, "bone", "titanium"]')
        assert np.array_equal(example(named, SIDE).scan.counts, usual.counts)


def test_counts_follow_the_side_and_pixels_the_detector():
    where = Circle(n_detector=(7, OfSide(times=0.5, plus=1)), detector_mm=(70.0, 26.0), n_views=OfSide(plus=-1))
    for side in (16, 24):
        found = where.resolve(side)
        assert found.n_detector == (7, side // 2 + 1) and found.n_views == side - 1
        assert found.d_detector == (10.0, 26.0 / (side // 2 + 1))
    crowded = Circle(n_views=4, crowding=2.0, arc_deg=160.0, start_deg=5.0).resolve(SIDE)
    assert crowded.angles_deg == (5.0, 15.0, 45.0, 95.0)


def test_metal_is_what_is_known_as_metal_or_said_to_be(tmp_path):
    rods = '{ material = "Ti", radius = 9 }, { material = "Al", radius = 9, at = [20, 0], metal = true }'
    (scene,) = read(tmp_path, HEAD + f"rods = [{rods}]")
    metal = example(scene, SIDE).scan.metal
    (plain,) = read(tmp_path, HEAD + f"rods = [{rods.replace('true', 'false')}]")
    assert 0 < int(example(plain, SIDE).scan.metal.sum()) < int(metal.sum())


def test_a_change_is_of_the_counts_or_of_what_is_said_of_them():
    given = example(Scene(name="usual", what="usual"), SIDE)
    counts, where = given.scan.counts, given.scan.geometry
    twice = changed(given, Twice()).scan
    assert twice.counts.shape[0] == 2 * where.n_views and np.array_equal(twice.counts[1::2], counts)
    assert np.allclose(twice.geometry.angles[1::2], where.angles)
    assert set(np.unique(changed(given, Filled(value=7)).scan.counts)) == {7}
    rounded = changed(given, Rounded()).scan.counts / counts.float()
    assert 0 < abs(rounded - 1).max() < 2e-7
    larger = changed(given, Magnified(voxel_mm=75.0))
    assert larger.scan.geometry.dso == 10 * where.dso and larger.scan.geometry.d_voxel == (75.0,) * 3
    assert np.allclose(larger.reference * 10, given.reference)
    crowded = dataclasses.replace(
        given, scan=dataclasses.replace(given.scan, geometry=Circle(crowding=2.0).resolve(SIDE))
    )
    for one in (given, crowded):
        turned = changed(one, Turned(deg=1.0)).scan.geometry
        assert np.allclose(turned.angles - one.scan.geometry.angles, np.radians(1.0))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("rod = []", "scene[0].rod: unknown key; expected one of name, what, near, methods, rods"),
        ("rods = []", "scene[0].rods: Expected `array` of length >= 1"),
        ('rods = ["watr"]', "scene[0].rods[0]: 'watr' is unknown; expected one of bone, titanium, water"),
        ('rods = [{ material = "Xx", radius = 1 }]', "scene[0].rods[0]: unknown material 'Xx'"),
        ('rods = [{ material = "Fe", radius = 0 }]', "scene[0].rods[0]: solid 'Fe at (0.0, 0.0)': size must be finite"),
        ('rods = ["water"]\nblock = { edge = 1, density = 1 }', "scene[0].rods and block exclude each other"),
        ("block = { edge = 1, density = -1 }", "scene[0].block.density must be finite and not negative"),
        ("scanner.tube.kvp = 5", "scene[0].scanner.tube.kvp must be within"),
        ("scanner.geometry.n_views = 0", "scene[0].scanner.geometry.n_views: Expected `int` >= 1"),
        ("scanner.geometry.dso = 600", "scene[0].scanner.geometry.dsd: expected 0 < dso < dsd"),
        ("scanner.geometry.n_views = { plus = -30 }", "scene[0].scanner.geometry: counts must be at least 1"),
        ("scanner.geometry.n_detector = [9, { tims = 2 }]", "n_detector[1].tims: unknown key; expected one of times"),
        ('change = { kind = "twise" }', "scene[0].change.kind: 'twise' is unknown; expected one of unchanged, twice"),
        ('change = { kind = "filled" }', "scene[0].change.value: missing; expected an integer"),
        ('unlike = ["fkd"]', "scene[0].unlike must name methods or groups, of by-mask, descent"),
        (HEAD, "two scenes are named 'own'"),
        ("near = 1", "scene[0].near: Expected `bool`, got `int`"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_path(line, words, tmp_path):
    with pytest.raises(InputError, match=re.escape(words)) as found:
        read(tmp_path, HEAD + line)
    assert str(found.value).startswith(f"{tmp_path / 'own.toml'}: ")


def test_names_of_other_cases_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"scene\[0\]\.name must not be 'threads', which is a case of its own"):
        read(tmp_path, HEAD.replace("own", "threads"))
    taken = {case for case, subject in study.catalogue() if subject in study.TABLE} - {s.name for s in load()}
    assert taken == {"threads", "float64"}


# --- methods on them ---------------------------------------------------------------------------------


def test_only_methods_that_are_like_each_other_are_held_against_the_other_form(tmp_path, own):
    text = 'change = { kind = "twice" }\nlike = { kind = "unchanged" }\nunlike = ["ordered", "sirt", "my_lab:half"]'
    (scene,) = read(tmp_path, HEAD + text)
    others = {name: scene.has_other(name) for name in ("fdk", "sirt", "splat", own)}
    assert [name for name, has in others.items() if has] == ["fdk"]


@pytest.mark.slow
def test_methods_of_the_users_own_run_on_scenes_of_their_own(tmp_path, own, capsys):
    text = HEAD + "near = false\n" + HEAD.replace("own", "bare") + "scanner.geometry.n_views = 1\n"
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "out"
    words = [str(out), "--short", "--suite", str(tmp_path / "own.toml"), "--method", own, "--method", "fdk"]
    assert study.main([*words, "--case", "own", "--case", "bare"]) == 1
    found = {r.task.row[1:]: r.found[0] for r in study.Stress().store(study.Flags(results=out)).read()}
    assert set(found) == {(case, subject) for case in ("own", "bare") for subject in (own, "fdk")}
    assert found["own", own].ok and found["bare", own].ok and "skipped: one view" in found["bare", own].found
    assert not found["bare", "fdk"].ok  # one view does not determine the object, which the file claims
    assert "3 of 4 rows are as expected" in capsys.readouterr().out
    with pytest.raises(InputError, match="there is no method 'fdc': did you mean fdk"):
        study.main([*words, "--method", "fdc"])
    with pytest.raises(InputError, match=r"nowhere\.toml: cannot be read"):
        study.main([str(out), "--suite", "nowhere.toml"])


def test_a_scene_for_the_simulator_alone_is_none_for_methods(tmp_path):
    (tmp_path / "own.toml").write_text(HEAD + "methods = false\n", encoding="utf-8")
    assert {case for case, _ in study.catalogue(tmp_path / "own.toml", ("sirt",))} == {"threads"}


def test_the_rows_of_a_method_are_those_of_its_variants_and_of_nothing_else():
    subjects = {subject for _, subject in study.catalogue(None, ("splat",))}
    assert subjects == {study.label(*m) for m in study.subjects(("splat",))} and "splat[response=known]" in subjects
    assert {case for case, _ in study.catalogue(None, ("fdk",))} > {"float64", "threads"}
    assert "float64" not in {case for case, _ in study.catalogue(None, ("sirt",))}


def test_the_true_mask_is_for_methods_that_declare_to_be_given_it(own):
    scene = Scene(name="own", what="own", near=False)
    for name in (own, "my_lab:given_the_mask"):
        stress_methods.on_scene(name, {}, scene, SIDE, Findings())
    seen = sys.modules["my_lab"].seen
    assert [scan.metal is None for scan in seen] == [True, False]


@pytest.mark.parametrize("near", [True, False])
@pytest.mark.parametrize("how", ["runaway", "resigned"])
def test_no_method_may_give_up_where_the_data_determine_the_object(own, how, near):
    found = Findings()
    stress_methods.on_scene(f"my_lab:{how}", {}, Scene(name="own", what="own", near=near), SIDE, found)
    assert bool(found.wrong) is near


def test_a_scene_that_says_something_else_is_run_again(tmp_path):
    def code(n, text):
        path = tmp_path / f"own-{n}.toml"
        path.write_text(HEAD + text, encoding="utf-8")
        return study.catalogue(path, ("fdk",))["own", "fdk"].code

    assert code(0, "") == code(1, "near = true") != code(2, "scanner.i0 = 1e4")


def test_the_example_in_the_docs_is_read_and_runs(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "how-to" / "test-stability.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^    \[\[scene\]\]\n(?:    .*\n|\n)*", page, re.M)
    for scene in read(tmp_path, re.sub(r"^    ", "", text, flags=re.M)):
        found = Findings()
        stress_methods.on_scene("fdk", {}, scene, 12, found)
        assert found.said and not found.wrong, str(found)


def test_the_page_names_every_key():
    page = (Path(__file__).parents[1] / "docs" / "how-to" / "test-stability.md").read_text(encoding="utf-8")
    for kind in (Scene, Circle):
        for key in msgspec.structs.fields(kind):
            assert f"`{key.name}`" in page, key.name


def test_the_rows_are_listed_without_torch():
    assert "torch" not in loaded("from ctsim.benchmarks.studies.stress.study import catalogue\ncatalogue()")


def test_help_is_printed_before_scenes_and_kernels_are_loaded():
    words = "'run-benchmark stress', 'ctsim.benchmarks.studies.stress.study', ['--help']"
    code = f"from ctsim.benchmarks.cli import guarded\ntry:\n    guarded({words})\nexcept SystemExit:\n    pass"
    assert not loaded(code) & SLOW
