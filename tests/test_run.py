import dataclasses
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from run_records import run_jobs, run_methods

from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.scores import judge
from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.benchmarks.scores.score import NOT_ASKED
from ctsim.benchmarks.studies.methods import attempt, plan, records
from ctsim.benchmarks.studies.methods import study as cli_run
from ctsim.benchmarks.studies.methods.captions import caption
from ctsim.benchmarks.studies.methods.panels import PanelRow, cut, draw, write_panels
from ctsim.benchmarks.studies.methods.volumes import (
    at_50kev_of,
    attached,
    identity_of,
    intermediates_of,
    read_intermediates,
    read_volume,
    write_volume,
)
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.scaninfo import ScanInfo
from ctsim.types import Scan, Volume

GEOMETRY = Geometry(
    dso=100.0, dsd=150.0, n_voxel=(12, 14, 16), d_voxel=(1.0, 1.0, 1.0), n_detector=(18, 20), d_detector=(1.5, 1.5),
    n_views=6,
)  # fmt: skip


@dataclass(frozen=True)
class Double:
    """A stored scan held in memory."""

    folder: Path
    name: str
    metal_free: "Double | None" = None
    scene_id: str = "scene"
    content_hash: str = "hash"
    code: str = "v1"
    l0: float = 10.0
    kerma: float | None = 1.25
    phantom: str = "box"
    has_truth: bool = True
    split: str = ""

    @property
    def place(self):
        return str(self.folder)

    def text(self, name):
        path = self.folder / name
        return path.read_text(encoding="utf-8") if path.is_file() else None

    @property
    def info(self):
        return ScanInfo(geometry=GEOMETRY, dark=0.0, i0=1e5, e_max=90.0, l0=self.l0, seed=3, metal=("Fe",))

    @property
    def geometry(self):
        return GEOMETRY

    @property
    def scan(self):
        counts = torch.full(GEOMETRY.shape, 1000, dtype=torch.uint16)
        return Scan(geometry=GEOMETRY, counts=counts, flat=torch.full(GEOMETRY.n_detector, 2000.0))

    @property
    def labels(self):
        labels = np.zeros(GEOMETRY.n_voxel, np.uint8)
        labels[3:9, 3:11, 3:13] = 1
        return labels

    @property
    def metal(self):
        metal = np.zeros(GEOMETRY.n_voxel, np.uint8)
        metal[5:7, 6:8, 7:9] = 1
        return metal

    def reference(self, which):
        return np.where(self.metal, 0.3, 0.02 * self.labels).astype(np.float32)


def open_double(folder):
    return double(Path(folder))


TWIN = {"tissue", "aligned", "aligned_50kev", "soft", "structure"}
"""The protocols of a metal-free twin."""


def double(folder, twin=True):
    return Double(folder=folder, name="box", metal_free=Double(folder=folder, name="box") if twin else None)


