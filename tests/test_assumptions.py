import numpy as np
import pytest
from run_records import append, make_record

from ctsim.benchmarks.scores.score import Score
from ctsim.benchmarks.studies.methods.grids import coincide
from ctsim.benchmarks.suites import load
from ctsim.benchmarks.tools import assumptions
from ctsim.errors import InputError
from ctsim.phantoms.scene import build
from ctsim.reconstruct.splat.fast import Settings, finer
from ctsim.reconstruct.splat.metal import FINER
from ctsim.scaninfo import LabelGrid


def record(scene, method, psnr):
    score = Score(region="r", reference="e", alignment="none", data_range=0.03, n_voxels=9, values={"psnr3d": psnr})
    more = {
        "scene": scene,
        "scene_id": scene,
        "scan": scene,
        "place": (int(scene != "box-strict"), int(method != "fdk")),
    }
    return make_record(method, scores={"tissue": score}, **more)


def test_a_favour_is_a_difference_from_the_strict_scene(tmp_path, capsys):
    append(
        tmp_path,
        record("box-strict", "fdk", 20.0),
        record("box-filter", "fdk", 20.25),
        record("box-strict", "splat", 30.0),
    )
    assert assumptions.main([str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "| strict | 20.00 | 30.00 |" in text and "| filter | +0.25 | – |" in text
    (tmp_path / "docs").mkdir()
    assert assumptions.main([str(tmp_path), str(tmp_path / "docs")]) == 0
    assert (tmp_path / "docs" / "assumptions.md").read_text(encoding="utf-8") == text


def test_other_results_are_refused(tmp_path):
    append(tmp_path, record("box", "fdk", 20.0))
    with pytest.raises(InputError, match="run the suite assumptions first"):
        assumptions.main([str(tmp_path)])


@pytest.mark.parametrize("scene", load("assumptions"), ids=lambda scene: scene.name)
def test_a_scene_shares_the_grid_that_its_name_says(scene):
    geometry = scene.resolve().geometry
    splats = finer(geometry, Settings().fineness).n_voxel
    phantom = build(scene)
    labels = LabelGrid(n_voxel=phantom.labels.shape, d_voxel=phantom.d_voxel, off_origin=phantom.off_origin)
    favour = scene.name.split("-", 2)[2]
    assert coincide(splats, geometry, labels) == (favour in ("splat-grid", "ideal"))
    assert coincide(geometry.n_voxel, geometry, labels) == (favour == "volume-grid")
    assert np.all(np.greater(splats, geometry.n_voxel))


@pytest.mark.parametrize(
    ("suite", "of_splats", "of_volume"),
    [(name, True, False) for name in ("core", "core-scatter", "lookalike")]
    + [
        (name, False, False)
        for name in ("quick", "ablation", "neural", "beams", "scatter", "headline", "systems", "tune", "patient")
    ]
    + [("paper", False, True)],
)
def test_a_suite_shares_the_grid_that_its_description_says(suite, of_splats, of_volume):
    for scene in load(suite):
        geometry, phantom = scene.resolve().geometry, scene.phantom
        size = tuple(phantom.size / n for n in phantom.n_voxel)
        shift = tuple(s * d for s, d in zip(phantom.grid_shift, size, strict=True))
        labels = LabelGrid(n_voxel=phantom.n_voxel, d_voxel=size, off_origin=shift)
        splats = finer(geometry, Settings().fineness).n_voxel
        assert coincide(splats, geometry, labels) == of_splats
        if suite != "paper":  # a single pass there, without fine splats at the surface of metal
            assert coincide([FINER * n for n in splats], geometry, labels) == of_splats
        assert coincide(geometry.n_voxel, geometry, labels) == of_volume
