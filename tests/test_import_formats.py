"""Simulated scans in HDF5, in the walnuts' layout and in those of R2-Gaussian and NAF: the same values and geometry."""

import collections
import pickle

import h5py
import msgspec
import numpy as np
import pytest
import scan_files
import torch
from closed_scans import BODY, GEOMETRY, METAL, counts_of, line_integrals

from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.work import bring
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.io.scans import formats as scans
from ctsim.io.scans.openfield import open_field
from ctsim.io.scans.scanfile import Stated
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.types import Scan

P = line_integrals(GEOMETRY, (*BODY, *METAL))
DARK = (100 + np.arange(40) % 7 + np.zeros((2, 32, 1))).astype(np.uint16)
FLAT = (40000 + 50 * np.arange(32)[:, None] + DARK[0] + np.zeros((3, 1, 1))).astype(np.uint16)
COUNTS = (counts_of(P, level=20000) + DARK[0]).astype(np.uint16)
SIGNAL = (COUNTS - DARK[0].astype(float)).astype(np.float32)
NEAR = 1e-5
"""Of the largest attenuation: what poses that differ by 1e-7 of their size and float32 sums leave."""


def brought(folder, source, **flags):
    return open_scan(bring(Flags(scan=source, out=folder / "data", **({"center": "file", "hold": 0} | flags))))


def same_fdk(stored, true: Scan) -> None:
    """Compare FDK of an import with that of the original, on the grid of the import."""
    here = stored.geometry
    grid = msgspec.structs.replace(
        true.geometry, n_voxel=here.n_voxel, d_voxel=here.d_voxel, off_origin=here.off_origin
    )
    one = fdk(Scan(geometry=grid, counts=true.counts, flat=true.flat, i0=stored.info.i0)).values.numpy()
    assert one.max() > 0.03
    assert np.abs(fdk(stored.scan).values.numpy() - one).max() < NEAR * one.max()


def signal_scan() -> Scan:
    flat = torch.from_numpy((FLAT[0] - DARK[0].astype(float)).astype(np.float32))
    return Scan(geometry=GEOMETRY, counts=torch.from_numpy(SIGNAL), flat=flat)


@pytest.mark.parametrize("n_views", [2, 3, 24, 40])
def test_photons_are_told_by_two_different_views(n_views):
    images = np.random.default_rng(1).poisson(1e4, (n_views, 64, 80)).astype(np.float32)
    found = open_field(lambda view: images[view], n_views, 0.0)
    # strips of 64 x 2 pixels and more tell a deviation to a tenth, and photons, by its square, to a quarter
    assert found.photons == pytest.approx(1e4, rel=0.25) and not found.note
    images[:-1] /= 3  # a body that covers the sides in all views but the last
    found = open_field(lambda view: images[view], n_views, 0.0)
    assert found.photons is not None and found.level == pytest.approx(1e4, rel=0.01)
    assert open_field(lambda view: images[view], 1, 0.0).photons is None


@pytest.mark.parametrize("photons", [1e5, 1e4, 300.0])
@pytest.mark.parametrize("transmission", [0.3, 0.6])
def test_the_level_of_a_narrow_open_edge_is_found(photons, transmission):
    """An object that covers all columns leaves three rows open at either end: their level is found, not a brighter one.

    Choosing the pixels by their noise misleads the median by less than half the noise of one.
    """
    image = np.full((64, 64), transmission)
    image[:3] = image[-3:] = 1.0
    found = open_field(lambda view: np.random.default_rng(view).poisson(photons * image) / photons, 24, 0.0)
    assert abs(found.level - 1) < 0.4 / photons**0.5 and found.photons is None and "brightest pixels" in found.note


@pytest.mark.parametrize("write", [scan_files.dxchange, scan_files.nxtomo])
def test_hdf5(tmp_path, write):
    centred = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0))  # the formats have no place for it
    stored = brought(tmp_path, write(tmp_path / "rods.h5", COUNTS, GEOMETRY, FLAT, DARK))
    assert np.array_equal(stored.scan.counts.numpy(), SIGNAL)
    assert np.array_equal(stored.scan.flat.numpy(), signal_scan().flat.numpy())
    assert np.allclose(stored.geometry.pose_array(), centred.pose_array(), rtol=1e-9, atol=1e-9)
    same_fdk(stored, Scan(geometry=centred, counts=torch.from_numpy(SIGNAL), flat=signal_scan().flat))