def good(scan, *, device, level=0.018):
    shape = scan.geometry.n_voxel
    values = torch.zeros(shape)
    values[tuple(slice(n // 4, -n // 4) for n in shape)] = level
    return Volume(values=values, details={"view_updates": 12})


def nonfinite(scan, *, device):
    values = torch.zeros(scan.geometry.n_voxel)
    values[0, 0, :2] = float("nan")
    return Volume(values=values)


def misshapen(scan, *, device):
    return Volume(values=torch.zeros((2, 3, 4)))


def hungry(scan, *, device):
    raise MemoryError("no room for 1 TB")


def spectral(scan, *, device, flaw=None):
    """Know the attenuation at any energy, or return something else there."""
    at = {None: lambda kev: torch.full(scan.geometry.n_voxel, 1 / kev), "shape": lambda kev: torch.zeros(2, 3, 4)}
    at["nan"] = lambda kev: torch.full(scan.geometry.n_voxel, math.nan)
    at["hungry"] = lambda kev: hungry(scan, device=device)
    at["broken"] = lambda kev: broken(scan, device=device)
    at["slow"] = lambda kev: time.sleep(1) or torch.zeros(scan.geometry.n_voxel)
    return dataclasses.replace(good(scan, device=device), at_energy=at[flaw])


def broken(scan, *, device):
    raise RuntimeError("this is\nbroken")


def slow(scan, *, device):
    time.sleep(60)


def punctual(scan, *, device, seconds=None):
    time.sleep(0.2 if seconds is None else seconds)
    return good(scan, device=device)


CALLS = []


def compiling(scan, *, device, seconds=None):
    """Take three calls until nothing is left to compile, as a method that stops when its seconds are over."""
    CALLS.append(seconds)
    time.sleep(2.5 if len(CALLS) < 3 else 0)
    return good(scan, device=device)


def crash(scan, *, device):
    os._exit(7)


def once(name, results, stored=None, **options):
    """Run one method on a scan alone, without its twin."""
    method = methods.find(f"test_run:{name}")
    jobs = plan.jobs_on(stored or double(results), ("metal",), [(method, (0, 0))], "test_run:open_double")
    return run_jobs(jobs, results, anchor=False, **options)[0]


def test_a_run_is_scored_timed_kept_and_recorded(tmp_path):
    record = once("good", tmp_path)
    assert record.status == "ok" and record.run.seed == 3 and record.run.params == {"level": 0.018}
    assert record.data_code == "v1" and record.kerma == 1.25
    assert set(record.scores) == {*TWIN, "paper", "metal", "projection", "artefact"}
    assert "without scene.toml" in record.scores["projection"].note
    assert record.scores["artefact"].note == NOT_ASKED
    assert set(record.scores["artefact"].values.values()) == {None}
    assert record.cost.view_updates == 12 and record.cost.peak_bytes > 0 and not record.cost.isolated
    assert record.host.ram > 0 and record.time.endswith("+00:00")
    assert records.read(tmp_path) == [record]
    import tifffile

    assert tifffile.imread(tmp_path / record.volume).shape == GEOMETRY.n_voxel


@pytest.mark.parametrize(
    ("name", "status", "reason"),
    [
        ("nonfinite", "nonfinite", "2 of 2688 voxels"),
        ("misshapen", "error", "shape (2, 3, 4)"),
        ("hungry", "out_of_memory", "no room"),
        ("broken", "error", "RuntimeError: this is broken"),
    ],
)
def test_failures_have_a_status_and_a_reason(tmp_path, name, status, reason):
    record = once(name, tmp_path)
    assert (record.status, record.scores) == (status, {}) and reason in record.reason
    assert records.read(tmp_path) == [record]


@pytest.mark.slow
def test_isolated_runs_end_as_they_do_here(tmp_path):
    record = once("good", tmp_path, isolate=True)
    assert record.status == "ok" and record.cost.isolated and record.scores == once("good", tmp_path).scores
    record = once("crash", tmp_path, isolate=True)
    assert record.status == "error" and "exit code 7" in record.reason


def test_a_time_limit_is_a_status(tmp_path):
    record = once("slow", tmp_path, seconds=0.5)
    assert record.status == "timeout" and "0.5 s" in record.reason


@pytest.mark.slow
def test_a_method_that_can_be_told_its_seconds_ends_by_itself(tmp_path):
    told = methods.within(methods.find("test_run:punctual"), 0.5)
    assert told.label == "test_run:punctual[seconds=0.5]"
    jobs = plan.jobs_on(double(tmp_path), ("metal",), [(told, (0, 0))], "test_run:open_double")
    (record,) = run_jobs(jobs, tmp_path, anchor=False, seconds=0.5)  # less than a process has to start
    assert record.status == "ok" and record.cost.wall > 0.5
    mine = methods.find("test_run:punctual", {"seconds": 0.1})
    assert methods.within(mine, 0.5) == mine and methods.within(methods.find("fdk"), 0.5) == methods.find("fdk")


@pytest.mark.slow
def test_the_command_leaves_a_method_that_knows_its_seconds_the_time_to_end(smallest, tmp_path, monkeypatch, capsys):
    words = ("--method", "test_run:punctual", "--method", "test_run:slow", "--no-anchor", "--seconds", "0.5")
    assert command(monkeypatch, capsys, smallest, tmp_path, *words)[0] == 1
    found = {r.run.method: r for r in records.read(tmp_path)}
    assert {name: r.status for name, r in found.items()} == {"test_run:punctual": "ok", "test_run:slow": "timeout"}
    assert {r.inputs for r in found.values()} == {"counts only"}  # a class of its own would be another table


@pytest.mark.slow
def test_a_warm_up_goes_on_until_nothing_is_left_to_compile(tmp_path):
    CALLS.clear()
    seconds = attempt.warm_up(methods.find("test_run:compiling"), double(tmp_path).scan)
    assert CALLS == [attempt.WARM] * 3 and seconds > 4 * attempt.WARM


def test_a_rerun_does_only_what_is_missing(tmp_path):
    found = [methods.find(f"test_run:{n}") for n in ("good", "broken")]
    jobs = plan.jobs([double(tmp_path)], found, anchor=False)
    assert [r.status for r in run_jobs(jobs, tmp_path, anchor=False)] == ["ok", "error"]
    left = plan.pending([job.task for job in jobs], records.read(tmp_path), tmp_path)
    assert [task.subject for task in left] == ["test_run:broken"]
    other = plan.jobs([double(tmp_path)], [methods.find("test_run:good", {"level": 0.02})], anchor=False)
    assert plan.pending([job.task for job in other], records.read(tmp_path), tmp_path) == [other[0].task]


def test_two_scans_that_would_be_one_row_are_refused(tmp_path):
    """NAME with the seed 3, and NAME-s3 of make-dataset --seeds 3."""
    alone, repeated = double(tmp_path / "a"), dataclasses.replace(double(tmp_path / "b"), name="box-s3")
    assert plan.repetition(alone) == plan.repetition(repeated) == ("box", 3)
    with pytest.raises(InputError, match=r"/a and .*/b are the same scene and seed"):
        plan.jobs([alone, repeated], [methods.find("test_run:good")], anchor=False)


def test_a_scans_held_out_views_are_simulated_once(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(judge, "held_out", lambda stored: made.append(stored.content_hash) or "none here")
    scans = [double(tmp_path), dataclasses.replace(double(tmp_path), content_hash="another", name="other")]
    found = [methods.find("test_run:good", {"level": level}) for level in (0.018, 0.02)]
    jobs = [job for method in found for job in plan.jobs(scans, [method], anchor=False)]
    records = run_jobs(jobs, tmp_path, anchor=False)
    assert [r.run.scene for r in records] == [scan.name for scan in scans] * 2
    assert made == [scans[0].content_hash, "another"]
    assert {r.scores["projection"].note for r in records} == {"none here"}


def test_the_anchor_is_judged_in_the_region_of_the_metal_scan(tmp_path, monkeypatch):
    monkeypatch.setitem(methods.TABLE, "fdk", ("test_run:good", "counts only"))
    without, with_metal = run_methods([double(tmp_path)], [methods.find("fdk")], tmp_path)
    assert without.run.variant == "metal_free" and without.identity != with_metal.identity
    assert without.scores["tissue"] == with_metal.scores["tissue"]
    assert set(without.scores) == TWIN
    assert len(plan.jobs([double(tmp_path, twin=False)], [methods.find("fdk")], anchor=True)) == 1


def test_a_method_can_skip_with_a_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "skip", lambda scan: "no spectrum given", raising=False)
    record = once("good", tmp_path)
    assert (record.status, record.reason) == ("skipped", "no spectrum given")


def test_the_tiny_scan_keeps_slices_and_memory():
    scan = double(Path()).scan
    small = attempt.tiny(scan)
    assert small.geometry.n_voxel == (8, 14, 16) and small.geometry.d_voxel == scan.geometry.d_voxel
    assert small.counts.data_ptr() == scan.counts.data_ptr() and small.counts.stride() == scan.counts.stride()


def shows(scan, *, device, entries=("view", "trace", "projection", "prior")):
    g = scan.geometry
    trace = np.zeros(g.n_detector, bool)
    trace[6:9, 7:11] = True
    found = {"view": 1, "trace": trace, "projection": torch.full(g.n_detector, 0.7), "prior": torch.ones(g.n_voxel)}
    found["wide"] = np.zeros((3, 3))
    return Volume(values=good(scan, device=device).values, details={"intermediates": {k: found[k] for k in entries}})


class Odd:
    pass


def talks(scan, *, device):
    details = {
        "read-out": np.str_("at Ē = 1"), "misfit": np.float32(0.5), "loss": float("nan"), "on": np.bool_(True),
        "course": (1.0, float("inf"), np.int64(3)), "nothing": None, "empty": {},
        "response": {"eta": [0.25, 0.75], "table": np.ones(3), 7: "no word", "theta": []},
        "densities": {"rho_a": torch.ones(2, 3), "rho_b": np.ones((2, 3))}, "lists": [1, np.ones(3)],
        "object": Odd(), "complex": 1j, "long": "x" * 10_000, "half": "\ud800", "huge": 10**5000, "view_updates": 12,
    }  # fmt: skip
    return Volume(values=good(scan, device=device).values, details=details)


def kept(results, record):
    return read_intermediates(intermediates_of(results / record.volume), record.identity)


def images(figure):
    return [axes for axes in figure.axes if axes.images]


def test_panels_show_every_kept_volume(tmp_path):
    record = once("good", tmp_path)
    (path,) = write_panels([record], [double(tmp_path)], tmp_path)
    assert path.name == "box.png" and path.stat().st_size > 10_000
    assert cut(np.asarray(double(tmp_path).metal) > 0, np.ones(GEOMETRY.n_voxel, bool)) == (5, 6, 7)
    write_volume(tmp_path / record.volume, np.zeros(GEOMETRY.n_voxel, np.float32), "another run")
    assert write_panels([record], [double(tmp_path)], tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
def test_what_a_method_knows_of_50_kev_is_scored_there_and_kept(tmp_path, isolate):
    record, plain = once("spectral", tmp_path, isolate=isolate), once("good", tmp_path)
    assert record.status == "ok" and record.volume is not None
    own = read_volume(at_50kev_of(tmp_path / record.volume))
    assert (own == np.float32(1 / 50)).all() and identity_of(at_50kev_of(tmp_path / record.volume)) == record.identity
    assert {k for k in plain.scores if record.scores[k] != plain.scores[k]} == {"aligned_50kev", "paper"}
    error = double(tmp_path).reference("50kev") - own
    assert record.scores["paper"].values["rmse"] == pytest.approx(np.sqrt(np.mean(error.astype(np.float64) ** 2)))
    for protocol, said in (("paper", True), ("tissue", False)):
        assert ("; test_run:spectral read at 50 keV." in caption([record, plain], protocol)) == said
    assert not at_50kev_of(tmp_path / str(plain.volume)).exists()


def test_a_rerun_without_a_volume_at_50_kev_leaves_none_of_an_earlier_one(tmp_path, monkeypatch):
    kept = at_50kev_of(tmp_path / str(once("spectral", tmp_path).volume))
    assert kept == tmp_path / "volumes/50kev/box__test_run_spectral.tif" and kept.exists()
    monkeypatch.setattr(sys.modules[__name__], "spectral", good)
    assert once("spectral", tmp_path, force=True).status == "ok" and not kept.exists()


@pytest.mark.parametrize(
    ("flaw", "status"), [("shape", "error"), ("nan", "nonfinite"), ("hungry", "out_of_memory"), ("broken", "error")]
)
def test_a_volume_at_50_kev_that_is_none_is_the_runs_failure(tmp_path, flaw, status):
    method = methods.find("test_run:spectral", {"flaw": flaw})
    outcome = attempt.attempt(method, double(tmp_path).scan, 0.0)
    assert outcome.status == status and "volume at 50 keV" in outcome.reason
    assert outcome.at_50kev is None or status == "nonfinite"
    assert outcome.cost is not None and outcome.cost.view_updates == 12


def test_reading_at_50_kev_is_no_time_of_the_method(tmp_path):
    outcome = attempt.attempt(methods.find("test_run:spectral", {"flaw": "slow"}), double(tmp_path).scan, 0.0)
    assert outcome.status == "ok" and outcome.cost is not None and outcome.cost.wall < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
def test_what_a_method_worked_with_is_kept_beside_its_volume(tmp_path, isolate):
    record = once("shows", tmp_path, isolate=isolate)
    assert record.status == "ok" and record.cost.isolated == isolate
    found = kept(tmp_path, record)
    assert found["view"] == 1 and found["trace"].sum() == 12 and found["trace"].dtype == bool
    assert (found["projection"] == np.float32(0.7)).all() and (found["prior"] == 1).all()
    assert read_intermediates(tmp_path / "volumes" / "box__test_run_shows.npz", "another run") == {}
    assert kept(tmp_path, once("good", tmp_path)) == {}
    (tmp_path / "volumes" / "box__test_run_shows.npz").write_bytes(b"PK damaged")
    with pytest.raises(InputError, match="cannot be read"):
        kept(tmp_path, record)


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
def test_a_record_keeps_what_a_method_says_of_its_result(tmp_path, isolate):
    record = once("talks", tmp_path, isolate=isolate)
    assert record.status == "ok" and record.cost.isolated == isolate and record.cost.view_updates == 12
    assert record.details == {
        "read-out": "at Ē = 1", "misfit": 0.5, "loss": None, "on": True, "course": [1.0, None, 3], "nothing": None,
        "empty": {}, "response": {"eta": [0.25, 0.75], "theta": []},
    }  # fmt: skip
    assert records.read(tmp_path) == [record]
    assert once("broken", tmp_path, isolate=isolate).details == {}


def test_panels_hold_what_each_method_gave():
    stored = double(Path())
    truth = truth_of(stored)
    reference = truth.references["effective"]
    rows = [PanelRow(caption="fdk", volume=reference + np.float32(0.001))]
    plain = images(draw(stored, truth, rows))
    # the reference has two slices, the method two and their errors
    assert len(plain) == 2 + 4
    error = plain[4].images[0]
    assert np.ma.allclose(error.get_array(), 0.001, atol=1e-8) and error.get_array().mask.sum() == 4
    # errors are signed on one scale around 0; the window is 2.5 times the body's 0.02, whatever a method gave
    clims = np.array([a.images[0].get_clim() for a in plain])
    assert clims == pytest.approx(np.array([[0, 0.05]] * 4 + [[-0.02, 0.02]] * 2), abs=1e-8)
    found = attached(shows(stored.scan, device="cpu").details, GEOMETRY)
    all_axes = images(draw(stored, truth, [*rows, PanelRow(caption="nmar", volume=reference, shown=found)]))
    measured, bridged = (a for a in all_axes if a.images[0].get_array().shape == GEOMETRY.n_detector)
    assert np.allclose(measured.images[0].get_array(), np.log(2.0), atol=1e-6)  # 1000 counts of 2000
    assert np.allclose(bridged.images[0].get_array(), 0.7) and len(bridged.collections) == 1  # the trace's outline
    assert len(all_axes) == 2 + 4 + 4 + 2 + 1


@pytest.mark.parametrize(
    ("entries", "words"),
    [(("trace",), "needs its 'view'"), (("view", "wide"), "no entry 'wide'")],
)
def test_intermediates_that_cannot_be_drawn_are_an_error(tmp_path, entries, words):
    method = methods.find("test_run:shows", {"entries": entries})
    outcome = attempt.attempt(method, double(tmp_path).scan, 0.0)
    assert outcome.status == "error" and words in outcome.reason
    for wrong in ({"view": 6}, {"view": -1}, {"prior": np.zeros((2, 2, 2))}, {"view": 0, "trace": np.zeros((5, 5))}):
        with pytest.raises(InputError):
            attached({"intermediates": wrong}, GEOMETRY)


def command(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", *map(str, arguments)])
    code = cli.run_benchmark()
    return code, capsys.readouterr()


def use_double(monkeypatch):
    monkeypatch.setattr(cli_run, "_scans", lambda given: [double(given.data)])


def test_the_command_writes_tables_and_a_picture(tmp_path, monkeypatch, capsys):
    use_double(monkeypatch)
    code, said = command(monkeypatch, capsys, tmp_path, tmp_path / "r", "--method", "test_run:good")
    assert code == 0 and "(protocol tissue)" in said.out
    names = {p.relative_to(tmp_path / "r").as_posix() for p in (tmp_path / "r").rglob("*") if p.is_file()}
    assert {"records.jsonl", "table.md", "table.csv", "table.tex", "panels/box.png"} <= names
    code, said = command(monkeypatch, capsys, tmp_path, tmp_path / "r", "--table")
    assert code == 0 and "(protocol tissue)" in said.out
    code, _ = command(monkeypatch, capsys, tmp_path, tmp_path / "r", "--method", "test_run:broken")
    assert code == 1


def test_ctrl_c_keeps_the_records(tmp_path, monkeypatch, capsys):
    use_double(monkeypatch)

    def interrupted(scan, *, device):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules[__name__], "stop", interrupted, raising=False)
    code, said = command(
        monkeypatch, capsys, tmp_path, tmp_path, "--method", "test_run:good", "--method", "test_run:stop"
    )
    assert code == 130 and "interrupted" in said.err
    assert [r.status for r in records.read(tmp_path)] == ["ok", "ok"]  # the twin and the scan
    assert (tmp_path / "table.md").exists()


def test_bad_input_is_one_sentence_and_code_2(tmp_path, monkeypatch, capsys):
    for arguments in [
        (tmp_path / "nothing", tmp_path / "r"),
        (tmp_path, tmp_path / "r", "--method", "fkd"),
        (tmp_path, tmp_path / "r", "--method", "fdk", "--set", "x"),
        (tmp_path, tmp_path / "r", "--table"),
    ]:
        code, said = command(monkeypatch, capsys, *arguments)
        assert code == 2 and said.err.startswith("run-benchmark: ") and said.err.count("\n") == 1, said.err


def test_help_loads_nothing_heavy():
    script = (
        "import sys\nfrom ctsim.benchmarks.cli import run_benchmark\nsys.argv = ['run-benchmark', '--help']\n"
        "try:\n    run_benchmark()\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'numba', 'pandas', 'matplotlib', 'scipy', 'skimage'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--method" in done.stdout
