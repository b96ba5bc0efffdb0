"""Several processes and a Dask cluster give what one process gives, also when one of them is killed at work."""

import contextlib
import gc
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from test_cli import stopped

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine import dask as dask_jobs
from ctsim.benchmarks.engine import process
from ctsim.benchmarks.engine.dask import Cluster
from ctsim.benchmarks.engine.host import open_jobs
from ctsim.benchmarks.engine.process import Lost, Pool
from ctsim.errors import InputError

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
METHODS = ("--method", "fdk", "--method", "test_workers:fatal_once")


def fatal_once(scan, *, device):
    """FDK, but the first process that asks is killed."""
    from ctsim.reconstruct.fdk import reconstruct

    _die_once(Path(os.environ["CTSIM_TEST_MARK"]))
    return reconstruct(scan)


def hang(scan, *, device):
    time.sleep(60)


def _die_once(mark):
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


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
    """Return the tables as text, without the one of times."""
    text = (results / "table.md").read_text(encoding="utf-8")
    rows = (results / "table.csv").read_text(encoding="utf-8").splitlines()
    parts = text.split("\n## ")
    return "\n## ".join(p for p in parts if not p.startswith("cost")) + "\n".join(r for r in rows if ",cost," not in r)


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
    from ctsim.manifest import verify

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
    flags = ("--scheduler", address, "--scene", "bare")
    assert score(serial / "data", tmp_path / "results", *flags, "--isolate") == 0
    found = scores(tmp_path / "results")
    assert len(found) == 2 and found.items() <= scores(serial / "results").items()
    assert all(r.cost.isolated for r in records_of(tmp_path / "results"))
    from ctsim.benchmarks.studies.methods.study import main

    words = (serial / "data", tmp_path / "hung", "--method", "test_workers:hang", "--seconds", "2", *flags)
    assert main([*map(str, words)]) == 1
    (hung,) = records_of(tmp_path / "hung")
    assert (hung.status, hung.reason) == ("timeout", "did not end within 2 s")
    assert len(client.nthreads()) == 2  # no worker was lost over it


class Keeps(Exception):
    """Cannot be pickled."""

    def __init__(self) -> None:
        super().__init__("a lock")
        self.lock = threading.Lock()


def job(given: str) -> str:
    if given == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if given == "refuse":
        raise InputError("not this one")
    if given == "fails":
        raise OSError("its own")
    if given == "recurses":
        return job(given)
    if given == "keeps":
        raise Keeps
    return f"{given} with {os.environ.get('NUMBA_NUM_THREADS')}"


@pytest.mark.parametrize("kind", ["local", "cluster"])
def test_a_job_that_kills_its_process_each_time_is_given_up_and_the_others_done(kind, request, monkeypatch):
    monkeypatch.setattr(process, "TRIES", 2)
    with Pool(2) if kind == "local" else Cluster(request.getfixturevalue("cluster")[0]) as pool:
        answers = dict(a for a in pool.answers(str if kind == "cluster" else job, ["one"]) if a)
        found = dict(a for a in pool.answers(job, ["die", "two"]) if a is not None)
    assert answers[0].startswith("one") and isinstance(found[0], Lost) and found[1].startswith("two")
    assert kind == "cluster" or "signal SIGKILL" in found[0].reason


@pytest.mark.parametrize("kind", ["local", "cluster"])
@pytest.mark.parametrize(
    ("given", "kind_of", "said"),
    [("recurses", RecursionError, "maximum recursion"), ("keeps", RuntimeError, "Keeps: a lock")],
)
def test_what_a_job_raised_arrives_with_its_traceback_whatever_it_was(kind, given, kind_of, said, request):
    """For a RecursionError Dask itself failed, said nothing, and the client waited for ever."""
    pool = Pool(2) if kind == "local" else Cluster(request.getfixturevalue("cluster")[0])
    with pool, pytest.raises(kind_of, match=said) as caught:
        list(pool.answers(job, [given]))
    assert any("in job" in note for note in caught.value.__notes__)


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
    from ctsim.writer import SceneWriter

    def put(self, view, arrays):
        put(self, view, arrays)

    if broken:
        SceneWriter._put, SceneWriter.put = SceneWriter.put, put  # type: ignore[attr-defined]
    else:
        SceneWriter.put = SceneWriter._put  # type: ignore[attr-defined]


def test_a_cluster_that_loses_all_its_workers_goes_on_with_those_that_come(cluster):
    address, client = cluster
    with Cluster(address) as pool:
        answers = pool.answers(time.sleep, [3.0, 3.0, 0.0])
        assert next(answers) is None  # two are at work
        for pid in client.run(os.getpid).values():
            os.kill(pid, signal.SIGKILL)
        assert sorted(a for a in answers if a) == [(0, None), (1, None), (2, None)]


