"""Voxels behind a header: they are read only if the file holds as many bytes as its header declares.

A compressed stream is decoded up to the declared size and no further.
"""

import bz2
import gzip
import math
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.arrayfile import check_size, check_volume
from ctsim.errors import InputError

QUOTED = 60  # characters of a header that a sentence repeats
PIECE = 2**20  # bytes decoded at a time, so that a stream that ends early takes no room
Shape = tuple[int, int, int]


def quoted(text: str) -> str:
    """Return what a header says for a sentence: short, and without characters that a terminal acts on."""
    return repr(text if len(text) <= QUOTED else f"{text[:QUOTED]}…")


def declared(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Shape:
    """Return the shape that a header declares, checked. Raises InputError for what is no volume or too many values."""
    check_volume(path, shape, dtype)
    k, j, i = shape
    return k, j, i


def beside(header: Path, name: str) -> Path:
    """Return the data file that a header names. Raises InputError unless it lies in the header's own folder."""
    found = header.parent / name
    if found.resolve().parent != header.parent.resolve():  # of links, too
        raise InputError(f"{header} names {quoted(name)} as its data; expected the name of a file in the same folder")
    if not found.is_file():
        raise InputError(f"{header} names {quoted(name)} as its data, but there is no such file")
    return found


def raw(path: Path, offset: int, shape: Shape, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read voxels [k, j, i] that begin `offset` bytes into a file and end with it."""
    size, there = math.prod(shape) * dtype.itemsize, path.stat().st_size - offset
    _check_length(path, there, size)
    return np.fromfile(path, dtype, offset=offset).reshape(shape)


def inflated(path: Path, offset: int, shape: Shape, dtype: np.dtype[Any], coding: str, *, skip: int = 0) -> NDArray:
    """Decode voxels [k, j, i] from a stream that begins `offset` bytes into a file.

    `coding` is "gzip", "bzip2" or "zlib"; the first `skip` decoded bytes are left out.
    """
    size, own = math.prod(shape) * dtype.itemsize, path.stat().st_size
    check_size(path, size + skip, own)
    with path.open("rb") as file:
        file.seek(offset)
        data = _decoded(file, coding, skip + size + 1)
    _check_length(path, len(data) - skip, size)
    return np.frombuffer(data, dtype, offset=skip).reshape(shape)


def _decoded(file: IO[bytes], coding: str, most: int) -> bytes | bytearray:
    """Return at most the first `most` bytes of a stream."""
    if coding == "zlib":
        engine = zlib.decompressobj()
        data = engine.decompress(file.read(), most)
        if len(data) < most and not engine.eof:
            raise EOFError("the compressed stream is cut short")
        return data
    found = bytearray()
    with gzip.GzipFile(fileobj=file) if coding == "gzip" else bz2.BZ2File(file) as stream:
        while len(found) < most and (piece := stream.read(min(PIECE, most - len(found)))):
            found += piece
    return found


def _check_length(path: Path, found: int, expected: int) -> None:
    if found < expected:
        raise InputError(f"{path} holds {max(found, 0)} bytes of voxels, its header declares {expected}")
    if found > expected:
        raise InputError(f"{path} holds more voxels than its header declares ({expected} bytes)")
