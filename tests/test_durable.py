"""Files that replace others: several processes at one file, and what killed processes leave."""

import errno
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from ctsim.benchmarks.studies.methods import volumes
from ctsim.benchmarks.studies.methods.volumes import read_volume, write_volume
from ctsim.dataset import durable, process
from ctsim.dataset.durable import replacing, write_synced
from ctsim.reconstruct.splat.checkpoint import Checkpoint

ROUNDS = 40


@pytest.fixture(autouse=True)
def forgetful(monkeypatch) -> None:
    """Every test is a process that has looked at no folder yet."""
    monkeypatch.setattr(durable, "_swept", set())


def volume(value: float) -> np.ndarray:
    return np.full((3, 4, 5), value, np.float32)


def test_two_commands_replace_one_file_and_the_last_has_its_way(tmp_path, monkeypatch):
    """The second begins and ends while the first has written its bytes and not yet put them in place."""
    path, fsync, second = tmp_path / "table.md", os.fsync, [True]

    def meanwhile(handle: int) -> None:
        fsync(handle)
        if second.pop():
            second.append(False)
            write_synced(path, b"second")
            assert path.read_bytes() == b"second"

    monkeypatch.setattr(os, "fsync", meanwhile)
    write_synced(path, b"first")
    assert path.read_bytes() == b"first" and [p.name for p in tmp_path.iterdir()] == ["table.md"]


def test_two_commands_replace_one_volume_and_the_last_has_its_way(tmp_path, monkeypatch):
    path, write_all, second = tmp_path / "a.tif", volumes.write_all, [True]

    def meanwhile(*what) -> None:
        if second.pop():
            second.append(False)
            write_volume(path, volume(2.0))
            np.testing.assert_array_equal(read_volume(path), volume(2.0))
        write_all(*what)

    monkeypatch.setattr(volumes, "write_all", meanwhile)
    write_volume(path, volume(1.0))
    np.testing.assert_array_equal(read_volume(path), volume(1.0))
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


def test_two_commands_replace_one_file_of_arrays_and_the_last_has_its_way(tmp_path, monkeypatch):
    path, savez, second = tmp_path / "a.npz", np.savez, [True]

    def meanwhile(file, **arrays) -> None:
        if second.pop():
            second.append(False)
            volumes.write_intermediates(path, {"prior": volume(2.0)}, "second")
        savez(file, **arrays)

    monkeypatch.setattr(np, "savez", meanwhile)
    volumes.write_intermediates(path, {"prior": volume(1.0)}, "first")
    np.testing.assert_array_equal(volumes.read_intermediates(path, "first")["prior"], volume(1.0))
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def replace_often(folder: Path, value: int) -> None:
    for _ in range(ROUNDS):
        write_synced(folder / "table.md", bytes([value]) * 50_000)
        write_volume(folder / "a.tif", volume(value))


def test_several_processes_replace_the_same_files_and_none_is_torn(tmp_path):
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=replace_often, args=(tmp_path, value)) for value in (1, 2)]
    for other in others:
        other.start()
    while any(other.is_alive() for other in others):
        if (tmp_path / "table.md").exists():
            found = (tmp_path / "table.md").read_bytes()
            assert found in (b"\1" * 50_000, b"\2" * 50_000)
        if (tmp_path / "a.tif").exists():
            values = read_volume(tmp_path / "a.tif")
            assert np.array_equal(values, volume(values[0, 0, 0]))
    for other in others:
        other.join()
    assert [other.exitcode for other in others] == [0, 0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tif", "table.md"]


def test_what_fails_leaves_the_old_file_and_nothing_beside_it_and_is_named(tmp_path):
    path = tmp_path / "table.md"
    write_synced(path, b"before")
    with pytest.raises(OSError, match=r"No space left on device: '.*/table\.md'"), replacing(path) as new:
        new.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(KeyboardInterrupt), replacing(path):
        raise KeyboardInterrupt
    with pytest.raises(OSError, match=r"'.*/none/table\.md'"):
        write_synced(tmp_path / "none" / "table.md", b"x")
    assert path.read_bytes() == b"before" and [p.name for p in tmp_path.iterdir()] == ["table.md"]


def test_a_name_as_long_as_a_file_system_allows_can_be_replaced(tmp_path):
    for name in ("x" * 255, "é" * 127):
        write_synced(tmp_path / name, b"x")
    assert len(list(tmp_path.iterdir())) == 2


def write_and_wait(path: Path, ready) -> None:
    with replacing(path) as new:
        new.write_bytes(b"half")
        ready.set()
        time.sleep(60)


def test_what_a_killed_process_left_goes_and_what_a_living_one_writes_stays(tmp_path):
    spawn = multiprocessing.get_context("spawn")
    ready = [spawn.Event(), spawn.Event()]
    writers = [spawn.Process(target=write_and_wait, args=(tmp_path / f"{k}.md", r)) for k, r in enumerate(ready)]
    for writer, event in zip(writers, ready, strict=True):
        writer.start()
        assert event.wait(60)
    os.kill(writers[0].pid or 0, signal.SIGKILL)
    writers[0].join()
    assert len(list(tmp_path.iterdir())) == 2
    write_synced(tmp_path / "table.md", b"x")
    left = [p.name for p in tmp_path.iterdir() if durable.is_new(p.name)]
    assert len(left) == 1 and left[0].startswith(".1.md.")
    writers[1].kill()
    writers[1].join()
    durable.sweep(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["table.md"]


def test_of_another_machine_only_what_nobody_has_written_for_a_day_goes(tmp_path):
    now = time.time()
    for hours in (1, 25):
        path = tmp_path / f".table.md.00000000-1-0000000{hours % 10}.new"
        path.write_bytes(b"half")
        os.utime(path, (now - 3600 * hours, now - 3600 * hours))
    for other in ("mine.new", ".table.md.new", f".x.{process.machine()}-1-123.new"):  # no names of ours
        (tmp_path / other).touch()
        os.utime(tmp_path / other, (0, 0))
    durable.sweep(tmp_path)
    assert len(list(tmp_path.iterdir())) == 4
    assert [p.name for p in tmp_path.iterdir() if durable.is_new(p.name)] == [".table.md.00000000-1-00000001.new"]


def test_a_checkpoint_that_is_done_with_leaves_nothing(tmp_path):
    spawn = multiprocessing.get_context("spawn")
    point, ready = Checkpoint(folder=tmp_path, identity="fit"), spawn.Event()
    point.write({"a": np.zeros(3)})
    killed = spawn.Process(target=write_and_wait, args=(point.path, ready))
    killed.start()
    assert ready.wait(60)
    killed.kill()
    killed.join()
    assert len(list(tmp_path.iterdir())) == 2
    point.remove()
    assert list(tmp_path.iterdir()) == []
