import msgspec
import numpy as np
import pytest

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.engine.record import Store
from ctsim.benchmarks.scores.score import VERSION
from ctsim.benchmarks.studies.methods.records import FILE, NAME, WHAT, RunRecord, read
from ctsim.benchmarks.studies.methods.study import main as run_benchmark
from ctsim.benchmarks.studies.methods.volumes import read_volume, write_volume
from ctsim.benchmarks.tools import rescore
from ctsim.errors import InputError

SCENE = """
name = "rods"
phantom = { recipe = "metal_rods", n_voxel = [33, 33, 33] }
scanner = { n_voxel = [24, 24, 24], n_detector = [32, 32], n_views = 24 }
"""


@pytest.fixture
def folders(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    data, results = tmp_path / "data", tmp_path / "results"
    assert make_dataset.main([str(tmp_path / "scene.toml"), str(data)]) == 0
    assert run_benchmark([str(data), str(results), "--method", "fdk", "--method", "limar"]) == 0
    return data, results


def as_before(results, change, back=1):
    """Make all records those of a version before, with other scores, and their volumes those of these runs."""
    records = []
    for record in read(results):
        task = msgspec.structs.replace(record.task, version=VERSION - back)
        found = msgspec.structs.replace(record.found[0], scores={})
        path = results / record.volume
        write_volume(path, read_volume(path), task.identity if change(record) else "another run")
        records.append(msgspec.structs.replace(record, task=task, found=(found,)))
    (results / NAME).unlink()
    Store(results, FILE, RunRecord, WHAT).append(records)


@pytest.mark.slow
def test_kept_volumes_are_scored_as_the_runs_were(folders, capsys):
    data, results = folders
    known = {record.identity: record for record in read(results)}
    as_before(results, lambda record: True)
    assert rescore.main([str(results), str(data)]) == 0
    again = [record for record in read(results) if record.task.version == VERSION]
    assert len(again) == len(known) == 4
    for record in again:
        first = known[record.identity]
        assert record.scores == first.scores and record.cost == first.cost and record.time == first.time
        assert set(record.details) - set(first.details) == {rescore.AGAIN}
        assert np.array_equal(read_volume(results / record.volume), read_volume(results / first.volume))
    capsys.readouterr()
    assert run_benchmark([str(data), str(results), "--method", "fdk", "--method", "limar"]) == 0
    assert len(read(results)) == 8  # the methods need not run
    assert rescore.main([str(results), str(data)]) == 0 and len(read(results)) == 8


@pytest.mark.slow
def test_protocols_that_are_not_named_keep_their_scores(folders):
    data, results = folders
    known = {(r.label, r.task.part): r.scores for r in read(results)}
    as_before(results, lambda record: True)
    assert rescore.main([str(results), str(data), "soft", "metal"]) == 0
    for record in (r for r in read(results) if r.task.version == VERSION):
        scores = known[record.label, record.task.part]
        assert record.scores == {name: scores[name] for name in ("soft", "metal") if name in scores}
    as_before(results, lambda record: True, back=2)  # other protocols may have changed in between
    assert rescore.main([str(results), str(data), "soft"]) == 1
    assert not [r for r in read(results) if r.task.version == VERSION]
    assert rescore.main([str(results), str(data)]) == 0
    with pytest.raises(InputError, match="'sofft': expected protocols among"):
        rescore.main([str(results), str(data), "sofft"])


@pytest.mark.slow
def test_a_volume_that_is_another_runs_is_not_scored(folders, capsys):
    data, results = folders
    as_before(results, lambda record: record.label != "limar" or record.task.part == "metal")
    assert rescore.main([str(results), str(data)]) == 1
    assert "limar, metal_free: the run's volume is not in" in capsys.readouterr().err
    again = {(r.label, r.task.part): r for r in read(results) if r.task.version == VERSION}
    assert len(again) == 3 and "not to be reconstructed" in again["limar", "metal"].scores["artefact"].note
    (data.parent / "other.toml").write_text(SCENE.replace("metal_rods", "validation"), encoding="utf-8")
    assert make_dataset.main([str(data.parent / "other.toml"), str(data.parent / "other")]) == 0
    assert rescore.main([str(results), str(data.parent / "other")]) == 1
    assert "the scan is not in" in capsys.readouterr().err
