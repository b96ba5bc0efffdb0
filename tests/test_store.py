"""Opening, reading and verifying stored scans."""

import hashlib
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest
import skimage.io
import tifffile
import torch
from small_scan import GEOMETRY, STACKS, one_view, volume, write

from ctsim.benchmarks import cli
from ctsim.dataset import store
from ctsim.dataset.manifest import INDEX, MANIFEST, IndexLine, read_index
from ctsim.dataset.store import list_scans, open_scan, verify
from ctsim.dataset.tiffstack import create_stack, map_array, write_all
from ctsim.dataset.writer import SceneWriter
from ctsim.errors import InputError


def test_a_stored_scan_opens_as_it_was_written(tmp_path):
    folder = write(tmp_path)
    stored = open_scan(folder)
    expected = np.stack([one_view(k)["counts"] for k in range(6)])
    assert stored.scan.counts.dtype == torch.uint16
    np.testing.assert_array_equal(stored.scan.counts.numpy(), expected)
    assert stored.geometry == GEOMETRY
    assert (stored.name, stored.scene_id, stored.l0, stored.scan.dark) == ("scene", "a" * 12, 12.5, 100.0)
    np.testing.assert_array_equal(stored.reference("effective"), volume())
    np.testing.assert_array_equal(stored.labels, volume() > 0.5)
    assert stored.array("paths").shape == (6, 2, 5, 7)
    twin = stored.metal_free
    assert twin is not None and twin.metal_free is None
    np.testing.assert_array_equal(twin.scan.counts.numpy()[5], one_view(5)["metal_free/counts"])
    np.testing.assert_array_equal(twin.reference("effective"), volume())
    with pytest.raises(InputError, match="written without metal"):
        _ = stored.metal
    assert list_scans(tmp_path) == (folder,)
    assert verify(tmp_path) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == [INDEX, "scene"]


def test_what_a_method_writes_into_counts_stays_in_memory(tmp_path):
    folder = write(tmp_path)
    open_scan(folder).scan.counts.zero_()
    assert verify(tmp_path) == []


def test_any_tiff_reader_sees_the_same_pixels_and_the_spacing(tmp_path):
    folder = write(tmp_path)
    expected = np.stack([one_view(k)["counts"] for k in range(6)])
    np.testing.assert_array_equal(tifffile.imread(folder / "counts.tif"), expected)
    np.testing.assert_array_equal(skimage.io.imread(folder / "counts.tif"), expected)
    np.testing.assert_array_equal(tifffile.imread(folder / "labels.tif"), volume() > 0.5)
    with tifffile.TiffFile(folder / "labels.tif") as file:
        assert file.is_imagej and file.series[0].axes == "ZYX"
        assert file.imagej_metadata is not None
        assert (file.imagej_metadata["unit"], file.imagej_metadata["spacing"]) == ("mm", 0.5)
        page = file.pages[0]
        assert isinstance(page, tifffile.TiffPage)
        x, y = (page.tags[f"{a}Resolution"].value for a in "XY")
        assert (x[0] / x[1], y[0] / y[1]) == (4.0, 2.5)  # pixels per mm
    with tifffile.TiffFile(folder / "paths.tif") as file:
        assert file.series[0].axes == "TCYX"


def test_a_stack_above_4_gb_is_bigtiff_and_starts_empty(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "posix_fallocate", lambda *_: None)  # keep it sparse
    shape = (9000, 500, 500)  # 4.5 GB
    path = tmp_path / "big.tif"
    offset = create_stack(path, shape, "uint16", (0.1, 0.1))
    assert path.stat().st_blocks * 512 < 50e6
    view = np.full(shape[1:], 7, np.uint16)
    with path.open("r+b") as file:
        write_all(file.fileno(), view, offset + 8999 * view.nbytes)
    with tifffile.TiffFile(path) as file:
        assert file.is_bigtiff
        np.testing.assert_array_equal(file.pages[8999].asarray(), view)
    np.testing.assert_array_equal(map_array(path, shape, "uint16", offset)[8998:, 0, 0], [0, 7])


