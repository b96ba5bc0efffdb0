"""A simulated scan in SkyScan's layout comes back with the same counts and geometry, and FDK of it is the same."""

import itertools
import re

import msgspec
import numpy as np
import pytest
import scan_files
import torch
from closed_scans import BODY, GEOMETRY, LEVEL, METAL, counts_of, line_integrals
from scipy import ndimage

from ctsim.beam.spectrum import Filter, Tube
from ctsim.benchmarks.export import Flags as Export
from ctsim.benchmarks.export import work as export
from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.settle import water_path
from ctsim.benchmarks.importing.work import bring
from ctsim.dataset.store import open_scan
from ctsim.dataset.writer import SceneWriter
from ctsim.errors import InputError
from ctsim.io.scans import formats as scans
from ctsim.io.scans.scanfile import filters_of
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.types import Scan

COUNTS = counts_of(line_integrals(GEOMETRY, (*BODY, *METAL)))
OPEN = 0.01 * LEVEL
"""The open field is a median of some hundred readings of 0.2 % noise; a column with any of the object is 3 % below."""


def brought(folder, log, **flags):
    return open_scan(bring(Flags(scan=log, out=folder / "data", center="file", hold=0, **flags)))


def same_orbit(found, true):
    """Compare all but the grid, to what the log rounds: lengths to 1e-6 mm, and the micrometres of a pixel to 1e-9."""
    assert np.allclose(found.pose_array(), true.pose_array(), rtol=1e-6, atol=1e-5)
    assert found.n_detector == true.n_detector


def test_counts_and_geometry_come_back(tmp_path):
    stored = brought(tmp_path, scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY))
    assert np.array_equal(stored.scan.counts.numpy(), COUNTS)
    same_orbit(stored.geometry, GEOMETRY)
    assert not stored.has_truth and stored.name == "rods"
    flat = stored.scan.flat.numpy()
    assert np.ptp(flat) == 0 and abs(float(flat[0, 0]) - LEVEL) < OPEN
    assert 0.7 < stored.info.i0 / 2e5 < 1.4  # of some 24 pairs of strips of 64 pixels
    assert stored.info.e_max == 90.0


def test_fdk_of_it_is_that_of_the_original(tmp_path):
    stored = brought(tmp_path, scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY))
    scan = stored.scan
    grid = msgspec.structs.replace(GEOMETRY, n_voxel=stored.geometry.n_voxel, d_voxel=stored.geometry.d_voxel)
    flat = torch.full(grid.n_detector, float(scan.flat[0, 0]))
    true = fdk(Scan(geometry=grid, counts=torch.from_numpy(COUNTS), flat=flat, i0=scan.i0)).values.numpy()
    assert np.abs(fdk(scan).values.numpy() - true).max() < 1e-4 * true.max()  # poses differ by 1e-6


@pytest.mark.parametrize(("arc", "start"), [(360.0, 0.0), (-360.0, 25.0), (200.0, 10.0), (-210.0, 0.0)])
def test_directions_arcs_and_starts(tmp_path, arc, start):
    true = msgspec.structs.replace(GEOMETRY, arc_deg=arc, start_deg=start)
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, true, step=round(abs(arc) / 24, 3))
    found = scans.open_scan(log).geometry
    # a step is rounded to half a thousandth of a degree, which 24 views add up unless the turn is whole
    assert np.allclose(found.angles, true.angles, atol=np.radians(24 * 0.0005) if abs(arc) < 360 else 1e-12)


def test_the_way_of_turning_can_be_said(tmp_path):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    other = msgspec.structs.replace(GEOMETRY, arc_deg=360.0)
    same_orbit(brought(tmp_path, log, turn="counter-clockwise").geometry, other)
    same_orbit(brought(tmp_path, log, turn="clockwise", name="same").geometry, GEOMETRY)
    stepped = scan_files.skyscan(tmp_path / "more", np.concatenate([COUNTS, COUNTS[:1]]), GEOMETRY, step=15.0)
    found = brought(tmp_path, stepped, turn="counter-clockwise", name="more").geometry
    assert np.allclose(found.angles[:-1], other.angles)


