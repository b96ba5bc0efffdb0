"""NIfTI-1 and NIfTI-2 in one file (.nii, .nii.gz). Its frame is RAS; arrays are stored with x fastest."""

import gzip
import math
from pathlib import Path

import nibabel
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.durable import replacing
from ctsim.errors import InputError
from ctsim.io.payload import declared, inflated, raw
from ctsim.io.volumes.frame import FROM_RAS, SKEW, Axes, axes_of
from ctsim.io.volumes.placed import Placed
from ctsim.io.volumes.volumefile import VolumeFile

Header = nibabel.Nifti1Header | nibabel.Nifti2Header
UNITS = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 1e-3}
"""mm of a unit of length by its code; where none is stated it is taken for mm."""
FARTHEST = 2**20  # bytes of header and extensions
_SIZES = {348: nibabel.Nifti1Header, 540: nibabel.Nifti2Header}


def open_volume(path: Path) -> VolumeFile:
    """Read the header of a .nii or .nii.gz file. Orientation is the sform's or the qform's; both must agree."""
    packed = path.name.lower().endswith(".gz")
    head = _header(path, packed)
    shape = declared(path, _shape(path, head), head.get_data_dtype())
    offset, dtype = float(head["vox_offset"]), head.get_data_dtype()
    if not (head.sizeof_hdr <= offset <= FARTHEST and offset.is_integer()):
        raise InputError(f"{path} has vox_offset = {offset:g}, expected {head.sizeof_hdr} to {FARTHEST} bytes")
    start = int(offset)

    def read() -> NDArray:
        return inflated(path, 0, shape, dtype, "gzip", skip=start) if packed else raw(path, start, shape, dtype)

    axes, rescale = _axes(path, head), _rescale(path, head)
    return VolumeFile(path=path, files=(path,), shape=shape, dtype=dtype, read=read, axes=axes, rescale=rescale)


def write_volume(path: Path, volume: Placed) -> None:
    """Write a volume in its own type, compressed if the name ends in .gz."""
    affine = np.eye(4)
    affine[:3, :3] = np.diag(FROM_RAS * volume.spacing[::-1])
    affine[:3, 3] = FROM_RAS * volume.first
    image = nibabel.Nifti1Image(volume.values.T, affine, dtype=volume.values.dtype)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine, 1)
    image.set_qform(affine, 1)
    data = image.to_bytes()
    with replacing(path) as new:
        new.write_bytes(gzip.compress(data, mtime=0) if path.name.lower().endswith(".gz") else data)


def _header(path: Path, packed: bool) -> Header:
    """Return the header of a file that holds header and voxels."""
    with gzip.open(path) if packed else path.open("rb") as file:
        block = file.read(540)
    for size, kind in _SIZES.items():
        if size in (int.from_bytes(block[:4], order) for order in ("little", "big")):
            head = kind(block[:size], check=False)
            break
    else:
        raise InputError(f"{path} is no NIfTI file: it does not begin with the size of a header, 348 or 540")
    if not bytes(head["magic"]).startswith((b"n+1", b"n+2")):
        raise InputError(f"{path} has its voxels in another file, or is no NIfTI file; expected one .nii or .nii.gz")
    return head


def _shape(path: Path, head: Header) -> tuple[int, ...]:
    """Return the array's shape [k, j, i]; a series of volumes is refused."""
    count, *sizes = (int(n) for n in head["dim"])
    if not 3 <= count <= 7 or any(n != 1 for n in sizes[3:count]):
        raise InputError(f"{path} has the dimensions {sizes[: max(count, 0)]}, expected one volume of three")
    return tuple(sizes[2::-1])


def _axes(path: Path, head: Header) -> Axes:
    affines = [affine for affine, code in (head.get_sform(coded=True), head.get_qform(coded=True)) if code > 0]
    if not affines:
        raise InputError(f"{path} states no orientation (sform_code and qform_code are 0); expected one of them")
    if (unit := int(head["xyzt_units"]) & 7) not in UNITS:
        raise InputError(f"{path} has the unit of length {unit}, expected metres (1), mm (2) or µm (3)")
    lengths, stated = np.linalg.norm(affines[0][:3, :3], axis=0), np.abs(head["pixdim"][1:4]).astype(np.float64)
    if not np.allclose(lengths, stated, rtol=SKEW, atol=0):
        raise InputError(
            f"{path} contradicts itself: its voxels are {[float(f'{v:.6g}') for v in stated]} by pixdim, "
            f"{[float(f'{v:.6g}') for v in lengths]} by its orientation"
        )
    axes, *others = (axes_of((affine[:3, :3].T * FROM_RAS * UNITS[unit])[::-1], path) for affine in affines)
    if any((other.order, other.flipped) != (axes.order, axes.flipped) for other in others):
        raise InputError(
            f"{path} contradicts itself: its axes point to other sides of the patient by sform than by qform; "
            "expected the same, or a sform_code or qform_code of 0"
        )
    return axes


def _rescale(path: Path, head: Header) -> tuple[float, float] | None:
    """Return slope and intercept; None where none are stated (0 or NaN), or those that change nothing."""
    slope, intercept = float(head["scl_slope"]), float(head["scl_inter"])
    if math.isnan(slope) or slope == 0 or (slope, intercept) == (1, 0):
        return None
    if not (math.isfinite(slope) and math.isfinite(intercept) and slope > 0):
        raise InputError(f"{path} has scl_slope = {slope:g} and scl_inter = {intercept:g}, expected a positive slope")
    return slope, intercept
