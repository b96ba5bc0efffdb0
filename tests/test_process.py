"""Functions in processes of their own, one with a time limit or several at once, and on a Dask cluster."""

import contextlib
import ctypes
import gc
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import engine_jobs as jobs
import numba
import numpy as np
import pytest
import torch
from engine_jobs import lives, started, until

from ctsim.benchmarks.engine import dask, host, process
from ctsim.benchmarks.engine.dask import Cluster
from ctsim.benchmarks.engine.host import open_jobs
from ctsim.benchmarks.engine.process import Lost, Pool, Process, Stopped, answered, check_limit
from ctsim.errors import InputError

TESTS = str(Path(__file__).parent)


@pytest.fixture
def one():
    with Process() as found:
        yield found


def numbers(path: Path) -> list[int]:
    return [int(word) for word in path.read_text().split()]


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def script(text: str, *arguments: object) -> list[str]:
    return [sys.executable, "-c", text, *map(str, arguments)]


ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([TESTS, *filter(None, sys.path)])}


# --- one process ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_that_is_none_is_refused(seconds):
    with pytest.raises(InputError, match=r"--seconds must be positive, got"):
        check_limit(seconds)


def test_limits_that_are_some():
    check_limit(None)
    check_limit(0.1)


def test_calls_share_a_process_that_is_not_ours(one):
    first = one.run(os.getpid)
    assert first != os.getpid() and one.run(os.getpid) == first


def test_what_hangs_or_dies_is_said_and_the_next_call_has_a_new_process(one):
    first = one.run(os.getpid)
    with pytest.raises(Stopped, match=r"did not end within 0\.2 s") as hung:
        one.run(time.sleep, 3600, seconds=0.2)
    assert (hung.value.status, hung.value.exit_code) == ("timeout", None)
    assert not lives(first)
    with pytest.raises(Stopped, match="the process died with exit code 3") as died:
        one.run(os._exit, 3)
    assert (died.value.status, died.value.exit_code) == ("error", 3)
    with pytest.raises(Stopped, match="the process died with signal SIGKILL"):
        one.run(jobs.job, "die")
    with pytest.raises(Stopped, match="the process died with exit code 7"):
        one.run(sys.exit, 7)
    assert one.run(os.getpid) not in (first, os.getpid())


def test_a_limit_holds_for_the_start_of_the_process_too(one):
    with pytest.raises(Stopped, match=r"did not end within 0\.001 s"):
        one.run(os.getpid, seconds=0.001)


def test_a_process_that_cannot_begin_is_one_that_died(monkeypatch):
    """Its pipe may be closed before anything was sent, which is no BrokenPipeError of ours."""
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    popen = subprocess.Popen

    def ended(*arguments, **more):
        found = popen(*arguments, **more)
        os.waitid(os.P_PID, found.pid, os.WEXITED | os.WNOWAIT)
        return found

    monkeypatch.setattr(subprocess, "Popen", ended)
    with Process() as found, pytest.raises(Stopped, match="the process died with exit code 1"):
        found.run(os.getpid)


def test_what_a_call_raises_is_raised_with_its_traceback_and_its_process_stays(one):
    first = one.run(os.getpid)
    with pytest.raises(InputError, match="a sentence") as refused:
        one.run(jobs.input_error, "a sentence")
    assert not hasattr(refused.value, "__notes__")  # it is said in one sentence
    with pytest.raises(OSError, match="its own") as failed:
        one.run(jobs.job, "fails")
    assert "engine_jobs.py" in failed.value.__notes__[0] and "in job" in failed.value.__notes__[0]
    assert one.run(os.getpid) == first


def test_an_exception_that_cannot_be_made_again_is_told_in_words(one):
    with pytest.raises(RuntimeError, match="Stopped: its arguments are not those of its making"):
        one.run(jobs.stopped_error)
    with pytest.raises(RuntimeError, match="Keeps: a lock"):
        one.run(jobs.job, "keeps")
    with pytest.raises(RecursionError, match="maximum recursion"):
        one.run(jobs.job, "recurses")


@pytest.mark.parametrize("function", [jobs.unpicklable, jobs.nested])
def test_an_answer_that_cannot_travel_is_an_exception_and_the_process_stays(one, function):
    first = one.run(os.getpid)
    with pytest.raises((TypeError, RecursionError), match=r"pickle|recursion"):
        one.run(function)
    assert one.run(os.getpid) == first


