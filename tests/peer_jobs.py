"""What tests of `run-benchmark peers` let other interpreters do; imports nothing that takes time."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from ctsim.benchmarks.studies.peers.finding import Measurement


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
