"""A measured scan through run-benchmark: masks are found, protocols skipped by name, and what needs no truth scored."""

import base64
import io
import json
import re

import msgspec
import numpy as np
import pytest
import scan_files
from closed_scans import BODY, GEOMETRY, METAL, counts_of, line_integrals
from PIL import Image

from ctsim.baselines import metal
from ctsim.baselines.metal import water_value
from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.work import bring
from ctsim.benchmarks.scores import unreferenced
from ctsim.benchmarks.scores.artefact import near_mm
from ctsim.benchmarks.scores.judge import Twin
from ctsim.benchmarks.scores.score import NEED_TRUTH, NO_REFERENCE
from ctsim.benchmarks.scores.unreferenced import HeldViews, Unreferenced, consistency
from ctsim.benchmarks.studies.methods import records, study
from ctsim.benchmarks.studies.methods.study import main
from ctsim.benchmarks.studies.methods.volumes import map_volume
from ctsim.benchmarks.submit import Flags as Submitted
from ctsim.benchmarks.submit.work import submit
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reports import report

TRUE = msgspec.structs.replace(GEOMETRY, n_views=96, off_detector=(0.0, 0.0))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("measured")
    counts = counts_of(line_integrals(TRUE, (*BODY, *METAL)))
    log = scan_files.skyscan(folder / "scan", counts, TRUE)
    bring(Flags(scan=log, out=folder / "data", n_voxel=32, hold=6))
    return folder / "data"


def test_a_run_and_its_table(data, tmp_path, capsys):
    results = tmp_path / "results"
    assert main([str(data), str(results), "--method", "fdk", "--method", "nmar", "--method", "twin-fdk"]) == 0
    found = {r.label: r for r in records.read(results)}
    assert [*found] == ["fdk", "twin-fdk", "nmar[mask=auto]"]
    assert found["nmar[mask=auto]"].details["mask_status"] == "ok"
    assert found["twin-fdk"].status == "skipped"
    # NMAR evens out what is near the rods; what is in the body lies beyond
    without = {"fdk": ([], False), "nmar[mask=auto]": (["artefact_index"], True)}
    for label in without:
        assert [*found[label].scores] == [NO_REFERENCE]
        values, note = found[label].scores[NO_REFERENCE].values, found[label].scores[NO_REFERENCE].note
        missing = [name for name, value in values.items() if value is None]
        assert (missing, "no artefact index" in note) == without[label]
    screen, page = capsys.readouterr().out, (results / "table.md").read_text()
    for protocol in NEED_TRUTH:
        assert protocol in page and protocol in screen
        assert f"## {protocol}" not in page.splitlines()
    assert "measured, without truth" in screen and "nmar[mask=auto]" in screen
    assert (results / "panels/rods.png").stat().st_size > 10_000
    assert report.main([str(results), str(data), "--out", str(tmp_path / "page.html")]) == 0
    check_slices((tmp_path / "page.html").read_text(encoding="utf-8"), results, data)


def check_slices(text, results, data):
    """The page has a slider over every slice of both volumes, in the window of the panel, and says so."""
    geometry, kept = open_scan(data / "rods").geometry, [r for r in records.read(results) if r.volume]
    volumes = [map_volume(results / r.volume) for r in kept]
    low, high = np.percentile(volumes[0], (1.0, 99.5))
    images = json.loads(re.search(r'<script type="application/json">(.*?)</script>', text, re.S)[1])
    n = geometry.n_voxel[0]
    assert images["z"] == list(range(n)) and images["start"] == n // 2
    assert set(images["volume"]) == {"0", "1"} and "error" not in images
    for row, volume in enumerate(volumes):
        shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(images["volume"][str(row)][5]))))
        # 8 bits over the window, row 0 at the bottom: half a grey of rounding
        found = low + shown[::-1] / 255 * (high - low)
        assert np.abs(found - np.clip(volume[5], low, high)).max() <= 0.51 * (high - low) / 255
    z, half = geometry.voxel_centres()[0][5], geometry.n_voxel[2] * geometry.d_voxel[2] / 2
    assert images["said"][5] == f"slice 5 of 0 … {n - 1}, z = {z:.1f} mm"
    said = f"left to right x = −{half:.1f} … {half:.1f} mm"
    assert said in text and "Measured, without truth" in text and f"{high:.4g} 1/mm" in text
    assert re.findall(r"<figcaption><b>(.*?)</b>", text) == [r.label for r in kept]
    for only_with_truth in ('data-kind="error"', 'data-kind="ring"', 'name="show"', "Errors are volume minus"):
        assert only_with_truth not in text.partition("<script>")[0]
    assert '<h2 id="figures">' not in text


