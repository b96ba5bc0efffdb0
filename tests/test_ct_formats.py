"""A CT in every format is the same body, and what makes a volume doubtful is refused in one sentence."""

import hashlib
import itertools
import os
import re
import shutil
import sys

import nibabel
import numpy as np
import pydicom
import pytest
import tifffile
from ct_files import SPACING, corner, oblique, stored, write, write_slices
from scipy import ndimage

from ctsim.errors import InputError
from ctsim.io.volumes.formats import open_volume
from ctsim.phantoms import ct_headers
from ctsim.phantoms.bodies.volume import TISSUES, CtVolume
from ctsim.phantoms.dataset import plan_scene
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scene import build, parse_suite, scene_id

KINDS = ("dicom", ".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")
PLACED = [(order, flips) for order in itertools.permutations(range(3)) for flips in ((False,) * 3, (True, False, True))]
GRID = {"size": 20.0, "n_voxel": (20, 26, 30), "metal": "none"}


def body(path, **changes):
    return build_recipe(CtVolume(**({"path": str(path)} | GRID | changes)), 0)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "ct.npy"
    np.save(path, corner())
    return body(path, spacing=SPACING)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("order", "flips"), PLACED)
def test_every_format_and_orientation_is_the_same_body_to_the_bit(expected, tmp_path, kind, order, flips):
    found = body(write(tmp_path, kind, *stored(corner(), order, flips)))
    assert np.array_equal(found.labels, expected.labels) and np.array_equal(found.density, expected.density)


def test_the_marked_corner_is_right_front_and_at_the_feet(expected):
    """x, y, z point to the patient's left, back and head, so the first voxel is the rightmost one, in front, below."""
    bone = np.argwhere(expected.labels == TISSUES.index("cortical_bone"))
    inside = np.argwhere(expected.labels)
    assert (bone.min(0) == inside.min(0)).all()


def test_tiff_is_taken_as_it_lies(expected, tmp_path):
    tifffile.imwrite(tmp_path / "ct.tif", (corner() + 1024).astype(np.uint16))
    found = body(tmp_path / "ct.tif", spacing=SPACING, rescale=(1.0, -1024.0))
    assert np.array_equal(found.labels, expected.labels)


@pytest.mark.parametrize(
    ("dtype", "coding"), [(np.int32, ".nii"), (np.float32, ".mha"), (np.float64, ".nrrd"), (">i2", ".nii")]
)
def test_the_stored_type_does_not_matter(expected, tmp_path, dtype, coding):
    array, steps = stored(corner())
    assert np.array_equal(body(write(tmp_path, coding, array.astype(dtype), steps)).labels, expected.labels)


def test_units_of_metres_and_a_slope_are_those_of_the_file(expected, tmp_path):
    array, steps = stored(corner())
    affine = np.eye(4)
    affine[:3, :3] = np.diag([-1, -1, 1]) @ steps[::-1].T / 1000
    image = nibabel.Nifti1Image((array * 2 + 2048).T, affine)
    image.header.set_xyzt_units("meter")
    image.header.set_slope_inter(0.5, -1024)
    data = bytearray(image.to_bytes())
    data[112:120] = np.array([0.5, -1024], "<f4").tobytes()  # nibabel stores values that it scales itself
    (tmp_path / "ct.nii").write_bytes(data)
    found = open_volume(tmp_path / "ct.nii")
    assert found.rescale == (0.5, -1024.0) and found.spacing == SPACING
    assert np.array_equal(body(tmp_path / "ct.nii").labels, expected.labels)


def test_signs_and_overlays_in_the_bits_of_a_slice_are_understood(expected, tmp_path):
    """12 bits with a sign, above which an old overlay stands."""
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    for path in folder.iterdir():
        one = pydicom.dcmread(path)
        values = np.frombuffer(one.PixelData, "<u2").astype(np.int32) - 1024
        one.PixelRepresentation, one.RescaleIntercept = 1, 0
        one.PixelData = ((values & 0x0FFF) | 0x5000).astype("<u2").tobytes()
        one.save_as(path)
    assert np.array_equal(body(folder).labels, expected.labels)


