"""What is written for others ends whole, or with one sentence and nothing left, where the system takes no more."""

import subprocess
import sys
from pathlib import Path

import pytest

from ctsim.benchmarks.export.scans import LAYOUTS

LIMITED = """
import resource, sys
from ctsim.benchmarks.cli import make_dataset
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # Python ignores the signal, so that writing itself fails
sys.exit(make_dataset())
"""
FORMATS = {"nifti": ".nii", "mha": ".mha", "dicom": ""} | {name: layout.file for name, layout in LAYOUTS.items()}


def limited(limit, *words) -> str:
    """Run make-dataset with a limit on the size of any file; return the one sentence that it ends with."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(limit), *map(str, words)],
        capture_output=True, text=True, cwd=Path(__file__).parents[1], timeout=300, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    lines = [line for line in done.stderr.split("\n") if line and not line.startswith("\r")]
    assert len(lines) == 1, done.stderr
    return lines[0]


@pytest.mark.parametrize("to", FORMATS)
def test_an_export_that_finds_no_room_leaves_nothing(smallest, tmp_path, to):
    out = tmp_path / "new" / f"one{FORMATS[to]}"
    assert limited(1000, "export", smallest / "smallest", out, "--to", to).endswith(f" export: {out}: File too large")
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize("limit", [1000, 20_000])
def test_a_shard_that_finds_no_room_leaves_nothing(smallest, tmp_path, limit):
    """At the first bytes, and within the arrays."""
    said = limited(limit, "shards", smallest, tmp_path / "out")
    assert said.endswith(f" shards: {tmp_path}/out/all-00000.h5: File too large")
    assert not (tmp_path / "out").exists()
