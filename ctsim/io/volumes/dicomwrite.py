"""A volume as a folder of DICOM slices (CT Image Storage), in HU: 16 bits a voxel, head first and supine.

Identifiers follow from the content, so that the same volume gives the same bytes.
"""

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, generate_uid
from pydicom.valuerep import format_number_as_ds

from ctsim.dataset.durable import making
from ctsim.errors import InputError
from ctsim.io.volumes.placed import Placed

INTERCEPT = -1024  # HU of the stored value 0, unless the volume has less
MOST = 2**16 - 1
EMPTY = ("StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName", "PatientBirthDate", "PatientSex")
EMPTY += ("PositionReferenceIndicator", "AcquisitionNumber", "KVP", "StudyID")
"""Attributes that DICOM wants to be there, if only empty."""


def write_volume(path: Path, volume: Placed) -> None:
    """Write a volume in HU as a new folder of slices.

    Values are rounded to a step of 1 HU, or of the least power of two at which their range fits into 16 bits.
    Raises InputError for a volume of one slice, and for values that are not finite.
    """
    stored, rescale = quantised(path, volume.values)
    with making(path) as folder:
        shown = repr((rescale, volume.spacing, volume.centre, stored.shape)).encode()
        series = hashlib.sha256(shown + stored.tobytes()).hexdigest()
        for k, image in enumerate(stored):
            one = _slice(volume, series, k)
            one.SeriesDescription = path.name[:64]
            _add_place(one, volume, k)
            _add_pixels(one, image, rescale)
            one.save_as(folder / f"{k:04d}.dcm", enforce_file_format=True)


def quantised(path: Path, values: NDArray[Any]) -> tuple[NDArray[np.uint16], tuple[int, int]]:
    """Return stored values, and slope and intercept that turn them into HU."""
    if not np.isfinite(values).all() or len(values) < 2:
        raise InputError(f"{path}: DICOM needs finite HU and at least two slices, got the shape {values.shape}")
    intercept = min(INTERCEPT, math.floor(values.min()))
    slope = 1
    while (float(values.max()) - intercept) / slope > MOST:
        slope *= 2
    return np.rint((values.astype(np.float64) - intercept) / slope).astype("<u2"), (slope, intercept)


def _slice(volume: Placed, series: str, k: int) -> FileDataset:
    """Return slice k of a volume without place and pixels; `series` identifies the volume's content."""
    study = volume.study or series
    series = study + series
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = _uid(series, f"slice {k}")
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    one = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    one.SOPClassUID, one.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
    one.StudyInstanceUID, one.FrameOfReferenceUID = _uid(study, "study"), _uid(study, "frame")
    one.SeriesInstanceUID = _uid(series, "series")
    for keyword in EMPTY:
        setattr(one, keyword, None)
    one.PatientName = one.PatientID = volume.subject[:64]
    one.Modality, one.Manufacturer, one.PatientPosition = "CT", "ctsim", "HFS"
    one.ImageType = ["DERIVED", "SECONDARY", "AXIAL"]
    one.SeriesNumber, one.InstanceNumber = 1, k + 1
    return one


def _add_place(one: FileDataset, volume: Placed, k: int) -> None:
    """Say where the middle of the slice's first pixel is, and how large its voxels are."""
    x, y, z = volume.first.tolist()
    dz, dy, dx = (format_number_as_ds(float(d)) for d in volume.spacing)
    one.ImagePositionPatient = [format_number_as_ds(v) for v in (x, y, z + k * volume.spacing[0])]
    one.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    one.PixelSpacing = [dy, dx]
    one.SliceThickness = one.SpacingBetweenSlices = dz


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
