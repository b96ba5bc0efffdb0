"""What make-dataset finds in a data folder: scenes of other code, what ended runs left, and ten thousand scenes."""

import os
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
from small_scan import STACKS, content, one_view, write
from test_writer import interrupt

from ctsim.benchmarks.make_dataset import main
from ctsim.benchmarks.make_dataset import work as command
from ctsim.benchmarks.suites import load
from ctsim.dataset import folder, locks, manifest, sources
from ctsim.dataset.folder import is_complete, remarks, unfinished
from ctsim.dataset.manifest import INDEX, MANIFEST, PROGRESS, IndexLine, read_index, read_manifest
from ctsim.dataset.store import open_scan, verify
from ctsim.dataset.writer import SceneWriter
from ctsim.errors import InputError
from ctsim.phantoms import dataset
from ctsim.phantoms import scene as scenes
from ctsim.phantoms.scene import scene_id

SUITE = """
[defaults.scanner]
n_views = 7
n_detector = [10, 12]
n_voxel = [10, 14, 22]
[defaults.phantom]
recipe = "validation"
n_voxel = [16, 16, 16]
metal = "none"

[[scene]]
name = "rods"
phantom = { metal = "Al" }

[[scene]]
name = "bare"
"""


@pytest.fixture
def other_code(monkeypatch):
    """A function after which this process runs other code of the simulator."""
    monkeypatch.setattr(sources, "hash_of", sources.hash_of)  # is put back

    def become(name: str) -> None:
        sources.hash_of = lambda packages: name
        sources.source_hash.cache_clear()

    yield become
    sources.source_hash.cache_clear()