def test_lengths_that_hdf5_lacks_are_asked_for(tmp_path):
    path = scan_files.dxchange(tmp_path / "rods.h5", COUNTS, GEOMETRY, FLAT, DARK)
    with h5py.File(path, "a") as file:
        del file["measurement/instrument/source"]
    with pytest.raises(InputError, match="does not say how far the source is from the axis; expected --dso MM"):
        scans.open_scan(path)
    found = scans.open_scan(path, stated=Stated(dso=150.0, dsd=300.0)).geometry
    assert (found.dso, found.dsd) == (150.0, 300.0)


def test_hdf5_opens_no_other_file(tmp_path):
    other = scan_files.dxchange(tmp_path / "other.h5", COUNTS, GEOMETRY, FLAT, DARK)
    path = tmp_path / "rods.h5"

    def refused(change):
        scan_files.dxchange(path, COUNTS, GEOMETRY, FLAT, DARK)
        with h5py.File(path, "a") as file:
            del file["exchange/data"]
            change(file)
        with pytest.raises(InputError, match=r"another file|its own data"):
            scans.open_scan(path)

    refused(lambda file: file.__setitem__("exchange/data", h5py.ExternalLink("other.h5", "/exchange/data")))
    layout = h5py.VirtualLayout((24, 32, 40), np.uint16)
    layout[:] = h5py.VirtualSource(str(other), "exchange/data", (24, 32, 40))
    refused(lambda file: file.create_virtual_dataset("exchange/data", layout))
    raw = [(str(other), 0, COUNTS.nbytes)]
    refused(lambda file: file.create_dataset("exchange/data", (24, 32, 40), np.uint16, external=raw))

    def twice(file):
        file["far"] = h5py.ExternalLink("other.h5", "/exchange")
        file["exchange/data"] = h5py.SoftLink("/far/data")

    refused(twice)


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("left", [False, True])
def test_walnuts(tmp_path, down, left):
    """The vectors of a circle about another axis, columns and rows in either direction."""
    moved = GEOMETRY.pose_array() + np.array([1.5, -2.0, 4.0] * 2 + [0.0] * 6)
    moved[:, 6:9] *= -1 if left else 1
    moved[:, 9:] *= -1 if down else 1
    turned = (slice(None), slice(None, None, -1 if down else 1), slice(None, None, -1 if left else 1))
    source = scan_files.walnut(tmp_path / "nut", COUNTS[turned], moved, FLAT[turned], DARK[turned])
    stored = brought(tmp_path, source)
    assert np.array_equal(stored.scan.counts.numpy(), SIGNAL)
    found = stored.geometry
    assert np.allclose(found.off_origin, (-4.0, 2.0, -1.5))
    assert np.allclose(found.pose_array(), GEOMETRY.pose_array(), atol=1e-9)
    same_fdk(stored, signal_scan())


def test_walnuts_off_the_circle_keep_their_poses(tmp_path):
    poses = GEOMETRY.pose_array()
    poses[:, 2] += np.linspace(0, 3, 24)
    scan = scans.open_scan(scan_files.walnut(tmp_path / "nut", COUNTS, poses, FLAT, DARK))
    assert np.array_equal(scan.geometry.pose_array(), poses)
    assert np.array_equal(scan.read(3), SIGNAL[3])
    assert "on no circle" in scan.notes[0]
    poses = GEOMETRY.pose_array()
    poses[5, 2] += 0.3  # all of it but the mean's share of 1/24 is seen at the detector: 0.2875 of 1.6 mm
    scan = scans.open_scan(scan_files.walnut(tmp_path / "nut", COUNTS, poses, FLAT, DARK))
    assert scan.geometry.poses is None and "stray at most 0.18" in scan.notes[0]


