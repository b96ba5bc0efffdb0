"""What test_apart.py lets other interpreters do; imports nothing that takes time."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ctsim.benchmarks.engine import host
from ctsim.benchmarks.studies.peers.finding import Measurement


def tell() -> None:
    """Say who we are and what we were given."""
    said = {"leads": os.getsid(0) == os.getpid(), "asked": sys.stdin.read(), "path": sys.path}
    threads = {name: os.environ[name] for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    sys.stdout.write(json.dumps({**said, **threads, "peak": host.peak_memory()}))


def sleep_in_two(file: str) -> None:
    """Start a process that sleeps, leave our number and its, and sleep."""
    other = subprocess.Popen(["sleep", "60"])
    with open(file + ".new", "w") as numbers:
        numbers.write(f"{os.getpid()} {other.pid}")
    os.rename(file + ".new", file)
    time.sleep(60)


def die_in_exact(task: Any, given: Any) -> list:
    """Measure as `run-benchmark peers` does, but for the case exact: leave a temporary folder and die."""
    if task.case == "exact":
        Path(os.environ["CTSIM_TEST_MARK"]).write_text(tempfile.mkdtemp(), encoding="utf-8")
        os._exit(3)
    return [Measurement(scene="s", contender="ctsim", seconds={"run": (1.0,)}, note=f"{task.part} {os.getpid()}")]


def make_two_megabytes(words: list[str]) -> int:
    """Be make-dataset SUITE OUT: say something, write two megabytes."""
    sys.stdout.write("made\n")
    Path(words[1]).mkdir()
    (Path(words[1]) / words[0]).write_bytes(bytes(2_000_000))
    return 0
