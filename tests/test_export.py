"""Volumes that we write, read by other libraries: every value, and where every corner is in mm."""

import itertools

import msgspec
import nibabel
import numpy as np
import pydicom
import pytest
import scan_files
import SimpleITK as sitk
from closed_scans import GEOMETRY, counts_of
from closed_scans import line_integrals as projected
from ct_files import SPACING, corner

from ctsim.benchmarks import cli
from ctsim.benchmarks.importing import Flags as Import
from ctsim.benchmarks.importing.work import bring
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.dataset.interop import Library, volume_to
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.io.volumes import dicomwrite, metaimage, nifti
from ctsim.io.volumes.formats import open_volume
from ctsim.io.volumes.placed import Placed
from ctsim.materials import attenuation
from ctsim.reconstruct.log import line_integrals

CENTRE = (10.0, -20.0, 35.5)  # z, y, x
GRID = Geometry(
    dso=400.0,
    dsd=900.0,
    n_voxel=(5, 7, 11),
    d_voxel=SPACING,
    n_detector=(7, 11),
    d_detector=(1.5, 0.5),
    n_views=5,
    off_origin=CENTRE,
)
WRITERS = {"ct.nii": nifti, "ct.nii.gz": nifti, "ct.mha": metaimage, "slices": dicomwrite}


def placed(values, **of):
    return Placed(values=values, spacing=SPACING, centre=CENTRE, **of)


def with_itk(path):
    """Read a file or a folder of slices with SimpleITK, whose frame is LPS."""
    if path.is_dir():
        reader = sitk.ImageSeriesReader()
        reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(path)))
        return reader.Execute()
    return sitk.ReadImage(str(path))


@pytest.mark.parametrize("name", WRITERS)
def test_another_library_finds_every_voxel_where_it_was(tmp_path, name):
    values = corner().astype(np.float32)
    WRITERS[name].write_volume(tmp_path / name, placed(values))
    image = with_itk(tmp_path / name)
    assert np.array_equal(sitk.GetArrayFromImage(image), values)
    z, y, x = GRID.voxel_centres()
    for k, j, i in itertools.product((0, 4), (0, 6), (0, 10)):
        # the places are tens of mm, which NIfTI holds as float32: 2⁻²⁴ · 64 mm = 4e-6 mm
        assert image.TransformIndexToPhysicalPoint((i, j, k)) == pytest.approx((x[i], y[j], z[k]), abs=4e-6)


@pytest.mark.parametrize("name", WRITERS)
def test_our_reader_returns_what_we_wrote(tmp_path, name):
    values = corner().astype(np.float32)
    WRITERS[name].write_volume(tmp_path / name, placed(values))
    found = open_volume(tmp_path / name)
    slope, intercept = found.rescale or (1, 0)
    assert np.array_equal(found.values() * slope + intercept, values) and found.spacing == SPACING


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("name", ["ct.nii.gz", "ct.mha"])
def test_values_keep_their_type(tmp_path, name, dtype):
    values = np.abs(corner()).astype(dtype)
    WRITERS[name].write_volume(tmp_path / name, placed(values))
    found = sitk.GetArrayFromImage(with_itk(tmp_path / name))
    assert found.dtype == dtype and np.array_equal(found, values)


def test_nifti_states_its_frame_and_unit(tmp_path):
    nifti.write_volume(tmp_path / "ct.nii", placed(corner()))
    head = nibabel.load(tmp_path / "ct.nii").header
    assert head.get_xyzt_units()[0] == "mm" and head["sform_code"] == head["qform_code"] == 1
    np.testing.assert_allclose(head.get_sform(), head.get_qform(), atol=1e-5)


def test_metaimage_refuses_a_type_that_it_lacks(tmp_path):
    with pytest.raises(InputError, match="MetaImage has no float16"):
        metaimage.write_volume(tmp_path / "ct.mha", placed(corner().astype(np.float16)))


