"""Jobs in a process of their own, within a time limit."""

import atexit
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from ctsim.benchmarks.engine.limited import Limited, Stopped
from ctsim.errors import InputError

WHOLE = 60.0  # seconds that a process has to start beside other work


def fail(words: str) -> None:
    raise InputError(words)


def fail_oddly() -> None:
    raise Stopped("error", "its arguments are not those of its making")


def wait_for_a_child(path: str) -> None:
    with subprocess.Popen(["sleep", "3600"]) as child:
        Path(path).write_text(str(child.pid), encoding="utf-8")


@pytest.fixture
def limited():
    with Limited(WHOLE) as process:
        yield process


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_that_is_none_is_refused(seconds):
    with pytest.raises(InputError, match="seconds must be positive"):
        Limited(seconds)


def test_jobs_share_a_process_that_is_not_ours(limited):
    first = limited.run(os.getpid)
    assert first != os.getpid() and limited.run(os.getpid) == first


def test_what_hangs_or_dies_is_said_and_the_next_job_has_a_new_process(limited):
    first = limited.run(os.getpid)
    limited.seconds = 0.2
    with pytest.raises(Stopped, match=r"did not end within 0\.2 s") as hung:
        limited.run(time.sleep, 3600)
    assert hung.value.status == "timeout"
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    limited.seconds = WHOLE
    with pytest.raises(Stopped, match="the process died with exit code 3") as died:
        limited.run(os._exit, 3)
    assert died.value.status == "error"
    assert limited.run(os.getpid) not in (first, os.getpid())


def test_what_a_job_raises_is_raised_and_its_process_stays(limited):
    first = limited.run(os.getpid)
    with pytest.raises(InputError, match="a sentence"):
        limited.run(fail, "a sentence")
    assert limited.run(os.getpid) == first


def clean_up(path: str) -> None:
    atexit.register(Path(path).touch)


def test_a_process_without_a_job_ends_by_itself_and_cleans_up(tmp_path):
    with Limited(WHOLE) as process:
        process.run(clean_up, str(tmp_path / "cleaned"))
    assert (tmp_path / "cleaned").exists()


def test_an_exception_that_cannot_be_made_again_is_told_in_words(limited):
    with pytest.raises(RuntimeError, match="its arguments are not those of its making"):
        limited.run(fail_oddly)


def test_what_a_job_started_ends_with_it(limited, tmp_path):
    limited.run(os.getpid)
    limited.seconds = 2.0
    with pytest.raises(Stopped, match="did not end"):
        limited.run(wait_for_a_child, str(tmp_path / "pid"))
    pid = int((tmp_path / "pid").read_text(encoding="utf-8"))
    for _ in range(100):  # it is the system's to reap now
        if not Path(f"/proc/{pid}/cmdline").exists() or not Path(f"/proc/{pid}/cmdline").read_bytes():
            break
        time.sleep(0.05)
    else:
        pytest.fail("the child lives on")


def test_ctrl_c_ends_the_job_with_its_process(limited):
    pid = limited.run(os.getpid)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    try:
        with pytest.raises(KeyboardInterrupt):
            limited.run(time.sleep, 3600)
    finally:
        signal.signal(signal.SIGALRM, before)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_the_process_has_the_variables_that_it_is_given(monkeypatch):
    monkeypatch.delenv("CTSIM_TEST", raising=False)
    with Limited(WHOLE, {"CTSIM_TEST": "7"}) as process:
        assert process.run(os.getenv, "CTSIM_TEST") == "7"
    assert "CTSIM_TEST" not in os.environ
