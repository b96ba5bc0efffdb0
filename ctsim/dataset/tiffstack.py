"""Uncompressed TIFF stacks with contiguous data, so that views can be written and mapped in place.

ImageJ's flavour is used where it exists (uint8, uint16 and float32 below 4 GB), since Fiji then shows
axes and millimetres; else plain TIFF or BigTIFF with the same pixels.
"""

import errno
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_AXES = {2: "YX", 3: "ZYX", 4: "TCYX"}
_CLASSIC = 2**32 - 2**24  # room for one directory entry per page
_NO_FALLOCATE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


def create_stack(path: Path, shape: tuple[int, ...], dtype: str, pixel: tuple[float, float]) -> int:
    """Create a stack of full size, zeros, for views first; return the byte offset of its data.

    `pixel` is (v, u) in mm. The space is reserved now, so that a full disk shows before hours of work.
    """
    offset = _write(path, shape, dtype, (1.0, *pixel), axes="TYX" if len(shape) == 3 else _AXES[len(shape)])
    handle = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(handle, 0, os.fstat(handle).st_size)
    except OSError as error:
        if error.errno not in _NO_FALLOCATE:
            raise
    finally:
        os.close(handle)
    return offset


def write_image(path: Path, array: NDArray[Any], spacing: tuple[float, ...]) -> int:
    """Write a volume [z, y, x] or an image [v, u] with its spacing in mm; return the data's offset."""
    array = np.ascontiguousarray(array)
    offset = _write(path, array.shape, array.dtype.name, spacing, axes=_AXES[array.ndim])
    handle = os.open(path, os.O_RDWR)
    try:
        write_all(handle, array, offset)  # unlike NumPy's tofile, it says why a disk refuses
    finally:
        os.close(handle)
    return offset


def write_all(handle: int, array: NDArray[Any], offset: int) -> None:
    """Write a contiguous array at an offset of an open file, however many calls that takes."""
    left = memoryview(array.reshape(-1).view(np.uint8).data)
    while left:
        written = os.pwrite(handle, left, offset)
        left, offset = left[written:], offset + written


def map_array(path: Path, shape: tuple[int, ...], dtype: str, offset: int) -> NDArray[Any]:
    """Map an array copy-on-write: writable for torch's sake, but the file never changes."""
    return np.memmap(path, np.dtype(dtype).newbyteorder("<"), "c", offset, shape).view(np.ndarray)


def _write(path: Path, shape: tuple[int, ...], dtype: str, spacing: tuple[float, ...], *, axes: str) -> int:
    """Write a file of the right size, its pixels zero; return the offset of its data."""
    import tifffile  # 0.1 s that planning and reading do without

    size = math.prod(shape) * np.dtype(dtype).itemsize
    plain = dtype not in ("uint8", "uint16", "float32") or size > _CLASSIC or shape[-2:] == (1, 1)
    unit = 10 if plain else 1  # pixels per centimetre, as TIFF counts, or per mm, as ImageJ says
    resolution = (unit / spacing[-1], unit / spacing[-2])  # x, then y
    with tifffile.TiffWriter(path, bigtiff=size > _CLASSIC, byteorder="<", imagej=not plain) as file:
        metadata: dict[str, Any] = {"axes": axes}
        if not plain:
            metadata |= {"unit": "mm"} | ({"spacing": spacing[0]} if axes == "ZYX" else {})
        file.write(
            None,
            shape=shape,
            dtype=dtype,
            photometric="minisblack",
            resolution=resolution,
            resolutionunit="CENTIMETER" if plain else "NONE",
            metadata=metadata,
        )
    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        if series.dataoffset is None or series.nbytes != size:
            raise RuntimeError(f"{path}: tifffile did not lay the data out in one piece")
        return int(series.dataoffset)
