import dataclasses
import shutil

import msgspec
import numpy as np
import pytest
import torch
from conftest import SMALLEST

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.scores import judge, projection
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.projection import REGIONS, HeldOut, half_way, held_out, projection_score, with_floor
from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.benchmarks.studies.methods import heldout, records, run, study
from ctsim.dataset.store import list_scans, open_scan
from ctsim.geometry import Geometry
from ctsim.reconstruct.projector import forward

GEOMETRY = Geometry(
    dso=100.0, dsd=150.0, n_voxel=(5, 7, 11), d_voxel=(1.0, 1.0, 1.0), n_detector=(8, 12), d_detector=(1.5, 1.5),
    n_views=6,
)  # fmt: skip


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The smallest scan with the truth that the protocol simulates for itself."""
    folder = tmp_path_factory.mktemp("truth")
    truth = "\n[truth]\nnoise_free = true\nmono_kev = [50.0]\npaths = true\ntrace = true\n"
    (folder / "scene.toml").write_text(SMALLEST + truth, encoding="utf-8")
    assert make_dataset.main([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return open_scan(list_scans(folder / "data")[0])


def angles(**changes):
    found = half_way(msgspec.structs.replace(GEOMETRY, **changes))
    return found if isinstance(found, str) else found.angles_deg


def test_held_out_views_lie_half_way():
    assert angles() == pytest.approx((30, 90, 150, 210, 270, 330))
    assert angles(arc_deg=-360.0, start_deg=10.0) == pytest.approx((40, 100, 160, 220, 280, 340))
    # 180° in 6 views: nothing was scanned from 150° on
    assert angles(arc_deg=180.0) == pytest.approx((15, 45, 75, 105, 135))
    shuffled = (90.0, 0.0, 270.0, 360.0, 180.0, 450.0)  # two of them seen twice
    assert angles(angles_deg=shuffled) == pytest.approx((45, 135, 225, 315))
    many = angles(n_views=360)
    assert len(many) == projection.N_VIEWS and many[0] == 0.5 and many[-1] == 359.5


def test_no_view_that_a_method_saw_is_held_out():
    for n in (2, 3, 24, 37, 240):
        geometry = msgspec.structs.replace(GEOMETRY, n_views=n)
        held = half_way(geometry)
        apart = np.abs(held.angles[:, None] - geometry.angles[None])
        # half of the angle between two views, to the rounding of angles in degrees
        assert np.minimum(apart, 2 * np.pi - apart).min() == pytest.approx(np.pi / n, abs=1e-6)


def test_there_may_be_no_half_way():
    assert "single angle" in angles(n_views=1)
    assert "single angle" in angles(angles_deg=(5.0,) * 6)
    assert "poses" in angles(poses=tuple(map(tuple, GEOMETRY.pose_array().tolist())))


def test_the_simulated_truth_is_what_the_dataset_holds(stored, monkeypatch):
    """Asked for the scan's own views, it must give their stored truth."""
    own = (0, 5)
    some = tuple(float(np.degrees(stored.geometry.angles[k])) for k in own)
    views = msgspec.structs.replace(stored.geometry, n_views=2, angles_deg=some)
    monkeypatch.setattr(projection, "half_way", lambda geometry: views)
    held = held_out(stored)
    for k, view in enumerate(own):
        # both obey a tolerance of 1e-4 in P, with nodes chosen on other rays
        np.testing.assert_allclose(held.truths["noise_free"][k], stored.array("noise_free")[view], atol=2e-4)
        # linear in lengths: float32 sums of a few terms of 1
        np.testing.assert_allclose(held.truths["50kev"][k], stored.array("mono_50kev")[view], atol=2e-6)
        assert (held.regions["trace"][k] == (stored.array("trace")[view] > 0)).all()
        assert (held.regions["body"][k] == (stored.array("paths")[view].sum(0) > 0)).all()
    assert not (held.regions["outside"] & held.regions["trace"]).any() and held.regions["trace"].any()
    assert "2 views held out" in held.note


def test_linear_truths_are_those_of_the_references(stored):
    """The scan's references, projected, come close to their own line integrals and not to each other's."""
    held, truth = held_out(stored), truth_of(stored)
    own = {kind: projection_score(truth.references[kind], held).values for kind in ("effective", "50kev")}
    size = float(np.sqrt(np.mean(np.square(held.truths["effective"][held.regions["body"]]))))
    for kind, other in (("effective", "50kev"), ("50kev", "effective")):
        assert own[kind][f"{kind}/body"] < own[other][f"{kind}/body"]
        # voxels of a twelfth of the grid blur edges: a tenth of the typical line integral is what they may cost
        assert own[kind][f"{kind}/outside"] < 0.1 * size
    noted = with_floor(held, truth).note
    assert f"{own['effective']['effective/outside']:.4f} (effective)" in noted


