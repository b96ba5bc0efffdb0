"""Scans in the layouts of other libraries: each reading and each voxel is where that library's own formulas put it.

Every reading has a value of its own. A file is read as the library reads it, its formulas (`test_interop`) give the
place of each of its pixels, and the reading with a value must lie where ours with that value does.
"""

import dataclasses
import json
import pickle
import xml.etree.ElementTree as ET

import h5py
import msgspec
import numpy as np
import pytest
import SimpleITK as sitk
from test_interop import leap, r2, rtk, spread, tigre

from ctsim.benchmarks.export.scans import LAYOUTS, Measured, write_scan
from ctsim.dataset.interop import Library, points_to
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.io.scans import exchange
from ctsim.io.scans import formats as scans
from ctsim.io.scans.scanfile import Stated

GEOMETRY = Geometry(
    dso=400.0,
    dsd=900.0,
    n_voxel=(5, 7, 11),
    d_voxel=(1.0, 2.0, 3.0),
    off_origin=(4.0, -5.0, 6.0),
    n_detector=(6, 9),
    d_detector=(1.5, 0.5),
    off_detector=(2.0, -3.0),
    n_views=4,
    start_deg=17.0,
    arc_deg=200.0,
)
HELD = {
    "tigre": GEOMETRY,
    "rtk": GEOMETRY,
    "astra": GEOMETRY,
    "leap": msgspec.structs.replace(GEOMETRY, d_voxel=(1.0, 3.0, 3.0)),
    "r2": msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0)),
    "naf": msgspec.structs.replace(GEOMETRY, off_origin=(0.0, 0.0, 0.0)),
}
"""The geometries: all that differs between axes differs, as far as a layout can hold it."""
CLOSE = {"rtol": 0, "atol": 4 * 2**-51 * 1000 + 20 * 2**-53 * 500}  # as in test_interop


def measured(geometry):
    rng = np.random.default_rng(1)
    p = rng.permutation(np.prod(geometry.shape)).reshape(geometry.shape).astype(np.float32)
    reference = rng.permutation(np.prod(geometry.n_voxel)).reshape(geometry.n_voxel).astype(np.float32) + 1
    counts, flat = (rng.integers(200, 60000, shape) for shape in (geometry.shape, geometry.n_detector))
    return Measured(
        geometry=geometry,
        p=p,
        reference=reference,
        counts=counts.astype(np.uint16),
        flat=flat.astype(np.float32),
        dark=103.5,
    )


def centres(n, d, off):
    """Return the centres of voxels along one axis."""
    return (np.arange(n) - (n - 1) / 2) * d + off


def mesh(*axes):
    """Return the points [.., .., .., xyz] of a volume whose three axes (of arrays) are x, y, z in this order."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def read_tigre(out):
    g = json.loads((out / "geometry.json").read_bytes())
    assert g["mode"] == "cone" and g["COR"] == 0 and not any(g["rotDetector"])
    assert np.allclose(np.multiply(g["nVoxel"], g["dVoxel"]), g["sVoxel"])
    assert np.allclose(np.multiply(g["nDetector"], g["dDetector"]), g["sDetector"])
    words = {"dso": g["DSO"], "dsd": g["DSD"], "n_detector": g["nDetector"], "d_detector": g["dDetector"]}
    theirs = type("G", (), words | {"off_detector": g["offDetector"]})
    z, y, x = (centres(*axis) for axis in zip(g["nVoxel"], g["dVoxel"], g["offOrigin"], strict=True))
    return tigre(np.load(out / "angles.npy"), theirs), np.load(out / "projections.npy"), mesh(x, y, z)


def read_rtk(out):
    root = ET.parse(out / "geometry.xml").getroot()
    assert root.tag == "RTKThreeDCircularGeometry" and root.get("version") == "3"
    angles = np.array([float(node.text) for node in root.iter("GantryAngle")])
    stack, grid = (sitk.ReadImage(str(out / f"{name}.mha")) for name in ("projections", "grid"))
    (n_u, n_v, n_views), (d_u, d_v, _), (u, v, first) = stack.GetSize(), stack.GetSpacing(), stack.GetOrigin()
    assert first == 0 and n_views == len(angles)
    matrices = [np.reshape(node.text.split(), (3, 4)).astype(float) for node in root.iter("Matrix")]
    assert len(matrices) == n_views
    words = {"dso": float(root.findtext("SourceToIsocenterDistance"))}
    words |= {"dsd": float(root.findtext("SourceToDetectorDistance")), "n_detector": (n_v, n_u)}
    middle = {"d_detector": (d_v, d_u), "off_detector": (v + (n_v - 1) / 2 * d_v, u + (n_u - 1) / 2 * d_u)}
    sides = zip(grid.GetSize(), grid.GetSpacing(), grid.GetOrigin(), strict=True)
    x, y, z = (o + np.arange(n) * d for n, d, o in sides)
    return rtk(angles, type("G", (), words | middle)), sitk.GetArrayFromImage(stack), mesh(x, y, z)


def read_astra(out):
    """ASTRA's cone_vec: rows of source, detector centre, u step, v step; data are (row, view, column)."""
    g = json.loads((out / "geometry.json").read_bytes())
    rays, volume = g["proj_geom"], g["vol_geom"]
    source, centre, u, v = np.split(np.load(out / "vectors.npy"), 4, axis=1)
    n_v, n_u = rays["DetectorRowCount"], rays["DetectorColCount"]
    source, pixels = spread(source, centre, (np.arange(n_v) - (n_v - 1) / 2, v), (np.arange(n_u) - (n_u - 1) / 2, u))
    axes = []
    for axis, count in (("X", "GridColCount"), ("Y", "GridRowCount"), ("Z", "GridSliceCount")):
        low, high = (volume["option"][f"Window{end}{axis}"] for end in ("Min", "Max"))
        axes.append(low + (np.arange(volume[count]) + 0.5) * (high - low) / volume[count])
    assert rays["type"] == "cone_vec"
    return (source, pixels.swapaxes(0, 1)), np.load(out / "projections.npy"), mesh(*axes)


