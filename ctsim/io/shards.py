"""Shards: many scans in a few HDF5 files, compressed without loss, for training.

A shard has one group a scan, named as the scan, with an array for each of `ITEMS`. Stacks [view, v, u] and volumes
[z, y, x] are in chunks of one image each, so that a slice is read without its neighbours; compressed ones have a
checksum (Adler-32). The file's attribute
`contents` lists the scans with their shapes as JSON, so that opening a thousand of them reads no array.
"""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.durable import replacing
from ctsim.errors import InputError
from ctsim.io.h5file import writing

STACKS = ("p", "twin_p", "trace")
VOLUMES = ("fdk", "twin", "reference", "metal")
ITEMS = STACKS + VOLUMES
FORMAT = 1
_CONTENTS = "contents"


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A scan in a shard: its name, its content hash in the data folder, whose body, which split, shapes by item."""

    name: str
    content_hash: str
    individual: str = ""
    split: str = ""
    shapes: dict[str, tuple[int, int, int]] = {}


class Contents(msgspec.Struct, frozen=True, kw_only=True):
    """What a shard says of itself; `items` are those that were asked for, none where it was to hold all there are.

    It is one of `of` shards of its split, 0 where that is unknown.
    """

    format: int
    scans: tuple[Entry, ...]
    items: tuple[str, ...] = ()
    of: int = 0


def write(
    path: Path,
    scans: Iterable[tuple[Entry, Mapping[str, NDArray[Any]], str]],
    items: tuple[str, ...] = (),
    of: int = 0,
) -> None:
    """Write a shard of (entry without shapes, arrays by item, scene.toml); it appears whole or not at all.

    `items` are those that were asked for, `of` is the number of shards of its split.
    """
    entries = []
    with _folder(path.parent), replacing(path) as new, writing(new) as (file, check):
        for entry, arrays, scene in scans:
            group = file.create_group(entry.name)
            group.attrs["scene"] = scene
            for item, array in arrays.items():
                group.create_dataset(
                    item, data=array, chunks=(1, *array.shape[1:]), shuffle=True, compression="gzip", compression_opts=1
                )
            shapes = {item: array.shape for item, array in arrays.items()}
            entries.append(msgspec.structs.replace(entry, shapes=shapes))
            check()  # before the next scan is reconstructed
        found = Contents(format=FORMAT, scans=tuple(entries), items=items, of=of)
        file.attrs[_CONTENTS] = msgspec.json.encode(found).decode()


@contextlib.contextmanager
def _folder(path: Path) -> Iterator[None]:
    """Make a folder, and remove it where it is new and nothing came into it."""
    is_new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            path.rmdir() if is_new else None
        raise


def contents(path: Path) -> Contents:
    """Return what a shard holds.

    Raises
    ------
    InputError
        When it cannot be read, or is no shard of this format.
    """
    try:
        with h5py.File(path, "r") as file:
            found = msgspec.json.decode(str(file.attrs[_CONTENTS]), type=Contents)
    except (OSError, KeyError, UnicodeError, msgspec.DecodeError) as error:
        raise InputError(
            f"{path}: is no shard ({' '.join(str(error).split())}); make-dataset shards writes them"
        ) from None
    if found.format != FORMAT:
        raise InputError(f"{path}: format {found.format}, this version reads format {FORMAT}")
    return found


def shards_of(root: Path) -> dict[Path, Contents]:
    """Return the shards of a folder by name, and what they hold.

    Raises InputError where there are none, or fewer of a split than there were to be.
    """
    found = {path: contents(path) for path in sorted(root.glob("*.h5"))}
    if not found:
        raise InputError(f"{root}: holds no shards (*.h5); make-dataset shards writes them")
    splits: dict[str, list[Contents]] = {}
    for path, one in found.items():
        splits.setdefault(path.stem.rpartition("-")[0], []).append(one)
    for split, there in splits.items():
        if len(there) < (of := max(one.of for one in there)):
            raise InputError(
                f"{root}: holds {len(there)} of {of} shards of {split}; make-dataset shards writes the others"
            )
    return found


def read(file: h5py.File, name: str, item: str, place: tuple[slice | int, ...]) -> NDArray[np.float32]:
    """Read a part of an item as float32. Raises InputError where the file is damaged there."""
    try:
        return np.asarray(file[name][item][place], np.float32)  # pyright: ignore[reportIndexIssue]
    except (OSError, KeyError):
        raise InputError(
            f"{file.filename}: {item} of {name} is damaged; delete the file, make-dataset shards writes it again"
        ) from None
