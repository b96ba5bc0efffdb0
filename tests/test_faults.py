"""Killed at any moment, refused by a disk, given damaged files: nothing is lost, nothing is left half-written.

CTSIM_FAULTS is the number of kills, 8 where it is not set.
"""

import contextlib
import hashlib
import os
import random
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from engine_jobs import until
from forks import Forks, Run, running
from test_workers import records_of, scores, tables

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.studies.methods import records
from ctsim.dataset.folder import partial_of
from ctsim.dataset.manifest import list_scans, read_manifest, verify
from ctsim.dataset.tiffstack import map_array

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("CTSIM_FAULTS", "8"))
VIEWS = 12
LONG = 300  # views of scenes that are written for a while
SUITE = f"""
[defaults.scanner]
n_views = {VIEWS}
n_detector = [10, 12]
n_voxel = [10, 14, 22]
[defaults.phantom]
recipe = "validation"
n_voxel = [16, 16, 16]

[[scene]]
name = "rods"

[[scene]]
name = "bare"
phantom = {{ metal = "none" }}
"""

PRELOAD = """
from pathlib import Path

from ctsim.dataset.writer import SceneWriter
from forks import die_after, note_every_view

note_every_view(SceneWriter)
die_after(SceneWriter, {view}, Path({mark!r}))  # Dask runs this file twice, which does no harm
"""


class Bench:
    """The two commands on a tiny suite, what they make undisturbed, and the process that forks."""

    def __init__(self, forks: Forks, folder: Path) -> None:
        self.forks, self.data, self.results = forks, folder / "data", folder / "results"
        self.suite = folder / "suite.toml"
        self.suite.write_text(SUITE, encoding="utf-8")
        first = [self.make(self.data, here=True), self.score(self.results, here=True)]
        assert [run.code for run in first] == [0, 0], first
        self.made, self.scored = self.make(folder / "data2"), self.score(folder / "results2")

    def make(self, data: Path, *flags: str, **how) -> Run:
        return self.forks.run("make-dataset", self.suite, data, *flags, **how)

    def score(self, results: Path, *flags: str, data: Path | None = None, **how) -> Run:
        asked = ("--scene", "rods", "--method", "fdk", "--method", "limar")
        return self.forks.run("run-benchmark", data or self.data, results, *asked, *flags, **how)

    def same_data(self, data: Path) -> bool:
        """Check that a dataset is this one: every checksum, the index, and no file beside."""
        assert verify(data) == []
        assert (data / "index.jsonl").read_bytes() == (self.data / "index.jsonl").read_bytes()
        assert names(data) == names(self.data)
        return True

    def same_results(self, results: Path) -> bool:
        """Check that results are these: every run once, equal scores, tables and volumes, and no file beside."""
        assert scores(results) == scores(self.results)
        assert tables(results) == tables(self.results)
        assert names(results) - {"records.torn"} == names(self.results)
        for path in (self.results / "volumes").iterdir():
            assert digest(results / "volumes" / path.name) == digest(path), path
        return True


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Iterator[Bench]:
    with Forks() as forks:
        yield Bench(forks, tmp_path_factory.mktemp("bench"))


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def moment(rng: random.Random, whole: Run) -> dict:
    """Choose when to kill: at a share of the time or at one of the changes of files that the whole run takes."""
    if rng.random() < 0.5:
        return {"seconds": rng.random() * whole.seconds}
    return {"change": rng.randint(1, whole.changes)}


def survive(run, whole: Run, kills: int, check) -> None:
    """Kill and resume `run(k, **how)` until that many kills have hit; `check(k)` each time that it came to its end."""
    rng, hit, k = random.Random(20261121), 0, 0
    while hit < kills:
        ended = run(k, **moment(rng, whole))
        assert ended.code in (0, -9), ended.said
        hit += ended.code == -9
        if ended.code == 0:
            check(k)
            k += 1
    assert run(k).code == 0
    check(k)


def test_make_dataset_survives_kills(bench, tmp_path):
    survive(
        lambda k, **how: bench.make(tmp_path / f"data{k}", **how),
        bench.made,
        KILLS - KILLS // 2,
        lambda k: bench.same_data(tmp_path / f"data{k}"),
    )


