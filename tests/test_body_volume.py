"""A CT volume as a body: attenuation by its HU, places in mm, metal in bone, and files that are not what is said."""

import hashlib
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.phantoms.bodies.volume import TISSUES, CtVolume
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scene import load_suite, parse_suite, scene_id, scene_to_toml, stream_id
from ctsim.tracer.voxelise import attenuation_volume

SPACING = (2.0, 1.5, 1.0)


@pytest.fixture
def head(tmp_path):
    """Save a ball of 46 mm, fat round bone round brain with a block of lung in it; return its HU."""
    axes = ((np.arange(n) + 0.5 - n / 2) * d for n, d in zip((30, 40, 60), SPACING, strict=True))
    z, y, x = np.meshgrid(*axes, indexing="ij")
    r = np.sqrt(x**2 + y**2 + z**2)
    hu = np.full(r.shape, -1000, np.int16)
    hu[r < 23], hu[r < 19], hu[r < 14] = -100, 900, 35
    hu[(np.abs(x - 5) < 4) & (np.abs(y + 3) < 5) & (np.abs(z - 4) < 6)] = -700
    tifffile.imwrite(tmp_path / "head.tif", (hu + 1024).astype(np.uint16))
    return hu


def recipe(tmp_path, **changes):
    given = {"path": str(tmp_path / "head.tif"), "spacing": SPACING, "rescale": (1.0, -1024.0), "n_voxel": (60,) * 3}
    return CtVolume(**({**given, "size": 60.0} | changes))


def test_at_its_energy_every_voxel_has_the_attenuation_of_its_hu(head, tmp_path):
    params = recipe(tmp_path, metal="none", kev=60.0)
    phantom = build_recipe(params, 0)
    (water,) = attenuation("water", np.array([60.0]))
    mu = {name: float(attenuation(name, np.array([60.0]))[0]) for name in TISSUES}
    grid = Geometry(
        dso=200.0,
        dsd=300.0,
        n_voxel=head.shape,
        d_voxel=SPACING,
        n_detector=(8, 8),
        d_detector=(1.0, 1.0),
        n_views=1,
    )
    found = attenuation_volume(phantom, grid, mu)
    # away from edges, where neither resampling to 1 mm nor averaging back changes what is uniform
    inside = ndimage.minimum_filter(head, 3) == ndimage.maximum_filter(head, 3)
    assert {-1000, -700, 35, 900} <= set(np.unique(head[inside]).tolist())
    expected = np.where(head > -900, water * (1 + head / 1000), 0)
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-5, atol=1e-7)
    assert set(np.unique(phantom.labels)) == {0, 1, 2, 3, 4}