@pytest.mark.parametrize("shape", [(1, 5, 7), (3, 1, 1), (1, 1, 1), (2, 1, 5, 7)])
def test_thin_stacks_keep_their_bytes(tmp_path, shape):
    path = tmp_path / "a.tif"
    offset = create_stack(path, shape, "float32", (0.1, 0.1))
    values = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    with path.open("r+b") as file:
        write_all(file.fileno(), values, offset)
    np.testing.assert_array_equal(tifffile.imread(path).ravel(), values.ravel())


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["counts.tif", "metal_free/counts.tif", "scan.json", "plan.json", "flat.tif"])
def test_verify_finds_one_flipped_bit(tmp_path, name):
    folder = write(tmp_path)
    flip(folder / name)
    problems = verify(tmp_path)
    assert len(problems) == 1
    assert name in problems[0] and "changed" in problems[0]


def test_verify_finds_what_is_missing_truncated_extra_or_unlisted(tmp_path):
    folder = write(tmp_path)
    (folder / "counts.tif").write_bytes((folder / "counts.tif").read_bytes()[:-1])
    (folder / "labels.tif").unlink()
    (folder / "notes.txt").write_text("mine")
    problems = "\n".join(verify(tmp_path))
    assert "counts.tif: truncated" in problems and "labels.tif: missing" in problems
    assert "notes.txt: extra" in problems
    assert problems.count("\n") == 2
    with pytest.raises(InputError, match=r"damaged dataset: .*counts.tif: truncated.*1 more"):
        open_scan(folder)
    (tmp_path / INDEX).write_text("")
    assert any("not in index" in p for p in verify(tmp_path))


def test_verify_finds_a_manifest_that_was_tampered_with(tmp_path):
    folder = write(tmp_path)
    path = folder / "counts.tif"
    old = hashlib.sha256(path.read_bytes()).hexdigest()
    flip(path)
    text = (folder / MANIFEST).read_text()
    (folder / MANIFEST).write_text(text.replace(old, hashlib.sha256(path.read_bytes()).hexdigest()))
    assert ["content hash" in p for p in verify(tmp_path)] == [True]
    (folder / MANIFEST).write_text(text[:50])
    with pytest.raises(InputError, match="damaged manifest"):
        open_scan(folder)


def edited(folder: Path, change) -> None:
    """Change a manifest by a function of it as JSON."""
    path = folder / MANIFEST
    held = msgspec.json.decode(path.read_bytes())
    change(held)
    path.write_bytes(msgspec.json.encode(held))


