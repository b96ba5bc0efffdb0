"""Arrays from files that may be anybody's: what a file declares is looked at before anything of it is decoded.

A compressed file of a megabyte can hold a gigabyte of zeros, and a header can declare more than any memory holds.
"""

import contextlib
import math
import struct
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.human import human_bytes

MOST = 2**31  # values: a volume of 1290³, 8.6 GB as float32
PLAIN, TIMES = 2**28, 100  # bytes, and times the file's own: no CT beyond both decodes to so much
HEADER = 10_000  # bytes of a .npy header; NumPy makes room for what one declares, up to 4 GB
LONGEST = 200  # characters of what a decoder says
# the micro sign, the Greek letter, and how ImageJ escapes the former
_PREFIXES = {"": 1e3, "c": 10.0, "m": 1.0, "u": 1e-3, "\u00b5": 1e-3, "\u03bc": 1e-3, "\\u00b5": 1e-3, "n": 1e-6}
_WORDS = {"": 1e3, "centi": 10.0, "milli": 1.0, "micro": 1e-3, "nano": 1e-6}
LENGTHS = {
    **{prefix + "m": scale for prefix, scale in _PREFIXES.items()},
    **{prefix + end: scale for prefix, scale in _WORDS.items() for end in ("meter", "metre", "meters", "metres")},
    **{"micron": 1e-3, "microns": 1e-3},
}
"""Millimetres of what files call a length, in lower case."""


def read_array(path: Path, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
    """Read a TIFF stack or a .npy array, of `shape` where that is known.

    Raises InputError, a sentence that begins with the path: for a file that is neither, does not hold one array of
    numbers of that shape, three-dimensional where none is said, or would decode to more than is plausible.
    """
    with decoding(path, "TIFF stack or .npy array"):
        return _npy(path, shape) if path.suffix.lower() == ".npy" else _tiff(path, shape)


def describe_array(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any]]:
    """Return shape and type of the volume in a TIFF stack or .npy array, decoding nothing; raises as `read_array`."""
    with decoding(path, "TIFF stack or .npy array"):
        if path.suffix.lower() == ".npy":
            (nz, ny, nx), dtype = _checked_npy(path, None)
        else:
            with _opened_tiff(path) as file:
                (nz, ny, nx), dtype = _checked_series(path, file.series[0], None)
    return (nz, ny, nx), dtype


def stated_spacing(path: Path) -> tuple[float, float, float] | None:
    """Return the size of the voxels (z, y, x) in mm that an ImageJ TIFF states, None where it states none.

    Raises as `read_array`, and where a size is no length.
    """
    with decoding(path, "TIFF stack"), _opened_tiff(path) as file:
        told, tags = file.imagej_metadata or {}, file.pages[0].tags
        units = [str(told.get(axis + "unit", told.get("unit", ""))).strip().lower() for axis in ("z", "y", "")]
        if not all(unit in LENGTHS for unit in units) or "XResolution" not in tags or "YResolution" not in tags:
            return None
        per = [tags[name].value for name in ("YResolution", "XResolution")]
        if not all(above and below for above, below in per):
            return None  # pixels of no size
        # ImageJ leaves a spacing of 1 out
        sizes = float(told.get("spacing", 1.0)), *(below / above for above, below in per)
        if not all(math.isfinite(size) and size > 0 for size in sizes):
            raise InputError(f"{path} states voxels of {sizes} {told['unit']} (z, y, x), expected lengths")
    z, y, x = (size * LENGTHS[unit] for size, unit in zip(sizes, units, strict=True))
    return z, y, x


def read_image(path: Path, shape: tuple[int, int]) -> NDArray[Any]:
    """Read a TIFF file of one grey image [row, column] of this shape, row 0 first; raises as `read_array`."""
    with decoding(path, "TIFF image"), _opened_tiff(path) as file:
        series = file.series[0]
        found, dtype = tuple(series.shape), np.dtype(series.dtype)
        if found != shape or dtype.kind not in "iuf":
            raise InputError(f"{path} holds {dtype} of shape {found}, expected numbers of shape {shape}")
        check_size(path, math.prod(found) * dtype.itemsize, path.stat().st_size)
        return np.asarray(series.asarray())


def image_shape(path: Path) -> tuple[int, int]:
    """Return the shape [row, column] of a TIFF file of one grey image, decoding nothing; raises as `read_array`."""
    with decoding(path, "TIFF image"), _opened_tiff(path) as file:
        found = tuple(file.series[0].shape)
    if len(found) != 2 or not 1 <= min(found) <= max(found) <= MOST:
        raise InputError(f"{path} holds an array of shape {found}, expected one image")
    return found[0], found[1]


@contextlib.contextmanager
def decoding(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a decoder raises for a file that is not its kind into an InputError that begins with the path."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # decoders warn of what they then raise for
            yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, OSError) and error.strerror:
            raise InputError(f"{path} cannot be read ({error.strerror}); expected a {kind}") from None
        raise InputError(f"{path} is no {kind}: {said[:LONGEST]}") from None


