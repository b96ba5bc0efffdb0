"""A scan whose scene holds metal, but whose grid or views do not, says so wherever it is made, listed or scored."""

import dataclasses

import msgspec
import numpy as np
import pytest

from ctsim.beam.quadrature import full_rule
from ctsim.beam.spectrum import Tube, spectrum
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.study import main as run_benchmark
from ctsim.dataset.store import open_scan
from ctsim.detector.response import Detector
from ctsim.geometry import Geometry
from ctsim.notes import metal_notes
from ctsim.phantoms.shapes import cylinder, sphere
from ctsim.solids import Solid
from ctsim.tracer.project import Response
from ctsim.types import Phantom

GRID, VIEW = "no metal on the reconstruction grid", "no metal in any view"
GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(5, 7, 11),
    d_voxel=(2.0, 2.0, 2.0),
    n_detector=(6, 30),
    d_detector=(3.0, 3.0),
    n_views=5,
)


def notes(*solids: Solid, **changes) -> list[str]:
    """Return what is said of solids in a cylinder of water, each by its first words."""
    water = cylinder("water", "water", (30.0, 100.0), metal=False)
    materials = tuple(dict.fromkeys(["air", "water", *(s.material for s in solids)]))
    phantom = Phantom(
        labels=np.zeros((2, 2, 2), np.uint8), materials=materials, d_voxel=(1.0, 1.0, 1.0), solids=(water, *solids)
    )
    response = Response.of(full_rule(spectrum(Tube()), Detector()), materials)
    found = metal_notes(phantom, msgspec.structs.replace(GEOMETRY, **changes), response, 34)
    assert all("Fe" in note for note in found)
    return [note.split(":")[0] for note in found]


def ball(radius: float, z: float = 0.0, x: float = 0.0) -> Solid:
    return sphere("ball", "Fe", radius, centre=(x, 0.0, z))


def test_metal_in_the_middle_is_no_news():
    assert notes(ball(2.0)) == [] == notes()


def test_metal_beside_the_grid_but_not_beside_the_detector():
    # the grid ends at |x| = 11 and |z| = 5 mm, the detector at 22.5 and 4.5 mm by the magnification of 2
    assert notes(ball(2.0, x=15.0)) == [GRID]
    assert notes(ball(2.0, z=9.0)) == [GRID, VIEW]
    assert notes(ball(2.0, z=4.9)) == []
    assert notes(ball(1.5, z=5.6), n_voxel=(7, 7, 11), n_detector=(4, 30)) == [VIEW]


def test_metal_smaller_than_half_a_voxel_is_seen_by_rays_alone():
    assert notes(ball(0.4)) == [GRID]


def test_a_wire_between_the_central_rays_is_seen():
    """With an even number of pixels no central ray meets the axis; 0.2 mm of iron cover 0.4 mm of a pixel of 3 mm."""
    assert notes(cylinder("wire", "Fe", (0.1, 9.0))) == [GRID]
    # 0.01 mm of iron take at most 0.08 of the photons from 20 keV on (mu = 20 cm²/g · 7.9 g/cm³ at most, half of it
    # on average) and cover 1/150 of a pixel: below 1 % of any signal
    assert notes(cylinder("hair", "Fe", (0.005, 9.0))) == [GRID, VIEW]


def test_metal_under_a_later_solid_is_none():
    lid = cylinder("lid", "water", (5.0, 20.0), metal=False)
    assert notes(ball(2.0), lid) == [GRID, VIEW] and notes(lid, ball(2.0)) == []


