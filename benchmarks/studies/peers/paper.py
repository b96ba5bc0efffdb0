"""What the case `paper` of `run-benchmark peers` does in its own process; imports no more than make-dataset does."""

import sys

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.engine import host


def make(suite: str, out: str, scene: str) -> None:
    """Make a scene, say the peak memory, and end with make-dataset's exit code."""
    code = make_dataset.main([suite, out, "--only", scene])
    sys.stdout.write(f"\n{host.peak_memory()}\n")
    raise SystemExit(code)