def test_a_last_image_that_repeats_the_first_is_kept(tmp_path):
    again = np.concatenate([COUNTS, COUNTS[:1]])
    log = scan_files.skyscan(tmp_path / "scan", again, GEOMETRY, step=15.0)
    stored = brought(tmp_path, log)
    assert stored.geometry.shape == (25, 32, 40)
    assert np.array_equal(stored.scan.counts[-1].numpy(), COUNTS[0])
    assert np.isclose(abs(stored.geometry.angles[-1] - stored.geometry.angles[0]), 2 * np.pi)


def test_a_tilted_camera_is_turned_back(tmp_path):
    """A smooth image is turned as a camera turns it; what is left is the error of interpolating it linearly twice."""
    v, u = np.meshgrid(np.arange(32.0), np.arange(40.0), indexing="ij")
    smooth = 20000 + 9000 * np.sin(u / 9 + 0.3) * np.cos(v / 7)
    angle = 4.0
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))

    def seen(v, u):  # row 0 at the bottom: counter-clockwise in this frame
        x, y = u - 19.5, v - 15.5
        x, y = cos * x + sin * y, -sin * x + cos * y
        return 20000 + 9000 * np.sin((x + 19.5) / 9 + 0.3) * np.cos((y + 15.5) / 7)

    tilted = np.broadcast_to(np.rint(seen(v, u)).astype(np.uint16), (24, 32, 40))
    found = scans.open_scan(scan_files.skyscan(tmp_path / "scan", tilted, GEOMETRY, tilt=angle)).read(0)
    inner = (slice(4, -4), slice(4, -4))
    curvature = 9000 * (1 / 81 + 1 / 49) / 8  # h²/8·|f″| of linear interpolation in both directions
    assert np.abs(found[inner] - smooth[inner]).max() < curvature + 1
    assert np.abs(tilted[0][inner] - smooth[inner]).max() > 10 * curvature


def test_shifted_images_are_moved_back(tmp_path):
    moves = np.random.default_rng(2).integers(-2, 3, (24, 2))
    moved = np.stack(
        [
            ndimage.shift(image[::-1], (down, right), order=0, mode="nearest")[::-1]
            for image, (right, down) in zip(COUNTS, moves, strict=True)
        ]
    )
    log = scan_files.skyscan(tmp_path / "scan", moved, GEOMETRY)
    scan_files.shifts(log, moves)
    stored = brought(tmp_path, log)
    inner = (slice(None), slice(2, -2), slice(2, -2))
    assert np.array_equal(stored.scan.counts.numpy()[inner], COUNTS[inner].astype(np.float32))
    assert "shifts of _TS.csv" in " ".join(stored.info.notes)


@pytest.mark.parametrize("coding", ["utf-8", "latin-1"])
def test_a_log_may_write_micrometres_with_their_sign(tmp_path, coding):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY, filter="Al 500 µm")
    log.write_bytes(log.read_text().replace("(um)", "(µm)").encode(coding))
    found = scans.open_scan(log)
    assert found.geometry.d_detector == pytest.approx(GEOMETRY.d_detector)
    assert found.filters == (Filter(material="Al", thickness=0.5),)


@pytest.mark.parametrize("photons", [300, 3000, 100_000])
def test_the_level_and_the_photons_of_an_open_pixel(tmp_path, photons):
    """Of few photons a percentile of single pixels is noise: 3.1 deviations above the level, 18 % for 300 photons."""
    counts = counts_of(line_integrals(GEOMETRY, BODY), photons=photons)
    info = brought(tmp_path, scan_files.skyscan(tmp_path / "scan", counts, GEOMETRY)).info
    # 24 strips of 64 pixels have the median of their noise to 2 %, and each strip its own median to a tenth
    assert 0.85 < info.i0 / photons < 1.15
    assert not any("open field is the brightest" in note for note in info.notes)


