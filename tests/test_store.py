"""Writing, interrupting, verifying and opening stored scans."""

import errno
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
import skimage.io
import tifffile
import torch

from ctsim import durable
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.manifest import INDEX, MANIFEST, read_index
from ctsim.store import SceneWriter, Stack, is_complete, list_scans, open_scan, verify
from ctsim.tiffstack import create_stack, map_array, write_all

GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(5, 7, 11),
    d_voxel=(0.5, 0.4, 0.25),
    n_detector=(5, 7),
    d_detector=(0.2, 0.25),
    n_views=6,
)
STACKS = (
    Stack(name="counts", shape=(6, 5, 7), dtype="uint16", pixel=(0.2, 0.25)),
    Stack(name="metal_free/counts", shape=(6, 5, 7), dtype="uint16", pixel=(0.2, 0.25)),
    Stack(name="paths", shape=(6, 2, 5, 7), dtype="float32", pixel=(0.2, 0.25)),
)


def one_view(view: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(view)
    return {s.name: (rng.random(s.shape[1:]) * 6e4).astype(s.dtype) for s in STACKS}


def write(
    data: Path, name: str = "scene", *, scene_id: str = "a" * 12, plan: str = "p", pause: float = 0.0, **more
) -> Path:
    with SceneWriter(data, name, scene_id=scene_id, plan_hash=plan, stacks=STACKS, sync_seconds=0.0, **more) as writer:
        for view in range(writer.first_view, GEOMETRY.n_views):
            writer.put(view, one_view(view))
            time.sleep(pause)
        for prefix in ("", "metal_free/"):
            writer.write_image(f"{prefix}reference_effective", volume(), GEOMETRY.d_voxel)
        writer.write_image("flat", np.full((5, 7), 4e4, np.float32), GEOMETRY.d_detector)
        writer.write_image("labels", (volume() > 0.5).astype(np.uint8), GEOMETRY.d_voxel)
        info = {"geometry": GEOMETRY, "dark": 100.0, "i0": 1e5, "e_max": 90.0, "l0": 12.5}
        writer.write_text("scan.json", msgspec.json.encode(info))
        writer.write_text("plan.json", "{}")
        return writer.finish()


def volume() -> np.ndarray:
    return np.random.default_rng(99).random(GEOMETRY.n_voxel).astype(np.float32)


def content(folder: Path) -> dict[str, str]:
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, str]:
    return content(write(tmp_path_factory.mktemp("whole")))


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
        x, y = (file.pages[0].tags[f"{a}Resolution"].value for a in "XY")
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


def counted(monkeypatch, fail_at: int, error: BaseException, *, forever: bool) -> list[int]:
    """Make the fail_at-th system call that writes, flushes or renames raise; return the counter."""
    calls = [0]

    def wrap(owner, name):
        real = getattr(owner, name)

        def call(*args, **kwargs):
            calls[0] += 1
            if calls[0] == fail_at or (forever and calls[0] > fail_at):
                raise error
            return real(*args, **kwargs)

        monkeypatch.setattr(owner, name, call)

    for owner, name in [(os, "pwrite"), (os, "fsync"), (os, "fdatasync"), (Path, "rename"), (Path, "replace")]:
        wrap(owner, name)
    return calls


@pytest.mark.parametrize("forever", [False, True])
def test_interrupted_at_any_system_call_it_resumes_to_the_same_bytes(tmp_path, whole, monkeypatch, forever):
    with monkeypatch.context() as patch:
        total = counted(patch, -1, OSError(), forever=False)
        write(tmp_path / "all")
    assert total[0] > 50
    # Ctrl-C strikes once; after a lost disk nothing works any more
    error = OSError(errno.EIO, "lost") if forever else KeyboardInterrupt()
    for k in range(1, total[0] + 1):
        data = tmp_path / f"{k}"
        with monkeypatch.context() as patch, pytest.raises((KeyboardInterrupt, OSError)):
            counted(patch, k, error, forever=forever)
            write(data)
        if (data / "scene").exists():  # whole or not at all
            assert {p: h for p, h in content(data / "scene").items() if not p.startswith(".")} == whole
        if not is_complete(data, "scene", "a" * 12):
            write(data)
        assert content(data / "scene") == whole
        assert verify(data) == []
        assert list_scans(data) == (data / "scene",)


