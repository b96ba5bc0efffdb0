"""A long fit kept on disk while it runs, so that it can go on after an interruption to the same last bit."""

import hashlib
import io
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.arrayfile import read_arrays
from ctsim.dataset.durable import sweep, write_synced
from ctsim.dataset.versions import code_version
from ctsim.errors import InputError
from ctsim.types import Scan

EVERY = 60.0  # seconds from one writing to the next
_CHECKSUM = 32  # bytes
State = Mapping[str, NDArray[Any]]


@dataclass(slots=True, kw_only=True)
class Checkpoint:
    """Arrays by name in `folder`, in a file that is named after what they belong to.

    A file is replaced whole: after a crash it holds the old arrays or the new ones. It is an .npz with the SHA-256 of
    its bytes after it.
    """

    folder: Path
    identity: str
    _written: float = field(default_factory=time.perf_counter)

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / f"{self.identity}.npz"

    def due(self) -> bool:
        """Say whether it is time to write."""
        return time.perf_counter() - self._written >= EVERY

    def write(self, state: State) -> None:
        """Write arrays. Raises InputError where the folder cannot be written to."""
        buffer, arrays = io.BytesIO(), dict[str, Any](state)
        np.savez(buffer, **arrays)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_synced(self.path, buffer.getvalue() + hashlib.sha256(buffer.getbuffer()).digest())
        except OSError as error:
            raise InputError(f"checkpoint {self.path} cannot be written: {error}") from None
        self._written = time.perf_counter()

    def read(self) -> dict[str, NDArray[Any]] | None:
        """Return what was written, None where nothing was. Raises InputError where it cannot be read or is damaged."""
        try:
            whole = self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(f"checkpoint {self.path} cannot be read: {error}") from None
        arrays, checksum = whole[:-_CHECKSUM], whole[-_CHECKSUM:]
        if hashlib.sha256(arrays).digest() != checksum:
            raise self.damaged("its checksum does not fit, or an earlier version wrote it")
        try:
            return read_arrays(io.BytesIO(arrays))
        except ValueError as error:
            raise self.damaged(error) from None

    def damaged(self, why: object) -> InputError:
        """Return the error of a file that holds no state to go on from."""
        return InputError(f"checkpoint {self.path} is damaged ({why}): delete it to start again")

    def remove(self) -> None:
        """Delete the file, if there is one, and what a run left that was killed while it wrote one."""
        self.path.unlink(missing_ok=True)
        sweep(self.folder)


def identity_of(scan: Scan, settings: object, method: str, module: str) -> str:
    """Hash what a fit depends on: the scan, the settings, the method's name, and the code of its `module`."""
    digest = hashlib.blake2b(digest_size=16)
    numbers = (scan.dark, scan.i0, scan.e_max, scan.floor, str(scan.counts.dtype), scan.metal is None)
    digest.update(msgspec.json.encode((scan.geometry, numbers, settings, method, code_version(module))))
    for array in (scan.counts, scan.flat, *([] if scan.metal is None else [scan.metal != 0])):
        digest.update(np.ascontiguousarray(array.numpy()).data)
    return digest.hexdigest()
