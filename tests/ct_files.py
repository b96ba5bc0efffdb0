"""One small CT in every format, written by other libraries than ours: SimpleITK, nibabel, pydicom, tifffile."""

from pathlib import Path

import nibabel
import numpy as np
import pydicom
import SimpleITK as sitk
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian

SPACING = (2.0, 1.5, 0.8125)  # of a volume [z, y, x]


def corner(shape=(5, 7, 11)):
    """HU [z, y, x] that no turn maps onto themselves: noise of all tissues, one corner of bone, another of air."""
    hu = np.random.default_rng(7).integers(-1000, 1000, shape).astype(np.int16)
    hu[0, 0, 0], hu[-1, -1, -1] = 1500, -1000
    return hu


def oblique():
    """Return the directions (x, y, z) of the axes z, y, x of a volume, turned by 9° and 6°."""
    a, b = np.radians([9.0, 6.0])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return (about_z @ about_x).T[::-1]


def stored(hu, order=(0, 1, 2), flips=(False, False, False), spacing=SPACING, directions=None):
    """Return a volume as a file may hold it, its axes in another order and direction, and the steps along them."""
    steps = (oblique() if directions is None else directions) * np.array(spacing)[:, None]
    array = np.transpose(hu, order)[tuple(slice(None, None, -1 if flip else 1) for flip in flips)]
    return np.ascontiguousarray(array), steps[list(order)] * np.where(flips, -1, 1)[:, None]


def write(folder: Path, kind: str, array, steps) -> Path:
    """Write an array with its steps (x, y, z) in mm along each of its axes; return the path."""
    if kind == "dicom":
        return write_slices(folder / "slices", array, steps)
    path = folder / f"ct{kind}"
    if kind in (".nii", ".nii.gz"):
        affine = np.eye(4)
        affine[:3, :3] = np.diag([-1, -1, 1]) @ steps[::-1].T
        affine[:3, 3] = (40, -30, 20)
        nibabel.Nifti1Image(array.T, affine).to_filename(path)
        return path
    image = sitk.GetImageFromArray(array)
    lengths = np.linalg.norm(steps, axis=1)
    image.SetSpacing(lengths[::-1].tolist())
    image.SetDirection((steps / lengths[:, None])[::-1].T.reshape(-1).tolist())
    image.SetOrigin((40.0, -30.0, 20.0))
    sitk.WriteImage(image, str(path), useCompression=kind in (".mha", ".nrrd"))
    return path


def write_slices(folder: Path, array, steps, **changes) -> Path:
    """Write int16 HU as DICOM slices with an intercept of −1024; `changes` are attributes of every slice."""
    folder.mkdir(parents=True, exist_ok=True)
    lengths = np.linalg.norm(steps, axis=1)
    for k, image in enumerate(array):
        one = slice_of(image + 1024, 40 * np.ones(3) + k * steps[0], f"1.2.3.{k + 1}")
        one.ImageOrientationPatient = [f"{v:.10f}" for v in (steps[::-1][:2] / lengths[::-1][:2, None]).reshape(-1)]
        one.PixelSpacing = [f"{v:.8f}" for v in lengths[1:]]
        for keyword, value in changes.items():
            setattr(one, keyword, value)
        one.save_as(folder / f"IM{37 * k % 53:02d}", enforce_file_format=True)  # names are in no order
    return folder


def slice_of(image, position, uid) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = CTImageStorage, uid
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    one = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    one.SOPClassUID, one.SOPInstanceUID = CTImageStorage, uid
    one.Modality, one.SeriesInstanceUID, one.SeriesDescription = "CT", "1.2.3", "head"
    one.ImagePositionPatient = [f"{v:.8f}" for v in position]
    one.Rows, one.Columns = image.shape
    one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
    one.BitsAllocated, one.BitsStored, one.HighBit, one.PixelRepresentation = 16, 12, 11, 0
    one.RescaleSlope, one.RescaleIntercept = 1, -1024
    one.PixelData = image.astype("<u2").tobytes()
    return one


def reread(path: Path) -> pydicom.FileDataset:
    return pydicom.dcmread(path)