@pytest.mark.parametrize("moved", [False, True], ids=["tilted", "shifted"])
def test_noise_is_that_of_pixels_before_they_are_turned_or_moved(tmp_path, moved):
    """Interpolation between four pixels leaves a quarter of the noise's variance: four times the photons."""
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY, tilt=0.0 if moved else 1.5)
    if moved:
        scan_files.shifts(log, np.full((24, 2), 0.5))
    assert 0.85 < brought(tmp_path, log).info.i0 / 2e5 < 1.15


@pytest.mark.parametrize(
    ("text", "sheets"),
    [
        ("Al 0.5mm", [("Al", 0.5)]),
        ("Al 1 mm", [("Al", 1.0)]),
        ("0.25mm Aluminum", [("Al", 0.25)]),
        ("Cu 0.11mm + Al 0.5mm", [("Cu", 0.11), ("Al", 0.5)]),
        ("copper 38 um", [("Cu", 0.038)]),
        ("No Filter", []),
        ("", []),
    ],
)
def test_filters(text, sheets):
    assert filters_of(text) == tuple(Filter(material=name, thickness=size) for name, size in sheets)


@pytest.mark.parametrize("text", ["Al+Cu", "Al", "0.5mm", "Xx 1mm", "Al 1mm Cu", "Al 1 inch", "GFP1 425/40nm, 475nmLP"])
def test_unclear_filters(text):
    assert filters_of(text) is None


def test_voltage_and_filter_reach_the_spectrum(tmp_path):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY, kv=70, filter="Cu 0.1mm")
    stored = brought(tmp_path, log)
    table = np.genfromtxt(stored.folder / "spectrum.csv", delimiter=",", names=True)
    assert 69 < table["energy_kev"].max() < 70
    assert stored.info.e_max == 70 and 1 < stored.info.l0 < 30
    tube = Tube(kvp=70, filters=(Filter(material="Cu", thickness=0.1),))
    assert water_path(tube, 0.0) == 0 and 10 < water_path(tube, 0.4) < 40


def test_the_axis_is_found_when_it_is_imported(tmp_path):
    true = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, -3.7 * 1.6))
    log = scan_files.skyscan(tmp_path / "scan", counts_of(line_integrals(true, (*BODY, *METAL))), true)
    found = open_scan(bring(Flags(scan=log, out=tmp_path / "data"))).geometry
    assert abs(-found.off_detector[1] / 1.6 - 3.7) < 0.25


def test_an_axis_that_is_assumed_is_said(tmp_path, capsys):
    """Of less than a turn the axis is not found; a number, or the axis of a turn, is no assumption."""
    short = msgspec.structs.replace(GEOMETRY, arc_deg=200.0)
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, short, step=8.333)
    assumed = "the detector's middle assumed, or --center PIXELS"
    for center, said in (("", True), ("file", True), ("0", False)):
        stored = open_scan(bring(Flags(scan=log, out=tmp_path / "data", name=f"one{center}", center=center)))
        assert (assumed in " ".join(stored.info.notes), assumed in capsys.readouterr().out) == (said, said)
    turn = scan_files.skyscan(tmp_path / "turn", COUNTS, GEOMETRY)
    assert assumed not in " ".join(open_scan(bring(Flags(scan=turn, out=tmp_path / "data"))).info.notes)


def test_the_axis_is_told_where_a_format_has_no_place_for_it(tmp_path, capsys):
    """An axis and a grid that Data Exchange does not hold come back by the words that its export prints."""
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0)))
    stored = open_scan(bring(Flags(scan=log, out=tmp_path / "data", hold=0, center="2.75")))
    export.export(Export(scan=stored.folder, out=tmp_path / "scan.h5", to="dxchange"))
    told = re.search(r"axis is: \+2\.75 columns .* needs (--center 2\.75),", capsys.readouterr().out)
    assert told
    center = told[1].split()[1]
    again = open_scan(bring(Flags(scan=tmp_path / "scan.h5", out=tmp_path / "data", hold=0, center=center)))
    np.testing.assert_allclose(again.geometry.pose_array(), stored.geometry.pose_array(), atol=1e-9)


