"""A volume as a folder of DICOM slices (CT Image Storage), in HU: 16 bits a voxel, head first and supine.

Identifiers follow from the content, so that the same volume gives the same bytes.
"""

import hashlib
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, generate_uid
from pydicom.valuerep import format_number_as_ds

from ctsim.dataset.durable import put_in_place
from ctsim.errors import InputError
from ctsim.geometry import Triple

INTERCEPT = -1024  # HU of the stored value 0, unless the volume has less
MOST = 2**16 - 1
EMPTY = ("StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName", "PatientBirthDate", "PatientSex")
EMPTY += ("PositionReferenceIndicator", "AcquisitionNumber", "KVP", "StudyID")
"""Attributes that DICOM wants to be there, if only empty."""


def write_volume(path: Path, values: NDArray[Any], spacing: Triple, centre: Triple) -> None:
    """Write a volume [z, y, x] in HU as a new folder; `spacing` and the `centre` of the array (z, y, x) are mm.

    Values are rounded to a step of 1 HU, or of the least power of two at which their range fits into 16 bits.
    Raises InputError for a volume of one slice, and for values that are not finite.
    """
    stored, rescale = quantised(path, values)
    folder = path.with_name(f".{path.name}.partial")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        shown = repr((rescale, spacing, centre, stored.shape)).encode()
        identity = hashlib.sha256(shown + stored.tobytes()).hexdigest()
        z, y, x = (c - (n - 1) / 2 * d for c, n, d in zip(centre, stored.shape, spacing, strict=True))
        for k, image in enumerate(stored):
            one = _slice(identity, k, path.name[:64])
            _add_place(one, (x, y, z + k * spacing[0]), spacing)
            _add_pixels(one, image, rescale)
            one.save_as(folder / f"{k:04d}.dcm", enforce_file_format=True)
        put_in_place(folder, path)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def quantised(path: Path, values: NDArray[Any]) -> tuple[NDArray[np.uint16], tuple[int, int]]:
    """Return stored values, and slope and intercept that turn them into HU."""
    if not np.isfinite(values).all() or len(values) < 2:
        raise InputError(f"{path}: DICOM needs finite HU and at least two slices, got the shape {values.shape}")
    intercept = min(INTERCEPT, math.floor(values.min()))
    slope = 1
    while (float(values.max()) - intercept) / slope > MOST:
        slope *= 2
    return np.rint((values.astype(np.float64) - intercept) / slope).astype("<u2"), (slope, intercept)


def _slice(identity: str, k: int, name: str) -> FileDataset:
    """Return slice k of a volume without place and pixels; its identifiers follow from the volume's `identity`."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = _uid(identity, f"slice {k}")
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    one = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    one.SOPClassUID, one.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
    one.StudyInstanceUID, one.SeriesInstanceUID = _uid(identity, "study"), _uid(identity, "series")
    one.FrameOfReferenceUID = _uid(identity, "frame")
    for keyword in EMPTY:
        setattr(one, keyword, None)
    one.PatientName = one.PatientID = one.SeriesDescription = name
    one.Modality, one.Manufacturer, one.PatientPosition = "CT", "ctsim", "HFS"
    one.ImageType = ["DERIVED", "SECONDARY", "AXIAL"]
    one.SeriesNumber, one.InstanceNumber = 1, k + 1
    return one


def _add_place(one: FileDataset, first: Triple, spacing: Triple) -> None:
    """Say where the slice's first pixel (x, y, z) is, in mm, and how large its voxels (z, y, x) are."""
    one.ImagePositionPatient = [format_number_as_ds(float(v)) for v in first]
    one.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    one.PixelSpacing = [format_number_as_ds(float(v)) for v in spacing[1:]]
    one.SliceThickness = one.SpacingBetweenSlices = format_number_as_ds(float(spacing[0]))


def _add_pixels(one: FileDataset, image: NDArray[np.uint16], rescale: tuple[int, int]) -> None:
    one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
    one.Rows, one.Columns = image.shape
    one.BitsAllocated = one.BitsStored = 16
    one.HighBit, one.PixelRepresentation = 15, 0
    one.RescaleSlope, one.RescaleIntercept, one.RescaleType = *rescale, "HU"
    one.WindowCenter, one.WindowWidth = 40, 400
    one.PixelData = image.tobytes()


def _uid(identity: str, of: str) -> UID:
    return generate_uid(entropy_srcs=[identity, of])