def test_the_same_place_is_bone_on_every_grid(head, tmp_path):
    for n in (30, 61):
        labels = build_recipe(recipe(tmp_path, n_voxel=(n,) * 3, metal="none"), 0).labels
        at = [round((15.0 + 30.0) / 60.0 * n - 0.5), n // 2, n // 2]  # 15 mm up, along z
        assert labels[tuple(at)] == TISSUES.index("cortical_bone")
        assert labels[n // 2, n // 2, n // 3] == TISSUES.index("soft_tissue")


def test_no_voxel_of_the_file_is_cut_off_or_passed_over(tmp_path):
    noise = np.random.default_rng(1).integers(-100, 100, (12, 20, 24)).astype(np.int16)
    np.save(tmp_path / "block.npy", noise)
    given = {"path": str(tmp_path / "block.npy"), "rescale": (1.0, 0.0), "metal": "none"}
    fine = build_recipe(recipe(tmp_path, **given, spacing=(2.0, 1.0, 1.0), n_voxel=(120,) * 3), 0)
    z, y, x = (np.flatnonzero(fine.labels.any(axis)) for axis in ((1, 2), (0, 2), (0, 1)))
    assert [(a[0], a[-1] + 1) for a in (z, y, x)] == [(36, 84), (40, 80), (36, 84)]  # of 0.5 mm
    # labels of 4 mm, an odd number of them: the inner ones hold blocks of 2 x 4 x 4 whole voxels
    coarse = build_recipe(recipe(tmp_path, **given, spacing=(2.0, 1.0, 1.0), n_voxel=(15,) * 3), 0)
    mu = np.array([float(attenuation(name, np.array([70.0]))[0]) for name in ("water", *TISSUES)])
    inner = (slice(5, 10),) * 3
    hu = 1000 * (coarse.density[inner] * mu[1:][coarse.labels[inner]] / mu[0] - 1)
    expected = noise[1:11, :, 2:22].reshape(5, 2, 5, 4, 5, 4).mean((1, 3, 5))
    np.testing.assert_allclose(hu, expected, atol=1e-3)


def test_metal_lies_in_bone_or_where_it_is_said_whatever_the_grid(head, tmp_path):
    drawn = [build_recipe(recipe(tmp_path, n_voxel=(n,) * 3), 5).solids for n in (24, 60)]
    assert drawn[0] == drawn[1] and len(drawn[0]) == 2
    for solid in drawn[0]:
        (capsule,) = solid.primitives
        k, j, i = (int(c / d + n / 2) for c, d, n in zip(capsule.centre[::-1], SPACING, head.shape, strict=True))
        assert head[k, j, i] == 900 and solid.material == "Ti" and solid.metal
    (one,) = build_recipe(recipe(tmp_path, at=((5.0, -3.0, 2.0),), insert_mm=2.0), 5).solids
    assert one.primitives[0].centre == pytest.approx((5.0, -3.0, 2.0)) and one.primitives[0].params == (2.0, 1.0)


def test_a_scene_says_which_file_it_is_of(head, tmp_path):
    text = f'''
name = "head"
phantom = {{ recipe = "ct_volume", path = "{tmp_path}/head.tif", spacing = [2.0, 1.5, 1.0], rescale = [1.0, -1024.0] }}
scanner = {{ n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 4 }}
'''
    (scene,) = parse_suite(text)
    assert scene.phantom.sha256 == hashlib.sha256((tmp_path / "head.tif").read_bytes()).hexdigest()
    kept = scene_to_toml(scene)
    np.save(tmp_path / "head.npy", head)
    tifffile.imwrite(tmp_path / "head.tif", (head + 1000).astype(np.uint16))
    (other,) = parse_suite(text)
    assert scene_id(other) != scene_id(scene)
    shutil.copy(tmp_path / "head.tif", tmp_path / "copy.tif")
    (moved,) = parse_suite(text.replace("head.tif", "copy.tif"))
    assert (scene_id(moved), stream_id(moved)) == (scene_id(other), stream_id(other))
    (stale,) = parse_suite(kept)  # the file has changed since: its scene can be read, not built
    assert scene_id(stale) == scene_id(scene)
    with pytest.raises(InputError, match=r"head\.tif has the SHA-256 .*, the scene was made of"):
        build_recipe(stale.phantom, 0)
    same = build_recipe(recipe(tmp_path, path=str(tmp_path / "head.npy"), rescale=(1.0, 0.0)), 0)
    assert set(np.unique(same.labels)) == {0, 1, 2, 3, 4}


@pytest.mark.parametrize("way", ["scene", "defaults", "vary", "split"])
def test_a_relative_path_begins_at_the_scene_file(head, tmp_path, monkeypatch, way):
    """And the scene is that of the absolute path, wherever it is read from and on whatever machine."""
    ct = 'recipe = "ct_volume", spacing = [2.0, 1.5, 1.0], rescale = [1.0, -1024.0]'
    text = {
        "scene": '[[scene]]\nname = "a"\nphantom = {{ {ct}, path = "{path}" }}\n',
        "defaults": '[defaults.phantom]\npath = "{path}"\n[[scene]]\nname = "a"\nphantom = {{ {ct} }}\n',
        "vary": '[[scene]]\nname = "a"\ncount = 1\nphantom = {{ {ct} }}\nvary = {{ "phantom.path" = ["{path}"] }}\n',
        "split": '[[scene]]\nname = "a"\ncount = 1\nsplit = {{ train = 1.0 }}\nphantom = {{ {ct} }}\n'
        'vary.phantom = {{ path = ["{path}"] }}\n',
    }[way]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    (whole,) = parse_suite(text.format(ct=ct, path=tmp_path / "head.tif"))
    (tmp_path / "elsewhere" / "own.toml").write_text(text.format(ct=ct, path="../head.tif"))
    for file in (Path("elsewhere/own.toml"), tmp_path / "elsewhere" / "own.toml"):
        (scene,) = load_suite(file)
        assert scene == whole and scene_id(scene) == scene_id(whole)
    (tmp_path / "elsewhere" / "own.toml").write_text(text.format(ct=ct, path="head.tif"))
    with pytest.raises(InputError, match=rf"path: {tmp_path}/elsewhere/head\.tif cannot be read"):
        load_suite(Path("elsewhere/own.toml"))  # where it is not, though it is in the working directory
    (ours,) = parse_suite(text.format(ct=ct, path="head.tif"))
    assert ours == whole  # without a file there is but the working directory


def test_a_relative_path_is_kept_whole_where_a_scene_says_all(head, tmp_path):
    """Else the scene.toml of a data folder would lead to another place from another working directory."""
    digest = hashlib.sha256((tmp_path / "head.tif").read_bytes()).hexdigest()
    (tmp_path / "own.toml").write_text(f'''
name = "head"
phantom = {{ recipe = "ct_volume", path = "head.tif", spacing = [2,1.5,1], rescale = [1, -1024], sha256 = "{digest}" }}
''')
    (scene,) = load_suite(tmp_path / "own.toml")
    assert scene.phantom.path == str(tmp_path / "head.tif") and parse_suite(scene_to_toml(scene)) == (scene,)


def test_a_scan_of_it_is_made_and_reopened(head, tmp_path):
    from ctsim.benchmarks.make_dataset import main as make_dataset

    (tmp_path / "scene.toml").write_text(
        f'''
name = "head"
phantom = {{ recipe = "ct_volume", path = "{tmp_path}/head.tif", spacing = [2.0, 1.5, 1.0], rescale = [1.0, -1024.0] }}
scanner = {{ n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 4 }}
''',
        encoding="utf-8",
    )
    assert make_dataset([str(tmp_path / "scene.toml"), str(tmp_path / "data")]) == 0
    stored = open_scan(list_scans(tmp_path / "data")[0])
    assert stored.metal.any() and stored.metal_free is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"path": "nowhere.tif"}, "path: nowhere.tif cannot be read (No such file or directory); expected a TIFF"),
        ({"rescale": (0.0, 0.0)}, "rescale must be a positive slope"),
        ({"kev": 5.0}, "kev must be within 20 to 200"),
        ({"at": ((0.0, 0.0, 0.0),), "n_inserts": 2}, "n_inserts is 2, but at has 1 places"),
        ({"at": ((float("nan"), 0.0, 0.0),)}, "at must be finite places in mm"),
        ({"spacing": (1e-3,) * 3}, "mm makes 8000000000 places of 72000 voxels, expected at most 16777216"),
        ({"rescale": (1e38, 0.0)}, "holds values that are no finite HU under rescale"),
        ({"at": ((29.0, 0.0, 0.0),)}, "at: inserts 12 mm long must be centred within 21.6 mm"),
        ({"rescale": (1.0, -9000.0)}, "has no voxel above -900 HU within 21.6 mm; is rescale right?"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(head, tmp_path, changes, words):
    with pytest.raises(InputError, match=re.escape(words)):
        build_recipe(recipe(tmp_path, **changes), 0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (np.zeros((3, 4)), "holds float64 of shape (3, 4), expected one array of numbers [z, y, x]"),
        (np.zeros((0, 4, 5)), "expected one array of numbers"),
        (np.full((3, 4, 5), np.nan), "no finite HU"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path, data, words):
    np.save(tmp_path / "head.npy", data)
    with pytest.raises(InputError, match=re.escape(words)):
        build_recipe(CtVolume(path=str(tmp_path / "head.npy"), spacing=SPACING), 0)
    (tmp_path / "head.npy").write_bytes(b"no array")
    with pytest.raises(InputError, match=r"head\.npy is no TIFF stack or \.npy array"):
        CtVolume(path=str(tmp_path / "head.npy"), spacing=SPACING)