def test_voxels_that_are_no_cubes_are_said(tmp_path, capsys):
    scanner = msgspec.structs.replace(GEOMETRY, n_views=6)
    folder = scan_files.r2(tmp_path / "scan", line_integrals(scanner), scanner)
    bring(Flags(scan=folder, out=tmp_path / "data", center="file"))
    sizes = " × ".join(f"{d:.4g}" for d in GEOMETRY.d_voxel)
    assert len({*GEOMETRY.d_voxel}) > 1 and f"voxels of {sizes} mm (z × y × x)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"files": 25}, "declares 25 images, there are 24"),
        ({"rows": 31}, "expected numbers of shape"),
        ({"dso": 400.0}, "the source 400 mm from the object"),
        ({"direction": "up"}, "expected CC or CW"),
        ({"step": 0.0}, "Rotation Step"),
        ({"pixel": -1.0}, "expected a positive size"),
        ({"columns": 10**9}, "expected a whole number|must give at most"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, changes, said):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY, **changes)
    with pytest.raises(InputError, match=said) as error:
        brought(tmp_path, log)
    assert str(error.value).startswith(str(tmp_path / "scan"))
    assert not list((tmp_path / "data").glob("[!.]*"))


def test_missing_and_doubled_images(tmp_path):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    image = tmp_path / "scan" / "rods00000007.tif"
    image.rename(tmp_path / "scan" / "rods0007.TIF")  # the same number
    assert np.array_equal(scans.open_scan(log).read(7), COUNTS[7])
    (tmp_path / "scan" / "rods00000007.tif").write_bytes((tmp_path / "scan" / "rods0007.TIF").read_bytes())
    with pytest.raises(InputError, match="one number"):
        scans.open_scan(log)
    image.unlink()
    (tmp_path / "scan" / "rods0007.TIF").unlink()
    with pytest.raises(InputError, match="lacks image 7"):
        scans.open_scan(log)
    secret = tmp_path / "secret.tif"
    (tmp_path / "scan" / "rods00000008.tif").rename(secret)
    image.symlink_to(secret)
    with pytest.raises(InputError, match="same folder"):
        scans.open_scan(log)


def test_no_open_column_is_said(tmp_path):
    """A body with a cavity, wider than the detector, is brightest inside of it."""
    true = msgspec.structs.replace(GEOMETRY, d_detector=(0.6, 0.6))
    p = line_integrals(true, (((0, 0, 0), (40, 40, 40), 0.02), ((0, 0, 0), (4, 4, 4), -0.02)))
    stored = brought(tmp_path, scan_files.skyscan(tmp_path / "scan", counts_of(p), true))
    assert "no column next to the object is open" in " ".join(stored.info.notes)


def test_the_same_import_does_nothing_and_views_are_held_out(tmp_path, capsys):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    for _ in range(2):
        folder = bring(Flags(scan=log, out=tmp_path / "data", center="file", hold=3))
    assert "already complete" in capsys.readouterr().out
    stored = open_scan(folder)
    held = stored.info.held
    assert held is not None and held.n_views == 3 and stored.geometry.n_views == 21
    places = {round(float(a), 9): k for k, a in enumerate(GEOMETRY.angles)}
    of_held, of_kept = ([places[round(float(a), 9)] for a in g.angles] for g in (held, stored.geometry))
    assert sorted(itertools.chain(of_held, of_kept)) == list(range(24))
    assert np.array_equal(stored.array("held"), COUNTS[of_held])
    assert np.array_equal(stored.scan.counts.numpy(), COUNTS[of_kept])