@pytest.mark.parametrize("write", [scan_files.r2, scan_files.naf])
def test_line_integrals(tmp_path, write):
    true = msgspec.structs.replace(GEOMETRY, off_detector=(1.2, 0.8), off_origin=(1.0, -2.0, 3.0))
    p = line_integrals(true, (*BODY, *METAL))
    stored = brought(tmp_path, write(tmp_path / "rods.pickle", p, true, test=(3, 10)), hold=None, i0=1e9)
    kept = [k for k in range(24) if k not in (3, 10)]
    same = stored.geometry
    assert (same.n_voxel, same.off_origin, same.n_detector) == (true.n_voxel, true.off_origin, true.n_detector)
    assert np.allclose(same.d_voxel, true.d_voxel)
    assert np.allclose(same.pose_array(), true.pose_array()[kept])
    held = stored.info.held
    assert held is not None and np.allclose(held.pose_array(), true.pose_array()[[3, 10]])
    # float32 twice, once of p and once of counts: 2⁻²⁴ of p and of 1
    assert np.allclose(-np.log(stored.scan.counts.double().numpy() / 1e9), p[kept], rtol=1e-7, atol=1e-7)
    angles = tuple(np.degrees(true.angles[kept]).tolist())
    part = msgspec.structs.replace(true, n_views=22, angles_deg=angles)
    same_fdk(stored, Scan.from_line_integrals(p[kept], part, e_max=90.0, i0=1e9))


@pytest.mark.parametrize("protocol", range(2, 6))
def test_every_protocol_of_pickles(tmp_path, protocol):
    scan = scans.open_scan(scan_files.naf(tmp_path / "rods.pickle", P, GEOMETRY, protocol=protocol))
    assert np.array_equal(scan.read(5), P[5].astype(np.float32))


class Evil:
    def __reduce__(self):
        return print, ("called",)


@pytest.mark.parametrize(
    "found", [Evil(), {"train": Evil()}, {"train": np.array([{}], object)}, collections.OrderedDict()]
)
def test_no_pickle_runs_anything(tmp_path, capsys, found):
    (tmp_path / "evil.pickle").write_bytes(pickle.dumps(found))
    with pytest.raises(InputError, match=r"expected plain values and arrays|no numbers"):
        scans.open_scan(tmp_path / "evil.pickle")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["../secret.npy", "/etc/passwd", "proj_train/link.npy", "", "."])
def test_r2_reads_its_folder_only(tmp_path, name):
    folder = scan_files.r2(tmp_path / "r2", P, GEOMETRY)
    np.save(tmp_path / "secret.npy", P[0])
    (folder / "proj_train/link.npy").symlink_to(tmp_path / "secret.npy")
    text = (folder / "meta_data.json").read_text()
    (folder / "meta_data.json").write_text(text.replace("proj_train/proj_train_0002.npy", name))
    with pytest.raises(InputError, match="expected a file in its folder"):
        scans.open_scan(folder)


def test_lengths_are_stated_once(tmp_path):
    with pytest.raises(InputError, match="states its lengths"):
        scans.open_scan(scan_files.r2(tmp_path / "r2", P, GEOMETRY), stated=Stated(dso=1.0))


@pytest.mark.parametrize("write", [scan_files.r2, scan_files.naf])
def test_a_view_for_testing_is_not_reconstructed_from(tmp_path, write):
    path = write(tmp_path / "rods.pickle", P, GEOMETRY, test=(3, 11), both=True)
    scan = scans.open_scan(path, "r2" if write is scan_files.r2 else "naf")
    kept = [k for k in range(len(P)) if k not in (3, 11)]
    assert scan.held == (len(kept), len(kept) + 1)
    for k, view in enumerate([*kept, 3, 11]):
        assert np.allclose(scan.read(k), P[view], atol=1e-6)
    every = scans.open_scan(write(tmp_path / "all.pickle", P, GEOMETRY, test=tuple(range(len(P))), both=True), "auto")
    assert every.held == () and every.geometry.n_views == len(P)  # nothing else to reconstruct from


def in_units(tmp_path, angles, unit=None):
    path = scan_files.dxchange(tmp_path / "a.h5", COUNTS, GEOMETRY, FLAT, DARK)
    with h5py.File(path, "r+") as file:
        theta = file["exchange/theta"]
        theta[...] = angles
        del theta.attrs["units"]
        if unit is not None:
            theta.attrs["units"] = unit
    return path


@pytest.mark.parametrize("unit", ["rad", "Radians", np.array([b"rad"], object), None, "degree", "°"])
def test_angles_are_in_the_unit_that_is_stated(tmp_path, unit):
    """Some writers store a list of one; without a unit a turn of degrees is one."""
    angles = -GEOMETRY.angles if "rad" in str(unit).lower() else -np.degrees(GEOMETRY.angles)
    assert np.allclose(scans.open_scan(in_units(tmp_path, angles, unit)).geometry.angles, GEOMETRY.angles)