def test_kept_views_are_those_that_were_simulated(stored, tmp_path):
    held = held_out(stored)
    assert heldout.kept(stored, tmp_path) is None
    heldout.keep(held, stored, tmp_path)
    found = heldout.kept(stored, tmp_path)
    assert (found.geometry, found.reference, found.note) == (held.geometry, held.reference, held.note)
    for own, again in ((held.truths, found.truths), (held.regions, found.regions)):
        assert own.keys() == again.keys()
        for name, array in own.items():
            assert array.dtype == again[name].dtype and np.array_equal(array, again[name])


def test_kept_views_of_other_data_code_or_protocols_do_not_count(stored, tmp_path, monkeypatch):
    heldout.keep(held_out(stored), stored, tmp_path)
    assert heldout.kept(dataclasses.replace(stored, content_hash="another"), tmp_path) is None
    for name, value in (("source_hash", lambda: "another"), ("VERSION", -1)):
        with monkeypatch.context() as patch:
            patch.setattr(heldout, name, value)
            assert heldout.kept(stored, tmp_path) is None
    path = heldout.path_of(stored, tmp_path)
    whole = path.read_bytes()
    for damaged in (b"", whole[:1000], whole[: len(whole) // 2], b"x" * 100):
        path.write_bytes(damaged)
        assert heldout.kept(stored, tmp_path) is None
    path.write_bytes(whole)
    assert heldout.kept(stored, tmp_path) is not None


def test_another_command_simulates_no_views_again(smallest, tmp_path, monkeypatch):
    made = []

    def counted(scan):
        made.append(scan.name)
        return held_out(scan)

    monkeypatch.setattr(judge, "held_out", counted)
    for method in ("fdk", "zero"):
        assert study.main([str(smallest), str(tmp_path), "--method", method]) == 0
        run._runner.cache_clear()  # as in a new process
    assert made == ["smallest"]
    found = [r.scores["projection"].values for r in records.read(tmp_path) if r.run.variant == records.METAL]
    assert len(found) == 2 and None not in {value for values in found for value in values.values()}


def held_double(volume, offsets):
    """Truth that lies above the projected volume by an offset in each region."""
    found = forward(torch.from_numpy(volume), GEOMETRY).numpy()
    trace = np.zeros(found.shape, bool)
    trace[:, 3:5, 4:6] = True
    outside = np.zeros(found.shape, bool)
    outside[:, :, 8:] = True
    lifted = found + np.where(trace, offsets[0], offsets[1]).astype(np.float32)
    return HeldOut(
        geometry=msgspec.structs.replace(GEOMETRY, angles_deg=tuple(np.degrees(GEOMETRY.angles).tolist())),
        truths={"noise_free": lifted, "effective": found, "50kev": lifted},
        regions={"body": trace | outside, "outside": outside, "trace": trace},
        reference="",
        note="",
    )


def test_scores_are_the_rmse_in_each_region():
    volume = np.random.default_rng(2).random(GEOMETRY.n_voxel).astype(np.float32)
    score = projection_score(volume, held_double(volume, (0.5, 0.1)))
    # the projections reach 8: float32 keeps their differences to 1e-6
    near = {"rel": 0, "abs": 2e-6}
    assert score.values["noise_free/trace"] == pytest.approx(0.5, **near)
    assert score.values["noise_free/outside"] == pytest.approx(0.1, **near)
    assert score.values["noise_free/trace:60.00deg"] == pytest.approx(0.5, **near)
    pixels = np.array([4.0, 8 * 4.0])
    assert score.values["50kev/body"] == pytest.approx(np.sqrt(pixels @ [0.25, 0.01] / pixels.sum()), **near)
    assert score.values["effective/body"] == 0 and score.n_voxels == 6 * 36
    spectral = projection_score(volume, held_double(volume, (0.5, 0.1)), np.zeros_like(volume))
    assert {k for k, v in spectral.values.items() if v != score.values[k]} == {f"50kev/{r}" for r in REGIONS}
    assert spectral.volume == "as returned; against 50 keV, read there"
    held = held_double(volume, (0.0, 0.0))
    empty = dataclasses.replace(held, regions=held.regions | {"trace": np.zeros_like(held.regions["trace"])})
    assert projection_score(volume, empty).values["noise_free/trace"] is None


def test_the_judge_projects_what_was_read_at_50_kev_too(stored):
    judge, (returned, other) = Judge.of(stored), truth_of(stored).references.values()
    found = judge.scores(returned, "metal", Twin(), other)["projection"]
    assert found == projection_score(returned, judge.views, other) != projection_score(returned, judge.views)


def test_a_scan_without_its_recipe_says_so(stored, tmp_path):
    folder = tmp_path / "scan"
    shutil.copytree(stored.folder, folder)
    copy = dataclasses.replace(stored, folder=folder)
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    cases = {
        "another geometry": text.replace("n_views = 12", "n_views = 14"),
        "cannot be simulated": text.replace('recipe = "validation"', 'recipe = "gone"'),
    }
    for words, changed in cases.items():
        assert changed != text
        (folder / "scene.toml").write_text(changed, encoding="utf-8")
        assert words in held_out(copy)
    (folder / "scene.toml").unlink()
    score = projection_score(np.zeros(stored.geometry.n_voxel, np.float32), held_out(copy))
    assert "without scene.toml" in score.note and set(score.values.values()) == {None}
