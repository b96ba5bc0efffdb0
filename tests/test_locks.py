"""Locks between processes, with flock and on file systems that have none."""

import errno
import fcntl
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from small_scan import STACKS, content, write
from test_record import Value, record

from ctsim.benchmarks.engine.record import Record, Store
from ctsim.dataset import locks, process
from ctsim.dataset.locks import Busy, Owner, lock, locked
from ctsim.dataset.store import verify
from ctsim.dataset.writer import SceneWriter
from ctsim.errors import InputError

NO_FLOCK = [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS]
APPENDED = 60


def take_flock_away(code: int = errno.ENOLCK) -> None:
    """Let this process's file systems have no flock, as Lustre has none that is mounted without."""

    def flock(handle: int, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    fcntl.flock = flock


@pytest.fixture(params=NO_FLOCK)
def no_flock(monkeypatch, request) -> None:
    monkeypatch.setattr(fcntl, "flock", fcntl.flock)  # is put back
    take_flock_away(request.param)


@pytest.fixture(params=[True, False], ids=["flock", "none"])
def maybe_flock(monkeypatch, request) -> None:
    monkeypatch.setattr(fcntl, "flock", fcntl.flock)
    if not request.param:
        take_flock_away()


def owner(**changes) -> Owner:
    mine = Owner(host="here", machine=process.machine(), pid=os.getpid(), started="", token="0123abcd", flock=False)
    return msgspec.structs.replace(mine, **changes)


def dead() -> int:
    """Return the number of a process that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        pass
    return child.pid


def test_without_flock_a_scene_is_written_and_a_second_process_is_refused(tmp_path, no_flock):
    with SceneWriter(tmp_path, "scene", scene_id="a", plan_hash="p", stacks=STACKS):
        with pytest.raises(InputError, match=rf"another process \({os.getpid()} on .*\) is writing the scene 'scene'"):
            write(tmp_path)
        write(tmp_path, "other")
    assert verify(tmp_path) == [f"{tmp_path}/.scene.partial: unfinished, make the scene again to go on from there"]
    assert not [p for p in tmp_path.iterdir() if "lock" in p.name]


def test_a_lock_that_cannot_be_had_for_another_reason_is_an_error_that_names_it(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", fcntl.flock)
    take_flock_away(errno.EIO)
    for use in (lambda path: lock(path, "it"), lambda path: locked(path).__enter__()):
        with pytest.raises(OSError, match="Input/output error") as found:
            use(tmp_path / "file")
        assert found.value.filename == str(tmp_path / "file")


def test_the_lock_that_a_killed_process_left_is_taken_over(tmp_path, maybe_flock):
    path = tmp_path / ".scene.lock"
    reused = owner(pid=os.getppid(), started="1")  # the number is another process's by now
    for left in (owner(pid=dead()), owner(pid=dead(), flock=True), reused):
        path.write_bytes(msgspec.json.encode(left))
        with lock(path, "it") as mine:
            assert msgspec.json.decode(path.read_bytes(), type=Owner) == mine.owner != left
        assert list(tmp_path.iterdir()) == []


def test_of_two_that_find_the_lock_of_a_killed_process_one_has_it(tmp_path, no_flock, monkeypatch):
    """The other has looked at the old lock before the first took it over, and tries to remove it afterwards."""
    path, left = tmp_path / ".scene.lock", owner(pid=dead())
    path.write_bytes(msgspec.json.encode(left))
    first = lock(path, "it")
    locks._remove(path, left, "it")
    assert locks._read(path) == first.owner
    first.release()


def test_a_lock_of_another_machine_without_flock_is_refused_with_what_to_do(tmp_path, maybe_flock):
    path = tmp_path / ".scene.lock"
    path.write_bytes(msgspec.json.encode(owner(host="node7", machine="00000000", pid=dead())))
    with pytest.raises(Busy, match=rf"\(\d+ on node7\) is writing it, or was killed while it did; delete {path}") as it:
        lock(path, "it")
    assert not it.value.certain and path.exists()


def test_without_flock_a_lock_that_does_not_say_whose_it_is_is_refused(tmp_path, no_flock, monkeypatch):
    monkeypatch.setattr(time, "sleep", lambda _: None)  # the time that whoever makes one has to say so
    (tmp_path / ".scene.lock").touch()
    with pytest.raises(Busy, match=r"another process is writing it, or was killed .* delete .*\.scene\.lock"):
        lock(tmp_path / ".scene.lock", "it")


def test_a_lock_that_cannot_be_signed_is_not_left(tmp_path, no_flock, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*scene\.lock'"):
        lock(tmp_path / ".scene.lock", "it")
    assert list(tmp_path.iterdir()) == []


def test_a_lock_removed_by_force_is_not_another_processs_to_lose(tmp_path, maybe_flock):
    path = tmp_path / ".scene.lock"
    mine = lock(path, "it")
    path.unlink()
    with lock(path, "it"):
        mine.release()
        assert path.exists()


def store(folder: Path) -> Store:
    return Store(folder, "rows", Record[Value], "a row")


def keep_appending(path: Path, who: int) -> None:
    """Append lines from another process, which has no flock either."""
    take_flock_away()
    for k in range(APPENDED):
        store(path.parent).append([record(who, k, case=f"{who} {k}")])


def test_without_flock_no_record_is_lost_where_processes_append_and_collect_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", fcntl.flock)
    take_flock_away()
    path, there = tmp_path / "rows.jsonl", tmp_path / "there"
    there.mkdir()
    store(there).append([record(0)])
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=keep_appending, args=(path, who)) for who in (1, 2)]
    for other in others:
        other.start()
    while any(other.is_alive() for other in others):
        store(tmp_path).collect((there,))
    for other in others:
        other.join()
    assert [other.exitcode for other in others] == [0, 0]
    store(tmp_path).collect((there,))
    expected = [record(0), *(record(who, k, case=f"{who} {k}") for who in (1, 2) for k in range(APPENDED))]
    assert sorted(store(tmp_path).read(), key=lambda r: (r.time, r.found[0].value)) == expected
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rows.jsonl", "there"]


def test_lines_whose_lock_another_machine_left_are_refused_after_a_while(tmp_path, no_flock, monkeypatch):
    monkeypatch.setattr(locks, "PATIENCE", 0.0)
    (tmp_path / ".rows.jsonl.lock").write_bytes(msgspec.json.encode(owner(host="node7", machine="00000000")))
    with pytest.raises(InputError, match=r"node7\) is writing rows\.jsonl, .* delete .*/\.rows\.jsonl\.lock if it"):
        store(tmp_path).append([record(1)])


SHIM = "#include <errno.h>\nint flock(int f, int o) { (void)f; (void)o; errno = ENOLCK; return -1; }\n"


@pytest.mark.skipif(shutil.which("gcc") is None or sys.platform != "linux", reason="needs gcc and LD_PRELOAD")
def test_a_process_whose_system_refuses_flock_writes_the_same_scene(tmp_path):
    (tmp_path / "shim.c").write_text(SHIM)
    shim = tmp_path / "shim.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", shim, tmp_path / "shim.c"], check=True)
    here = Path(__file__).parent
    code = (
        f"import fcntl, sys; sys.path[:0] = [{str(here.parent)!r}, {str(here)!r}]\n"
        "from pathlib import Path\nfrom small_scan import write\n"
        f"write(Path({str(tmp_path / 'data')!r}))\n"
        "try: fcntl.flock(0, fcntl.LOCK_EX)\n"
        "except OSError: print('no flock')\n"
    )
    environment = {**os.environ, "LD_PRELOAD": str(shim)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "no flock\n"), done.stderr
    assert content(tmp_path / "data" / "scene") == content(write(tmp_path / "here"))
    assert verify(tmp_path / "data") == [] and len(list((tmp_path / "data").iterdir())) == 2
