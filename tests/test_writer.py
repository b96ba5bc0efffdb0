"""Writing scenes: interrupted, killed, in each other's way, and on a full disk."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from engine_jobs import started
from small_scan import STACKS, content, one_view, write

from ctsim.benchmarks.make_dataset import main
from ctsim.dataset import durable, folder
from ctsim.dataset.manifest import INDEX, mend_index, read_index, read_manifest
from ctsim.dataset.store import list_scans, open_scan, verify
from ctsim.dataset.writer import SceneWriter, is_complete
from ctsim.errors import InputError


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, str]:
    return content(write(tmp_path_factory.mktemp("whole")))


def go_on(data: Path) -> None:
    """Do what make-dataset does when it comes again."""
    folder.recover(data)
    there = folder.finished(data, "scene", "a" * 12)
    if there is None:
        write(data)
    else:
        folder.tidy(data, [there])
        mend_index(data, [there], ["scene"])


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


@pytest.mark.slow
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
        go_on(data)
        assert content(data / "scene") == whole
        assert verify(data) == []
        assert list_scans(data) == (data / "scene",)


def test_killed_at_random_moments_it_resumes_to_the_same_bytes(tmp_path, whole):
    root = Path(__file__).parents[1]
    code = (
        f"import sys; sys.path[:0] = [{str(root)!r}, {str(Path(__file__).parent)!r}]\n"
        "from pathlib import Path\nfrom small_scan import write\n"
        f"print('ready', flush=True)\nwrite(Path({str(tmp_path)!r}), pause=0.03)\n"
    )
    rng = np.random.default_rng(5)
    kills = 0
    for _ in range(8):
        with started([sys.executable, "-c", code], stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            child.stdout.readline()
            try:
                child.wait(float(rng.uniform(0.0, 0.15)))
                break
            except subprocess.TimeoutExpired:
                child.send_signal(signal.SIGKILL)
                kills += 1
        if kills == 3:
            break
    go_on(tmp_path)
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
    made = write(tmp_path)
    before = content(made)
    with pytest.raises(InputError, match="holds another scene"):
        write(tmp_path, scene_id="b" * 12)
    with pytest.raises(InputError, match="already complete"):
        write(tmp_path)
    assert content(made) == before
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
    made = write(tmp_path, scene_id="b" * 12, force=True)
    assert open_scan(made).scene_id == "b" * 12
    assert read_index(tmp_path)["scene"].scene_id == "b" * 12
    assert verify(tmp_path) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == [INDEX, "scene"]


def test_a_replacement_that_was_cut_off_is_mended(tmp_path):
    write(tmp_path).rename(tmp_path / ".scene.old")
    folder.recover(tmp_path)
    assert is_complete(tmp_path, "scene", "a" * 12)


def test_a_file_is_not_taken_for_a_scene(tmp_path):
    (tmp_path / "data").write_text("")
    with pytest.raises(InputError, match="is a file"):
        write(tmp_path / "data")
    with pytest.raises(InputError, match="scene name"):
        write(tmp_path, "../up")
    with pytest.raises(InputError, match=r"scene name 'index\.jsonl'"):
        write(tmp_path, INDEX)


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


LARGE = """
name = "large"
phantom = {{ recipe = "validation", metal = "none", n_voxel = [16, 16, 16] }}
scanner = {{ n_voxel = {n_voxel}, n_detector = {n_detector}, n_views = 40 }}
"""
LIMITED = """
import resource, sys
from ctsim.benchmarks.cli import make_dataset
resource.setrlimit(resource.RLIMIT_FSIZE, (10**6, 10**6))
sys.exit(make_dataset())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_detector", "n_voxel"), [([128, 128], [10, 12, 12]), ([12, 12], [64, 64, 64])], ids=["stack", "volume"]
)
def test_a_file_the_kernel_refuses_is_one_sentence_and_loses_nothing(tmp_path, n_detector, n_voxel):
    """A limit of 1 MB on any file; the stack of counts or the reference exceeds it, all else is far smaller.

    Python ignores the signal that comes with it, so that the write itself fails.
    """
    suite, data = tmp_path / "large.toml", tmp_path / "data"
    suite.write_text(LARGE.format(n_detector=n_detector, n_voxel=n_voxel))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(suite), str(data)],
        capture_output=True, text=True, cwd=Path(__file__).parents[1], timeout=300, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    kept = 0 if n_detector[0] == 128 else 40
    assert f"make-dataset: {data}: the disk is full; scene 'large' keeps its first {kept} of 40 views" in done.stderr
    assert not (data / "large").exists()
    with pytest.raises(InputError, match="dataset folder"):
        list_scans(data)
    assert main([str(suite), str(data)]) == 0
    assert main([str(suite), str(tmp_path / "whole")]) == 0
    again, whole = (read_manifest(made / "large") for made in (data, tmp_path / "whole"))
    assert max(entry.bytes for entry in again.files.values()) > 10**6
    assert again.content_hash == whole.content_hash
    assert verify(data) == []


def test_views_must_come_in_order_and_in_shape(tmp_path):
    with SceneWriter(tmp_path, "scene", scene_id="a", plan_hash="p", stacks=STACKS) as writer:
        with pytest.raises(ValueError, match="expected view 0"):
            writer.put(1, one_view(1))
        with pytest.raises(ValueError, match="a view has shape"):
            writer.put(0, one_view(0) | {"counts": np.zeros((7, 5), np.uint16)})
