"""Pickles of plain values and NumPy arrays of numbers, and of nothing else: no name in a file is imported."""

import io
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ctsim.errors import InputError
from ctsim.io.payload import quoted

LARGEST = 2**33  # bytes of a file
_NUMBERS = "biuf"


def load_plain(path: Path) -> Any:
    """Read a pickle. Raises InputError for one that holds anything but plain values and arrays of numbers."""
    try:
        return _Reader(path.read_bytes(), str(path)).load()
    except (InputError, MemoryError, OSError):
        raise
    except Exception as error:  # a damaged pickle may raise anything
        raise InputError(f"{path} is no pickle: {' '.join(str(error).split())[:200] or type(error).__name__}") from None


_Base: Any = getattr(pickle, "_Unpickler")  # noqa: B009


class _Reader(_Base):
    """Python's own reader in Python: that in C makes room for what a damaged file declares."""

    def __init__(self, data: bytes, name: str) -> None:
        super().__init__(io.BytesIO(data))
        self.name = name

    def find_class(self, module: str, name: str) -> Any:
        """Return what the names in NumPy's pickles stand for. Raises InputError for any other name."""
        found = _NAMES.get((module.replace("numpy.core.", "numpy._core."), name))
        if found is None:
            raise InputError(f"{self.name} holds {quoted(f'{module}.{name}')}, expected plain values and arrays")
        return found

    def persistent_load(self, pid: Any) -> Any:
        """Raise InputError: what a pickle refers to lies elsewhere."""
        raise InputError(f"{self.name} refers to what lies elsewhere, expected plain values and arrays")

    def load_build(self) -> None:
        """Set the state of an array or of its type. Raises ValueError for that of anything else."""
        if len(self.stack) < 2 or not isinstance(self.stack[-2], np.ndarray | np.dtype):
            raise ValueError("the state of no array is set")
        super().load_build()

    def load_bytearray8(self) -> None:
        """Read bytes that may be changed, making room for no more of them than there are."""
        size = int.from_bytes(self.read(8), "little")
        if len(data := self.read(size)) != size:
            raise EOFError("it ends within an array")
        self.append(bytearray(data))

    dispatch: ClassVar[dict[int, Any]] = {
        **_Base.dispatch,
        pickle.BUILD[0]: load_build,
        pickle.BYTEARRAY8[0]: load_bytearray8,
    }


def _latin(text: Any, coding: Any) -> bytes:
    """Return the bytes that protocol 2 writes as a text."""
    if not isinstance(text, str) or coding != "latin1":
        raise ValueError("a text is no bytes")
    return text.encode("latin-1")


def _no_bytes() -> bytes:
    """Return what protocol 2 writes as a call without arguments."""
    return b""


def _dtype(text: Any, *_: Any) -> np.dtype[Any]:
    """Return a type of numbers: a copy, whose byte order may be set."""
    found = np.dtype(text, False, True) if isinstance(text, str) else np.dtype(object)
    if found.kind not in _NUMBERS:
        raise ValueError("an array holds no numbers")
    return found


def _empty(*_: Any) -> np.ndarray[Any, Any]:
    return np.empty(0, np.uint8)


def _scalar(dtype: Any, data: Any) -> Any:
    if not isinstance(dtype, np.dtype) or dtype.kind not in _NUMBERS or not isinstance(data, bytes):
        raise ValueError("a number is none")
    return np.frombuffer(data, dtype, 1)[0].item()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    if not isinstance(dtype, np.dtype) or dtype.kind not in _NUMBERS or not isinstance(data, bytes | bytearray):
        raise ValueError("an array holds no numbers")
    return np.frombuffer(data, dtype).reshape(shape, order=order)


_NAMES: dict[tuple[str, str], Any] = {
    ("numpy._core.multiarray", "_reconstruct"): _empty,
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _latin,
    ("__builtin__", "bytes"): _no_bytes,
    ("numpy", "dtype"): _dtype,
    ("numpy", "ndarray"): "the class of an array, of which no use is made",
}