def test_slices_of_another_byte_order_are_understood(expected, tmp_path):
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    for name, syntax, order in (("IM37", "1.2.840.10008.1.2.2", ">u2"), ("IM05", "1.2.840.10008.1.2", "<u2")):
        one = pydicom.dcmread(folder / name)
        one.PixelData = np.frombuffer(one.PixelData, "<u2").astype(order).tobytes()
        one.file_meta.TransferSyntaxUID = syntax
        assert len(list(one.iterall())) > 10  # decoded before they are written in another order
        little = order == "<u2"
        pydicom.dcmwrite(folder / name, one, implicit_vr=little, little_endian=little, enforce_file_format=True)
    assert np.array_equal(body(folder).labels, expected.labels)


def test_a_scene_says_what_its_file_says(tmp_path):
    path = write(tmp_path, ".mha", *stored(corner()))
    scene = 'name = "head"\nphantom = {{ recipe = "ct_volume", path = "{}", {} size = 20.0 }}\n'
    scene += "scanner = {{ n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 4 }}"
    (short,), (full,) = (
        parse_suite(scene.format(path, more)) for more in ("", f"spacing = {list(SPACING)}, rescale = [1.0, 0.0],")
    )
    assert short == full and scene_id(short) == scene_id(full)
    assert short.phantom.spacing == SPACING and short.phantom.rescale == (1.0, 0.0)


def test_the_hash_of_a_folder_is_that_of_its_slices_whatever_their_names(tmp_path):
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    before = CtVolume(path=str(folder))
    (folder / "notes.txt").write_text("not a slice")
    with (folder / "backup.zip").open("wb") as file:
        file.truncate(2**29)  # larger than any slice, and not read
    (folder / "IM00").rename(folder / "z")
    assert CtVolume(path=str(folder)).sha256 == before.sha256
    one = pydicom.dcmread(folder / "z")
    one.PixelData = bytes(len(one.PixelData))
    one.save_as(folder / "z")
    with pytest.raises(InputError, match=r"has the SHA-256 .*, the scene was made of"):
        build_recipe(before, 0)


def test_a_scene_parses_and_hashes_each_slice_once(tmp_path, monkeypatch):
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    text = f'name = "head"\nphantom = {{ recipe = "ct_volume", path = "{folder}", size = 20.0 }}\n'
    text += "scanner = { n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 4 }"
    parsed, hashed, dcmread, file_digest = [], [], pydicom.dcmread, hashlib.file_digest
    monkeypatch.setattr(pydicom, "dcmread", lambda *a, **k: parsed.append(1) or dcmread(*a, **k))
    monkeypatch.setattr(hashlib, "file_digest", lambda *a: hashed.append(1) or file_digest(*a))
    # as if the slices, written just now, were old; as new ones they are read for every use
    for settled, times in ((0.0, 1), (3600.0, 3)):
        monkeypatch.setattr(ct_headers, "SETTLED", settled)
        (scene,) = parse_suite(text)
        plan_scene(scene)
        build(scene)
        assert (len(parsed), len(hashed)) == (5 * times, 5 * times)
        parsed.clear(), hashed.clear()
    # another file under the same name, size and time of change is another file
    old = (folder / "IM00").stat()
    one = pydicom.dcmread(folder / "IM00")
    one.PixelData = bytes(len(one.PixelData))
    monkeypatch.setattr(ct_headers, "SETTLED", 0.0)
    one.save_as(folder / "IM00")
    os.utime(folder / "IM00", ns=(old.st_atime_ns, old.st_mtime_ns))
    with pytest.raises(InputError, match=r"has the SHA-256 .*, the scene was made of"):
        build(scene)


def test_the_hash_of_a_header_holds_its_data(tmp_path):
    path = write(tmp_path, ".mhd", *stored(corner()))
    before = CtVolume(path=str(path)).sha256
    (tmp_path / "ct.raw").write_bytes((corner() + 1).tobytes())
    assert CtVolume(path=str(path)).sha256 != before


def refused(path, words, **changes):
    with pytest.raises(InputError) as caught:
        body(path, **changes)
    assert re.search(words, str(caught.value)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"spacing": (2.0, 1.5, 1.0)}, r"spacing: got \(2\.0, 1\.5, 1\.0\) mm, but .* says \(2\.0, 1\.5, 0\.8125\)"),
        ({"rescale": (1.0, -1000.0)}, r"rescale: got \(1\.0, -1000\.0\), but .* says \(1\.0, -1024\.0\)"),
        (
            {"path": "nowhere"},
            r"path: nowhere cannot be read .*; expected a folder of DICOM slices, NIfTI file",
        ),
        ({"existing_metal": "keep"}, "existing_metal must be"),
        ({"metal_hu": 10.0}, "metal_hu must be within 1000 to 100000"),
    ],
)
def test_a_recipe_that_contradicts_its_file_is_refused(tmp_path, changes, words):
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    refused(words=words, **{"path": folder, **changes})