def read_leap(out):
    """LEAP's load_param: a key and a value a line, angles in degrees with commas."""
    lines = (out / "parameters.cfg").read_text(encoding="utf-8").splitlines()
    g = {key: value for key, _, value in (line.partition(" = ") for line in lines)}
    text = {key for key, value in g.items() if not value.replace(".", "", 1).lstrip("-").isdigit()}
    assert text == {"geometry", "phis"}  # LEAP 1.26 reads any other value as a number, and wants each of these three
    assert (g["geometry"], *(float(g[key]) for key in ("tau", "helicalPitch", "tiltAngle"))) == ("cone", 0, 0, 0)
    n, d = (int(g["numRows"]), int(g["numCols"])), (float(g["pixelHeight"]), float(g["pixelWidth"]))
    off = [((k - 1) / 2 - float(g[c])) * size for k, size, c in zip(n, d, ("centerRow", "centerCol"), strict=True)]
    words = {"dso": float(g["sod"]), "dsd": float(g["sdd"]), "n_detector": n, "d_detector": d, "off_detector": off}
    angles = np.array([float(angle) for angle in g["phis"].split(",")])
    assert len(angles) == int(g["numAngles"])
    width = {"X": "voxelWidth", "Y": "voxelWidth", "Z": "voxelHeight"}
    axes = (centres(int(g[f"num{a}"]), float(g[width[a]]), float(g[f"offset{a}"])) for a in "XYZ")
    return leap(angles, type("G", (), words)), np.load(out / "projections.npy"), mesh(*axes)


def read_r2(out):
    g = json.loads((out / "meta_data.json").read_bytes())
    s = g["scanner"]
    told = {"dso": s["DSO"], "dsd": s["DSD"], "n_detector": s["nDetector"]}
    told["d_detector"] = np.divide(s["sDetector"], s["nDetector"])
    angles = np.array([frame["angle"] for frame in g["proj_train"]])
    images = np.stack([np.load(out / frame["file_path"]) for frame in g["proj_train"]])
    few = np.stack([np.load(out / frame["file_path"]) for frame in g["proj_test"]])
    assert np.array_equal(few, images[::10])
    axes = (centres(n, size / n, o) for n, size, o in zip(s["nVoxel"], s["sVoxel"], s["offOrigin"], strict=True))
    low = np.subtract(s["offOrigin"], np.divide(s["sVoxel"], 2))
    np.testing.assert_allclose(g["bbox"], [low, low + s["sVoxel"]])
    return r2(angles, type("G", (), told)), images, mesh(*axes)