@pytest.mark.parametrize(("low", "high", "slope"), [(-1000, 3000, 1), (-5000.4, 60000, 1), (-1024, 64512, 2)])
def test_slices_hold_all_hu_to_half_a_step(tmp_path, low, high, slope):
    values = corner().astype(np.float32)
    values[0, 0, 0], values[1, 2, 3] = low, high
    dicomwrite.write_volume(tmp_path / "a", placed(values))
    found = sitk.GetArrayFromImage(with_itk(tmp_path / "a"))
    assert np.abs(found - values).max() <= slope / 2
    assert {float(pydicom.dcmread(p).RescaleSlope) for p in (tmp_path / "a").iterdir()} == {slope}


def test_the_same_volume_gives_the_same_slices_and_another_others(tmp_path):
    for name, change in (("a/ct", 0), ("b/ct", 0), ("c/ct", 1)):
        (tmp_path / name).parent.mkdir()
        dicomwrite.write_volume(tmp_path / name, placed(corner().astype(np.float32) + change))
    a, b = ([p.read_bytes() for p in sorted((tmp_path / name / "ct").iterdir())] for name in "ab")
    assert a == b
    first, other = (pydicom.dcmread(tmp_path / name / "ct/0000.dcm") for name in "ac")
    for keyword in ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID", "FrameOfReferenceUID"):
        assert first[keyword].value != other[keyword].value


def test_volumes_of_a_study_share_its_frame(tmp_path):
    for name, change in (("a", 0), ("b", 1)):
        dicomwrite.write_volume(tmp_path / name, placed(corner() + change, subject="hip", study="one"))
    first, other = (pydicom.dcmread(tmp_path / name / "0000.dcm") for name in "ab")
    for keyword in ("StudyInstanceUID", "FrameOfReferenceUID", "PatientName"):
        assert first[keyword].value == other[keyword].value
    assert first.SeriesInstanceUID != other.SeriesInstanceUID


@pytest.mark.parametrize("values", [np.full((3, 4, 5), np.nan), np.zeros((1, 4, 5))])
def test_what_is_no_ct_is_not_written_as_slices(tmp_path, values):
    with pytest.raises(InputError, match="finite HU and at least two slices"):
        dicomwrite.write_volume(tmp_path / "a", placed(values))
    assert not list(tmp_path.iterdir())


def run(monkeypatch, *words):
    monkeypatch.setattr("sys.argv", ["make-dataset", "export", *map(str, words)])
    return cli.make_dataset()


def test_help_lists_the_command(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["make-dataset", "--help"])
    with pytest.raises(SystemExit):
        cli.make_dataset()
    assert "  export        write a volume or a scan for other programs\n" in capsys.readouterr().out