def test_a_call_that_cannot_be_read_is_an_exception_and_the_process_stays(one):
    first = one.run(os.getpid)
    one.pipe.send_bytes(pickle.dumps((eval, ("1",))).replace(b"eval", b"oval"))
    with pytest.raises(AttributeError, match="oval"):
        one.receive()
    assert one.run(os.getpid) == first


def test_answers_are_what_they_were():
    assert answered(divmod, 7, 2) == (False, (3, 1))
    failed, error = answered(jobs.input_error, "a sentence")
    assert failed and type(error) is InputError and error.__traceback__ is None
    failed, error = answered(jobs.job, "fails")
    assert failed and isinstance(error, OSError) and error.__traceback__ is None and "in job" in error.__notes__[0]


@pytest.mark.parametrize("size", [10, 5_000_000])
def test_large_arguments_and_answers_arrive(one, size):
    assert one.run(bytes, size) == bytes(size)
    assert one.run(len, bytes(size)) == size


def test_it_finds_our_modules_leads_its_session_and_gets_no_answer_from_the_user(one, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    said = one.run(jobs.tell, seconds=60.0)
    assert said["path"] == sys.path and said["path"][0] == str(tmp_path)
    assert said["leads"] and said["stdin"] == ""


def test_it_has_the_variables_that_it_is_given(monkeypatch):
    monkeypatch.delenv("CTSIM_TEST", raising=False)
    monkeypatch.setenv("CTSIM_OURS", "8")
    with Process({"CTSIM_TEST": "7"}) as found:
        said = found.run(jobs.tell)["environment"]
    assert (said["CTSIM_TEST"], said["CTSIM_OURS"]) == ("7", "8") and "CTSIM_TEST" not in os.environ


def test_threads_set_by_a_call_are_inherited_but_what_is_given_wins(monkeypatch):
    """As Dask's workers set them, not by the environment."""
    before = numba.get_num_threads(), torch.get_num_threads()
    monkeypatch.setenv("NUMBA_NUM_THREADS", "99")
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    try:
        with Process() as found, Process({"OMP_NUM_THREADS": "5"}) as other:
            said, told = found.run(jobs.tell)["environment"], other.run(jobs.tell)["environment"]
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
    assert (said["NUMBA_NUM_THREADS"], said["OMP_NUM_THREADS"]) == ("1", "1")
    assert (told["NUMBA_NUM_THREADS"], told["OMP_NUM_THREADS"]) == ("1", "5")


def test_its_peak_memory_is_its_own(one):
    ours = np.ones(25_000_000)
    assert host.peak_memory() > ours.nbytes
    # an interpreter's; a fork, or a figure that starts at its parent's, would have ours in it
    assert one.run(jobs.tell)["peak"] < 0.5 * ours.nbytes


def test_a_process_without_a_call_ends_by_itself_and_cleans_up(tmp_path):
    with Process() as found:
        found.run(jobs.touch_at_exit, str(tmp_path / "cleaned"))
    assert (tmp_path / "cleaned").exists()


@pytest.mark.parametrize("how", ["limit", "close"])
def test_what_a_call_started_ends_with_it(one, tmp_path, how):
    one.run(os.getpid)
    if how == "limit":
        with pytest.raises(Stopped, match="did not end"):
            one.run(jobs.sleep_in_two, str(tmp_path / "pids"), seconds=2.0)
    else:
        one.run(jobs.start_and_leave, str(tmp_path / "pids"))
        one.close()
    until(lambda: not any(map(lives, numbers(tmp_path / "pids"))))


def test_a_process_that_is_closed_at_work_is_killed_after_its_grace(one, tmp_path):
    one.send(jobs.sleep_on, str(tmp_path / "pid"))
    until((tmp_path / "pid").exists)
    one.close(0.1)
    assert not lives(*numbers(tmp_path / "pid"))
    assert one.run(divmod, 7, 2) == (3, 1)  # by a new one


def test_processes_leave_no_descriptor_open():
    with Process() as found:
        found.run(os.getpid)
    before = descriptors()
    for n in range(3):
        with Process() as found, contextlib.suppress(Stopped):
            found.run(os._exit, n)
            found.run(os.getpid)
    assert descriptors() == before


def test_ctrl_c_ends_the_call_with_its_process(one):
    pid = one.run(os.getpid)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    try:
        with pytest.raises(KeyboardInterrupt):
            one.run(time.sleep, 3600)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert not lives(pid)


def test_ctrl_c_while_an_answer_arrives_leaves_no_half_of_it(one, monkeypatch):
    one.run(os.getpid)
    real = type(one.pipe).recv

    def interrupted(pipe):
        pipe._recv(8)  # what was read so far
        raise KeyboardInterrupt

    monkeypatch.setattr(type(one.pipe), "recv", interrupted)
    with pytest.raises(KeyboardInterrupt):
        one.run(bytes, 100)
    monkeypatch.setattr(type(one.pipe), "recv", real)
    assert one.run(divmod, 7, 2) == (3, 1)


CALLS = "import sys, engine_jobs as jobs; from ctsim.benchmarks.engine.process import Pool, Process\n"
IN_PROCESS = CALLS + "Process().run(getattr(jobs, sys.argv[1]), sys.argv[2])"
IN_POOL = CALLS + "with Pool(2) as pool: list(pool.answers(getattr(jobs, sys.argv[1]), [sys.argv[2]]))"


@pytest.mark.parametrize("code", [IN_PROCESS, IN_POOL])
def test_they_end_with_a_process_that_is_killed_and_so_do_their_children(tmp_path, code):
    pids = tmp_path / "pids"
    with started(script(code, "sleep_in_two", pids), env=ENVIRONMENT) as it:
        until(pids.exists)
        it.kill()
    until(lambda: not any(map(lives, numbers(pids))))


def test_a_call_can_write_down_where_it_stopped_when_its_parent_is_killed(tmp_path):
    pid = tmp_path / "pid"
    with started(script(IN_PROCESS, "sleep_and_note", pid), env=ENVIRONMENT) as it:
        until(pid.exists)
        it.kill()
    until((tmp_path / "pid.stopped").exists)
    until(lambda: not lives(*numbers(pid)))


def test_what_does_not_hear_is_killed_after_its_grace_when_its_parent_is_killed(tmp_path):
    pid = tmp_path / "pid"
    with started(script(IN_PROCESS, "sleep_on_with_little_grace", pid), env=ENVIRONMENT) as it:
        until(pid.exists)
        it.kill()
    until(lambda: not lives(*numbers(pid)))


def test_it_works_from_a_daemon(tmp_path):
    daemon = multiprocessing.get_context("spawn").Process(
        target=jobs.call_from_here, args=(str(tmp_path / "said"),), daemon=True
    )
    daemon.start()
    daemon.join(60)
    assert daemon.exitcode == 0 and (tmp_path / "said").read_text() == "True ['one', 'two']"


def test_it_works_from_a_script_that_guards_nothing_and_runs_it_once(tmp_path):
    path = tmp_path / "script.py"
    path.write_text("print('run')\nimport engine_jobs as jobs\njobs.call_from_here('said')\n")
    done = subprocess.run(
        [sys.executable, path], env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "run\n" and (tmp_path / "said").read_text() == "True ['one', 'two']"


# --- several at once --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    """The address of a scheduler of two workers, each a process with one thread, and a client."""
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


@pytest.fixture(params=["pool", "cluster"])
def opened(request):
    """Two processes of this machine, or a cluster's workers."""
    if request.param == "pool":
        with Pool(2) as found:
            yield found
        return
    address, client = request.getfixturevalue("cluster")
    with Cluster(address) as found:
        client.wait_for_workers(2, timeout=60)  # those that were killed start again, unless the machine is too busy
        yield found


def ended(answers) -> dict:
    return dict(answer for answer in answers if answer is not None)


def test_answers_come_by_number(opened):
    assert ended(opened.answers(len, ["", "a", "bb", "ccc"])) == {0: 0, 1: 1, 2: 2, 3: 3}
    assert ended(opened.answers(len, [])) == {}


@pytest.mark.slow
def test_a_job_that_kills_its_process_each_time_is_given_up_and_the_others_done(opened):
    found = ended(opened.answers(jobs.job, ["die", "two"]))
    assert isinstance(found[0], Lost) and found[1].startswith("two")
    assert isinstance(opened, Cluster) or found[0].reason == (
        "its process died 3 times, the last time with signal SIGKILL"
    )


def test_a_job_whose_process_dies_is_tried_three_times(tmp_path):
    with Pool(2) as pool:
        assert ended(pool.answers(jobs.die_once, [str(tmp_path / "once")])) == {0: "done"}
        ended(pool.answers(jobs.die_and_count, [str(tmp_path / "count")]))
    assert (tmp_path / "count").read_text() == "xxx"


@pytest.mark.parametrize(
    ("given", "kind_of", "said"),
    [
        ("recurses", RecursionError, "maximum recursion"),
        ("keeps", RuntimeError, "Keeps: a lock"),
        ("fails", OSError, "its own"),
    ],
)
def test_what_a_job_raised_arrives_with_its_traceback(opened, given, kind_of, said):
    """For a RecursionError Dask itself failed, said nothing, and the client waited for ever."""
    with pytest.raises(kind_of, match=said) as caught:
        list(opened.answers(jobs.job, [given]))
    assert any("in job" in note for note in caught.value.__notes__)


def test_what_a_job_refuses_is_raised_here(opened):
    with pytest.raises(InputError, match="not this one"):
        list(opened.answers(jobs.job, ["refuse"]))


@pytest.mark.parametrize(
    ("workers", "set_before", "threads"),
    [(2, {}, ("4", "4")), (3, {}, ("2", "2")), (99, {}, ("1", "1")), (2, {"OMP_NUM_THREADS": "2,1"}, ("4", "2"))],
)
def test_each_process_has_its_share_of_the_cores_but_never_more_than_were_set(
    monkeypatch, workers, set_before, threads
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name in process.THREADS.values():
        monkeypatch.delenv(name, raising=False)
    for name, value in set_before.items():
        monkeypatch.setenv(name, value)
    with Pool(workers) as pool:
        (said,) = ended(pool.answers(os.getenv, ["NUMBA_NUM_THREADS"])).values()
        (told,) = ended(pool.answers(os.getenv, ["OMP_NUM_THREADS"])).values()
    assert (said, told) == threads


def test_jobs_run_at_the_same_time_and_only_as_many_processes_as_are_needed(tmp_path):
    with Pool(2) as pool:
        answers = pool.answers(jobs.sleep_and_note, [str(tmp_path / name) for name in "abc"])
        assert next(answers) is None  # nothing has happened for a while
        until(lambda: (tmp_path / "a").exists() and (tmp_path / "b").exists())
        assert not (tmp_path / "c").exists()
    with Pool(64) as pool:
        before = descriptors()
        ended(pool.answers(len, ["", ""]))
        assert descriptors() <= before + 2 * 2  # a pipe to each that has begun, and one that tells it of our end


def test_a_pool_that_is_closed_at_work_lets_jobs_write_down_where_they_stopped(tmp_path):
    with Pool(2) as pool:
        answers = pool.answers(jobs.sleep_and_note, [str(tmp_path / "a"), str(tmp_path / "b")])
        next(answers)
        until(lambda: (tmp_path / "a").exists() and (tmp_path / "b").exists())
    assert (tmp_path / "a.stopped").exists() and (tmp_path / "b.stopped").exists()
    assert not any(lives(*numbers(tmp_path / name)) for name in "ab")


def test_a_pool_kills_what_does_not_hear(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "GRACE", 0.2)
    with Pool(2) as pool:
        next(pool.answers(jobs.sleep_on, [str(tmp_path / "a")]))
        until((tmp_path / "a").exists)
    assert not lives(*numbers(tmp_path / "a"))


def test_idle_processes_of_a_pool_clean_up(tmp_path):
    with Pool(2) as pool:
        ended(pool.answers(jobs.touch_at_exit, [str(tmp_path / "a")]))
    assert (tmp_path / "a").exists()


def test_a_job_that_cannot_be_sent_costs_the_pool_no_process():
    with Pool(1) as pool:
        (pid,) = ended(pool.answers(jobs.job, ["one"])) and [p._popen.pid for p in pool._idle]
        with pytest.raises(TypeError, match="pickle"):
            list(pool.answers(jobs.job, [jobs.unpicklable()]))
        assert ended(pool.answers(len, ["a"])) == {0: 1}
    assert not lives(pid)


# --- a cluster --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "scheduler", "said"),
    [
        (0, None, "expected 1 or more"),
        (2, "tcp://127.0.0.1:9", "exclude each other"),
        (1, "tcp://127.0.0.1:9", "no Dask scheduler answers there"),  # the port of `discard`
        (1, "nonsense://x", "no Dask scheduler answers there"),
        (1, "tls://127.0.0.1:9", "needs certificates: expected distributed.comm.tls.ca-file"),
        (1, "ucx://127.0.0.1:9", "no Dask scheduler answers there"),  # not installed with Dask
    ],
)
def test_workers_that_cannot_be_had_are_one_sentence(monkeypatch, workers, scheduler, said):
    monkeypatch.setattr(dask, "CONNECT", 0.3)
    with pytest.raises(InputError, match=said) as refused:
        open_jobs(workers, scheduler)
    assert "\n" not in str(refused.value)


def test_what_workers_are_asked_for():
    with open_jobs(1, None) as found:
        assert found is None
    with open_jobs(2, None) as found:
        assert isinstance(found, Pool)


@pytest.mark.slow
def test_a_cluster_that_loses_all_its_workers_goes_on_with_those_that_come(cluster):
    address, client = cluster
    with Cluster(address) as found:
        answers = found.answers(time.sleep, [3.0, 3.0, 0.0])
        assert next(answers) is None  # two are at work
        for pid in client.run(os.getpid).values():
            os.kill(pid, signal.SIGKILL)
        # Dask's own restart of a killed worker fails now and then
        command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
        with started([*command, "--no-dashboard"], stderr=subprocess.DEVNULL):
            assert sorted(a for a in answers if a) == [(0, None), (1, None), (2, None)]


def test_a_client_that_found_no_scheduler_is_gone_before_the_next(monkeypatch):
    """Collected while another client is made, it would wait for a lock that is held then."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(dask, "CONNECT", 0.3)
    gc.disable()
    try:
        before = {id(o) for o in gc.get_objects() if type(o) is distributed.Client}
        with pytest.raises(InputError, match="no Dask scheduler answers there"):
            Cluster("tcp://127.0.0.1:9")
        assert {id(o) for o in gc.get_objects() if type(o) is distributed.Client} <= before
    finally:
        gc.enable()


def whole(file: Path) -> bool:
    """Whether the file in which a scheduler tells its address is there, and not half of it."""
    return file.exists() and file.read_text().rstrip().endswith("}")


def test_a_scheduler_that_goes_is_one_sentence(tmp_path):
    file = tmp_path / "scheduler.json"
    command = ("-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", file)
    with started([sys.executable, *command], stderr=subprocess.DEVNULL) as scheduler:
        until(lambda: whole(file))
        with Cluster(json.loads(file.read_text())["address"]) as found:
            answers = found.answers(jobs.job, ["one"])
            assert next(answers) is None  # no worker has come yet
            scheduler.kill()
            with pytest.raises(InputError, match="it is gone"):
                list(answers)


def test_a_scheduler_that_does_not_answer_is_one_sentence(cluster, monkeypatch):
    def timed_out():
        raise OSError("Timed out trying to connect")

    with Cluster(cluster[0]) as found:
        monkeypatch.setattr(found._client, "nthreads", timed_out)
        with pytest.raises(InputError, match="it is gone"):
            list(found.answers(jobs.job, ["one"]))


def test_a_cluster_without_the_package_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "ctsim.benchmarks.engine.dask")
    with pytest.raises(InputError, match=r"pip install 'ctsim\[cluster\]'"):
        open_jobs(1, "tcp://127.0.0.1:9")


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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:unclosed <s:ResourceWarning")  # <ssl.SSLSocket, <socket.socket
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl, which makes the certificates, is not installed")
def test_a_scheduler_with_certificates_works_for_those_who_have_them_alone(tmp_path, monkeypatch):
    config = pytest.importorskip("dask").config
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
            running.enter_context(started(command, stderr=subprocess.DEVNULL))
            until(lambda: whole(file))
        address = json.loads(file.read_text())["address"]
        assert address.startswith("tls://")
        with config.set(configured(ours)), Cluster(address) as found:
            assert ended(found.answers(str.upper, ["one"])) == {0: "ONE"}
        monkeypatch.setattr(dask, "CONNECT", 1.0)
        with config.set(configured(others)), pytest.raises(InputError, match="no Dask scheduler answers there"):
            Cluster(address)
        with pytest.raises(InputError, match=r"tls://.* needs certificates: expected distributed\.comm\.tls\.ca-file"):
            Cluster(address)
        plain = address.replace("tls://", "tcp://")
        with config.set(configured(ours)), pytest.raises(InputError, match=r"encryption required by Dask"):
            Cluster(plain)
    gc.collect()  # here, as Dask leaves sockets of refused connections open, which would fail a later test


def test_an_interrupt_within_a_callback_from_c_is_not_lost(capsys):
    def compare(_a, _b):
        signal.raise_signal(signal.SIGTERM)
        return 0

    kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), process.interruptible():
        ctypes.CDLL(None).qsort((ctypes.c_int * 2)(), 2, 4, kind(compare))
        time.sleep(10)  # without `interruptible` the sort's interrupt is printed, and this goes on to its end
        pytest.fail("the interrupt was lost")
    assert "KeyboardInterrupt" not in capsys.readouterr().err and sys.unraisablehook is hook