def test_a_measured_scan_is_of_no_code_of_the_simulator(data, smallest, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(study, "source_hash", lambda: "another")
    for folder, warned in ((smallest, True), (data, False)):
        caplog.clear()
        assert main([str(folder), str(tmp_path / folder.name), "--method", "zero", "--dry-run"]) == 0
        assert ("other code of the simulator" in caplog.text) == warned


def test_a_volume_made_elsewhere_has_the_scores_that_need_no_truth(data, tmp_path, capsys):
    """FDK's own volume scores as FDK does; it lies as FDK's does, or is refused."""
    results, volume = tmp_path / "results", tmp_path / "mine.npy"
    values = fdk(open_scan(data / "rods").scan).values.numpy()
    assert main([str(data), str(results), "--method", "fdk"]) == 0
    given = Submitted(data=data, results=results, volume=volume, scene="rods", name="mine")
    np.save(volume, values)
    submitted = submit(given)[0]
    own = next(r for r in records.read(results) if r.label == "fdk")
    assert [*submitted.scores] == [NO_REFERENCE]
    assert submitted.scores[NO_REFERENCE].values == own.scores[NO_REFERENCE].values
    for wrong, said in ((values[:, :, ::-1], "looks flipped along x"), (10 * values, "looks like 1/cm")):
        np.save(volume, wrong)
        with pytest.raises(InputError, match=said):
            submit(given)


def test_a_method_that_is_not_made_for_the_orbit_is_skipped(data, tmp_path):
    """Views of a walnut that leave the circle: FDK, and what begins with it, cannot use them; SIRT can."""
    poses = TRUE.pose_array()[::8]
    poses[:, 2] += np.linspace(0, 3, len(poses))
    counts = counts_of(line_integrals(msgspec.structs.replace(TRUE, n_views=12), BODY))
    flat, dark = np.full((1, *TRUE.n_detector), 40000.0), np.zeros((1, *TRUE.n_detector))
    nut = scan_files.walnut(tmp_path / "nut", counts, poses, flat, dark)
    bring(Flags(scan=nut, out=tmp_path / "data", n_voxel=16, hold=2))
    told = [word for name in ("fdk", "limar", "nmar", "cgls") for word in ("--method", name)]
    assert main([str(tmp_path / "data"), str(tmp_path / "results"), *told, "--set", "cgls.iterations=2"]) == 0
    found = {r.label.partition("[")[0]: r for r in records.read(tmp_path / "results")}
    assert {name: r.status for name, r in found.items()} == {
        "fdk": "skipped", "limar": "skipped", "nmar": "skipped", "cgls": "ok"
    }  # fmt: skip
    assert all("needs a circular orbit" in found[name].reason for name in ("fdk", "limar", "nmar"))
    [scene] = list_scans(tmp_path / "data")
    np.save(tmp_path / "mine.npy", np.random.default_rng(0).normal(size=open_scan(scene).geometry.n_voxel))
    given = {"data": tmp_path / "data", "results": tmp_path / "results", "scene": scene.name, "name": "mine"}
    assert [*submit(Submitted(**given, volume=tmp_path / "mine.npy"))[0].scores] == [NO_REFERENCE]


def test_rays_through_a_doubtful_mask_are_not_outside_the_trace(data, monkeypatch, tmp_path, capsys):
    """What may be metal is left out of "outside", and no ray counts as in the trace; the screen says what happened."""
    stored = open_scan(data / "rods")
    sure = Unreferenced.of(stored).views.regions
    monkeypatch.setattr(metal, "METAL", 1e3)  # no metal is that bright
    found = Unreferenced.of(stored)
    assert "rays through what is bright" in found.note
    assert np.array_equal(found.views.regions["outside"], sure["outside"])
    assert sure["trace"].any() and not found.views.regions["trace"].any()
    assert main([str(data), str(tmp_path / "results"), "--method", "nmar"]) == 0
    assert "rods, nmar[mask=auto]: its metal mask is doubtful and was not used" in capsys.readouterr().out
    monkeypatch.setattr(unreferenced, "SUSPECT", 1e3)
    assert Unreferenced.of(stored).views.regions["outside"].sum() > sure["outside"].sum()


def test_scores_see_what_they_are_for(data):
    """Streaks and noise in air, noise near metal, and another object each raise their own number."""
    stored = open_scan(data / "rods")
    judge = Unreferenced.of(stored)
    values = fdk(stored.scan).values.numpy()

    def scored(volume):
        return judge.scores(volume, "metal", Twin())[NO_REFERENCE].values

    base, rng = scored(values), np.random.default_rng(0)
    streaked = values + judge.water * 0.2 * np.sin(np.arange(32) / 3).astype(np.float32)
    assert scored(streaked)["air_streak"] > 2 * base["air_streak"]
    noisy = values + rng.normal(0, 0.2 * judge.water, values.shape).astype(np.float32)
    assert scored(noisy)["air_entropy"] > base["air_entropy"] + 0.5
    # without noise soft tissue varies by 0.16 of water near the metal and by 0.18 beyond; noise of 0.4 makes it 0.43
    near = np.where(judge.near, 2 * noisy - values, values)
    assert scored(near)["artefact_index"] > base["artefact_index"]
    assert scored(np.zeros_like(values))["held/outside"] > 3 * base["held/outside"]
    assert scored(np.zeros_like(values))["air_entropy"] == 0


def with_ball(folder, *solids):
    """Import the scan with small solids of metal, which masks may miss; return its judge, FDK's volume and its grid."""
    log = scan_files.skyscan(folder / "scan", counts_of(line_integrals(TRUE, (*BODY, *METAL, *solids))), TRUE)
    stored = open_scan(bring(Flags(scan=log, out=folder / "data", n_voxel=32, hold=6)))
    return Unreferenced.of(stored), fdk(stored.scan).values.numpy(), stored.geometry


def test_metal_that_the_mask_misses_does_not_rule_the_artefact_index(tmp_path):
    """A ball far from the metal, as one of 8 voxels or less, is neither soft tissue nor is what lies around it far."""
    judge, values, grid = with_ball(tmp_path, ((0, -6, 5), (0.6, 0.6, 0.6), 1.0))
    far = judge.far
    z, y, x = (c.reshape([-1 if axis == k else 1 for k in range(3)]) for axis, c in enumerate(grid.voxel_centres()))
    distance = np.sqrt((x - 0) ** 2 + (y + 6) ** 2 + (z - 5) ** 2)
    assert values[distance < max(grid.d_voxel)].max() > unreferenced.MISSED * water_value(values)
    assert distance[far].min() > near_mm(grid.d_voxel) - 0.6 - max(grid.d_voxel)
    assert far.any() and values[far].max() <= unreferenced.SUSPECT * water_value(values)
    assert values[judge.near].max() <= unreferenced.SUSPECT * water_value(values)
    index, _ = judge._artefact_index(values)
    bright = values.copy()
    bright[~far & ~judge.near] = 1.0  # a method that shows the ball, and every metal, as dense as it likes
    assert judge._artefact_index(bright)[0] == index
    without, _, _ = with_ball(tmp_path / "without")
    assert far.sum() < without.far.sum()


def test_a_body_that_varies_more_far_from_metal_has_no_artefact_index(data):
    """A difference that noise may make counts as 0; the note says why a larger one gives no number."""
    judge = Unreferenced.of(open_scan(data / "rods"))
    rng = np.random.default_rng(0).normal(0, 1, judge.near.shape)

    def scored(near, far):  # spreads in HU
        values = judge.water * (1 + np.where(judge.near, near, far) * rng / 1000)
        found = judge.scores(values.astype(np.float32), "metal", Twin())[NO_REFERENCE]
        return found.values["artefact_index"], found.note

    n = min(judge.near.sum(), judge.far.sum())
    assert scored(100, 60)[0] == pytest.approx(80, rel=5 / np.sqrt(2 * n))  # five deviations of a spread of n values
    assert scored(87, 100)[0] == 0 and "no artefact index" not in scored(87, 100)[1]
    index, note = scored(50, 100)
    assert index is None
    said = re.search(r"no artefact index: the body varies by (\d+) HU near the metal, by (\d+) HU beyond$", note)
    assert said and abs(int(said[1]) - 50) < 15 and abs(int(said[2]) - 100) < 30


def test_consistency_is_that_of_closed_form(data):
    """Of a volume of 0, the RMSE is the RMS of P."""
    stored = open_scan(data / "rods")
    views = Unreferenced.of(stored).views
    assert isinstance(views, HeldViews)
    found = consistency(np.zeros(stored.geometry.n_voxel, np.float32), views)
    for name, mask in views.regions.items():
        assert found[f"held/{name}"] == pytest.approx(float(np.sqrt(np.mean(views.p[mask].astype(float) ** 2))))
    held = stored.info.held
    assert held is not None
    steps = np.rint((TRUE.start_deg - np.degrees(held.angles)) / (360 / TRUE.n_views)).astype(int)
    true = line_integrals(TRUE, (*BODY, *METAL))[steps % TRUE.n_views]
    clear = true < 2  # photons 2e5·exp(−2): noise of 0.6 %, six of which is 0.04
    assert np.abs(views.p - true)[clear].max() < 0.04
