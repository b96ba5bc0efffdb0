"""Functions in an interpreter of their own."""

import functools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import apart_jobs
import numba
import numpy as np
import pytest
import torch
from test_workers import until

from ctsim.benchmarks.engine import apart, host


@pytest.fixture
def one_thread():
    """Let the kernels of this process have one thread, by a call as Dask's workers do, not by the environment."""
    threads = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


def test_it_finds_our_modules_has_our_threads_and_hears_neither_keyboard_nor_ctrl_c(one_thread):
    done = apart.call(apart_jobs.tell)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["path"] == sys.path and said["leads"] and said["asked"] == ""
    assert (said["NUMBA_NUM_THREADS"], said["OMP_NUM_THREADS"]) == ("1", "1")


def test_its_peak_memory_is_its_own():
    ours = np.ones(50_000_000)
    assert host.peak_memory() > ours.nbytes
    # an interpreter's; a fork, or a figure that starts at its parent's, would have ours in it
    assert json.loads(apart.call(apart_jobs.tell).stdout)["peak"] < 0.5 * ours.nbytes


def test_what_it_raises_and_how_it_ends_is_told():
    done = apart.call(int, "no number")
    assert done.returncode == 1 and "ValueError" in done.stderr
    assert apart.call(sys.exit, 7).returncode == 7


def gone(pids: Path) -> bool:
    return not any(Path("/proc", pid).exists() for pid in pids.read_text().split())


def test_what_overstays_is_killed_with_what_it_has_started(tmp_path):
    pids = tmp_path / "pids"
    with apart.started(functools.partial(apart_jobs.sleep_in_two, str(pids))) as process:
        until(pids.exists)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
    assert process.returncode == -signal.SIGKILL
    until(lambda: gone(pids))


def test_it_ends_with_a_process_that_is_killed(tmp_path):
    pids = tmp_path / "pids"
    code = f"import apart_jobs; from ctsim.benchmarks import apart; apart.call(apart_jobs.sleep_in_two, {str(pids)!r})"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-P", "-c", code], env=environment) as it:
        until(pids.exists)
        it.kill()
    until(lambda: gone(pids))