OUTSIDE = ["../../../pwn", "/tmp/pwn", "..", "", ".scene", "other", "a/b", "scene\n", "index.jsonl"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_manifest_that_names_another_folder_is_refused(tmp_path, name, capsys):
    """It names what is written of the scan: volumes and pictures would lie outside the results."""
    folder = write(tmp_path / "data")
    edited(folder, lambda held: held.update(name=name))
    with pytest.raises(InputError, match=r"manifest\.json: names the scene .*, expected its folder's name, 'scene'"):
        open_scan(folder)
    assert ["names the scene" in p for p in verify(tmp_path / "data")] == [True]
    results = tmp_path / "x" / "y" / "results"
    command = (
        "run-benchmark",
        "ctsim.benchmarks.studies.methods.study",
        [str(tmp_path / "data"), str(results), "--scene", name],
    )
    assert cli.guarded(*command) == 2
    assert "names the scene" in capsys.readouterr().err and {p.name for p in tmp_path.iterdir()} == {"data"}


def test_a_scene_is_opened_by_any_path_to_its_folder_but_not_under_another_name(tmp_path, monkeypatch):
    folder = write(tmp_path)
    monkeypatch.chdir(folder / "metal_free")
    for path in ("..", folder / "metal_free" / "..", "../../scene/."):
        assert open_scan(path).name == "scene"
    folder.rename(tmp_path / "renamed")
    with pytest.raises(InputError, match="names the scene 'scene', expected its folder's name, 'renamed'"):
        open_scan(tmp_path / "renamed")
    (tmp_path / "a b").mkdir()
    (tmp_path / "renamed" / MANIFEST).rename(tmp_path / "a b" / MANIFEST)
    edited(tmp_path / "a b", lambda held: held.update(name="a b"))
    with pytest.raises(InputError, match="names the scene 'a b'"):
        open_scan(tmp_path / "a b")


@pytest.mark.parametrize(
    "name", ["../scene/flat.tif", "/etc/hostname", "metal_free/../flat.tif", "", "a//b", "./a", ".a"]
)
def test_a_manifest_that_names_files_outside_its_folder_is_refused(tmp_path, name):
    folder = write(tmp_path)
    edited(folder, lambda held: held["files"].update({name: held["files"]["flat.tif"]}))
    with pytest.raises(
        InputError, match=r"manifest\.json: names the file .*, expected a path within the scene's folder"
    ):
        open_scan(folder)
    assert any("names the file" in p for p in verify(tmp_path))


@pytest.mark.parametrize("name", [name for name in OUTSIDE if name != "other"])
def test_an_index_that_names_another_folder_is_refused(tmp_path, name):
    write(tmp_path / "data")
    line = msgspec.json.encode(IndexLine(name=name, scene_id="a", content_hash="b"))
    with (tmp_path / "data" / INDEX).open("ab") as file:
        file.write(line + b"\n")
    for use in (list_scans, verify):
        with pytest.raises(InputError, match=r"index\.jsonl: line 2 names the scene .*, expected a folder's name"):
            use(tmp_path / "data")


def test_the_index_and_the_manifest_must_name_the_same_scan(tmp_path):
    write(tmp_path)
    for change in ({"scene_id": "b" * 12}, {"content_hash": "c"}, {"code": "d"}):
        line = msgspec.structs.replace(read_index(tmp_path)["scene"], **change)
        (tmp_path / INDEX).write_bytes(msgspec.json.encode(line) + b"\n")
        assert ["its content is not the one that index.jsonl names" in p for p in verify(tmp_path)] == [True]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 9}, "format 9, this version reads the formats 2 and 3"),
        ({"format": 9, "colour": 1}, "format 9, this version reads the formats 2 and 3"),
        ({"colour": 1}, "damaged manifest .*colour"),
        ({"format": "three"}, "damaged manifest"),
        ({"format": 2}, "damaged manifest .format 2 with the code"),
        ({"code": ""}, "damaged manifest .format 3 with the code ''"),
    ],
)
def test_a_manifest_of_another_format_is_refused_as_such(tmp_path, change, said):
    folder = write(tmp_path)
    edited(folder, lambda held: held.update(change))
    with pytest.raises(InputError, match=said):
        open_scan(folder)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"offset": 8}, "content hash"),
        ({"shape": [6, 7, 5]}, "content hash"),
        ({"dtype": "int16"}, "content hash"),
        ({"offset": 10**6}, "counts.tif"),
        ({"shape": [600, 5, 7]}, "counts.tif"),
        ({"dtype": "float64"}, "counts.tif"),
        ({"shape": [-6, 5, 7]}, "counts.tif"),
        ({"offset": -1}, "counts.tif"),
        ({"dtype": "potato"}, "counts.tif"),
        ({"dtype": "O"}, "counts.tif"),
        ({"shape": None}, "counts.tif"),
    ],
)
def test_an_edited_array_entry_is_found_and_named(tmp_path, change, said):
    folder = write(tmp_path)
    manifest = msgspec.json.decode((folder / MANIFEST).read_bytes())
    manifest["files"]["counts.tif"] |= change
    (folder / MANIFEST).write_bytes(msgspec.json.encode(manifest))
    problems = verify(tmp_path)
    assert any(said in p for p in problems) and any("content hash" in p for p in problems)
    if said == "counts.tif":  # what lies inside the file can be mapped, and only the hash tells
        with pytest.raises(InputError, match=r"counts\.tif") as caught:
            open_scan(folder)
        assert "scan.json" not in str(caught.value)


def test_an_array_that_cannot_be_mapped_is_refused_by_its_own_name(tmp_path, monkeypatch):
    folder = write(tmp_path)

    def refuse(*_):
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(store, "map_array", refuse)
    stored = open_scan(folder)  # maps nothing yet
    with pytest.raises(InputError, match=r"counts\.tif: .*Cannot allocate memory"):
        _ = stored.scan


def test_a_file_is_no_data_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        verify(tmp_path / "file")
    with pytest.raises(InputError, match="no such folder"):
        verify(tmp_path / "none")


