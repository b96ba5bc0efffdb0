"""A folder of DICOM slices as one volume: one series of CT, evenly spaced, from an upright gantry, not compressed.

Rows and columns lie along ImageOrientationPatient; slices are ordered by ImagePositionPatient, whatever their names.
"""

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pydicom.filereader
from numpy.typing import NDArray
from pydicom.dataelem import RawDataElement
from pydicom.uid import UID, ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from ctsim.errors import InputError
from ctsim.io.payload import declared, quoted
from ctsim.io.volumes.frame import Axes, axes_of, unit_vectors
from ctsim.io.volumes.volumefile import VolumeFile

PLAIN = (ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian)
LARGEST = 2**28  # bytes of a file: a slice of 8192² has half of it
UNEVEN = 0.1
"""How far a slice may be off its even place, in gaps: stored positions are rounded, a missing slice is a whole gap."""
OFF = 0.05  # of the gap between positions, by which SpacingBetweenSlices may be rounded
TILT = 0.05  # degrees, below which a gantry is upright
SAME = {
    "Rows": 1,
    "Columns": 1,
    "PixelSpacing": 2,
    "ImageOrientationPatient": 6,
    "BitsAllocated": 1,
    "BitsStored": 1,
    "HighBit": 1,
    "PixelRepresentation": 1,
    "RescaleSlope": 1,
    "RescaleIntercept": 1,
    "SpacingBetweenSlices": 1,
}
"""What all slices of a volume share, and how many numbers it has."""
OPTIONAL = ("RescaleSlope", "RescaleIntercept", "SpacingBetweenSlices")
OTHERS = ("ImagePositionPatient", "SeriesInstanceUID", "SeriesDescription", "Modality", "SamplesPerPixel")
OTHERS += ("NumberOfFrames", "GantryDetectorTilt", "RescaleType")
Values = tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Slice:
    """What the header of one slice says: the values of `SAME` by name, its position in mm, its series.

    `unit` is its RescaleType, "" for HU.

    Its pixels are `n_bytes` that begin `offset` bytes into the file.
    """

    path: Path
    shared: dict[str, Values]
    position: NDArray[np.float64]
    series: str
    description: str
    unit: str
    big_endian: bool
    offset: int
    n_bytes: int


def open_volume(path: Path) -> VolumeFile:
    """Read the headers of all slices in a folder, whose other files and sub-folders are left out."""
    if not path.is_dir():
        raise InputError(f"{path} is one file; expected the folder that holds all slices of a series")
    slices = [found for file in sorted(path.iterdir()) if file.is_file() and (found := _read_slice(file))]
    if len(slices) < 2:
        raise InputError(
            f"{path} holds {len(slices)} DICOM slices (not counting sub-folders), expected one series of at least two"
        )
    _check_same(path, slices)
    first, shared = slices[0], slices[0].shared
    key = "ImageOrientationPatient"  # a row's direction, then a column's
    along = unit_vectors(first.path, key, np.reshape(shared[key], (2, 3)))
    slices.sort(key=lambda s: float(s.position @ np.cross(along[0], along[1])))
    dtype = _dtype(first)
    shape = declared(path, (len(slices), int(shared["Rows"][0]), int(shared["Columns"][0])), dtype)
    if math.prod(shape) * dtype.itemsize > (there := sum(s.path.stat().st_size for s in slices)):
        raise InputError(f"{path} has {there} bytes, fewer than pixels of the shape {shape} that its slices declare")
    slope, intercept = shared["RescaleSlope"], shared["RescaleIntercept"]
    if slope and slope[0] <= 0:
        raise InputError(f"{first.path} has RescaleSlope = {slope[0]:g}, expected a positive number")
    if intercept and not slope:
        raise InputError(f"{first.path} has RescaleIntercept = {intercept[0]:g} and no RescaleSlope, expected both")
    axes = _axes(path, slices, along)

    def read() -> NDArray[Any]:
        out = np.empty(shape, dtype.newbyteorder("="))
        for k, one in enumerate(slices):
            out[k] = _pixels(one)
        return out

    return VolumeFile(
        path=path,
        files=tuple(s.path for s in slices),
        shape=shape,
        dtype=dtype,
        read=read,
        axes=axes,
        rescale=(slope[0], intercept[0] if intercept else 0.0) if slope else None,
        unit=next((s.unit for s in slices if s.unit), ""),
    )


