"""Several processes and a Dask cluster give what one process gives, also when one of them is killed at work."""

import hashlib
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from test_cli import stopped

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine import dask as dask_jobs

pytestmark = pytest.mark.slow

SUITE = """
[defaults.scanner]
n_views = 12
n_detector = [10, 12]
n_voxel = [10, 14, 22]
[defaults.phantom]
recipe = "validation"
n_voxel = [16, 16, 16]

[[scene]]
name = "steel"
phantom = { metal = "Fe" }
scanner = { n_views = 200 }  # is finished last, though it is first

[[scene]]
name = "rods"

[[scene]]
name = "bare"
phantom = { metal = "none" }
"""
METHODS = ("--method", "fdk", "--method", "engine_jobs:fatal_once")


def set_mark(path):
    os.environ["CTSIM_TEST_MARK"] = path


def kill_a_writer(pids: Callable[[], Iterable[int]], data: Path) -> threading.Thread:
    """Kill, once it is seen to write into an unfinished scene, one of the processes."""

    def writes(pid: int) -> bool:
        try:
            opened = [os.readlink(f"/proc/{pid}/fd/{n}") for n in os.listdir(f"/proc/{pid}/fd")]
        except OSError:
            return False
        return any(name.startswith(str(data)) and ".partial/" in name for name in opened)

    def watch():
        end = time.monotonic() + 60
        while time.monotonic() < end:
            for pid in filter(writes, pids()):
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
                return
            time.sleep(0.002)

    killed: list[int] = []
    thread = threading.Thread(target=watch)
    thread.killed = killed  # type: ignore[attr-defined]
    thread.start()
    return thread


def children() -> list[int]:
    return [int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()]


def make(data: Path, *flags: str) -> int:
    from ctsim.benchmarks.make_dataset import main

    suite = data.with_suffix(".toml")
    suite.write_text(SUITE, encoding="utf-8")
    return main([str(suite), str(data), *flags])


def score(data: Path, results: Path, *flags: str) -> int:
    from ctsim.benchmarks.studies.methods.study import main

    return main([str(data), str(results), *METHODS, *flags])


def scores(results: Path) -> dict:
    """Return what was measured of each run, and fail where one was recorded twice."""
    return {r.identity: (r.label, r.task.place, r.status, r.scores) for r in records_of(results)}


def records_of(results: Path) -> list:
    from ctsim.benchmarks.studies.methods import records

    found = records.read(results)
    assert len({r.identity for r in found}) == len(found)
    return found


def volumes(results: Path) -> dict[str, str]:
    """Return a hash of every volume that was kept."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in (results / "volumes").iterdir()}


def tables(results: Path) -> str:
    """Return the tables as text, without times: the table of costs, and the last column of the main table."""
    text = (results / "table.md").read_text(encoding="utf-8")
    rows = (results / "table.csv").read_text(encoding="utf-8").splitlines()
    parts = text.split("\n## ")
    kept = [re.sub(r"\|[^|\n]*\|$", "|", p, flags=re.M) if "main: " in p[:9] else p for p in parts]
    return "\n## ".join(p for p in kept if not p.startswith("cost")) + "\n".join(r for r in rows if ",cost," not in r)


@pytest.fixture(scope="module")
def serial(tmp_path_factory) -> Path:
    """A folder with `data` and `results`, made by one process."""
    folder = tmp_path_factory.mktemp("serial")
    os.environ["CTSIM_TEST_MARK"] = str(folder / "mark")
    (folder / "mark").touch()
    assert make(folder / "data") == 0
    assert score(folder / "data", folder / "results") == 0
    return folder


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers, each a process with one thread."""
    import dask.config
    from distributed import Client, LocalCluster

    # a job may be moved from a worker that is killed to the other before that is, too; twice that on a busy machine
    dask.config.set({"distributed.deploy.lost-worker-timeout": "10m"})  # 15 s are too few on a busy machine
    dask.config.set({"distributed.scheduler.allowed-failures": 4})
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs="CRITICAL"
        ) as found,
        Client(found, set_as_default=False) as client,
    ):
        yield found.scheduler_address, client


def same_data(one: Path, other: Path) -> bool:
    """Compare names, recipes and checksums, and the order in which scenes are listed."""
    from ctsim.dataset.manifest import verify

    return verify(other) == [] and (one / "index.jsonl").read_bytes() == (other / "index.jsonl").read_bytes()


def same_results(one: Path, other: Path) -> bool:
    assert scores(one) == scores(other)
    assert tables(one) == tables(other)
    assert volumes(one) == volumes(other)
    return len(volumes(one)) > 0


def test_two_workers_make_the_same_dataset_though_one_is_killed(serial, tmp_path):
    killer = kill_a_writer(children, tmp_path / "data")
    assert make(tmp_path / "data", "--workers", "2") == 0
    killer.join()
    assert killer.killed and same_data(serial / "data", tmp_path / "data")