SUITE = """
[defaults]
truncated = true
seed = 3
[defaults.phantom]
recipe = "validation"
metal = "Fe"
n_voxel = [16, 16, 16]
[defaults.scanner.geometry]
dso = 2000.0
dsd = 2200.0
n_voxel = [1, 16, 16]
d_voxel = [0.5, 3.75, 3.75]
d_detector = [0.5, 4.0]
n_views = 12
off_origin = [{z}, 0.0, 0.0]

[[scene]]
name = "above"  # one row of the detector, above the rods, which end at 25.5 mm
[scene.scanner.geometry]
n_detector = [1, 24]
off_detector = [29.0, 0.0]

[[scene]]
name = "seen"  # rows that see the rods, too
[scene.scanner.geometry]
n_detector = [60, 24]
off_detector = [20.0, 0.0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("slices")
    (found / "suite.toml").write_text(SUITE.replace("{z}", "26.4"), encoding="utf-8")
    return found


@pytest.fixture(scope="module")
def data(folder):
    assert make_dataset([str(folder / "suite.toml"), str(folder / "data")]) == 0
    return folder / "data"


def test_a_dry_run_says_it(folder, capsys):
    assert make_dataset([str(folder / "suite.toml"), "--dry-run", str(folder / "none")]) == 0
    above, seen = capsys.readouterr().out.split("seen\n")
    assert f"note    {GRID}" in above and f"note    {VIEW}" in above
    assert GRID in seen and VIEW not in seen


def test_making_it_says_it_and_the_scan_keeps_it(folder, data, capsys, tmp_path):
    assert make_dataset([str(folder / "suite.toml"), str(tmp_path / "again"), "--only", "above"]) == 0
    said = capsys.readouterr().err
    assert f"above: {GRID}" in said and f"above: {VIEW}" in said
    above, seen = open_scan(data / "above"), open_scan(data / "seen")
    assert [note.split(":")[0] for note in above.info.notes] == [GRID, VIEW]
    assert [note.split(":")[0] for note in seen.info.notes] == [GRID]
    # the notes are true
    assert above.info.metal == ("Fe",) and not above.metal.any() and not seen.metal.any()
    assert above.metal_free is not None and seen.metal_free is not None
    assert changed(above) < 0.01 < 0.2 < changed(seen)


def changed(stored) -> float:
    """Return the greatest share by which a reading differs from the twin's, whose noise is the same."""
    with_it, without = (s.scan.counts.numpy().astype(float) - s.scan.dark for s in (stored, stored.metal_free))
    return float((np.abs(with_it - without) / without).max())


def test_a_scan_with_metal_has_no_notes(smallest):
    text = (smallest / "smallest" / "scan.json").read_bytes()
    assert b"notes" not in text and b"notes" not in (smallest / "smallest" / "plan.json").read_bytes()


@pytest.mark.slow
def test_scoring_it_says_it(data, tmp_path, caplog):
    methods = [word for name in ("fdk", "nmar") for word in ("--method", name)]
    assert run_benchmark([str(data), str(tmp_path), *methods]) == 0
    warned = [r.getMessage() for r in caplog.records]
    assert any(GRID in w and "above, seen" in w for w in warned) and any(VIEW in w and "seen" not in w for w in warned)
    found = [r for r in records.read(tmp_path) if r.run.variant == "metal"]
    assert len(found) == 4
    for record in found:
        for protocol in ("metal", "artefact"):
            score = record.scores[protocol]
            assert GRID in score.note and set(score.values.values()) == {None}
            assert (VIEW in score.note) == (record.run.scene == "above")
        assert record.status == "ok"
        uncorrected = record.details.get("uncorrected_reason", "")
        assert uncorrected == ("no metal in the mask: the volume is FDK's" if record.label == "nmar" else "")
    text = (tmp_path / "table.md").read_text()
    assert "## metal" in text and GRID in text.split("## metal")[1].split("## ")[0]


def test_a_scan_of_an_older_version_is_looked_at_by_its_mask(data, tmp_path):
    stored = open_scan(data / "above")
    info = msgspec.structs.replace(stored.info, notes=())
    judge = Judge.of(dataclasses.replace(stored, info=info))
    assert judge.absent.startswith(GRID)
    bare = Judge.of(dataclasses.replace(stored, info=msgspec.structs.replace(info, metal=())))
    assert bare.absent == "" and "metal" not in bare.scores(np.zeros((1, 16, 16), np.float32), "metal", Twin())


@pytest.mark.parametrize("name", ["limar", "nmar", "bhc-poly"])
def test_a_correction_without_metal_says_that_it_is_fdk_s(data, name):
    volume = find(name).reconstruct(scan_for(find(name), open_scan(data / "above"), "metal"))
    assert volume.details["uncorrected_reason"] == "no metal in the mask: the volume is FDK's" and not volume.reason
