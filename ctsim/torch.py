"""Scans for training: a PyTorch dataset over shards that `make-dataset shards` has written. Needs `ctsim[io]`."""

import bisect
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

try:
    import h5py
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("ctsim.torch reads HDF5: pip install 'ctsim[io]'", name=error.name) from None
import torch
from torch.utils.data import Dataset

from ctsim.errors import InputError
from ctsim.human import human_choice
from ctsim.io.shards import ITEMS, STACKS, Entry, read, shards_of

AXES = {"z": 0, "y": 1, "x": 2}


class Scans(Dataset[dict[str, torch.Tensor]]):
    """Scans, or their slices, as float32 tensors by item.

    Items are "p" (line integrals of the scan), "twin_p" (those of the twin without metal), "trace" (1 where a ray meets
    metal), each [view, v, u]; and "fdk", "twin" (FDK of scan and twin), "reference" (true attenuation, 1/mm), "metal"
    (1 in metal), each [z, y, x]. With `plane`, "z", "y" or "x", a sample is one slice across that axis: volumes become
    images, and stacks, which go with "z" only, those of a scan of one row, [view, u]. Files are compressed by slices
    across z, so a slice across y or x takes as long as its whole volume.

    Nothing is held in memory but the list of scans. Each process opens the files for itself at its first sample, so
    instances can be pickled, and workers of a DataLoader may be forked or spawned.

    Raises
    ------
    InputError
        When there is no shard, one of a split is missing, no scan is in the split, or a scan lacks an item.
    """

    def __init__(
        self,
        root: str | Path,
        items: Sequence[str] = ("fdk", "reference"),
        *,
        plane: str | None = None,
        split: str = "",
    ) -> None:
        if isinstance(items, str):
            raise InputError(f"items: expected a tuple of names, such as ({items!r},), got the text {items!r}")
        self.root, self.items, self.plane = Path(root), tuple(items), plane
        if not self.items:
            raise InputError(f"items: expected at least one of {', '.join(ITEMS)}")
        if unknown := [item for item in self.items if item not in ITEMS]:
            raise InputError(f"items: {unknown[0]!r} is unknown, expected some of {human_choice(ITEMS, unknown[0])}")
        if plane is not None and plane not in AXES:
            raise InputError(f"plane must be 'z', 'y', 'x' or None, got {plane!r}")
        listed = [(path, entry) for path, found in shards_of(self.root).items() for entry in found.scans]
        first: dict[str, Path] = {}
        for path, entry in listed:
            if (other := first.setdefault(entry.name, path)) != path:
                raise InputError(
                    f"{root}: {other.name} and {path.name} both hold {entry.name}; expected each scan once"
                )
        self._scans = [(path, entry) for path, entry in listed if not split or entry.split == split]
        if not self._scans:
            known = ", ".join(sorted({entry.split for _, entry in listed if entry.split})) or "no split"
            raise InputError(f"{root}: no scan in split {split!r}, expected {known}")
        sizes = [self._samples(path, entry) for path, entry in self._scans]
        self._ends = list(itertools.accumulate(sizes))
        self._files: dict[Path, h5py.File] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        path, entry, at = self._place(index)
        file = self._file(path)
        return {item: torch.from_numpy(read(file, entry.name, item, self._part(item, at))) for item in self.items}

    def where(self, index: int) -> tuple[str, str, int]:
        """Return the scan's name, its individual, and the number of the slice (0 without `plane`)."""
        _, entry, at = self._place(index)
        return entry.name, entry.individual, at

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": {}}

    def _samples(self, path: Path, entry: Entry) -> int:
        """Return how many samples a scan gives. Raises InputError where it lacks an item or its slice has no stack."""
        for item in self.items:
            if item not in entry.shapes:
                raise InputError(
                    f"{path}: {entry.name} has no {item!r}, expected some of {', '.join(entry.shapes)}"
                    + "; name it under --items of make-dataset shards"
                    + (", and let the scene have truth.trace = true" if item == "trace" else "")
                )
        if self.plane is None:
            return 1
        stacks = [item for item in self.items if item in STACKS]
        for item in stacks:
            rows, layers = entry.shapes[item][1], entry.shapes.get("reference", (1,))[0]
            if self.plane != "z" or (rows, layers) != (1, 1):
                raise InputError(
                    f"plane = {self.plane!r} cuts volumes, but {item!r} holds projections, and {entry.name} has {rows} "
                    f"rows and {layers} slices: projections go with plane = 'z' where there is one of each; expected "
                    "plane = None, or items without them"
                )
        volumes = [item for item in self.items if item not in STACKS]
        return entry.shapes[volumes[0]][AXES[self.plane]] if volumes else 1

    def _place(self, index: int) -> tuple[Path, Entry, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        k = bisect.bisect_right(self._ends, index)
        return *self._scans[k], index - (self._ends[k - 1] if k else 0)

    def _part(self, item: str, at: int) -> tuple[slice | int, ...]:
        every = slice(None)
        if self.plane is None:
            return every, every, every
        if item in STACKS:
            return every, 0, every
        place: list[slice | int] = [every, every, every]
        place[AXES[self.plane]] = at
        return tuple(place)

    def _file(self, path: Path) -> h5py.File:
        """Return the open file; one that another process opened before it forked is not used."""
        if self._process != os.getpid():
            self._files, self._process = {}, os.getpid()
        if path not in self._files:
            try:
                self._files[path] = h5py.File(path, "r")
            except OSError as error:
                raise InputError(f"{path}: cannot be opened any more ({' '.join(str(error).split())})") from None
        return self._files[path]