def tilted(array, steps):
    return array, np.array([[0.0, 0.5, 2.0], *steps[1:]])


UPRIGHT = np.eye(3)[::-1]
DOUBTFUL = {
    "a tilted gantry": ({"GantryDetectorTilt": "15"}, r"gantry tilted by 15° \(GantryDetectorTilt\)"),
    "another modality": ({"Modality": "MR"}, "has the Modality 'MR', expected CT"),
    "no spacing": ({"PixelSpacing": None}, "has the PixelSpacing none, expected 2 finite numbers"),
    "frames": ({"NumberOfFrames": "4"}, "several frames or colours"),
    "bits": ({"HighBit": 9}, "stores bits 0 to 9 of 16, 12 of them used"),
    "a slope of 0": ({"RescaleSlope": "0"}, "RescaleSlope = 0, expected a positive"),
    "an intercept alone": ({"RescaleSlope": None}, "RescaleIntercept = -1024 and no RescaleSlope, expected both"),
    "no HU": (
        {"RescaleSlope": None, "RescaleIntercept": None},
        r"rescale: .* grey values \(uint16\) that cannot be HU",
    ),
    "another unit": ({"RescaleType": "US"}, r"rescale: .* 'US'; expected HU, or rescale = \[1, -1024\]"),
    "two spacings": (
        {"SpacingBetweenSlices": "7"},
        "slices are 7 mm apart by SpacingBetweenSlices, 2 mm by ImagePositionPatient",
    ),
    "directions": (
        {"ImageOrientationPatient": [1, 0, 0, 0, 2, 0]},
        r"has ImageOrientationPatient of the lengths \[1\.0, 2\.0\]",
    ),
    "large size": ({"Rows": 20000, "Columns": 20000}, r"fewer than pixels of the shape \(5, 20000, 20000\)"),
    "size": ({"Rows": 8}, "holds 154 bytes of pixels, its header declares 176"),
}


@pytest.mark.parametrize(("changes", "words"), DOUBTFUL.values(), ids=DOUBTFUL)
def test_doubtful_slices_are_refused(tmp_path, changes, words):
    refused(write_slices(tmp_path / "slices", *stored(corner()), **changes), words)


def test_a_series_that_is_no_volume_is_refused(tmp_path):
    array, steps = stored(corner(), directions=UPRIGHT)
    refused(write_slices(tmp_path / "sheared", *tilted(array, steps)), "axes that meet at 75.96°")
    folder = write_slices(tmp_path / "gap", array, steps)
    (folder / "IM21").unlink()  # the third of five
    refused(folder, "slices 2 to 4 mm apart, expected equal gaps")
    shutil.copy(folder / "IM00", folder / "again")
    refused(folder, "slices 0 to 4 mm apart")
    folder = write_slices(tmp_path / "two", array, steps)
    one = pydicom.dcmread(folder / "IM00")
    one.SeriesInstanceUID, one.SeriesDescription = "1.2.4", "scout"
    one.save_as(folder / "IM99")
    refused(folder, r"holds 2 series \(5 slices 'head'; 1 slices 'scout'\)")
    refused(folder / "IM00.dcm", "cannot be read")
    refused(tmp_path, "holds 0 DICOM slices")
    one.RescaleIntercept, one.SeriesInstanceUID = 0, "1.2.3"
    one.save_as(folder / "IM99")
    refused(folder, r"IM99 has the RescaleIntercept \(0\.0,\), IM00 \(-1024\.0,\)")


def test_compressed_slices_are_refused(tmp_path):
    folder = write_slices(tmp_path / "slices", *stored(corner()))
    for path in folder.iterdir():
        one = pydicom.dcmread(path)
        one.compress("1.2.840.10008.1.2.5")
        one.save_as(path)
    refused(folder, r"compressed \('RLE Lossless'\), expected plain pixels")


