"""Datasets of many scans: planning holds no file open, reads each recipe once, and runs need a handful of files."""

import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest

from ctsim.benchmarks import methods
from ctsim.benchmarks.studies.methods import plan, records
from ctsim.benchmarks.studies.methods import study as cli_run
from ctsim.dataset.manifest import INDEX, MANIFEST
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError

LIMIT = 64  # open files; the interpreter and its libraries need a dozen


def copies(smallest: Path, data: Path, n: int) -> Path:
    """Make a dataset of n scans that share their files."""
    source, lines = list_scans(smallest)[0], []
    data.mkdir()
    for k in range(n):
        name = f"s{k:04d}"
        folder = Path(shutil.copytree(source, data / name, copy_function=os.link))
        manifest = msgspec.json.decode((source / MANIFEST).read_bytes())
        manifest |= {"name": name, "content_hash": hashlib.sha256(name.encode()).hexdigest()}
        (folder / MANIFEST).unlink()
        (folder / MANIFEST).write_bytes(msgspec.json.encode(manifest))
        lines.append(msgspec.json.encode({k: manifest[k] for k in ("name", "scene_id", "content_hash")}))
    (data / INDEX).write_bytes(b"\n".join(lines) + b"\n")
    return data


@pytest.fixture(scope="module")
def many(smallest, tmp_path_factory) -> Path:
    """100 scans, of which four open files each would be 400."""
    return copies(smallest, tmp_path_factory.mktemp("many") / "data", 100)


def limited(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Call run-benchmark in a process that may open no more than LIMIT files."""
    return subprocess.run(
        [sys.executable, "-c", "import sys; from ctsim.benchmarks.cli import run_benchmark; sys.exit(run_benchmark())"]
        + [str(a) for a in arguments],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (LIMIT, LIMIT)),
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_planning_and_running_need_few_files_however_many_scans_there_are(many, tmp_path):
    planned = limited(many, tmp_path / "results", "--method", "fdk", "--dry-run")
    assert planned.returncode == 0 and "200 of 200 runs" in planned.stdout, planned.stderr
    asked = [word for k in range(0, 100, 5) for word in ("--scene", f"s{k:04d}")]
    done = limited(many, tmp_path / "results", "--method", "fdk", "--no-keep-volumes", *asked)
    assert done.returncode == 0, done.stderr
    assert [r.status for r in records.read(tmp_path / "results")] == ["ok"] * 40


def test_planning_opens_nothing_and_reads_every_recipe_once(many, monkeypatch, tmp_path):
    read = []
    loads = tomllib.loads
    monkeypatch.setattr(tomllib, "loads", lambda text: read.append(text) or loads(text))
    before = len(os.listdir("/proc/self/fd"))
    scans = [open_scan(folder) for folder in list_scans(many)]
    listed = plan.jobs(scans, [methods.find(name) for name in ("fdk", "limar", "nmar")], anchor=True)
    assert len(plan.pending([job.task for job in listed], [], tmp_path)) == 600
    assert len({job.task.identity for job in listed}) == 600
    assert len(os.listdir("/proc/self/fd")) == before and len(read) == 100


def test_a_scene_that_is_not_there_is_one_line(many):
    given = cli_run.Flags(data=many, results=many, scene=("s0007x",))
    with pytest.raises(InputError, match=r"'s0007x': .* has 100, nearest s0007,") as caught:
        cli_run._scans(given)
    assert len(str(caught.value)) < 300
    with pytest.raises(InputError, match="has 100, such as s0000,"):
        cli_run._scans(cli_run.Flags(data=many, results=many, scene=("lung",)))