def test_the_index_survives_a_torn_line_and_a_missing_folder(tmp_path):
    write(tmp_path)
    with (tmp_path / INDEX).open("a") as file:
        file.write('{"name": "half')
    assert [p.name for p in list_scans(tmp_path)] == ["scene"]
    folder = write(tmp_path, "second")
    assert [p.name for p in list_scans(tmp_path)] == ["scene", "second"]
    folder.rename(tmp_path / ".hidden")
    with pytest.raises(InputError, match="'second' but its folder is missing"):
        list_scans(tmp_path)
    assert any("second: missing" in p for p in verify(tmp_path))
    (tmp_path / INDEX).write_text("nonsense\n")
    with pytest.raises(InputError, match="line 1 is damaged"):
        list_scans(tmp_path)


GOOD = {"geometry": msgspec.to_builtins(GEOMETRY), "dark": 100.0, "i0": 1e5, "e_max": 90.0, "l0": 12.5}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"l0": None}, "`l0`"),
        ({"l0": -3.0}, "l0"),
        ({"geometry": {"dso": 1.0}}, "geometry"),
        ({"e_max": "high"}, "e_max"),
        ({"e_max": 0}, "e_max"),
        ({"e_max": -1}, "e_max"),
        ({"dark": "nan"}, "dark"),
        ({"dark": True}, "dark"),
        ({"dark": "100.0"}, "dark"),
        ({"i0": 0}, "i0"),
        ({"i0": -5}, "i0"),
        ({"i0": "inf"}, "i0"),
        ({"seed": "x"}, "seed"),
        ({"seed": -1}, "seed"),
        ({"potato": 1}, "potato"),
        ({"geometry": GOOD["geometry"] | {"n_views": 7}}, "counts.tif: shape"),
        ({"geometry": GOOD["geometry"] | {"n_detector": [5, 8]}}, "counts.tif: shape"),
    ],
)
def test_a_wrong_scan_json_is_refused_by_name(tmp_path, change, said):
    with pytest.raises(InputError, match=said) as caught:
        open_scan(with_info(write(tmp_path), {k: v for k, v in (GOOD | change).items() if v is not None}))
    assert "\n" not in str(caught.value) and ("scan.json" in str(caught.value))


@pytest.mark.parametrize("number", ["NaN", "1e999", "-Infinity"])
def test_a_number_that_json_does_not_know_is_refused(tmp_path, number):
    text = msgspec.json.encode(GOOD).replace(b'"i0":100000.0', b'"i0":' + number.encode())
    with pytest.raises(InputError, match=r"scan\.json"):
        open_scan(with_info(write(tmp_path), text))


def with_info(folder: Path, info: dict | bytes) -> Path:
    """Give a stored scan another scan.json, of the size that its manifest says."""
    text = info if isinstance(info, bytes) else msgspec.json.encode(info)
    manifest = msgspec.json.decode((folder / MANIFEST).read_bytes())
    manifest["files"]["scan.json"]["bytes"] = len(text)
    (folder / "scan.json").write_bytes(text)
    (folder / MANIFEST).write_bytes(msgspec.json.encode(manifest))
    return folder


def test_a_flat_without_a_usable_pixel_is_refused_when_the_scan_is_asked_for(tmp_path):
    folder = write(tmp_path)
    stored = open_scan(with_info(folder, GOOD | {"dark": 4e4}))  # the open field's own value
    with pytest.raises(InputError, match="scene: flat: no pixel is finite and above"):
        _ = stored.scan


def test_each_asking_gets_a_view_of_its_own_and_leaves_no_file_open(tmp_path):
    opened = Path("/proc/self/fd")
    before = len(list(opened.iterdir()))
    stored = open_scan(write(tmp_path))
    assert len(list(opened.iterdir())) == before
    expected = np.stack([one_view(k)["counts"] for k in range(6)])
    first = stored.scan
    first.counts.zero_()
    first.flat.zero_()
    np.testing.assert_array_equal(stored.scan.counts.numpy(), expected)
    assert (stored.scan.flat == 4e4).all()
    del first
    assert len(list(opened.iterdir())) == before


def test_the_content_hash_sees_counts_but_not_the_plans_estimates(tmp_path):
    a = open_scan(write(tmp_path / "a")).content_hash
    with SceneWriter(tmp_path / "b", "scene", scene_id="a", plan_hash="p", stacks=STACKS) as writer:
        for view in range(6):
            writer.put(view, {k: v + (view == 3) for k, v in one_view(view).items()})
        writer.finish()
    assert read_index(tmp_path / "b")["scene"].content_hash != a