def test_an_import_goes_on_to_another_library(tmp_path):
    """The geometry of a circle and the readings are all that most need; R2-Gaussian wants a truth, too."""
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    folder = bring(Flags(scan=log, out=tmp_path / "data", center="file"))
    export.export(export.Flags(scan=folder, out=tmp_path / "rtk", to="rtk"))
    assert {path.name for path in (tmp_path / "rtk").iterdir()} == {"geometry.xml", "grid.mha", "projections.mha"}
    with pytest.raises(InputError, match="the scan comes without one"):
        export.export(export.Flags(scan=folder, out=tmp_path / "r2", to="r2"))
    assert not (tmp_path / "r2").exists()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_pixel_that_lacks_readings_is_dead_and_said(tmp_path, value):
    """It is interpolated in every view, and a method that knows dead pixels knows it as one."""
    counts = COUNTS.astype(np.float64 if value == 1e300 else np.float32)
    counts[3, 2, 5] = value
    stored = brought(tmp_path, scan_files.skyscan(tmp_path / "scan", counts, GEOMETRY))
    assert "1 of 1280 pixels have readings that are not finite, the first in view 3 at column 5 of row 2" in " ".join(
        stored.info.notes
    )
    found = stored.scan.counts.numpy()
    np.testing.assert_allclose(found[:, 2, 5], (counts[:, 2, 4] + counts[:, 2, 6]) / 2, rtol=1e-6)
    found[:, 2, 5] = counts[:, 2, 5] = 0
    assert np.array_equal(found, counts)
    assert stored.scan.flat[2, 5] == 0 and (stored.scan.flat > 0).sum() == 32 * 40 - 1
    assert abs(stored.info.gain - LEVEL) < OPEN and 0.7 < stored.info.i0 / 2e5 < 1.4


@pytest.mark.parametrize("moved", [False, True], ids=["stored", "moved"])
@pytest.mark.parametrize(
    ("where", "said"),
    [
        (np.s_[:], "every pixel has readings that are not finite, the first in view 0 at column 0 of row 0"),
        (np.s_[7], "every pixel has readings that are not finite, the first in view 7"),
        (np.s_[7, :8, :8], r"of 1280 pixels have readings that are not finite, .*; expected at most 1% of the pixels"),
    ],
)
def test_more_than_a_few_pixels_without_readings_are_refused(tmp_path, where, said, moved):
    counts = COUNTS.astype(np.float32)
    counts[where] = np.nan
    log = scan_files.skyscan(tmp_path / "scan", counts, GEOMETRY)
    if moved:
        scan_files.shifts(log, np.zeros((24, 2)))
    with pytest.raises(InputError, match=said):
        brought(tmp_path, log)
    assert not (tmp_path / "data").exists()


def test_an_image_that_is_moved_off_the_panel_is_refused(tmp_path):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    moves = np.zeros((24, 2))
    moves[4, 1] = -31.5
    scan_files.shifts(log, moves)
    assert scans.open_scan(log)
    moves[4, 1] = -32
    scan_files.shifts(log, moves)
    with pytest.raises(InputError, match=r"rods_TS.csv moves image 4 by -32 pixels in y, off the panel of 32 × 40"):
        scans.open_scan(log)


def test_a_negative_voltage_is_no_voltage(tmp_path):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY, kv=-90)
    notes = " ".join(brought(tmp_path, log).info.notes)
    assert "Source Voltage (kV) = -90 is no voltage" in notes and "the tube voltage is unknown" in notes
    assert brought(tmp_path, log, kv=90.0, name="stated").info.e_max == 90


def test_a_log_ends_with_the_last_view(tmp_path, capsys):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    brought(tmp_path, log)
    assert capsys.readouterr().err == "24/24 views: rods\n"


def test_an_import_that_goes_on_says_from_where(tmp_path, capsys, monkeypatch):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    put = SceneWriter.put

    def stopped(self, view, arrays):
        if view == 9:
            raise KeyboardInterrupt
        put(self, view, arrays)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(SceneWriter, "put", stopped)
        brought(tmp_path, log)
    assert capsys.readouterr().err == ""
    assert np.array_equal(brought(tmp_path, log).scan.counts.numpy(), COUNTS)
    assert capsys.readouterr().err == "rods: goes on from view 9 of 24\n24/24 views: rods\n"


@pytest.mark.parametrize("name", ["..", "a/b", ".hidden", "index.jsonl"])
def test_a_name_is_that_of_a_folder(tmp_path, name):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, GEOMETRY)
    with pytest.raises(InputError, match=f"--name '{re.escape(name)}': expected a plain folder name"):
        brought(tmp_path, log, name=name)
    assert not (tmp_path / "data").exists()