def test_killed_at_random_moments_it_resumes_to_the_same_bytes(tmp_path, whole):
    root = Path(__file__).parents[1]
    code = (
        f"import sys; sys.path[:0] = [{str(root)!r}, {str(Path(__file__).parent)!r}]\n"
        "from pathlib import Path\nfrom test_store import write\n"
        f"print('ready', flush=True)\nwrite(Path({str(tmp_path)!r}), pause=0.03)\n"
    )
    rng = np.random.default_rng(5)
    kills = 0
    for _ in range(8):
        child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        assert child.stdout is not None
        child.stdout.readline()
        try:
            child.wait(float(rng.uniform(0.0, 0.15)))
            break
        except subprocess.TimeoutExpired:
            child.send_signal(signal.SIGKILL)
            kills += 1
        child.wait()
        child.stdout.close()
        if kills == 3:
            break
    child.stdout.close()
    if not is_complete(tmp_path, "scene", "a" * 12):
        write(tmp_path)
    assert kills > 0
    assert content(tmp_path / "scene") == whole
    assert verify(tmp_path) == []


def interrupt(data: Path, views: int, *, scene_id: str = "a" * 12) -> None:
    with (
        pytest.raises(KeyboardInterrupt),
        SceneWriter(data, "scene", scene_id=scene_id, plan_hash="p", stacks=STACKS) as writer,
    ):
        for view in range(views):
            writer.put(view, one_view(view))
        raise KeyboardInterrupt


def test_an_interrupted_run_goes_on_at_the_last_view(tmp_path):
    interrupt(tmp_path, 4)
    assert not (tmp_path / "scene").exists()
    with pytest.raises(InputError, match="dataset folder"):
        list_scans(tmp_path)
    with SceneWriter(tmp_path, "scene", scene_id="a" * 12, plan_hash="p", stacks=STACKS) as writer:
        assert writer.first_view == 4
        with pytest.raises(ValueError, match="4 of 6 views"):
            writer.finish()


def test_an_unfinished_scene_is_refused_by_name_and_reported(tmp_path):
    write(tmp_path, "other")
    interrupt(tmp_path, 2)
    partial = tmp_path / ".scene.partial"
    with pytest.raises(InputError, match=r"\.scene\.partial: not a finished scene"):
        open_scan(partial)
    assert [str(partial) in p and "unfinished" in p for p in verify(tmp_path)] == [True]


def test_output_of_another_scene_is_refused_and_left_alone(tmp_path):
    folder = write(tmp_path)
    before = content(folder)
    with pytest.raises(InputError, match="holds another scene"):
        write(tmp_path, scene_id="b" * 12)
    with pytest.raises(InputError, match="already complete"):
        write(tmp_path)
    assert content(folder) == before
    assert is_complete(tmp_path, "scene", "a" * 12)
    with pytest.raises(InputError, match="holds another scene"):
        is_complete(tmp_path, "scene", "b" * 12)


def test_an_unfinished_run_of_another_scene_or_plan_is_refused_and_left_alone(tmp_path):
    interrupt(tmp_path, 3)
    before = content(tmp_path / ".scene.partial")
    with pytest.raises(InputError, match="another scene"):
        write(tmp_path, scene_id="b" * 12)
    with pytest.raises(InputError, match="another plan"):
        write(tmp_path, plan="q")
    assert content(tmp_path / ".scene.partial") == before
    write(tmp_path, scene_id="b" * 12, force=True)
    assert open_scan(tmp_path / "scene").scene_id == "b" * 12