def naf(angles, g):
    """src/dataset/tigre.py, get_rays: W and H are nDetector's first and second, rows go down from the top."""
    (w, h), (d_w, d_h), (off_w, off_h) = g["nDetector"], g["dDetector"] / 1000, g["offDetector"] / 1000
    u, v = (np.arange(w) + 0.5 - w / 2) * d_w + off_w, (np.arange(h) + 0.5 - h / 2) * d_h + off_h
    zero, cos, sin = 0 * angles, np.cos(angles), np.sin(angles)
    across, down, ahead = (
        np.stack(axis, -1) for axis in ((-sin, cos, zero), (zero, zero, zero - 1), (-cos, -sin, zero))
    )
    source = g["DSO"] / 1000 * np.stack([cos, sin, zero], -1)
    return spread(source, source + g["DSD"] / 1000 * ahead, (v, down), (u, across))


def read_naf(out):
    g = pickle.loads(out.read_bytes())
    assert len(g["train"]["angles"]) == g["numTrain"] and len(g["val"]["angles"]) == g["numVal"] == 1
    assert np.array_equal(g["val"]["projections"], g["train"]["projections"][::10])
    source, pixels = naf(g["train"]["angles"], g)
    axes = (centres(n, d, 0) for n, d in zip(g["nVoxel"], g["dVoxel"], strict=True))  # get_voxels has no offset
    return (1000 * source, 1000 * pixels), g["train"]["projections"], mesh(*axes)


READERS = {
    "tigre": read_tigre,
    "rtk": read_rtk,
    "astra": read_astra,
    "leap": read_leap,
    "r2": read_r2,
    "naf": read_naf,
}


def by_value(values, points):
    """Return points [..., xyz] in the order of the values that they belong to."""
    order = np.argsort(values, axis=None)
    return points.reshape(-1, 3)[order]


def pixels_of(g):
    """Return the detector's pixel centres, [view, v, u, xyz] in mm."""
    _, centre, u, v = np.split(g.pose_array(), 4, axis=1)
    n_v, n_u = g.n_detector
    _, pixels = spread(None, centre, (np.arange(n_v) - (n_v - 1) / 2, v), (np.arange(n_u) - (n_u - 1) / 2, u))
    return pixels


def name_of(to):
    return f"scan{LAYOUTS[to].file}"


@pytest.mark.parametrize("to", READERS)
def test_every_reading_and_voxel_is_where_the_library_has_it(tmp_path, to):
    scan = measured(HELD[to])
    write_scan(tmp_path / name_of(to), to, scan)
    (source, pixels), values, voxels = READERS[to](tmp_path / name_of(to))
    g = scan.geometry

    def frame(points):
        return points_to(Library.RTK, points) if to == "rtk" else points

    assert np.array_equal(np.sort(values, axis=None), np.sort(scan.p, axis=None)) and values.dtype == np.float32
    np.testing.assert_allclose(frame(g.pose_array()[:, :3]), source, **CLOSE)
    np.testing.assert_allclose(by_value(values, pixels), by_value(scan.p, frame(pixels_of(g))), **CLOSE)
    z, y, x = g.voxel_centres()
    if to == "rtk":  # its x, y, z are our y, z, x
        np.testing.assert_allclose(voxels, mesh(y, z, x), rtol=0, atol=1e-12)
    else:
        np.testing.assert_allclose(voxels, mesh(x, y, z), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("to", "scale"), [("r2", 1), ("naf", 1000)])
def test_the_true_volume_lies_on_the_voxels(tmp_path, to, scale):
    """R2-Gaussian compares in the unit of its lengths, here 1/mm, and NAF in 1/m."""
    scan = measured(HELD[to])
    out = tmp_path / name_of(to)
    write_scan(out, to, scan)
    _, _, voxels = READERS[to](out)
    image = pickle.loads(out.read_bytes())["image"] if to == "naf" else np.load(out / "vol_gt.npy")
    z, y, x = np.meshgrid(*scan.geometry.voxel_centres(), indexing="ij")
    ours = by_value(scan.reference, np.stack([x, y, z], -1))
    np.testing.assert_allclose(by_value(image, voxels), ours, rtol=0, atol=1e-12)
    assert np.array_equal(np.sort(image, axis=None), np.sort(scan.reference * np.float32(scale), axis=None))


def test_counts_come_back_from_data_exchange(tmp_path):
    assert LAYOUTS.keys() - READERS.keys() == {"dxchange"}
    g = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0))
    scan = measured(msgspec.structs.replace(g, off_detector=(0.0, -3.0)))  # the format holds neither axis nor grid
    write_scan(tmp_path / "a.h5", "dxchange", scan)
    found = exchange.open_scan(tmp_path / "a.h5", Stated())
    np.testing.assert_allclose(found.geometry.pose_array(), g.pose_array(), rtol=0, atol=1e-9)
    for view in range(g.n_views):
        assert np.array_equal(found.read(view), scan.counts[view].astype(np.float64) - scan.dark)
    assert np.array_equal(found.flat, scan.flat - np.float32(scan.dark))
    with h5py.File(tmp_path / "a.h5") as file:  # as the format's reference has it: the first row is the top one
        assert np.array_equal(file["exchange/data"][1, 0], scan.counts[1, -1])
        assert file["exchange/data"].dtype == np.uint16 and file["exchange/data_white"].shape == (1, *g.n_detector)
        assert np.diff(file["exchange/theta"]) == pytest.approx(-g.arc_deg / g.n_views)