def test_old_names_and_words_of_a_metaimage_are_understood(expected, tmp_path):
    path = write(tmp_path, ".mhd", *stored(corner(), (1, 0, 2)))
    text = path.read_text().replace("TransformMatrix", "Rotation")
    path.write_bytes(b"Comment = M\xfcnchen\n" + text.encode())
    assert np.array_equal(body(path).labels, expected.labels)
    path.write_text(re.sub("ElementSpacing = .*", "ElementSpacing = 1 1", text))
    refused(path, "has ElementSpacing = '1 1', expected 3 numbers")
    path.write_text(re.sub("Rotation = .*", "Rotation = 2 0 0 0 1 0 0 0 1", text))
    refused(path, r"has Rotation of the lengths \[2\.0, 1\.0, 1\.0\], expected unit vectors")


def written(folder, kind, values):
    """Write values as a format stores them, also one that states no steps."""
    array, steps = stored(values)
    if kind not in (".tif", ".npy"):
        return write(folder, kind, array, steps)
    path = folder / f"ct{kind}"
    (tifffile.imwrite if kind == ".tif" else np.save)(path, array)
    return path


@pytest.mark.parametrize("kind", [".nii", ".mha", ".nrrd", ".tif"])
def test_grey_values_without_hu_need_a_rescale(tmp_path, kind):
    path = written(tmp_path, kind, (corner() // 16 + 100).clip(0, 255).astype(np.uint8))
    refused(path, r"rescale: .* holds grey values \(uint8\) that cannot be HU", spacing=SPACING)
    assert body(path, spacing=SPACING, rescale=(16.0, -1600.0)).labels.any()


def test_a_spacing_that_no_one_states_is_missed(tmp_path):
    np.save(tmp_path / "ct.npy", corner())
    refused(tmp_path / "ct.npy", r"spacing: .*ct\.npy states none; expected the size of its voxels")


def test_a_nifti_without_or_with_two_orientations_is_refused(tmp_path):
    path = write(tmp_path, ".nii", *stored(corner()))
    data = bytearray(path.read_bytes())
    codes = data[252:256]
    data[252:256] = bytes(4)
    path.write_bytes(data)
    refused(path, r"states no orientation \(sform_code and qform_code are 0\)")
    data[252:256] = codes
    data[80:84] = np.float32(3).tobytes()  # pixdim of x
    path.write_bytes(data)
    refused(path, r"contradicts itself: its voxels are \[3\.0, 1\.5, 2\.0\] by pixdim, \[0\.8125, 1\.5, 2\.0\]")


def test_a_nifti_whose_two_orientations_differ_is_refused(expected, tmp_path):
    path = write(tmp_path, ".nii", *stored(corner()))
    image, path = nibabel.Nifti1Image.from_filename(path), tmp_path / "two.nii"
    turned, tilted = image.affine.copy(), image.affine.copy()
    turned[:2] *= -1  # as a file in LPS that passes for one in RAS
    tilted[:3, :3] = nibabel.eulerangles.euler2mat(0.2) @ tilted[:3, :3]  # the nearest axes are the same
    image.set_qform(tilted, 1)
    image.to_filename(path)
    assert np.array_equal(body(path).labels, expected.labels)
    image.set_qform(turned, 1)
    image.to_filename(path)
    refused(path, "by sform than by qform; expected the same, or a sform_code or qform_code of 0")
    image.set_qform(turned, 0)
    image.to_filename(path)
    assert np.array_equal(body(path).labels, expected.labels)


@pytest.mark.parametrize(
    "words", [{"SpacingBetweenSlices": "-2.02"}, {"SpacingBetweenSlices": "0"}, {"RescaleType": "HU"}]
)
def test_what_is_stated_twice_and_alike_is_taken(expected, tmp_path, words):
    assert np.array_equal(body(write_slices(tmp_path / "slices", *stored(corner()), **words)).labels, expected.labels)


def test_a_unit_can_be_overruled(expected, tmp_path):
    folder = write_slices(tmp_path / "slices", *stored(corner()), RescaleType="US")
    assert np.array_equal(body(folder, rescale=(1.0, -1024.0)).labels, expected.labels)


def test_metal_of_the_ct_is_refused_or_replaced_never_kept(tmp_path):
    hu = np.full((12, 20, 20), 40, np.int16)
    hu[:, :, 9:] = 900
    clean = hu.copy()
    hu[5:7, 8:10, 14:16], hu[6, 9, 6] = 9000, 3000  # an implant in bone, and a voxel at the limit
    np.save(tmp_path / "ct.npy", hu)
    given = {"spacing": (1.0, 1.0, 1.0), "rescale": (1.0, 0.0)}  # there is no air
    refused(tmp_path / "ct.npy", r"holds metal, 8 voxels above metal_hu = 3000 HU \(up to 9000\)", **given)
    np.save(tmp_path / "clean.npy", clean)
    expected = body(tmp_path / "clean.npy", **given)
    hu[6, 9, 6] = 40
    hu[6, 9, 17] = 2900  # the implant's blur, 2 mm from its last voxel
    np.save(tmp_path / "ct.npy", hu)
    found = body(tmp_path / "ct.npy", existing_metal="mask", **given)
    assert np.array_equal(found.labels, expected.labels) and np.array_equal(found.density, expected.density)
    kept = body(tmp_path / "ct.npy", existing_metal="none", **given)
    assert not np.array_equal(kept.density, expected.density)
    np.save(tmp_path / "all.npy", np.full((4, 4, 4), 5000, np.int16))
    refused(tmp_path / "all.npy", "metal_hu: all voxels are above 3000 HU", existing_metal="mask", **given)


@pytest.mark.parametrize("to", [500, 1500, 2600])
@pytest.mark.parametrize("metal", ["refuse", "mask"])
def test_metal_that_is_cut_off_below_the_limit_is_not_kept(tmp_path, to, metal):
    """Bone with an implant, blurred as a scanner does, of which the file has lost what is above `to`."""
    hu = np.full((24, 24, 24), -1000.0)
    hu[4:20, 4:20, 4:20] = 40
    hu[8:16, 8:16, 6:18] = 1200
    bone = ndimage.gaussian_filter(hu, 1.0) + np.random.default_rng(0).normal(0, 20, hu.shape)
    hu[10:14, 10:14, 8:16] = 9000
    hu = ndimage.gaussian_filter(hu, 1.0) + np.random.default_rng(0).normal(0, 20, hu.shape)
    given = {"spacing": (1.0, 1.0, 1.0), "existing_metal": metal}
    np.save(tmp_path / "ct.npy", np.minimum(hu, to).astype(np.int16))
    instead = f"or metal_hu below {to} if" if to > 1000 else "or a CT that is not cut off"  # metal_hu is at least 1000
    refused(tmp_path / "ct.npy", rf"ends at {to} HU, with \d+ voxels of that value in one piece.*{instead}", **given)
    hot = np.minimum(hu, to).astype(np.int16)
    hot[0, 0, :9] = to + 600  # letters
    np.save(tmp_path / "ct.npy", hot)
    refused(tmp_path / "ct.npy", rf"ends at {to} HU, with \d+ voxels of that value", **given)
    np.save(tmp_path / "bone.npy", bone.astype(np.int16))  # 12 bits end above it, and its brightest voxels are few
    body(tmp_path / "bone.npy", **given)


def test_metal_of_a_ct_that_is_cut_off_is_offered_what_is_taken(tmp_path):
    """A CT of 12 bits: no higher metal_hu is taken, since what is above its end is lost."""
    hu = ndimage.gaussian_filter(np.where(np.indices((24, 24, 24)).sum(0) > 40, 9000.0, -900.0), 1)
    hu += np.random.default_rng(0).normal(0, 20, hu.shape)
    np.save(tmp_path / "ct.npy", np.minimum(hu, 3071).astype(np.int16))
    given = {"spacing": (1.0, 1.0, 1.0)}
    refused(tmp_path / "ct.npy", 'holds metal.*"mask", or existing_metal = "none" if it is bone$', **given)
    body(tmp_path / "ct.npy", existing_metal="none", **given)


def test_a_drawn_volume_of_few_levels_is_not_cut_off(tmp_path):
    hu = np.full((12, 12, 12), -1000, np.int16)
    hu[3:9, 3:9, 3:9] = 1500
    np.save(tmp_path / "ct.npy", hu)
    body(tmp_path / "ct.npy", spacing=(1.0, 1.0, 1.0))


def test_grey_values_of_a_few_levels_end_without_being_cut_off(tmp_path):
    """A smooth bone in steps of 50 HU: its last level is its thinnest."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    hu = 50 * np.round((2500 * np.exp(-2 * (x * x + y * y + z * z)) - 1000) / 50)
    np.save(tmp_path / "ct.npy", hu.astype(np.int16))
    assert np.count_nonzero(hu == hu.max()) > 8
    body(tmp_path / "ct.npy", spacing=(1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("unit", "scale"),
    [
        ("mm", 1.0),
        ("\\u00B5m", 1e-3),
        ("microns", 1e-3),
        ("cm", 10.0),
        ("millimeter", 1.0),
        ("pixel", None),
        ("", None),
    ],
)
def test_the_spacing_of_an_imagej_stack_is_the_files(tmp_path, unit, scale, expected):
    """ImageJ states pixels a unit along x and y, and the unit along z; without one it states nothing."""
    path, factor = tmp_path / "ct.tif", scale or 1.0
    z, y, x = (d / factor for d in SPACING)
    told = {"spacing": z, "axes": "ZYX"} | ({"unit": unit} if unit else {})
    tifffile.imwrite(path, corner(), imagej=True, resolution=(1 / x, 1 / y), metadata=told)
    if scale is None:
        refused(path, "states none")
        assert np.array_equal(body(path, spacing=SPACING).labels, expected.labels)
        return
    assert np.array_equal(body(path).labels, expected.labels)
    assert np.array_equal(body(path, spacing=SPACING).labels, expected.labels)
    refused(path, "expected the same or none", spacing=(3.0, 3.0, 3.0))


def test_an_imagej_stack_may_have_a_unit_for_each_axis_and_pixels_of_no_size(tmp_path, expected):
    path, (z, y, x) = tmp_path / "ct.tif", SPACING
    told = {"spacing": z, "unit": "mm", "yunit": "um", "axes": "ZYX"}
    tifffile.imwrite(path, corner(), imagej=True, resolution=(1 / x, 1 / (1000 * y)), metadata=told)
    assert np.array_equal(body(path).labels, expected.labels)
    tifffile.imwrite(path, corner(), imagej=True, resolution=((0, 1), (0, 1)), metadata=told)
    refused(path, "states none")
    assert np.array_equal(body(path, spacing=SPACING).labels, expected.labels)


def test_a_name_in_capitals_is_the_same_format(tmp_path, expected):
    with (tmp_path / "CT.NPY").open("wb") as file:
        np.save(file, corner())
    assert np.array_equal(body(tmp_path / "CT.NPY", spacing=SPACING).labels, expected.labels)


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    path = write(tmp_path, ".nii", *stored(corner()))
    for name in ("nibabel", "ctsim.io.volumes.nifti"):
        monkeypatch.setitem(sys.modules, name, None) if name == "nibabel" else monkeypatch.delitem(sys.modules, name)
    refused(path, r"this format needs nibabel; pip install 'ctsim\[io\]' installs it")


def test_directions_are_a_rotation():
    assert np.allclose(oblique() @ oblique().T, np.eye(3))
    assert np.linalg.det(oblique()[::-1]) == pytest.approx(1)


NO_HU = {
    "grey values of 8 bits": lambda hu: (hu // 16 + 100).clip(0, 255),
    "HU + 1024": lambda hu: hu + 1024,
    "attenuation in 1/mm": lambda hu: (0.02 * (1 + hu / 1000)).astype(np.float32),
    "0 to 1": lambda hu: ((hu + 1000) / 2500).astype(np.float32),
    "-1 to 1": lambda hu: ((hu + 1000) / 1250 - 1).astype(np.float32),
}


@pytest.mark.parametrize("kind", [".nii.gz", ".mha", ".nrrd", ".npy"])
@pytest.mark.parametrize("change", NO_HU.values(), ids=NO_HU)
def test_values_that_are_no_hu_need_a_rescale(tmp_path, kind, change):
    path = written(tmp_path, kind, change(corner()))
    refused(path, r"rescale: .* a CT in HU has air .* or rescale = \[1, 0\]", spacing=SPACING)
    assert body(path, spacing=SPACING, rescale=(1.0, 0.0), n_inserts=0).labels.shape  # of a CT without air, say


def test_a_rescale_of_the_file_that_leads_to_no_hu_is_refused(tmp_path):
    folder = write_slices(tmp_path / "slices", *stored(corner()), RescaleIntercept="0")
    refused(folder, r"holds \d+ to \d+, but a CT in HU .* rescale = \[1, 0\]")
    assert body(folder, rescale=(1.0, 0.0), n_inserts=0, metal_hu=4000.0).labels.shape