def check_size(path: Path, size: int, own: int) -> None:
    """Refuse a file of `own` bytes that would decode to `size` bytes, more than a CT does."""
    if size > max(PLAIN, TIMES * own):
        raise InputError(
            f"{path} has {human_bytes(own)} and would decode to {human_bytes(size)}, as no CT does; "
            "expected a file that is not compressed, if this is meant"
        )


def check_volume(path: Path, shape: Sequence[int], dtype: Any) -> None:
    """Refuse what is no array of numbers [z, y, x], or has more values than are read."""
    if len(shape) != 3 or min(shape) < 1 or np.dtype(dtype).kind not in "iuf":
        raise InputError(f"{path} holds {dtype} of shape {tuple(shape)}, expected one array of numbers [z, y, x]")
    if math.prod(shape) > MOST:
        raise InputError(f"{path} declares {math.prod(shape)} values of shape {tuple(shape)}, expected at most {MOST}")


def _tiff(path: Path, shape: tuple[int, ...] | None) -> NDArray[Any]:
    with _opened_tiff(path) as file:
        series = file.series[0]
        _checked_series(path, series, shape)
        return np.asarray(series.asarray())


@contextlib.contextmanager
def _opened_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF file as itself alone: some flavours name other files, which tifffile would open wherever they lie.

    Raises InputError for a file that is cut off between two pages, of which tifffile gives those that are left.
    """
    import tifffile

    with path.open("rb") as file:
        whole = _holds_its_pages(file)
    if not whole:
        raise InputError(f"{path} ends before its pages do")
    with tifffile.TiffFile(path, is_ome=False, is_mmstack=False, is_ndtiff=False) as file:
        yield file


def _holds_its_pages(file: IO[bytes]) -> bool:
    """Say whether each page of a TIFF or BigTIFF file leads to another one within the file; true of other files.

    A page is a list of tags, and behind them the place of the next page, 0 for none. Of a first page that is not whole
    tifffile says what is wrong.
    """
    order = {b"II": "<", b"MM": ">"}.get(file.read(2), "")
    version = int.from_bytes(file.read(2), "little" if order == "<" else "big")
    if not order or version not in (42, 43):
        return True
    count, offset, tag = ("Q", "Q", 20) if version == 43 else ("H", "I", 12)

    def read(kind: str) -> int | None:
        raw = file.read(struct.calcsize("<" + kind))
        return struct.unpack(order + kind, raw)[0] if len(raw) == struct.calcsize("<" + kind) else None

    if version == 43:
        file.seek(8)
    at, seen = read(offset), set()
    while at and at not in seen:
        seen.add(at)
        file.seek(at)
        if (tags := read(count)) is None:
            return len(seen) == 1
        file.seek(min(file.tell() + tags * tag, 2**62))
        at = read(offset)
    return at is not None or len(seen) < 2


def _checked_series(path: Path, series: Any, shape: tuple[int, ...] | None) -> tuple[tuple[int, ...], np.dtype[Any]]:
    found, dtype = tuple(series.shape), np.dtype(series.dtype)
    _check(path, found, dtype, shape)
    if shape is None:
        check_size(path, math.prod(found) * dtype.itemsize, path.stat().st_size)
    return found, dtype


def _npy(path: Path, shape: tuple[int, ...] | None) -> NDArray[Any]:
    _checked_npy(path, shape)
    return np.load(path, allow_pickle=False)


def _checked_npy(path: Path, shape: tuple[int, ...] | None) -> tuple[tuple[int, ...], np.dtype[Any]]:
    with path.open("rb") as file:
        found, _, dtype = _header(file)
        _check(path, found, dtype, shape)
        if math.prod(found) * dtype.itemsize > path.stat().st_size - file.tell():
            raise InputError(f"{path} ends before its array of shape {found} does")
    return found, dtype


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz file, or of its bytes, as `numpy.savez` writes it, not compressed.

    Raises OSError where it cannot be read, and ValueError for what is none or declares more than the file holds.
    """
    try:
        with zipfile.ZipFile(source) as file:
            for member in file.infolist():
                _check_member(file, member)
        if not isinstance(source, Path):
            source.seek(0)
        with np.load(source, allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except (EOFError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
        raise ValueError(str(error) or type(error).__name__) from None


def _check_member(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Refuse an array that is not in the file as it stands: NumPy makes room for all that a header says."""
    if member.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{member.filename} is compressed, which nothing here writes")
    with file.open(member) as inner:
        found, _, dtype = _header(inner)
    if math.prod(found) * dtype.itemsize > member.file_size:
        raise ValueError(f"{member.filename} ends before its array of shape {found} does")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read shape, whether the order is Fortran's, and dtype from the beginning of a .npy file."""
    version = np.lib.format.read_magic(file)
    begin, width = file.tell(), 2 if version == (1, 0) else 4
    if (size := int.from_bytes(file.read(width), "little")) > HEADER:
        raise ValueError(f"its header declares {size} bytes of itself, expected at most {HEADER}")
    file.seek(begin)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)


def _check(path: Path, found: tuple[int, ...], dtype: Any, shape: tuple[int, ...] | None) -> None:
    """Refuse an array that is not what was asked for, or more than is read."""
    if shape is not None and found != shape:
        raise InputError(f"{path} holds {dtype} of shape {found}, expected {shape}")
    if shape is None:
        check_volume(path, found, dtype)