class Arrays(pickle.Unpickler):
    """Loads arrays and nothing else."""

    def find_class(self, module, name):
        assert (module.partition(".")[0], name) in {
            ("numpy", "ndarray"),
            ("numpy", "dtype"),
            ("numpy", "_reconstruct"),
            ("numpy", "_frombuffer"),
        }
        return super().find_class(module, name)


def test_the_pickle_holds_arrays_numbers_and_names_only(tmp_path):
    write_scan(tmp_path / "a.pickle", "naf", measured(HELD["naf"]))
    with (tmp_path / "a.pickle").open("rb") as file:
        assert Arrays(file).load()["mode"] == "cone"


def test_a_pickle_is_read_back_as_it_was(tmp_path):
    """NAF's rays have the detector as (u, v) with v downwards."""
    given = measured(HELD["naf"])
    write_scan(tmp_path / "a.pickle", "naf", given)
    found = scans.open_scan(tmp_path / "a.pickle")
    for name in ("n_voxel", "d_voxel", "off_origin", "n_detector", "d_detector", "off_detector", "dso", "dsd"):
        np.testing.assert_allclose(getattr(found.geometry, name), getattr(given.geometry, name), rtol=1e-12)
    kept = [k for k in range(4) if k % 10]
    np.testing.assert_array_equal([found.read(k) for k in range(3)], given.p[kept])


def test_a_square_detector_whose_axes_cannot_be_told_apart_is_refused(tmp_path):
    square = msgspec.structs.replace(HELD["naf"], n_detector=(6, 6))
    write_scan(tmp_path / "a.pickle", "naf", measured(square))
    with pytest.raises(InputError, match=r"has the dDetector .* on a square detector"):
        scans.open_scan(tmp_path / "a.pickle")
    plain = msgspec.structs.replace(square, d_detector=(0.5, 0.5), off_detector=(0.0, 0.0))
    write_scan(tmp_path / "b.pickle", "naf", measured(plain))
    assert scans.open_scan(tmp_path / "b.pickle").geometry.d_detector == (0.5, 0.5)


@pytest.mark.parametrize(
    ("to", "change", "said"),
    [
        ("dxchange", {}, "off_detector is (2.0, -3.0) mm"),
        ("r2", {}, "off_detector is (2.0, -3.0) mm"),
        ("naf", {}, "off_origin is (4.0, -5.0, 6.0) mm"),
        ("leap", {}, "square in x and y, but d_voxel is (1.0, 2.0, 3.0)"),
        ("rtk", {"poses": tuple(map(tuple, GEOMETRY.pose_array()))}, "given by poses"),
    ],
)
def test_what_a_layout_cannot_hold_is_refused(tmp_path, to, change, said):
    scan = measured(msgspec.structs.replace(GEOMETRY, **change))
    with pytest.raises(InputError, match=f"^--to {to}: ") as caught:
        write_scan(tmp_path / "a", to, scan)
    assert said in str(caught.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("to", sorted(LAYOUTS))
def test_a_measured_scan_is_written_where_no_truth_is_needed(tmp_path, to):
    """R2-Gaussian and NAF do not start without a true volume; the others never see one."""
    centred = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0), off_origin=(0.0, 0.0, 0.0))
    whole = measured(HELD.get(to, centred))
    scan, out = dataclasses.replace(whole, reference=None), tmp_path / ("a" + LAYOUTS[to].file)
    if to in ("r2", "naf"):
        with pytest.raises(InputError, match="comes without one: expected tigre, rtk, astra, leap, dxchange"):
            write_scan(out, to, scan)
        assert not list(tmp_path.iterdir())
        return
    write_scan(out, to, scan)
    write_scan(tmp_path / ("b" + LAYOUTS[to].file), to, whole)
    assert content_of(out) == content_of(tmp_path / ("b" + LAYOUTS[to].file))


def content_of(path):
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return [(p.relative_to(path), p.read_bytes()) for p in files]