def test_two_workers_score_the_same(serial, tmp_path):
    assert score(serial / "data", tmp_path / "results", "--workers", "2") == 0
    assert same_results(serial / "results", tmp_path / "results")


def test_a_cluster_makes_the_same_dataset_though_a_worker_is_killed(serial, cluster, tmp_path):
    address, client = cluster
    killer = kill_a_writer(lambda: client.run(os.getpid).values(), tmp_path / "data")
    assert make(tmp_path / "data", "--scheduler", address) == 0
    killer.join()
    assert killer.killed and same_data(serial / "data", tmp_path / "data")


def test_a_cluster_scores_the_same_though_a_worker_is_killed(serial, cluster, tmp_path, monkeypatch):
    address, client = cluster
    monkeypatch.setenv("CTSIM_TEST_MARK", str(tmp_path / "mark"))  # for the worker that follows the killed one
    client.run(set_mark, str(tmp_path / "mark"))
    assert score(serial / "data", tmp_path / "results", "--scheduler", address) == 0
    assert (tmp_path / "mark").exists() and same_results(serial / "results", tmp_path / "results")


def test_a_clusters_worker_runs_methods_apart_within_a_time_limit(serial, cluster, tmp_path):
    address, client = cluster
    client.run(set_mark, str(serial / "mark"))
    workers = set(client.nthreads())  # the one that follows a killed one may still be starting
    flags = ("--scheduler", address, "--scene", "bare")
    assert score(serial / "data", tmp_path / "results", *flags, "--isolate") == 0
    found = scores(tmp_path / "results")
    assert len(found) == 2 and found.items() <= scores(serial / "results").items()
    assert all(r.cost.isolated for r in records_of(tmp_path / "results"))
    from ctsim.benchmarks.studies.methods.study import main

    words = (serial / "data", tmp_path / "hung", "--method", "engine_jobs:hang", "--seconds", "2", *flags)
    assert main([*map(str, words)]) == 1
    (hung,) = records_of(tmp_path / "hung")
    assert (hung.status, hung.reason) == ("timeout", "did not end within 2 s")
    assert workers and workers <= set(client.nthreads())  # none was lost over it


def test_a_scene_that_fails_on_a_cluster_ends_the_command_with_a_traceback(cluster, tmp_path):
    address, client = cluster
    client.run(break_scenes)
    try:
        with pytest.raises(RecursionError, match="maximum recursion") as caught:
            make(tmp_path / "data", "--scheduler", address)
    finally:
        client.run(break_scenes, False)
    assert any("in put" in note for note in caught.value.__notes__)


def break_scenes(broken: bool = True) -> None:
    """Let no scene be written in this process, or again."""
    from ctsim.dataset.writer import SceneWriter

    def put(self, view, arrays):
        put(self, view, arrays)

    if broken:
        SceneWriter._put, SceneWriter.put = SceneWriter.put, put  # type: ignore[attr-defined]
    else:
        SceneWriter.put = SceneWriter._put  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--workers", "0"], "expected 1 or more"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "exclude each other"),
        (["--scheduler", "tcp://127.0.0.1:9"], "no Dask scheduler answers there"),  # the port of `discard`
        (["--scheduler", "nonsense://x"], "no Dask scheduler answers there"),
        (["--scheduler", "tls://127.0.0.1:9"], "needs certificates: expected distributed.comm.tls.ca-file"),
        (["--scheduler", "ucx://127.0.0.1:9"], "no Dask scheduler answers there"),  # not installed with Dask
    ],
)
def test_workers_that_cannot_be_had_are_one_sentence(serial, tmp_path, monkeypatch, capsys, flags, said):
    monkeypatch.setattr(dask_jobs, "CONNECT", 0.3)
    suite = tmp_path / "suite.toml"
    suite.write_text(SUITE, encoding="utf-8")
    for module, arguments in (
        ("make_dataset", [suite, tmp_path / "data", "--only", "bare"]),
        ("studies.methods.study", [serial / "data", tmp_path / "results"]),
    ):
        assert cli.guarded("command", f"ctsim.benchmarks.{module}", [*map(str, arguments), *flags]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
    assert not (tmp_path / "data").exists() and not (tmp_path / "results").exists()


def test_sigterm_ends_the_workers_and_keeps_what_they_noted(serial, tmp_path):
    (tmp_path / "data.toml").write_text(SUITE, encoding="utf-8")
    data = tmp_path / "data"
    arguments = (data.with_suffix(".toml"), data, "--workers", "2")
    code, said = stopped("make_dataset", arguments, tmp_path, (data / ".steel.partial" / "counts.tif").exists)
    assert code == 130 and "interrupted" in said and "Traceback" not in said
    assert not any(data.glob(".*.lock"))  # no worker is at it any more
    assert make(data) == 0 and same_data(serial / "data", data)
