"""The metal-free twin: run by the same method with the same parameters, kept, and never another's."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from run_records import run_jobs
from test_run import GEOMETRY, Double

from ctsim.benchmarks import methods
from ctsim.benchmarks.engine.record import encoded
from ctsim.benchmarks.scores.score import COLUMNS, NO_TWIN, NOT_ASKED
from ctsim.benchmarks.studies.methods import attempt, plan, records
from ctsim.benchmarks.studies.methods.volumes import identity_of, map_volume, read_volume, write_volume
from ctsim.errors import InputError
from ctsim.materials import attenuation
from ctsim.types import Scan, Volume


@dataclasses.dataclass(frozen=True)
class Pair(Double):
    """A scan of 1000 counts a pixel; its twin, which has no twin, has 900."""

    level: int = 1000

    @property
    def scan(self):
        counts = torch.full(GEOMETRY.shape, self.level, dtype=torch.uint16)
        return Scan(geometry=GEOMETRY, counts=counts, flat=torch.full(GEOMETRY.n_detector, 2000.0))


def pair(folder: Path | str) -> Pair:
    folder = Path(folder)
    (folder / "spectrum.csv").write_text("energy_kev,photon_fraction,signal_fraction\n60.0,1,1\n")
    return Pair(folder=folder, name="box", metal_free=Pair(folder=folder, name="box", level=900))


def counted(scan, *, device, scale=1e-5):
    """The volume is the mean count times `scale`, everywhere."""
    mean = float(scan.counts.to(torch.float32).mean())
    return Volume(values=torch.full(scan.geometry.n_voxel, mean * scale))


def unhappy(scan, *, device):
    """Fails on the twin only."""
    if int(scan.counts[0, 0, 0]) == 900:
        raise RuntimeError("nothing to correct")
    return Volume(values=torch.full(scan.geometry.n_voxel, 0.01))


def do(folder, *, name="counted", scales=(1e-5,), **options):
    """Run what is missing; return the tasks that were run as (variant, scale) and the records."""
    overrides = [{} if name != "counted" else {"scale": s} for s in scales]
    found = [methods.find(f"test_twins:{name}", o) for o in overrides]
    listed = {job.task.identity: job for job in plan.jobs([pair(folder)], found, anchor=options.get("anchor", True))}
    listed = {k: dataclasses.replace(job, open="test_twins:pair") for k, job in listed.items()}
    left = plan.pending([job.task for job in listed.values()], records.read(folder), folder)
    jobs = [listed[task.identity] for task in left]
    return [(j.variant, j.method.params.get("scale")) for j in jobs], run_jobs(jobs, folder, **options)


def test_the_twin_is_reconstructed_first_and_compared_in_hu(tmp_path):
    did, (_, record) = do(tmp_path)
    assert did == [("metal_free", 1e-5), ("metal", 1e-5)]
    # 100 counts times 1e-5 1/mm; float32 volumes of 0.01 round to 1e-7 of it, the difference to 1e-6
    expected = 1000 * 100e-5 / attenuation("water", np.array([60.0]))[0]
    score = record.scores["artefact"]
    assert score.values["rmse_near"] == pytest.approx(expected, rel=2e-6)
    assert "1/mm" in score.note and score.reference.startswith("the metal-free scan")


def test_methods_with_other_parameters_have_twins_of_their_own(tmp_path):
    scales = (1e-5, 3e-5)
    did, done = do(tmp_path, scales=scales)
    assert [v for v, _ in did] == ["metal_free", "metal"] * 2
    near = [r.scores["artefact"].values["rmse_near"] for r in done if r.run.variant == "metal"]
    assert near[1] / near[0] == pytest.approx(3, rel=5e-6)
    assert do(tmp_path, scales=scales)[0] == []


def test_the_twin_that_was_just_run_is_not_taken_for_anothers(tmp_path):
    found = [methods.find("test_twins:counted", {"scale": s}) for s in (1e-5, 3e-5)]
    a_twin, _, _, b_scan = plan.jobs([pair(tmp_path)], found, anchor=True)
    _, record = run_jobs([a_twin, b_scan], tmp_path, keep_volumes=False)
    assert record.scores["artefact"].note == NOT_ASKED
    assert set(record.scores["artefact"].values.values()) == {None}


def forget(folder, identity):
    """Take the record of a run out of the file, as if it had not been done."""
    path = folder / f"{records.FILE}.jsonl"
    kept = [record for record in records.read(folder) if record.identity != identity]
    path.write_bytes(encoded(kept))


def test_a_kept_twin_is_not_run_again(tmp_path):
    _, (twin, record) = do(tmp_path)
    forget(tmp_path, record.identity)
    did, (again,) = do(tmp_path)
    assert did == [("metal", 1e-5)] and again.scores == record.scores
    assert identity_of(tmp_path / twin.volume) == twin.identity


@pytest.mark.parametrize("spoil", ["another run's", "without a name", "gone", "not a volume"])
def test_what_is_not_the_twins_volume_is_not_taken_for_it(tmp_path, spoil):
    _, (twin, record) = do(tmp_path)
    forget(tmp_path, record.identity)
    path = tmp_path / twin.volume
    other = np.zeros(GEOMETRY.n_voxel, np.float32)
    if spoil == "gone":
        path.unlink()
    elif spoil == "not a volume":
        path.write_text("nothing")
    else:
        write_volume(path, other, record.identity if spoil == "another run's" else "")
    did, (_, again) = do(tmp_path)
    assert [v for v, _ in did] == ["metal_free", "metal"] and again.scores == record.scores


def test_without_kept_volumes_the_twin_is_run_beside_its_scan(tmp_path):
    _, (_, record) = do(tmp_path, keep_volumes=False)
    assert record.scores["artefact"].values["rmse_near"] > 0
    assert do(tmp_path, keep_volumes=False)[0] == []
    forget(tmp_path, record.identity)
    assert [v for v, _ in do(tmp_path, keep_volumes=False)[0]] == ["metal_free", "metal"]


def test_a_scan_scored_without_its_twin_is_done_again_when_the_twin_is_wanted(tmp_path):
    _, (record,) = do(tmp_path, anchor=False)
    assert record.scores["artefact"].note == NOT_ASKED
    assert do(tmp_path, anchor=False)[0] == []
    did, (_, again) = do(tmp_path)
    assert len(did) == 2 and again.scores["artefact"].values["rmse_far"] is not None
    assert do(tmp_path)[0] == [] and do(tmp_path, anchor=False)[0] == []


def test_a_twin_that_failed_is_named_and_tried_again(tmp_path):
    _, (twin, record) = do(tmp_path, name="unhappy")
    assert (twin.status, record.status) == ("error", "ok")
    score = record.scores["artefact"]
    assert set(score.values.values()) == {None} and "nothing to correct" in score.note
    assert [v for v, _ in do(tmp_path, name="unhappy")[0]] == ["metal_free", "metal"]


def test_a_skipped_twin_is_not_a_reason_to_repeat_the_scan(tmp_path, monkeypatch):
    def skip(scan):
        return "no metal" if int(scan.counts[0, 0, 0]) == 900 else None

    monkeypatch.setattr(sys.modules[__name__], "skip", skip, raising=False)
    _, (_, record) = do(tmp_path)
    assert "skipped: no metal" in record.scores["artefact"].note
    assert do(tmp_path)[0] == [("metal_free", 1e-5)]


def test_a_scan_without_a_twin_has_no_artefact_numbers(tmp_path):
    alone = dataclasses.replace(pair(tmp_path), metal_free=None)
    listed = plan.jobs([alone], [methods.find("test_twins:counted")], anchor=True)
    (record,) = run_jobs(listed, tmp_path)
    assert record.scores["artefact"].note == NO_TWIN
    assert set(record.scores["artefact"].values) == set(COLUMNS["artefact"])
    assert set(record.scores["artefact"].values.values()) == {None}
    assert plan.pending([job.task for job in listed], records.read(tmp_path), tmp_path) == []


def test_repetitions_are_seeds_of_one_scene(tmp_path):
    stored = dataclasses.replace(pair(tmp_path), name="box-s7")
    assert plan.repetition(stored) == ("box-s7", 3)
    (tmp_path / "scene.toml").write_text('name = "box-s7"\nseed = 7\n')
    assert plan.repetition(stored) == ("box", 7)
    assert plan.repetition(dataclasses.replace(stored, name="box-s17")) == ("box-s17", 7)
    for damaged in ("seed = ", "seed = 'x'", "seed = " + "9" * 5000, "seed = " + "[" * 3000 + "]" * 3000):
        (tmp_path / "scene.toml").write_text(damaged)
        with pytest.raises(InputError, match=r"scene\.toml"):
            plan.repetition(stored)
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"scene\.toml"):
        plan.repetition(stored)


def test_a_volume_that_cannot_be_read_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="no such volume"):
        read_volume(tmp_path / "v.tif")
    (tmp_path / "v.tif").write_text("x")
    with pytest.raises(InputError, match="TIFF"):
        read_volume(tmp_path / "v.tif")
    assert identity_of(tmp_path / "v.tif") is None


def test_a_volume_cut_short_anywhere_is_whole_or_one_sentence(tmp_path, caplog):
    caplog.set_level("CRITICAL", "tifffile")
    path = tmp_path / "v.tif"
    write_volume(path, np.ones((2, 3, 4), np.float32), "whose")
    whole = path.read_bytes()
    assert identity_of(path) == "whose"
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert identity_of(path) in ("whose", None)
        try:
            values = map_volume(path)
        except InputError as error:
            assert "cannot be read" in str(error)
        else:  # only what follows the voxels is missing
            assert values.shape == (2, 3, 4) and (values == 1).all()


def masked(scan, *, device, mask="oracle"):
    """The volume is 1 where the true mask is."""
    if scan.metal is None:
        raise RuntimeError("no mask was given")
    return Volume(values=scan.metal.to(torch.float32))


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
def test_the_true_mask_goes_to_methods_that_ask_for_it_and_is_empty_in_the_twin(tmp_path, isolate):
    twin, record = do(tmp_path, name="masked", isolate=isolate)[1]
    assert (twin.status, record.status, record.run.mask) == ("ok", "ok", "oracle")
    assert read_volume(tmp_path / twin.volume).max() == 0
    np.testing.assert_array_equal(read_volume(tmp_path / record.volume), pair(tmp_path).metal)
    assert pair(tmp_path).scan.metal is None


def test_warming_up_sees_the_metal(tmp_path):
    scan = attempt.scan_for(methods.find("test_twins:masked"), pair(tmp_path), "metal")
    small = attempt.tiny(scan)
    assert tuple(small.metal.shape) == small.geometry.n_voxel == (8, 14, 16)
    assert small.metal.sum() == scan.metal.sum() > 0


def heard(scan, *, device):
    """Remembers what it was called with."""
    CALLS.append((int(scan.counts[0, 0, 0]), scan.geometry.n_views))
    return Volume(values=torch.zeros(scan.geometry.n_voxel))


CALLS: list[tuple[int, int]] = []


def test_the_warm_up_is_on_the_scan_with_metal(tmp_path):
    CALLS.clear()
    do(tmp_path, name="heard")
    assert CALLS == [(1000, 6), (900, 6), (1000, 6)]  # warm-up, twin, scan; 6 views are all there are