@pytest.mark.parametrize("turns", [0.5, 1.0, 2.0])
def test_angles_without_a_unit_that_may_be_radians_are_refused(tmp_path, turns):
    path = in_units(tmp_path, np.linspace(0, turns * 2 * np.pi, len(GEOMETRY.angles), endpoint=False))
    with pytest.raises(
        InputError, match=r"'exchange/theta' has no attribute units and spans \d+\.\d+, which may be rad"
    ):
        scans.open_scan(path)


def test_angles_in_another_unit_are_refused(tmp_path):
    with pytest.raises(InputError, match="'exchange/theta' is in 'gon', expected deg or rad"):
        scans.open_scan(in_units(tmp_path, np.degrees(GEOMETRY.angles), "gon"))


def test_an_entry_of_nxtomo_may_lie_one_group_deeper(tmp_path):
    path = scan_files.nxtomo(tmp_path / "a.h5", COUNTS, GEOMETRY, FLAT, DARK)
    with h5py.File(path, "r+") as file:
        (name,) = (name for name in file if "instrument" in file[name])
        file.move(name, "entry1/tomo_entry")
    assert scans.open_scan(path).geometry.n_views == len(GEOMETRY.angles)


@pytest.mark.parametrize(("turn", "refused"), [(0.0, True), (360.0, True), (1.0, False)])
def test_views_from_one_side_are_refused(tmp_path, turn, refused):
    source = in_units(tmp_path, 30 + turn * np.arange(24), "deg")
    if not refused:
        assert brought(tmp_path, source).geometry.n_views == 24
        return
    with pytest.raises(InputError, match=r"a.h5 has 24 views from one side, expected angles that differ"):
        brought(tmp_path, source)
    assert not (tmp_path / "data").exists()


def test_one_view_is_imported(tmp_path):
    one = msgspec.structs.replace(GEOMETRY, n_views=1)
    source = scan_files.dxchange(tmp_path / "a.h5", COUNTS[:1], one, FLAT, DARK)
    assert brought(tmp_path, source).geometry.n_views == 1


@pytest.mark.parametrize("name", ["data", "data_white", "data_dark"])
@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_images_of_hdf5_without_a_number_are_refused(tmp_path, name, value):
    source = scan_files.dxchange(tmp_path / "a.h5", COUNTS.astype(float), GEOMETRY, FLAT.astype(float), DARK * 1.0)
    with h5py.File(source, "r+") as file:
        file[f"exchange/{name}"][...] = value
    with pytest.raises(InputError, match=r"a.h5: every pixel has readings that are not finite, the first in"):
        brought(tmp_path, source)
    assert not (tmp_path / "data").exists()


def test_a_pixel_without_an_open_field_is_dead(tmp_path):
    flat = FLAT.astype(np.float32)
    flat[1, 4, 6] = np.nan
    stored = brought(tmp_path, scan_files.dxchange(tmp_path / "a.h5", COUNTS, GEOMETRY, flat, DARK))
    assert "the first in the open field at column 6 of row 4 from below" in " ".join(stored.info.notes)
    assert np.argwhere(stored.scan.flat.numpy() == 0).tolist() == [[4, 6]]


@pytest.mark.parametrize("write", [scan_files.naf, scan_files.r2])
def test_line_integrals_that_nothing_holds_are_refused(tmp_path, write):
    def with_value(where, value):
        p = P.copy()
        p[where] = value
        return write(tmp_path / f"{len(list(tmp_path.iterdir()))}.pickle", p, GEOMETRY)

    with pytest.raises(InputError, match=r"a line integral of view 5 is -1000, expected -50 or more"):
        brought(tmp_path, with_value(5, -1e3))
    with pytest.raises(InputError, match=r"every pixel has readings that are not finite"):
        brought(tmp_path, with_value(slice(None), np.nan))
    assert not (tmp_path / "data").exists()
    stored = brought(tmp_path, with_value((5, 3, 7), np.nan))
    between = np.exp(-(P[5, 3, 6] + P[5, 3, 8]) / 2)
    assert stored.scan.counts[5, 3, 7] / stored.info.i0 == pytest.approx(between, rel=1e-5)
    assert np.argwhere(stored.scan.flat.numpy() == 0).tolist() == [[3, 7]]