def _read_slice(path: Path) -> Slice | None:
    """Return what the header of a slice says; None for another file: no DICOM, or none with an image."""
    found = _dataset(path)
    if found is None or (found.get("Rows") is None and found.get("Modality") != "CT"):
        return None
    if (modality := found.get("Modality")) != "CT":
        raise InputError(f"{path} has the Modality {quoted(str(modality))}, expected CT")
    if (found.get("NumberOfFrames") or 1) != 1 or (found.get("SamplesPerPixel") or 1) != 1:
        raise InputError(f"{path} holds several frames or colours, expected one slice of grey values")
    tilt = _numbers(path, found, "GantryDetectorTilt", 1, optional=True)
    if tilt and abs(tilt[0]) > TILT:
        raise InputError(
            f"{path} was taken with the gantry tilted by {tilt[0]:g}° (GantryDetectorTilt); "
            "expected 0°: resample the series first"
        )
    position = _numbers(path, found, "ImagePositionPatient", 3)
    offset, n_bytes = _pixels_in(found)
    unit = str(found.get("RescaleType") or "").strip()
    return Slice(
        path=path,
        shared={key: _numbers(path, found, key, n, optional=key in OPTIONAL) for key, n in SAME.items()},
        position=np.array(position),
        series=str(found.get("SeriesInstanceUID") or ""),
        description=str(found.get("SeriesDescription") or "without a description"),
        unit="" if unit == "HU" else unit,
        big_endian=found.file_meta.TransferSyntaxUID == ExplicitVRBigEndian,
        offset=offset,
        n_bytes=n_bytes,
    )


def _dataset(path: Path) -> pydicom.FileDataset | None:
    """Parse what is used of a file, of which nothing is decompressed; None for a file that is no DICOM file."""
    with path.open("rb") as file:
        is_dicom = file.read(132)[128:] == b"DICM" or path.name.lower().endswith((".dcm", ".ima"))
    if path.name == "DICOMDIR" or not is_dicom:
        return None
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has more than {LARGEST} bytes, expected a DICOM slice")
    data = path.read_bytes()  # not the file: of that, room would be made for what a length declares
    syntax = _coding(data)
    if not isinstance(syntax, UID):
        raise InputError(f"{path} does not say how it is coded (TransferSyntaxUID); expected a DICOM slice")
    if syntax not in PLAIN:
        raise InputError(
            f"{path} is compressed ({quoted(syntax.name)}), expected plain pixels, as gdcmconv --raw writes"
        )
    return pydicom.dcmread(io.BytesIO(data), specific_tags=[*SAME, *OTHERS, "PixelData"])


def _coding(data: bytes) -> Any:
    """Return the transfer syntax of a file. pydicom, where it parses a deflated file, inflates it whole."""
    meta = pydicom.filereader.read_dataset(
        io.BytesIO(data[132:]), is_implicit_VR=False, is_little_endian=True, stop_when=lambda tag, *_: tag.group != 2
    )
    return meta.get("TransferSyntaxUID")


def _pixels_in(found: pydicom.Dataset) -> tuple[int, int]:
    """Return where in its file the pixels of a slice begin, and how many bytes they are; none where there are none."""
    raw = found.get_item("PixelData") if "PixelData" in found else None
    if not isinstance(raw, RawDataElement) or not raw.value:
        return 0, 0
    return raw.value_tell, len(raw.value)


def _numbers(path: Path, found: pydicom.Dataset, key: str, count: int, *, optional: bool = False) -> Values:
    """Return the finite numbers of an attribute; none where it may be left out and is."""
    value = found.get(key)
    if optional and value in (None, ""):
        return ()
    try:
        values = tuple(float(v) for v in (value if count > 1 else [value]))
    except (TypeError, ValueError):
        values = ()
    if len(values) != count or not np.isfinite(values).all():
        shown = "none" if value in (None, "") else quoted(str(value))
        raise InputError(f"{path} has the {key} {shown}, expected {count} finite number{'s' * (count > 1)}")
    return values


