"""Writing a scan: view by view next to its final place, then renamed.

A scene is written into `DATA/.NAME.partial/`. Stacks are uncompressed TIFF files of full size from the
start; views are written at their offset as they are made, so memory does not grow with their number.
After every few seconds the data are flushed and the number of safe views is noted; an interrupted run of
the same code goes on from there. When all is written the files are hashed, flushed and the folder is
renamed to `DATA/NAME`: it appears whole or not at all. Row 0 of an image is the bottom of the detector.
"""

import contextlib
import errno
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset import durable
from ctsim.dataset import manifest as mf
from ctsim.dataset.folder import Progress, is_complete, lock_of, partial_of, read_progress
from ctsim.dataset.locks import Busy, Lock
from ctsim.dataset.sources import source_hash
from ctsim.dataset.tiffstack import create_stack, write_all, write_image
from ctsim.errors import InputError

__all__ = ["SceneWriter", "Stack", "is_complete"]

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stack:
    """A TIFF stack to be filled view by view: `shape` is (view, v, u) or (view, m, v, u), `pixel` (v, u) mm."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    pixel: tuple[float, float] = (1.0, 1.0)


class SceneWriter:
    """Writes one scene; a context manager that holds the scene's lock.

    `first_view` is the view to go on from. Leaving the context without `finish` keeps what is there. What other
    code began starts again.

    Raises
    ------
    InputError
        When another process writes the scene, when the unfinished folder belongs to another scene or
        plan, when a finished scene is in the way (unless `force`), and when the disk is full.
    """

    def __init__(
        self,
        data_dir: str | Path,
        name: str,
        *,
        scene_id: str,
        plan_hash: str,
        stacks: tuple[Stack, ...],
        force: bool = False,
        sync_seconds: float = 5.0,
    ) -> None:
        if mf.is_reserved(name):
            raise InputError(f"scene name {name!r}: is what the data folder's own index is called; expected another")
        if not mf.is_name(name):
            raise InputError(f"scene name {name!r}: expected letters, digits and ._+- and no leading dot")
        self.data_dir, self.name, self.force = Path(data_dir), name, force
        self.scene_id, self.plan_hash, self.stacks = scene_id, plan_hash, stacks
        self.n_views = stacks[0].shape[0] if stacks else 0
        self.first_view = self._views = self._safe = 0
        self._partial = partial_of(self.data_dir, name)
        self._sync_seconds, self._last_sync = sync_seconds, time.monotonic()
        self._files: dict[str, int] = {}
        self._offsets: dict[str, int] = {}
        self._arrays: dict[str, tuple[tuple[int, ...], str, int]] = {}
        self._lock: Lock | None = None

    @property
    def final(self) -> Path:
        """The scene's folder when it is finished."""
        return self.data_dir / self.name

    def __enter__(self) -> Self:
        with self._full_disk():
            try:
                self.data_dir.mkdir(parents=True, exist_ok=True)
            except FileExistsError:
                raise InputError(f"{self.data_dir}: is a file, expected a folder") from None
            self._lock = lock_of(self.data_dir, self.name)
            try:
                self._begin()
            except BaseException:
                self._close()
                raise
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        try:
            if self._files and kind is not None:
                with contextlib.suppress(OSError):
                    self._checkpoint()
        finally:
            self._close()
        if isinstance(error, OSError) and error.errno in _FULL:
            raise self._full() from error

    def put(self, view: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write one view of every stack; views come in order from `first_view`."""
        if view != self._views or set(arrays) != {s.name for s in self.stacks}:
            raise ValueError(f"expected view {self._views} of {[s.name for s in self.stacks]}")
        with self._full_disk():
            for stack in self.stacks:
                array = np.ascontiguousarray(arrays[stack.name], stack.dtype)
                if array.shape != stack.shape[1:]:
                    raise ValueError(f"{stack.name}: a view has shape {array.shape}, expected {stack.shape[1:]}")
                write_all(self._files[stack.name], array, self._offsets[stack.name] + view * array.nbytes)
            self._views = view + 1
            if time.monotonic() - self._last_sync >= self._sync_seconds:
                self._checkpoint()

    def write_image(self, name: str, array: NDArray[Any], spacing: tuple[float, ...]) -> None:
        """Write a whole volume [z, y, x] or image [v, u] as NAME.tif; `spacing` (mm) runs along its axes."""
        with self._full_disk():
            path = self._path(f"{name}.tif")
            offset = write_image(path, array, spacing)
            self._arrays[f"{name}.tif"] = (array.shape, array.dtype.name, offset)

    def write_text(self, name: str, text: str | bytes) -> None:
        """Write a small file such as scene.toml."""
        with self._full_disk():
            self._path(name).write_bytes(text.encode() if isinstance(text, str) else text)

    def finish(self, about: mf.About | None = None) -> Path:
        """Hash and flush everything, put the folder in its place and list it in the index."""
        mf.append_index(self.data_dir, self.settle(about))
        return self.final

    def settle(self, about: mf.About | None = None) -> mf.Manifest:
        """Do what `finish` does but for the index, which is to get the manifest that is returned."""
        if self._views != self.n_views:
            raise ValueError(f"only {self._views} of {self.n_views} views were written")
        with self._full_disk():
            self._checkpoint()
            for stack in self.stacks:
                self._arrays[f"{stack.name}.tif"] = (stack.shape, stack.dtype, self._offsets[stack.name])
            entries = self._entries()
            whole = mf.Manifest(
                format=mf.FORMAT,
                name=self.name,
                scene_id=self.scene_id,
                plan_hash=self.plan_hash,
                content_hash=mf.content_hash(entries),
                files=entries,
                code=source_hash(),
                about=about,
            )
            text = msgspec.json.format(msgspec.json.encode(whole), indent=1)
            (self._partial / mf.MANIFEST).write_bytes(text)
            durable.sync_tree(self._partial)
            durable.put_in_place(self._partial, self.final)
            # only now: a crash before the rename must be able to go on
            (self.final / mf.PROGRESS).unlink(missing_ok=True)
        return whole

    def _begin(self) -> None:
        durable.recover(self.final)
        if self.final.exists() and not self.force:
            is_complete(self.data_dir, self.name, self.scene_id)  # names another scene
            raise Busy(f"{self.final}: already complete; replace it with --force")  # also by another process just now
        known = self._known()
        if known is None or known.views == 0:
            shutil.rmtree(self._partial, ignore_errors=True)
            self._partial.mkdir()
            self._note(0)
            for stack in self.stacks:
                path = self._path(f"{stack.name}.tif")
                self._offsets[stack.name] = create_stack(path, stack.shape, stack.dtype, stack.pixel)
            durable.sync_tree(self._partial)
        else:
            self._offsets = known.offsets
            self.first_view = self._views = self._safe = known.views
            for path in self._partial.iterdir():
                if durable.is_new(path.name):  # whoever wrote it does not have the lock any more
                    path.unlink()
        for stack in self.stacks:
            self._files[stack.name] = os.open(self._partial / f"{stack.name}.tif", os.O_RDWR)

    def _known(self) -> Progress | None:
        """Return what an unfinished folder says of itself, None when there is nothing to go on from."""
        known = read_progress(self._partial)
        if known is None:
            return None  # ended before the first note or after the last: nothing safe is lost by starting over
        if known.scene_id == self.scene_id and known.code != source_hash():
            return None  # the views of two versions are no scan
        if known.scene_id != self.scene_id or known.plan_hash != self.plan_hash:
            if self.force:
                return None
            what = "plan" if known.scene_id == self.scene_id else "scene"
            raise InputError(
                f"{self._partial}: unfinished output of another {what} ({known.views} views); "
                "delete it or replace it with --force"
            )
        for stack in self.stacks:
            path = self._partial / f"{stack.name}.tif"
            size = int(np.prod(stack.shape)) * np.dtype(stack.dtype).itemsize
            if not path.is_file() or path.stat().st_size < known.offsets.get(stack.name, 0) + size:
                return None
        return known

    def _checkpoint(self) -> None:
        for handle in self._files.values():
            os.fdatasync(handle)
        self._note(self._views)
        self._safe, self._last_sync = self._views, time.monotonic()

    def _note(self, views: int) -> None:
        note = Progress(
            scene_id=self.scene_id,
            plan_hash=self.plan_hash,
            views=views,
            offsets=self._offsets,
            code=source_hash(),
        )
        durable.write_synced(self._partial / mf.PROGRESS, msgspec.json.encode(note))

    def _entries(self) -> dict[str, mf.FileEntry]:
        entries = {}
        for path in sorted(p for p in self._partial.rglob("*") if p.is_file()):
            name = path.relative_to(self._partial).as_posix()
            if name in mf.OWN:
                continue
            shape, dtype, offset = self._arrays.get(name, (None, None, None))
            entries[name] = mf.FileEntry(
                bytes=path.stat().st_size, sha256=mf.file_sha256(path), shape=shape, dtype=dtype, offset=offset
            )
        return entries

    def _path(self, name: str) -> Path:
        path = self._partial / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _full(self) -> InputError:
        if self._files:
            with contextlib.suppress(OSError):
                self._checkpoint()  # the views that did find room
        return InputError(
            f"{self.data_dir}: the disk is full; scene {self.name!r} keeps its first {self._safe} of {self.n_views} "
            "views and goes on from there when it is made again"
        )

    @contextlib.contextmanager
    def _full_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in _FULL:
                raise self._full() from error
            raise

    def _close(self) -> None:
        for handle in self._files.values():
            os.close(handle)
        self._files = {}
        if self._lock is not None:
            self._lock.release()
            self._lock = None
