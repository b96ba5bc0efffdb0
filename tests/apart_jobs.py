"""What test_apart.py lets other interpreters do; imports nothing that takes time."""

import json
import os
import subprocess
import sys
import time

from benchmarks import host


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