def _check_same(folder: Path, slices: list[Slice]) -> None:
    """Refuse slices of several series, and slices that do not fit onto each other."""
    series: dict[str, list[Slice]] = {}
    for one in slices:
        series.setdefault(one.series, []).append(one)
    if len(series) > 1:
        names = [f"{len(found)} slices {quoted(found[0].description)}" for found in list(series.values())[:5]]
        raise InputError(
            f"{folder} holds {len(series)} series ({'; '.join(names)}{'; …' * (len(series) > 5)}); "
            "expected one: move the others to folders of their own"
        )
    first = slices[0]
    for one in slices[1:]:
        for key, value in one.shared.items():
            if len(value) != len(first.shared[key]) or not np.allclose(value, first.shared[key], rtol=1e-4, atol=1e-4):
                raise InputError(
                    f"{one.path} has the {key} {value}, {first.path.name} {first.shared[key]}; expected equal slices"
                )


def _axes(folder: Path, slices: list[Slice], along: NDArray[np.float64]) -> Axes:
    """Return the axes of ordered slices. Raises InputError where they are not evenly spaced, or sheared."""
    positions = np.array([s.position for s in slices])
    step = (positions[-1] - positions[0]) / (len(slices) - 1)
    rows, columns = slices[0].shared["PixelSpacing"]  # between rows, then between columns
    axes = axes_of(np.array([step, along[1] * rows, along[0] * columns]), folder)
    gaps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    off = np.linalg.norm(positions - positions[0] - np.arange(len(slices))[:, None] * step, axis=1)
    if off.max() > UNEVEN * np.linalg.norm(step):
        raise InputError(
            f"{folder} has slices {gaps.min():.4g} to {gaps.max():.4g} mm apart, expected equal gaps: "
            "a slice is missing or there twice, or the series must be resampled first"
        )
    gap, stated = float(np.linalg.norm(step)), np.abs(slices[0].shared["SpacingBetweenSlices"])
    if stated.any() and np.abs(stated - gap).max() > OFF * gap:  # some write 0 for none
        raise InputError(
            f"{folder} contradicts itself: slices are {stated[0]:g} mm apart by SpacingBetweenSlices, {gap:g} mm by "
            "ImagePositionPatient; expected the same, or no SpacingBetweenSlices"
        )
    return axes


def _dtype(one: Slice) -> np.dtype[Any]:
    """Return the type of the stored pixels. Raises InputError for bits that are none of a slice."""
    allocated, stored, high, signed = (
        int(one.shared[key][0]) for key in ("BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation")
    )
    if allocated not in (8, 16, 32) or not 0 < stored <= high + 1 <= allocated or signed not in (0, 1):
        raise InputError(
            f"{one.path} stores bits 0 to {high} of {allocated}, {stored} of them used; expected 8, 16 or 32 with room"
        )
    return np.dtype(f"{'>' if one.big_endian else '<'}{'i' if signed else 'u'}{allocated // 8}")


def _pixels(one: Slice) -> NDArray[Any]:
    """Return the stored values of a slice; bits outside of those that are used are left out."""
    dtype = _dtype(one)
    rows, columns = (int(one.shared[key][0]) for key in ("Rows", "Columns"))
    size = rows * columns * dtype.itemsize
    with one.path.open("rb") as file:
        file.seek(one.offset)
        data = file.read(one.n_bytes)
    if len(data) not in (size, size + size % 2):
        raise InputError(f"{one.path} holds {len(data) or 'no'} bytes of pixels, its header declares {size}")
    values = np.frombuffer(data, dtype, rows * columns).astype(dtype.newbyteorder("=")).reshape(rows, columns)
    stored, high = (int(one.shared[key][0]) for key in ("BitsStored", "HighBit"))
    bits = dtype.itemsize * 8
    return (values << (bits - 1 - high)) >> (bits - stored)  # the shift to the right repeats the sign
