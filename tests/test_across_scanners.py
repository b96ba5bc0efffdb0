"""Tables that compare scanners on one object lead with HU, others with PSNR3D."""

import dataclasses
import re

import msgspec
import pytest
from run_records import changed, make_record
from test_tables import cells

from ctsim.benchmarks.scores.score import MAIN, MAIN_ACROSS, Score
from ctsim.benchmarks.studies.methods import overview, tables
from ctsim.benchmarks.studies.methods.captions import RANGES_DIFFER, across_scanners
from ctsim.benchmarks.studies.methods.records import Cost
from ctsim.dataset.store import open_scan

TUBES = {"mild": 0.030, "hard": 0.024}
"""Scenes and the range of their PSNR3D, 1/mm."""
OLDER = ""


def score(size=None, **values):
    return Score(region="r", reference="t", alignment="none", data_range=size, n_voxels=9, values=values)


def runs(sizes=TUBES, phantom="p", methods=("fdk", "splat")):
    """Records of scan and twin: the harder the beam, the smaller the error in HU, and the lower PSNR3D too."""
    found = []
    for scene, size in sizes.items():
        for k, method in enumerate(methods):
            hu = 40.0 * (size / 0.03) ** 4 - 5 * k
            scores = {
                "tissue": score(size, psnr3d=1000 * size - 1 + k, ssim3d=0.9, rmse=0.001),
                "soft": score(rmse=hu), "artefact": score(rmse=hu + 1),
                "structure": score(false_bone=0.1, false_air=0, false_bone_between=0.2, rmse_between=9.0),
            }  # fmt: skip
            cost = Cost(wall=1.5, cpu=2.5, peak_bytes=2**21, view_updates=60, device="cpu")
            more = {"scene": scene, "inputs": "counts only", "status": "ok", "cost": cost, "phantom": phantom}
            found.append(make_record(method, scores=scores, scan=scene, **more))
            clean = {"tissue": score(size, psnr3d=40.0, ssim3d=0.95, rmse=0.0005), "soft": score(rmse=10.0)}
            found.append(make_record(method, scores=clean, scan=scene, variant="metal_free", **more))
    return found


def titles(records):
    text = tables.render(records, "md")
    return cells(text, "| inputs")[2:], text


def test_hu_come_first_where_one_object_is_seen_by_several_scanners():
    shown, text = titles(runs())
    assert shown == [how.title for how in MAIN_ACROSS.values()]
    assert shown[:3] == ["soft tissue RMSE (HU)", "artefact RMSE (HU)", "cost of metal (HU)"]
    assert "same object to different scanners, so HU come first" in text and "(0.024 to 0.03 1/mm)" in text
    # of FDK behind the mild beam: 40 HU, 41 against its twin, 30 more than the twin's 10
    assert cells(text, "| counts only | fdk")[2:5] == ["<u>40.0</u>", "<u>41.0</u>", "<u>30.0</u>"]


@pytest.mark.parametrize(
    "records",
    [
        pytest.param(runs({"mild": 0.030}), id="one scene"),
        pytest.param(runs({"mild": 0.030, "low-dose": 0.030}), id="the same spectrum"),
        pytest.param(runs({"mild": 0.030, "alike": 0.030 / (0.99 * RANGES_DIFFER)}), id="nearly the same"),
        pytest.param(runs({"a": 0.03}, "p") + runs({"b": 0.024}, "q"), id="other objects"),
        pytest.param(runs() + runs({"head": 0.03}, "q"), id="and another object"),
        pytest.param(runs(phantom=OLDER), id="older records"),
        pytest.param(runs() + runs({"old": 0.02}, OLDER), id="some older records"),
    ],
)
def test_psnr_comes_first_elsewhere(records):
    assert not across_scanners(records)
    shown, text = titles(records)
    assert shown == [how.title for how in MAIN.values()] and "HU come first" not in text


def test_two_objects_in_two_scanners_each_are_a_comparison_of_scanners():
    assert across_scanners(runs() + runs({"m": 0.03, "h": 0.024}, "q"))


def test_a_run_without_scores_changes_no_headline():
    failed = make_record("sirt", scene="mild", scan="mild", inputs="counts only", status="timeout", reason="r")
    assert across_scanners([*runs(), failed]) and not across_scanners([failed]) and not across_scanners([])


def test_the_terminal_leads_with_hu_too(tmp_path):
    text = overview.text(runs(), tmp_path / "r", tmp_path / "d")
    head = next(line for line in text.splitlines() if "method" in line)
    assert re.findall(r"\S+", head)[2:7] == ["HU", "metal", "lost", "PSNR", "s"]
    row = next(line for line in text.splitlines() if "fdk" in line)
    assert re.findall(r"\S+", row)[3:8] == ["40.0", "41.0", "30.0", "29.00", "1.5"]
    assert "HU: RMSE of soft tissue in HU (protocol soft)" in text
    plain = overview.text([changed(r, phantom=OLDER) for r in runs()], tmp_path / "r", tmp_path / "d")
    assert "PSNR: PSNR3D in dB" in plain and "HU: RMSE" not in plain


@pytest.mark.slow
def test_a_scan_knows_its_object(smallest):
    """By what lies where: the same labels of other materials are another object."""
    stored = open_scan(next(p for p in sorted(smallest.iterdir()) if p.is_dir()))
    info = msgspec.structs.replace(stored.info, materials=(*stored.info.materials[:-1], "Au"))
    assert len(stored.phantom) == 12 and dataclasses.replace(stored, info=info).phantom != stored.phantom
    files = {name: entry for name, entry in stored.files.items() if name != "labels.tif"}
    assert dataclasses.replace(stored, files=files).phantom == ""