def test_what_a_job_refuses_is_raised_here_and_the_cores_are_shared():
    with Pool(2) as pool:
        share = max(1, len(os.sched_getaffinity(0)) // 2)
        assert [a for a in pool.answers(job, ["one"]) if a] == [(0, f"one with {share}")]
        with pytest.raises(InputError, match="not this one"):
            list(pool.answers(job, ["refuse"]))


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


def test_a_client_that_found_no_scheduler_is_gone_before_the_next():
    """Collected while another client is made, it would wait for a lock that is held then."""
    distributed = pytest.importorskip("distributed")
    gc.disable()
    try:
        before = {id(o) for o in gc.get_objects() if type(o) is distributed.Client}
        with pytest.raises(InputError, match="no Dask scheduler answers there"):
            Cluster("tcp://127.0.0.1:9")
        assert {id(o) for o in gc.get_objects() if type(o) is distributed.Client} <= before
    finally:
        gc.enable()


def test_a_scheduler_that_goes_is_one_sentence(tmp_path):
    file = tmp_path / "scheduler.json"
    command = ("-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", file)
    with subprocess.Popen([sys.executable, *command], stderr=subprocess.DEVNULL) as scheduler:
        until(file.exists)
        with Cluster(json.loads(file.read_text())["address"]) as pool:
            answers = pool.answers(job, ["one"])
            assert next(answers) is None  # no worker has come yet
            scheduler.kill()
            with pytest.raises(InputError, match="it is gone"):
                list(answers)


def certificate(folder: Path, name: str) -> dict[str, str]:
    """Make a certificate that is its own authority; return the files as Dask's configuration wants them."""
    key, cert = folder / f"{name}.key", folder / f"{name}.pem"
    files = ["-keyout", key, "-out", cert]
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", f"/CN={name}", *files],
        check=True,
        capture_output=True,
    )
    return {"ca-file": str(cert), "cert": str(cert), "key": str(key)}


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl, which makes the certificates, is not installed")
def test_a_scheduler_with_certificates_works_for_those_who_have_them_alone(tmp_path, monkeypatch):
    dask = pytest.importorskip("dask")
    ours, others = certificate(tmp_path, "ours"), certificate(tmp_path, "others")

    def configured(files):
        names = {"ca-file": "ca-file", "cert": "client.cert", "key": "client.key"}
        tls = {f"distributed.comm.tls.{name}": files[file] for file, name in names.items()}
        return tls | {"distributed.comm.require-encryption": True}

    flags = [word for name, path in ours.items() for word in (f"--tls-{name}", path)]
    file = tmp_path / "scheduler.json"
    flags += ["--no-dashboard", "--scheduler-file", str(file)]
    scheduler = ["dask_scheduler", "--protocol", "tls", "--port", "0", *flags]
    worker = ["dask_worker", "--nthreads", "1", "--no-nanny", *flags]
    with contextlib.ExitStack() as running:
        for module, *words in (scheduler, worker):
            command = [sys.executable, "-m", f"distributed.cli.{module}", *words]
            process = running.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL))
            running.callback(process.kill)
            until(file.exists)
        address = json.loads(file.read_text())["address"]
        assert address.startswith("tls://")
        with dask.config.set(configured(ours)), Cluster(address) as pool:
            assert [answer for answer in pool.answers(str.upper, ["one"]) if answer] == [(0, "ONE")]
        monkeypatch.setattr(dask_jobs, "CONNECT", 1.0)
        with dask.config.set(configured(others)), pytest.raises(InputError, match="no Dask scheduler answers there"):
            Cluster(address)
        with pytest.raises(InputError, match=r"tls://.* needs certificates: expected distributed\.comm\.tls\.ca-file"):
            Cluster(address)
        plain = address.replace("tls://", "tcp://")
        with dask.config.set(configured(ours)), pytest.raises(InputError, match=r"encryption required by Dask"):
            Cluster(plain)


def test_a_scheduler_that_does_not_answer_is_one_sentence_but_a_jobs_own_error_is_not(cluster, monkeypatch):
    def timed_out():
        raise OSError("Timed out trying to connect")

    with Cluster(cluster[0]) as pool:
        with pytest.raises(OSError, match="its own"):
            list(pool.answers(job, ["fails"]))
        monkeypatch.setattr(pool._client, "nthreads", timed_out)
        with pytest.raises(InputError, match="it is gone"):
            list(pool.answers(job, ["one"]))


def test_a_cluster_without_the_package_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "ctsim.benchmarks.engine.dask")
    with pytest.raises(InputError, match=r"pip install 'ctsim\[cluster\]'"):
        open_jobs(1, "tcp://127.0.0.1:9")


def test_sigterm_ends_the_workers_and_keeps_what_they_noted(serial, tmp_path):
    (tmp_path / "data.toml").write_text(SUITE, encoding="utf-8")
    data = tmp_path / "data"
    arguments = (data.with_suffix(".toml"), data, "--workers", "2")
    code, said = stopped("make_dataset", arguments, tmp_path, (data / ".steel.partial" / "counts.tif").exists)
    assert code == 130 and "interrupted" in said and "Traceback" not in said
    assert not any(data.glob(".*.lock"))  # no worker is at it any more
    assert make(data) == 0 and same_data(serial / "data", data)


def test_workers_end_with_a_command_that_is_killed(tmp_path):
    code = (
        "from ctsim.benchmarks.engine.process import Pool; from test_workers import wait\n"
        f"with Pool(2) as pool: list(pool.answers(wait, [{str(tmp_path / 'pid')!r}]))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    ) as it:
        until((tmp_path / "pid").exists)
        it.kill()
    until(lambda: not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists())


def wait(path: str) -> None:
    Path(path + ".new").write_text(str(os.getpid()))
    os.rename(path + ".new", path)
    time.sleep(60)


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)
