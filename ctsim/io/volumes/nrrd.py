"""NRRD: a text header, an empty line, then the voxels, or a header (.nhdr) that names the file of the voxels.

Rows of `space directions` are the steps along the axes of the array, the fastest axis first.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.io.payload import beside, declared, inflated, quoted, raw
from ctsim.io.volumes.frame import axes_of
from ctsim.io.volumes.volumefile import VolumeFile

TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
CODINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
SPACES = {
    **dict.fromkeys(("left-posterior-superior", "lps"), (1, 1, 1)),
    **dict.fromkeys(("right-anterior-superior", "ras"), (-1, -1, 1)),
    **dict.fromkeys(("left-anterior-superior", "las"), (1, -1, 1)),
}
"""Signs that turn a space's x, y, z into the patient's left, back and head."""
LONGEST = 2**16  # bytes of a header


def open_volume(path: Path) -> VolumeFile:
    """Read the header of a .nrrd or .nhdr file."""
    fields, end = _header(path)
    name = fields.get("data file", fields.get("datafile"))
    if name is not None and (name.split()[:1] == ["LIST"] or "%" in name):
        raise InputError(f"{path} has its voxels in several files; expected one")
    data = path if name is None else beside(path, name)
    dtype, coding = _dtype(path, fields), _known(path, fields, "encoding", CODINGS)
    sizes = tuple(int(word) for word in _needed(path, fields, "sizes").split())
    shape = declared(path, sizes[::-1], dtype)
    for key in ("line skip", "lineskip", "byte skip", "byteskip"):
        if fields.get(key, "0") != "0":
            raise InputError(
                f"{path} has {key}: {quoted(fields[key])}, expected voxels at the beginning or after the header"
            )
    offset = end if name is None else 0
    axes = axes_of(_steps(path, fields)[::-1], path)

    def read() -> NDArray:
        return raw(data, offset, shape, dtype) if coding == "raw" else inflated(data, offset, shape, dtype, coding)

    files = (path,) if name is None else (path, data)
    return VolumeFile(path=path, files=files, shape=shape, dtype=dtype, read=read, axes=axes)


def _header(path: Path) -> tuple[dict[str, str], int]:
    """Return the fields, and where the voxels begin if they are in this file."""
    with path.open("rb") as file:
        head = file.read(LONGEST)
    if not head.startswith(b"NRRD000"):
        raise InputError(f"{path} is no NRRD file: it does not begin with NRRD000")
    fields: dict[str, str] = {}
    end = head.index(b"\n") + 1
    while end < len(head):
        line, _, _ = head[end:].partition(b"\n")
        end += len(line) + 1
        text = line.decode("utf-8", "replace").rstrip("\r")
        if not text:
            break
        key, colon, value = text.partition(": ")
        if colon and not text.startswith("#"):  # "key:=value" pairs are comments, too
            fields[key.strip().lower()] = value.strip()
    return fields, end


def _needed(path: Path, fields: dict[str, str], key: str) -> str:
    if key not in fields:
        raise InputError(f"{path} has no field {key!r}, which an NRRD volume needs")
    return fields[key]


def _known(path: Path, fields: dict[str, str], key: str, table: dict[str, str]) -> str:
    if (given := _needed(path, fields, key).lower()) not in table:
        raise InputError(f"{path} has {key}: {quoted(given)}, expected one of {', '.join(table)}")
    return table[given]


def _dtype(path: Path, fields: dict[str, str]) -> np.dtype:
    dtype = np.dtype(_known(path, fields, "type", TYPES))
    if dtype.itemsize == 1:
        return dtype
    return np.dtype(_known(path, fields, "endian", {"little": "<", "big": ">"}) + dtype.str[1:])


def _steps(path: Path, fields: dict[str, str]) -> NDArray[np.float64]:
    """Return the steps (x, y, z) in mm along the file's axes, the fastest first, in the patient's frame."""
    space = _needed(path, fields, "space").lower()
    if space not in SPACES:
        raise InputError(f"{path} has space: {quoted(space)}, expected one of {', '.join(SPACES)}")
    units = fields.get("space units", "").replace('"', "").split()
    if any(unit != "mm" for unit in units):
        raise InputError(f"{path} has space units: {quoted(' '.join(units))}, expected mm")
    text = _needed(path, fields, "space directions")
    try:
        rows = [[float(v) for v in row.split(",")] for row in text.strip("() ").replace(") (", ")(").split(")(")]
    except ValueError:
        rows = []
    if [len(row) for row in rows] != [3, 3, 3]:
        raise InputError(f"{path} has space directions: {quoted(text)}, expected three vectors of three numbers")
    return np.array(rows) * SPACES[space]
