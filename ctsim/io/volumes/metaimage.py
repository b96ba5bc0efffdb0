"""MetaImage, ITK's own format: a text header, then the voxels, in the same file (.mha) or in another (.mhd and .raw).

Its frame is LPS. Each row of TransformMatrix is the direction of one axis of the array, the fastest axis first.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.durable import replacing
from ctsim.errors import InputError
from ctsim.io.payload import beside, declared, inflated, quoted, raw
from ctsim.io.volumes.frame import axes_of, unit_vectors
from ctsim.io.volumes.placed import Placed
from ctsim.io.volumes.volumefile import VolumeFile

TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
MATRICES = ("TransformMatrix", "Rotation", "Orientation")
"""Names of the key with the directions; none of them means the identity."""
LONGEST = 2**16  # bytes of a header
_LAST = "ElementDataFile"  # the voxels begin after its line


def open_volume(path: Path) -> VolumeFile:
    """Read the header of a .mha or .mhd file."""
    keys, end = _header(path)
    name = keys[_LAST]
    data = path if name == "LOCAL" else beside(path, name)
    dtype = _dtype(path, keys)
    shape = declared(path, _sizes(path, keys), dtype)
    offset = end if data == path else _skipped(path, keys)
    packed = _flag(keys, "CompressedData")
    key = next((key for key in MATRICES if key in keys), MATRICES[0])
    directions = unit_vectors(path, key, np.reshape(_numbers(path, keys, key, "1 0 0 0 1 0 0 0 1", 9), (3, 3)))
    steps = directions * np.array(_numbers(path, keys, "ElementSpacing"))[:, None]

    def read() -> NDArray:
        return inflated(data, offset, shape, dtype, "zlib") if packed else raw(data, offset, shape, dtype)

    files = (path,) if data == path else (path, data)
    return VolumeFile(path=path, files=files, shape=shape, dtype=dtype, read=read, axes=axes_of(steps[::-1], path))


def write_volume(path: Path, volume: Placed) -> None:
    """Write a volume as .mha, not compressed. Raises InputError for a type that MetaImage lacks."""
    values = volume.values
    known = {np.dtype(code): name for name, code in reversed(TYPES.items())}  # int before long
    kind = known.get(values.dtype)
    if kind is None:
        raise InputError(f"{path}: MetaImage has no {values.dtype}, expected one of {', '.join(map(str, known))}")
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "Offset": _words(volume.first.tolist()),
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",
        "ElementSpacing": _words(float(v) for v in volume.spacing[::-1]),
        "DimSize": _words(values.shape[::-1]),
        "ElementType": kind,
        _LAST: "LOCAL",
    }
    with replacing(path) as new, new.open("wb") as file:
        file.write("".join(f"{key} = {value}\n" for key, value in header.items()).encode("ascii"))
        file.write(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).data)


def _words(values: Iterable[float]) -> str:
    return " ".join(f"{value!r}" for value in values)


def _header(path: Path) -> tuple[dict[str, str], int]:
    """Return the header's keys and where it ends."""
    with path.open("rb") as file:
        head = file.read(LONGEST)
    keys: dict[str, str] = {}
    end = 0
    while _LAST not in keys:
        line, newline, _ = head[end:].partition(b"\n")
        key, equals, value = line.decode("utf-8", "replace").partition("=")
        if not equals or not (newline or key.strip() == _LAST):
            raise InputError(f"{path} is no MetaImage: its header has no line {_LAST} = …")
        keys[key.strip()] = value.strip()
        end += len(line) + len(newline)
    _check_kind(path, keys)
    return keys, end


def _check_kind(path: Path, keys: dict[str, str]) -> None:
    """Refuse what is none of one array of numbers, or has its voxels in a way that is not read."""
    expected = {"ObjectType": "Image", "NDims": "3", "BinaryData": "True", "ElementNumberOfChannels": "1"}
    for key, value in expected.items():
        if keys.get(key, value).lower() != value.lower():
            raise InputError(f"{path} has {key} = {quoted(keys[key])}, expected {value}")
    if keys[_LAST].split()[:1] == ["LIST"] or "%" in keys[_LAST]:
        raise InputError(f"{path} has its voxels in several files; expected one")


def _dtype(path: Path, keys: dict[str, str]) -> np.dtype:
    if (kind := keys.get("ElementType", "")) not in TYPES:
        raise InputError(f"{path} has ElementType = {quoted(kind)}, expected one of {', '.join(TYPES)}")
    swapped = _flag(keys, "BinaryDataByteOrderMSB") or _flag(keys, "ElementByteOrderMSB")
    return np.dtype(TYPES[kind]).newbyteorder(">" if swapped else "<")


def _flag(keys: dict[str, str], key: str) -> bool:
    return keys.get(key, "False").lower() in ("true", "1")


def _numbers(path: Path, keys: dict[str, str], key: str, default: str = "", count: int = 3) -> list[float]:
    """Return the numbers of a key."""
    text = keys.get(key, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{path} has {key} = {quoted(text)}, expected {count} numbers")
    return values


def _sizes(path: Path, keys: dict[str, str]) -> tuple[int, ...]:
    """Return the shape [k, j, i]."""
    values = _numbers(path, keys, "DimSize")
    if not all(v.is_integer() for v in values):
        raise InputError(f"{path} has DimSize = {quoted(keys['DimSize'])}, expected three integers")
    return tuple(int(v) for v in values[::-1])


def _skipped(path: Path, keys: dict[str, str]) -> int:
    """Return how many bytes of the data file come before the voxels."""
    try:
        size = int(keys.get("HeaderSize", "0"))
    except ValueError:
        size = -1
    if size < 0:
        raise InputError(f"{path} has HeaderSize = {quoted(keys['HeaderSize'])}, expected a number of bytes from 0")
    return size
