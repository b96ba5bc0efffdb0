"""A function in an interpreter of its own, which counts its own memory only and ends with the process that started it.

Unlike multiprocessing's it may be started by a daemon, as Dask's workers are, and does not import the user's script
again.
"""

import contextlib
import functools
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

# sys.path comes first: it says where what the job needs is found
_BEGIN = """import pickle, sys
file = open(sys.argv[1], "rb")
sys.path[:] = pickle.load(file)
from ctsim.benchmarks.engine import apart
apart.be(file)"""
_THREADS = {"numba": "NUMBA_NUM_THREADS", "torch": "OMP_NUM_THREADS"}


@contextlib.contextmanager
def started(job: Callable[[], object], **pipes: Any) -> Iterator["subprocess.Popen[str]"]:
    """Start a process that calls `job`, which can be pickled; where it has not ended with the block, it is killed.

    Modules are found where they are here, the kernels have as many threads, and Ctrl-C is not heard. `pipes` are
    stdout and stderr as of Popen.
    """
    read, write = os.pipe()  # nothing is ever written: it closes when we end, however that happens
    with tempfile.TemporaryDirectory(prefix="ctsim-apart-") as folder, open(read) as theirs, open(write, "w"):
        file = Path(folder) / "job.pickle"
        file.write_bytes(pickle.dumps(sys.path) + pickle.dumps(job))
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _BEGIN, str(file)],
            stdin=theirs,
            text=True,
            env=_environment(),
            start_new_session=True,
            **pipes,
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with what it has started itself
                process.wait()


def call(function: Callable[..., object], *given: object) -> "subprocess.CompletedProcess[str]":
    """Call `function(*given)` apart; return the exit code and what it wrote to stdout and stderr."""
    job = functools.partial(function, *given)
    with started(job, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        out, err = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def _environment() -> dict[str, str]:
    """Return our variables, with the threads that our kernels have: those set by a call would not be inherited."""
    libraries = {variable: sys.modules.get(name) for name, variable in _THREADS.items()}
    return os.environ | {v: str(library.get_num_threads()) for v, library in libraries.items() if library is not None}


def be(file: IO[bytes]) -> None:
    """Be the process: call the job in `file`."""
    threading.Thread(target=_follow_parent, args=(os.dup(0),), daemon=True).start()
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)  # a job that asks the user gets no answer
    with file:
        job = pickle.load(file)
    job()


def _follow_parent(pipe: int) -> None:
    """End this process, with what it has started, when the one that holds the other end of the pipe has ended."""
    os.read(pipe, 1)
    os.killpg(0, signal.SIGKILL)