def test_the_command_writes_references_labels_and_reconstructions(smallest, tmp_path, monkeypatch, capsys):
    scan = smallest / "smallest"
    stored = open_scan(scan)
    truth, at_50 = stored.reference("effective"), stored.reference("50kev")
    assert run(monkeypatch, scan, tmp_path / "a.nii.gz", "--to", "nifti") == 0
    assert "10 × 12 × 12 voxels of" in capsys.readouterr().out
    assert np.array_equal(sitk.GetArrayFromImage(with_itk(tmp_path / "a.nii.gz")), truth)
    assert run(monkeypatch, scan, tmp_path / "b", "--to", "dicom", "--volume", "reference_50kev") == 0
    (water,) = attenuation("water", np.array([50.0]))
    found = sitk.GetArrayFromImage(with_itk(tmp_path / "b"))
    assert np.abs(found - (at_50 / water - 1) * 1000).max() < 0.51  # rounded to 1 HU, float32
    assert run(monkeypatch, scan, tmp_path / "c.mha", "--to", "mha", "--volume", "labels") == 0
    assert np.array_equal(sitk.GetArrayFromImage(with_itk(tmp_path / "c.mha")), stored.labels)
    np.save(tmp_path / "mine.npy", truth.astype(np.float64) * 1.5)
    assert run(monkeypatch, scan, tmp_path / "d.mha", "--to", "mha", "--volume", tmp_path / "mine.npy", "--hu") == 0
    found = sitk.GetArrayFromImage(with_itk(tmp_path / "d.mha"))
    np.testing.assert_allclose(found, (truth * 1.5 / effective_attenuation(stored) - 1) * 1000, atol=1e-2)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("{scan}", "{new}.nii", "--to", "mha"), "expected a name that ends in .mha"),
        (("{scan}", "{new}.dcm", "--to", "dicom"), "will be a folder of slices, expected a name without .dcm"),
        (("{scan}", "{scan}", "--to", "dicom"), "is there already, expected a new name"),
        (("{scan}", "{new}", "--to", "dicom", "--volume", "labels"), "holds uint8, which is no attenuation"),
        (("{scan}", "{new}.mha", "--to", "mha", "--volume", "counts"), "expected a volume on the grid (10, 12, 12)"),
        (("{scan}", "{new}.mha", "--to", "mha", "--volume", "nowhere"), "nowhere is no file and none of labels, metal"),
        (("{scan}", "{new}.mha", "--to", "mha", "--volume", "{scan}/flat.tif"), "expected (10, 12, 12)"),
        (("{scan}", "{new}.mha", "--to", "mha", "--hu", "--kev", "0"), "--kev must be within 1 to 800, got 0"),
        (
            ("{scan}", "{new}.nii", "--to", "nifti", "--kev", "60"),
            "--kev says at which energy water is 0 HU: expected --hu",
        ),
        (("{new}", "{new}.mha", "--to", "mha"), "no such scene folder"),
        (
            ("{scan}/metal_free", "{new}", "--to", "rtk"),
            "metal_free is the twin of {scan}: expected that one, with --twin",
        ),
        (("{scan}", "{new}", "--to", "rtk", "--twin", "--hu"), "expected neither --volume, --hu nor --kev"),
        (("{scan}", "{new}.nii", "--to", "nifti", "--twin"), "a volume of the twin is --volume metal_free/NAME"),
    ],
)
def test_a_wrong_call_is_one_sentence_and_writes_nothing(smallest, tmp_path, monkeypatch, capsys, words, sentence):
    filled = [word.format(scan=smallest / "smallest", new=tmp_path / "new") for word in words]
    assert run(monkeypatch, *filled) == 2
    said = capsys.readouterr().err
    assert (
        sentence.format(scan=smallest / "smallest") in said and said.count("\n") == 1 and not list(tmp_path.iterdir())
    )


def test_the_twin_is_written_as_a_scan_of_its_own(smallest, tmp_path, monkeypatch, capsys):
    stored = open_scan(smallest / "smallest")
    twin = stored.metal_free
    for name, of, words in (("a", stored, ()), ("b", twin, ("--twin",))):
        assert run(monkeypatch, stored.folder, tmp_path / name, "--to", "rtk", *words) == 0
        found = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / name / "projections.mha")))
        assert np.array_equal(found, line_integrals(of.scan, slice(None))[0].numpy())
    with_metal, without = ((tmp_path / name / "projections.mha").read_bytes() for name in "ab")
    assert with_metal != without
    assert all((tmp_path / "a" / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in ("geometry.xml",))
    assert run(monkeypatch, stored.folder, tmp_path / "c", "--to", "r2", "--twin") == 0
    true = np.load(tmp_path / "c" / "vol_gt.npy")
    assert np.array_equal(true, volume_to(Library.R2_GAUSSIAN, twin.reference("effective")))
    assert not np.array_equal(true, volume_to(Library.R2_GAUSSIAN, stored.reference("effective")))


def test_a_measured_scan_has_neither_twin_nor_true_volume(tmp_path, monkeypatch, capsys):
    few = msgspec.structs.replace(GEOMETRY, n_views=6)
    log = scan_files.skyscan(tmp_path / "scan", counts_of(projected(few)), few)
    folder = bring(Import(scan=log, out=tmp_path / "data", center="0"))
    capsys.readouterr()
    for words, sentence in (
        (
            ("a.nii", "--to", "nifti"),
            "--volume: reference_effective is no file, and a measured scan has no true volume",
        ),
        (("a", "--to", "rtk", "--twin"), "--twin: the scan 'rods' has no metal-free twin"),
    ):
        assert run(monkeypatch, folder, tmp_path / words[0], *words[1:]) == 2
        said = capsys.readouterr().err
        assert sentence in said and said.count("\n") == 1 and not (tmp_path / words[0]).exists()