def test_make_dataset_goes_on_within_a_scene_that_it_was_killed_in(bench, tmp_path):
    view = (VIEWS // 2, str(tmp_path / "mark"))
    ended = [bench.make(tmp_path / "data", view=view).code for _ in range(2)]
    assert ended == [-9, 0] and bench.same_data(tmp_path / "data")
    assert (tmp_path / "mark").read_text().split() == [str(VIEWS // 2 + 1), "0"]  # the second scene is begun anew


def test_make_dataset_survives_kills_while_it_makes_scenes_again(bench, tmp_path):
    data = Path(shutil.copytree(bench.data, tmp_path / "data"))
    rng = random.Random(7)
    whole = bench.make(data, "--force")
    for _ in range(max(5, KILLS // 10)):
        bench.make(data, "--force", **moment(rng, whole))
        assert not [p for p in verify(data) if "unfinished" not in p and "not in index" not in p]
        assert (bench.make(data).code, bench.make(data, "--force").code) == (0, 0)
        assert bench.same_data(data)


def views_written(data: Path, whole: Path) -> int:
    """Return how many views the unfinished scene that is farthest on has on the disk; the same, whole, lies in `whole`.

    No view has only counts of 0.
    """
    most = 0
    for scene in list_scans(whole):
        entry = read_manifest(scene).files["counts.tif"]
        assert entry.shape and entry.dtype and entry.offset
        with contextlib.suppress(OSError, ValueError):  # it is not begun, or just finished
            counts = map_array(partial_of(data, scene.name) / "counts.tif", entry.shape, entry.dtype, entry.offset)
            most = max(most, int(counts.any((1, 2)).sum()))
    return most


def test_make_dataset_survives_kills_of_a_clusters_workers(bench, tmp_path):
    """Each time that a random number of views is written, one of the workers is killed, whatever it does.

    One is killed when it has noted a view, so that another goes on from there.
    """
    import dask.config
    from distributed import LocalCluster

    suite, data, kills, ended = tmp_path / "suite.toml", tmp_path / "data", [], threading.Event()
    preload, mark = tmp_path / "preload.py", tmp_path / "mark"
    preload.write_text(PRELOAD.format(view=LONG // 2, mark=str(mark)), encoding="utf-8")
    suite.write_text(SUITE.replace(f"n_views = {VIEWS}", f"n_views = {LONG}"), encoding="utf-8")
    whole = tmp_path / "whole"
    assert bench.forks.run("make-dataset", suite, whole).code == 0
    dask.config.set({"distributed.deploy.lost-worker-timeout": "10m"})  # 15 s are too few on a busy machine
    dask.config.set({"distributed.scheduler.allowed-failures": 100})  # as many as we like

    def kill() -> None:
        rng = random.Random(20261121)
        for _ in range(max(2, KILLS // 25)):
            after = rng.randrange(LONG // 2)
            while views_written(data, whole) <= after:
                if ended.wait(0.002):
                    return
            kills.append(rng.choice([nanny.pid for nanny in cluster.workers.values() if nanny.pid]))
            with contextlib.suppress(ProcessLookupError):  # it was killed before, and its nanny has not seen it yet
                os.kill(kills[-1], signal.SIGKILL)
            time.sleep(0.1)  # else all are killed for one count

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        silence_logs="CRITICAL",
        preload=[str(preload)],
    ) as cluster:
        killer = threading.Thread(target=kill)
        killer.start()
        try:
            code = make_dataset.main([str(suite), str(data), "--scheduler", cluster.scheduler_address])
        finally:
            ended.set()
            killer.join()
    assert code == 0 and kills
    assert verify(data) == [] and names(data) == names(whole)
    assert (data / "index.jsonl").read_bytes() == (whole / "index.jsonl").read_bytes()
    for path in (path for path in whole.rglob("*.*") if path.name not in ("plan.json", "manifest.json")):
        assert digest(data / path.relative_to(whole)) == digest(path), path
    assert str(LONG // 2 + 1) in mark.read_text().split()


def test_run_benchmark_survives_kills(bench, tmp_path):
    survive(
        lambda k, **how: bench.score(tmp_path / f"results{k}", **how),
        bench.scored,
        KILLS // 2,
        lambda k: bench.same_results(tmp_path / f"results{k}"),
    )


def test_run_benchmark_with_workers_survives_kills(bench, tmp_path):
    """The command or one of its workers is killed, or Ctrl-C is heard; then the same command ends well."""
    rng, hits = random.Random(20261123), 0
    whole = bench.score(tmp_path / "whole", "--workers", "2")
    assert whole.code == 0 and bench.same_results(tmp_path / "whole")
    for k in range(3 * max(1, KILLS // 24)):
        results = tmp_path / f"results{k}"
        target = ("command", "worker", "interrupt")[k % 3]
        ended = bench.score(results, "--workers", "2", seconds=0.7 * rng.random() * whole.seconds, target=target)
        hits += ended.hit
        assert ended.code in {"command": (0, -9), "worker": (0,), "interrupt": (0, 130)}[target], ended.said
        assert "Traceback" not in ended.said, ended.said
        until(lambda at=results: not running(at))
        assert ended.code or bench.same_results(results)  # a worker that died was replaced
        path = results / records.NAME
        kept = path.read_bytes() if path.exists() else b""
        assert bench.score(results, "--workers", "2").code == 0 and bench.same_results(results)
        assert path.read_bytes().startswith(kept[: kept.rfind(b"\n") + 1])  # nothing was lost, or measured again
    assert hits >= 2 * max(1, KILLS // 24)  # a run may end before its moment


def test_no_worker_outlives_a_run_benchmark_that_is_killed(bench, tmp_path):
    results, waits = tmp_path / "results", tmp_path / "results.waits"
    asked = (bench.data, results, "--scene", "rods", "--method", "forks:patient", "--workers", "2")
    assert bench.forks.run("run-benchmark", *asked, seconds=0, begun=str(waits)).code == -9
    until(lambda: not running(results))
    assert bench.forks.run("run-benchmark", *asked).code == 0
    found, fdk = (
        {r.run.variant: r.scores for r in records_of(f) if "limar" not in r.label} for f in (results, bench.results)
    )
    assert found == fdk and len(found) == 2


@pytest.mark.parametrize("kilobytes", [8, 32, 56, 80])
def test_a_full_disk_is_one_sentence_and_loses_nothing(bench, tmp_path, kilobytes):
    for name, run, same in (
        ("make-dataset", bench.make, bench.same_data),
        ("run-benchmark", bench.score, bench.same_results),
    ):
        folder = tmp_path / name
        folder.mkdir()
        ended = run(folder, disk=(str(folder), kilobytes * 1024))
        refused(ended, f"{name}: {folder}", "disk is full|No space left|File too large")
        left = Path(f"{folder}.left")
        again = run(left if left.exists() else folder)
        assert again.code == 0 and same(left if left.exists() else folder), again.said


def refused(ended: Run, begins: str, says: str) -> None:
    """Check for exit code 2 and one sentence of the user's; a progress bar may stand before it."""
    last = ended.said.rstrip("\n").rpartition("\n")[2]
    assert ended.code == 2 and "Traceback" not in ended.said, ended.said
    assert last.startswith(begins) and re.search(says, last), ended.said


def test_a_folder_that_cannot_be_written_is_one_sentence(bench, tmp_path):
    tmp_path.chmod(0o555)
    try:
        refused(bench.make(tmp_path / "data", powerless=True), f"make-dataset: {tmp_path}", "Permission denied")
        refused(bench.score(tmp_path / "results", powerless=True), f"run-benchmark: {tmp_path}", "Permission denied")
    finally:
        tmp_path.chmod(0o755)
    results = Path(shutil.copytree(bench.results, tmp_path / "results"))
    (results / "records.jsonl").chmod(0o444)
    ended = bench.score(results, "--force", powerless=True)
    refused(ended, f"run-benchmark: {results}/records.jsonl", "Permission denied")
    assert scores(results) == scores(bench.results)


def test_a_dataset_that_cannot_be_written_can_be_scored(bench, tmp_path):
    data = Path(shutil.copytree(bench.data, tmp_path / "data"))
    for path in (data, *data.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    assert bench.score(tmp_path / "results", data=data, powerless=True).code == 0
    assert bench.same_results(tmp_path / "results")


def test_a_complete_dataset_that_cannot_be_written_is_complete(bench, tmp_path):
    data = Path(shutil.copytree(bench.data, tmp_path / "data"))
    for path in (data, *data.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    for flags in ([], ["--dry-run"], ["--workers", "2"]):
        ended = bench.make(data, *flags, powerless=True)
        assert ended.code == 0 and ended.said.count("already complete") == 2, ended.said
    assert bench.forks.run("make-dataset", "--verify", data, powerless=True).code == 0
    data.chmod(0o755)
    (data / ".rods.partial").mkdir()  # of --force; it cannot be removed, so it is named
    data.chmod(0o555)
    ended = bench.make(data, powerless=True)
    assert ended.code == 0 and ".rods.partial: an unfinished replacement" in ended.said
    data.chmod(0o755)


def test_a_complete_dataset_on_a_full_disk_is_complete(bench, tmp_path):
    folder = Path(shutil.copytree(bench.data, tmp_path / "data"))  # for where there is no disk, but a limit
    ended = bench.make(folder, disk=(str(folder), 2**20), holds=str(bench.data))
    assert ended.code == 0 and ended.said.count("already complete") == 2, ended.said


def test_a_cut_last_record_is_measured_again(bench, tmp_path):
    results = Path(shutil.copytree(bench.results, tmp_path / "results"))
    path = results / records.NAME
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    ended = bench.score(results)
    assert ended.code == 0 and "cut short" in ended.said
    assert bench.same_results(results)


def cut_inner_record(data: Path, results: Path) -> str:
    path = results / records.NAME
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([lines[0][:99], *lines[1:]]) + b"\n")
    return "records.jsonl, line 1: expected a record"


def lose_counts(data: Path, results: Path) -> str:
    (data / "rods/counts.tif").unlink()
    return "rods/counts.tif: missing"


def shorten_counts(data: Path, results: Path) -> str:
    os.truncate(data / "rods/counts.tif", 100)
    return "rods/counts.tif: truncated, 100 bytes"


def cut_manifest(data: Path, results: Path) -> str:
    os.truncate(data / "rods/manifest.json", 99)
    return "rods/manifest.json: damaged"


def damage_index(data: Path, results: Path) -> str:
    (data / "index.jsonl").write_bytes(b'{"name": "ro\n' + (data / "index.jsonl").read_bytes())
    return "index.jsonl: line 1 is damaged"


def damage_scan(data: Path, results: Path) -> str:
    (data / "rods/scan.json").write_bytes(b"\xff" * (data / "rods/scan.json").stat().st_size)
    return "rods/scan.json: damaged"


def lose_scene(data: Path, results: Path) -> str:
    shutil.rmtree(data / "rods")
    return "'rods' but its folder is missing"


def shorten_volume(data: Path, results: Path) -> str:
    (path,) = (results / "volumes").glob("rods__fdk.tif")
    os.truncate(path, path.stat().st_size // 2)
    return "volumes/rods__fdk.tif"


def lose_volume(data: Path, results: Path) -> str:
    (results / "volumes/rods__fdk.tif").unlink()
    return ""  # only its row of the picture is lost


DAMAGES = [
    cut_inner_record, lose_counts, shorten_counts, cut_manifest, damage_index, damage_scan, lose_scene, shorten_volume,
    lose_volume,
]  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_one_sentence(bench, tmp_path, damage):
    data = Path(shutil.copytree(bench.data, tmp_path / "data"))
    results = Path(shutil.copytree(bench.results, tmp_path / "results"))
    says = damage(data, results)
    ended = bench.score(results, data=data)
    if not says:
        assert ended.code == 0
        return
    refused(ended, "run-benchmark: ", re.escape(says))
    sound = bench.forks.run("make-dataset", "--verify", data).code == 0
    assert sound == (damage in (cut_inner_record, shorten_volume))  # what is wrong with the data, --verify finds too


def test_a_flipped_bit_is_found_by_verify_and_mended_by_force(bench, tmp_path):
    data = Path(shutil.copytree(bench.data, tmp_path / "data"))
    path = data / "rods/counts.tif"
    pixels = bytearray(path.read_bytes())
    pixels[len(pixels) // 2] ^= 16
    path.write_bytes(pixels)
    refused(bench.forks.run("make-dataset", "--verify", data), str(path), "changed")
    assert bench.make(data, "--force", "--only", "rods").code == 0 and bench.same_data(data)