@pytest.fixture
def suite(tmp_path) -> str:
    path = tmp_path / "suite.toml"
    path.write_text(SUITE)
    return str(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("whole")
    (path / "suite.toml").write_text(SUITE)
    assert main([str(path / "suite.toml"), str(path / "data")]) == 0
    return path / "data"


@pytest.fixture
def made(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


def names(path: Path) -> set[str]:
    return {p.relative_to(path).as_posix() for p in path.rglob("*")}


def interrupted_at(view: int, monkeypatch) -> None:
    """Let the simulator be interrupted when it has made so many views."""
    real = dataset.simulate_views

    def views(*given, **more):
        for k, arrays in real(*given, **more):
            if k == view:
                raise KeyboardInterrupt
            yield k, arrays

    monkeypatch.setattr(dataset, "simulate_views", views)


def test_an_unfinished_scan_of_other_code_is_begun_anew(tmp_path, other_code):
    interrupt(tmp_path, 4)
    assert unfinished(tmp_path)["scene"].code == sources.source_hash() != ""
    other_code("v2")
    with SceneWriter(tmp_path, "scene", scene_id="a" * 12, plan_hash="another", stacks=STACKS) as writer:
        assert writer.first_view == 0
        for view in range(2):
            writer.put(view, one_view(view))
        with pytest.raises(ValueError, match="2 of 6"):
            writer.finish()
    with pytest.raises(InputError, match="unfinished output of another scene"):  # what somebody asked for is not lost
        SceneWriter(tmp_path, "scene", scene_id="b" * 12, plan_hash="p", stacks=STACKS).__enter__()


def test_a_scan_is_of_one_version_of_the_simulator(tmp_path, suite, monkeypatch, other_code, capsys):
    real = dataset.simulate_views

    def ones(*given, **more):
        for k, arrays in real(*given, **more):
            yield k, {name: np.ones_like(array) for name, array in arrays.items()}

    data = tmp_path / "data"
    with monkeypatch.context() as patch:
        interrupted_at(4, patch)
        assert main([suite, str(data), "--only", "rods"]) == 130
    monkeypatch.setattr(dataset, "simulate_views", ones)
    other_code("v2")
    capsys.readouterr()
    assert main([suite, str(data), "--only", "rods", "--dry-run"]) == 0
    assert "begun by other code of the simulator, so they start again: rods\n" in capsys.readouterr().out
    assert main([suite, str(data), "--only", "rods"]) == 0
    error = capsys.readouterr().err
    assert "start again: rods\n" in error and "goes on from view" not in error
    assert (open_scan(data / "rods").scan.counts.numpy() == 1).all() and verify(data) == []
    assert read_manifest(data / "rods").code == read_index(data)["rods"].code == "v2"


def test_finished_scans_of_other_code_are_named_and_kept(made, suite, other_code, capsys):
    assert main([suite, str(made)]) == 0
    assert "other code" not in capsys.readouterr().err
    before = content(made)
    other_code("v2")
    said = "were made by other code of the simulator, so this code may make other data of them: "
    remedy = "; make-dataset --force makes them again\n"
    assert main([suite, str(made)]) == 0
    error = capsys.readouterr().err
    assert "rods: already complete, by other code\n" in error and f"2 of 2 scenes {said}rods, bare{remedy}" in error
    assert main([suite, str(made), "--dry-run"]) == 0
    assert f"2 of 2 scenes {said}rods, bare{remedy}" in capsys.readouterr().out
    assert main([str(made), "--verify"]) == 0
    captured = capsys.readouterr()
    assert f"2 of 2 scenes {said}rods, bare{remedy}" in captured.err and "every file is as it was" in captured.out
    assert content(made) == before
    assert main([suite, str(made), "--force", "--only", "rods"]) == 0
    capsys.readouterr()
    assert main([suite, str(made)]) == 0
    assert f"1 of 2 scenes {said}bare; make-dataset --force --only NAME … makes" in capsys.readouterr().err


def test_a_scan_of_the_former_format_is_read_and_named(made, suite, capsys):
    for name in ("rods", "bare"):
        path = made / name / MANIFEST
        old = {k: v for k, v in msgspec.json.decode(path.read_bytes()).items() if k != "code"} | {"format": 2}
        path.write_bytes(msgspec.json.encode(old))
    lines = [{k: v for k, v in msgspec.to_builtins(line).items() if k != "code"} for line in read_index(made).values()]
    (made / INDEX).write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    before = content(made)
    assert open_scan(made / "rods").name == "rods" and verify(made) == []
    assert main([suite, str(made)]) == 0
    assert "2 of 2 scenes were made by other code" in capsys.readouterr().err
    assert content(made) == before


def test_a_table_of_scans_of_different_code_is_remarked_upon(made, suite, other_code, tmp_path, caplog):
    from ctsim.benchmarks.studies.methods.study import main as run

    assert run([str(made), str(tmp_path / "results"), "--dry-run"]) == 0 and not caplog.messages
    first = sources.source_hash()
    other_code("v2")
    assert run([str(made), str(tmp_path / "results"), "--dry-run"]) == 0
    assert [text.partition(", so")[0] for text in caplog.messages] == [
        f"{made}: 2 of 2 scenes were made by other code of the simulator"
    ]
    caplog.clear()
    assert main([suite, str(made), "--force", "--only", "bare"]) == 0
    assert run([str(made), str(tmp_path / "results"), "--dry-run"]) == 0
    assert caplog.messages == [
        f"{made}: the scenes were made by different code of the simulator, so their scores may not compare: "
        f"rods by {first}; bare by v2; make-dataset --force makes them again"
    ]
    caplog.clear()
    assert run([str(made), str(tmp_path / "results"), "--dry-run", "--scene", "bare"]) == 0 and not caplog.messages


def test_a_worker_of_other_code_is_refused(whole, suite, tmp_path):
    (scene,) = (s for s in load(suite) if s.name == "bare")
    job = command.SceneJob(scenes=(scene,), out=tmp_path / "data", force=False, code="v2")
    with pytest.raises(InputError, match="bare: a worker runs other code of the simulator than make-dataset"):
        command.do(job)
    assert not (tmp_path / "data").exists()


def test_a_worker_does_not_wait_for_ever_for_a_lock_of_which_nothing_is_known(suite, tmp_path, monkeypatch):
    def busy(*given, **more):
        tried.append(1)
        raise locks.Busy("another process", certain=len(tried) > 3)

    scene, tried = load(suite)[1], []
    job = command.SceneJob(scenes=(scene,), out=tmp_path, force=False, code=sources.source_hash())
    monkeypatch.setattr(command, "make_scenes", busy)
    monkeypatch.setattr(command.time, "sleep", lambda _: None)
    monkeypatch.setattr(command, "PATIENCE", 2 * command.TICK)
    with pytest.raises(locks.Busy):
        command.do(job)
    assert len(tried) == 3


def test_complete_data_are_only_read(made, suite, monkeypatch, capsys):
    """Neither locked nor written to, nor is room asked for or anything built or planned."""
    for owner, name in [
        (locks, "lock"), (folder, "lock"), (locks, "locked"), (manifest, "locked"), (manifest, "write_synced"),
        (shutil, "disk_usage"), (dataset, "plan_scene"), (dataset, "build"), (shutil, "rmtree"), (Path, "unlink"),
    ]:  # fmt: skip
        monkeypatch.setattr(owner, name, lambda *_, name=name, **__: pytest.fail(f"{name} was called"))
    before = content(made)
    for flags in ([], ["--dry-run"], ["--only", "bare"]):
        assert main([suite, str(made), *flags]) == 0
        assert "already complete" in "".join(capsys.readouterr())
    assert main([str(made), "--verify"]) == 0
    assert content(made) == before


@pytest.mark.parametrize("damage", ["index", "line", "order", "leftovers"])
def test_a_dry_run_writes_nothing_and_a_run_mends(made, whole, suite, capsys, damage):
    lines = (made / INDEX).read_bytes().splitlines(keepends=True)
    if damage == "index":
        (made / INDEX).unlink()
    elif damage == "line":
        (made / INDEX).write_bytes(lines[1])
    elif damage == "order":
        (made / INDEX).write_bytes(b"".join(reversed(lines)))
    else:
        (made / "rods" / PROGRESS).write_bytes(b"{}")
        (made / ".rods.lock").touch()
        (made / ".bare.old").mkdir()
        (made / ".bare.partial").mkdir()
    before = names(made)
    assert main([suite, str(made), "--dry-run"]) == 0
    assert is_complete(made, "rods", read_manifest(made / "rods").scene_id)
    assert names(made) == before
    assert main([suite, str(made)]) == 0
    assert names(made) == names(whole) and (made / INDEX).read_bytes() == (whole / INDEX).read_bytes()


def force_interrupted(made: Path, suite: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        interrupted_at(4, patch)
        assert main([suite, str(made), "--force", "--only", "rods"]) == 130
    assert (made / ".rods.partial").is_dir()


def test_what_an_interrupted_force_left_goes_where_it_would_become_what_is_there(made, whole, suite, capsys):
    force_interrupted(made, suite)
    capsys.readouterr()
    assert main([str(made), "--verify"]) == 0
    partial = f"{made}/.rods.partial"
    again = f"{partial}: an unfinished replacement; --force goes on with it, delete it to do without\n"
    assert capsys.readouterr().err == again
    assert main([suite, str(made)]) == 0
    assert f"{partial}: removed, an unfinished replacement\n" in capsys.readouterr().err
    assert names(made) == names(whole) and remarks(made) == [] == verify(made)


@pytest.mark.parametrize("by", ["recipe", "code"])
def test_what_an_interrupted_force_left_stays_and_is_named_where_it_would_become_another(
    made, suite, tmp_path, other_code, capsys, by
):
    other = suite
    if by == "recipe":
        other = str(tmp_path / "other.toml")
        Path(other).write_text(SUITE.replace("n_views = 7", "n_views = 9"))
    else:
        other_code("v2")
    force_interrupted(made, other)
    capsys.readouterr()
    again = f"{made}/.rods.partial: an unfinished replacement; --force goes on with it, delete it to do without\n"
    for argv in ([suite, str(made)], [str(made), "--verify"]):
        assert main(argv) == 0
        assert again in capsys.readouterr().err
    assert main([other, str(made), "--force", "--only", "rods"]) == 0
    assert "goes on from view 4" in capsys.readouterr().err
    assert not [text for text in remarks(made) if "replacement" in text]


def test_an_interrupted_force_of_code_that_is_no_more_is_of_no_use(made, suite, other_code, capsys):
    force_interrupted(made, suite)
    other_code("v2")
    assert main([suite, str(made)]) == 0
    assert f"{made}/.rods.partial: removed, an unfinished replacement\n" in capsys.readouterr().err


def test_what_another_process_replaces_just_now_stays(made, suite, capsys):
    force_interrupted(made, suite)
    capsys.readouterr()
    with folder.lock_of(made, "rods"):
        assert main([suite, str(made)]) == 0
    assert (made / ".rods.partial").is_dir() and "replacement" not in capsys.readouterr().err


def test_nothing_to_do_needs_no_room_and_other_scenes_unfinished_are_no_room(made, suite, monkeypatch, capsys):
    usage = type(shutil.disk_usage(made))
    monkeypatch.setattr(command.shutil, "disk_usage", lambda _: usage(10**6, 10**6, 0))
    assert main([suite, str(made)]) == 0
    shutil.rmtree(made / "bare")
    (made / INDEX).write_bytes((made / INDEX).read_bytes().splitlines(keepends=True)[0])
    (made / ".another.partial").mkdir()
    (made / ".another.partial" / "counts.tif").write_bytes(b"x" * 10**5)
    capsys.readouterr()
    assert main([suite, str(made)]) == 2
    assert "only 0 B are free" in capsys.readouterr().err


class Killed(BaseException):
    """What ends a worker."""


class KilledOnce:
    """A pool whose worker is killed in its first job, when the scene is in place but not in the index."""

    workers = 1

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def answers(self, function, jobs):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(dataset, "append_index", self.kill)
            patch.setattr(locks.Lock, "release", lambda lock: os.close(lock.handle))
            with pytest.raises(Killed):
                function(jobs[0])
        yield from ((k, function(job)) for k, job in enumerate(jobs))

    def kill(self, *_: object) -> None:
        raise Killed


def test_a_worker_killed_when_its_scene_is_in_place_leaves_nothing_to_do(whole, suite, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "open_jobs", lambda *_: KilledOnce())
    assert main([suite, str(tmp_path / "data"), "--workers", "2"]) == 0
    assert verify(tmp_path / "data") == [] and names(tmp_path / "data") == names(whole)
    assert (tmp_path / "data" / INDEX).read_bytes() == (whole / INDEX).read_bytes()


def many(data: Path, n: int) -> str:
    """Write n small scans of one suite and return its path; their files are one scan's, linked."""
    text = "[defaults.phantom]\nrecipe = 'validation'\n[defaults.scanner]\nn_views = 6\n"
    text += "".join(f"[[scene]]\nname = 's{k}'\nseed = {k}\n" for k in range(n))
    path = data.with_suffix(".toml")
    path.write_text(text)
    first = write(data, "s0")
    index = []
    for scene in load(str(path)):
        to = data / scene.name
        if to != first:
            shutil.copytree(first, to, copy_function=os.link)
        found = msgspec.structs.replace(read_first(first), name=scene.name, scene_id=scene_id(scene))
        (to / MANIFEST).unlink()
        (to / MANIFEST).write_bytes(msgspec.json.encode(found))
        index.append(
            IndexLine(name=found.name, scene_id=found.scene_id, content_hash=found.content_hash, code=found.code)
        )
    (data / INDEX).write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in index))
    return str(path)


def read_first(path: Path) -> manifest.Manifest:
    return msgspec.json.decode((path / MANIFEST).read_bytes(), type=manifest.Manifest)


def test_complete_scenes_are_known_as_such_in_work_that_grows_as_their_number(tmp_path, monkeypatch):
    """Twice the scenes: the index is read once, each manifest once, the scanner that all have is checked once."""
    counts: list[dict[str, int]] = []
    for n in (12, 24):
        data = tmp_path / f"data{n}"
        suite, count = many(data, n), {"index": 0, "manifest": 0, "geometry": 0, "lists": 0}
        scenes._known_to_image.cache_clear()
        with monkeypatch.context() as patch:
            for name, owner, attribute in [
                ("index", manifest, "read_index"),
                ("manifest", manifest, "read_manifest"),
                ("geometry", scenes, "check_geometry"),
                ("lists", os, "scandir"),
            ]:
                real = getattr(owner, attribute)

                def call(*given, real=real, name=name, count=count, **more):
                    count[name] += 1
                    return real(*given, **more)

                patch.setattr(owner, attribute, call)
            for owner, attribute in ((dataset, "build"), (dataset, "plan_scene")):
                patch.setattr(owner, attribute, lambda *_: pytest.fail("a scene that is there was planned"))
            assert main([suite, str(data)]) == 0
        counts.append(count)
    assert counts[0]["index"] == counts[1]["index"] == 1 and counts[0]["geometry"] == counts[1]["geometry"] == 1
    assert (counts[0]["manifest"], counts[1]["manifest"]) == (12, 24)
    assert counts[0]["lists"] == counts[1]["lists"]


def test_a_scene_id_does_not_depend_on_how_a_number_is_written(suite):
    """Numbers are read as their key's kind, also in a scene that was not read from a file."""
    scene = load(suite)[0]
    by_hand = msgspec.structs.replace(scene, scanner=msgspec.structs.replace(scene.scanner, start_deg=60))
    as_float = msgspec.structs.replace(scene, scanner=msgspec.structs.replace(scene.scanner, start_deg=60.0))
    assert scene_id(by_hand) == scene_id(as_float) != scene_id(scene)
    with_list = msgspec.structs.replace(scene.scanner, n_detector=[10, 12])  # cannot be remembered
    assert scene_id(msgspec.structs.replace(scene, scanner=with_list)) == scene_id(scene)
