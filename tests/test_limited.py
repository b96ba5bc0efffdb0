"""Jobs in a process of their own, within a time limit."""

import atexit
import os
import signal
import time
from pathlib import Path

import pytest

from benchmarks.limited import Limited, Stopped
from ctsim.errors import InputError

WHOLE = 60.0  # seconds that a process has to start beside other work


def fail(words: str) -> None:
    raise InputError(words)


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


def test_ctrl_c_ends_the_job_with_its_process(limited):
    pid = limited.run(os.getpid)
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    with pytest.raises(KeyboardInterrupt):
        limited.run(time.sleep, 3600)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_the_process_has_the_variables_that_it_is_given(monkeypatch):
    monkeypatch.delenv("CTSIM_TEST", raising=False)
    with Limited(WHOLE, {"CTSIM_TEST": "7"}) as process:
        assert process.run(os.getenv, "CTSIM_TEST") == "7"
    assert "CTSIM_TEST" not in os.environ
