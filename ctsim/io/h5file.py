"""HDF5 files written through Python, where a full disk is an OSError: HDF5 itself then ends the process by a signal."""

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py


class _Sink(io.FileIO):
    """A file that keeps its first error and takes all that follows, so that HDF5 can always close it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.error: OSError | None = None

    def write(self, data: memoryview) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def check(self) -> None:
        """Raise the first error of writing."""
        if self.error is not None:
            raise self.error


@contextlib.contextmanager
def writing(path: Path) -> Iterator[tuple[h5py.File, Callable[[], None]]]:
    """Yield a new HDF5 file, and a function that raises the OSError of what was written so far, as leaving does."""
    with _Sink(path) as sink:
        try:
            with h5py.File(sink, "w") as file:
                yield file, sink.check
        finally:
            sink.check()  # what HDF5 raises for a file that is cut short says less
