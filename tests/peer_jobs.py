"""What tests of `run-benchmark peers` let other interpreters do; imports nothing that takes time."""

import sys
from pathlib import Path


def make_two_megabytes(words: list[str]) -> int:
    """Be make-dataset SUITE OUT: say something, write two megabytes."""
    sys.stdout.write("made\n")
    Path(words[1]).mkdir()
    (Path(words[1]) / words[0]).write_bytes(bytes(2_000_000))
    return 0