@pytest.mark.parametrize("can_swap", [True, False])
def test_force_replaces_a_finished_scene(tmp_path, monkeypatch, can_swap):
    if not can_swap:
        monkeypatch.setattr(durable, "_exchange", lambda *_: False)
    write(tmp_path)
    folder = write(tmp_path, scene_id="b" * 12, force=True)
    assert open_scan(folder).scene_id == "b" * 12
    assert read_index(tmp_path)["scene"].scene_id == "b" * 12
    assert verify(tmp_path) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == [INDEX, "scene"]


def test_a_replacement_that_was_cut_off_is_mended(tmp_path):
    folder = write(tmp_path)
    folder.rename(tmp_path / ".scene.old")
    durable.recover(folder)
    assert is_complete(tmp_path, "scene", "a" * 12)


def test_a_file_is_not_taken_for_a_scene(tmp_path):
    (tmp_path / "data").write_text("")
    with pytest.raises(InputError, match="is a file"):
        write(tmp_path / "data")
    with pytest.raises(InputError, match="scene name"):
        write(tmp_path, "../up")


def test_two_processes_cannot_write_one_scene(tmp_path):
    with SceneWriter(tmp_path, "scene", scene_id="a", plan_hash="p", stacks=STACKS):
        with pytest.raises(InputError, match="another process"):
            write(tmp_path)
        write(tmp_path, "other")


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_says_so_and_loses_nothing(tmp_path, whole, monkeypatch, code):
    real, calls = os.pwrite, [0]

    def pwrite(handle, data, offset):
        calls[0] += 1
        if calls[0] > 3 * len(STACKS):
            raise OSError(code, "full")
        return real(handle, data[: max(1, len(data) // 2)], offset) if len(data) > 40 else real(handle, data, offset)

    with (
        monkeypatch.context() as patch,
        pytest.raises(InputError, match=r"disk is full; scene 'scene' keeps its first \d"),
    ):
        patch.setattr(os, "pwrite", pwrite)
        write(tmp_path)
    assert content(write(tmp_path)) == whole


def test_a_full_disk_shows_before_the_first_view(tmp_path, monkeypatch):
    def fallocate(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "posix_fallocate", fallocate)
    with pytest.raises(InputError, match="first 0 of 6 views"):
        write(tmp_path)


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


@pytest.mark.parametrize(
    ("change", "said"),
    [({"l0": None}, "l0"), ({"geometry": {"dso": 1.0}}, "scan.json"), ({"e_max": "high"}, "scan.json")],
)
def test_a_wrong_scan_json_is_refused_by_name(tmp_path, change, said):
    folder = write(tmp_path)
    info = msgspec.json.decode((folder / "scan.json").read_bytes()) | change
    info = {k: v for k, v in info.items() if v is not None}
    text = msgspec.json.encode(info)
    manifest = msgspec.json.decode((folder / MANIFEST).read_bytes())
    manifest["files"]["scan.json"]["bytes"] = len(text)
    (folder / "scan.json").write_bytes(text)
    (folder / MANIFEST).write_bytes(msgspec.json.encode(manifest))
    with pytest.raises(InputError, match=said):
        open_scan(folder)


def test_the_content_hash_sees_counts_but_not_the_plans_estimates(tmp_path):
    a = open_scan(write(tmp_path / "a")).content_hash
    with SceneWriter(tmp_path / "b", "scene", scene_id="a", plan_hash="p", stacks=STACKS) as writer:
        for view in range(6):
            writer.put(view, {k: v + (view == 3) for k, v in one_view(view).items()})
        writer.finish()
    assert read_index(tmp_path / "b")["scene"].content_hash != a


def test_views_must_come_in_order_and_in_shape(tmp_path):
    with SceneWriter(tmp_path, "scene", scene_id="a", plan_hash="p", stacks=STACKS) as writer:
        with pytest.raises(ValueError, match="expected view 0"):
            writer.put(1, one_view(1))
        with pytest.raises(ValueError, match="a view has shape"):
            writer.put(0, one_view(0) | {"counts": np.zeros((7, 5), np.uint16)})
