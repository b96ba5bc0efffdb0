"""The files of a run: its volumes, and the intermediates for the pictures; and the details for its record.

Volumes are TIFF stacks that name their run. A method attaches intermediates (a metal trace, filled projections, a
prior) to its volume, `Volume(..., details={"intermediates": {"view": 15, "trace": ...}})`; no score reads them. They
are kept next to the volume as NAME.npz. The other details go into the record.
"""

import hashlib
import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tifffile
from numpy.typing import NDArray

from ctsim.benchmarks.studies.methods.records import METAL, RunTask
from ctsim.dataset.arrayfile import read_arrays
from ctsim.dataset.durable import replacing
from ctsim.dataset.tiffstack import write_all
from ctsim.errors import InputError
from ctsim.geometry import Geometry

# raised by tifffile (TiffFileError is a ValueError) and JSON for files that are cut short or changed
DAMAGED = (ValueError, LookupError, AttributeError, TypeError, RecursionError, struct.error)

KEY = "intermediates"
_RUN = "run"
Intermediates = dict[str, NDArray[Any]]

LONGEST_NAME = 100  # characters of a method's label in the name of a file
LONGEST = 10_000  # bytes of JSON; a record drops longer entries
ELSEWHERE = ("view_updates", KEY)  # details that a run keeps in its cost and in a file


def volume_name(task: RunTask) -> str:
    """Return the path of a kept volume in the results folder: scene and method in allowed characters."""
    label = "".join(c if c.isalnum() or c in "-.=" else "_" for c in task.subject)
    if len(label) > LONGEST_NAME:  # such as a program's command
        label = f"{label[:LONGEST_NAME]}-{hashlib.sha256(task.subject.encode()).hexdigest()[:8]}"
    twin = "" if task.part == METAL else "__metal_free"
    return f"volumes/{task.hints['name']}{twin}__{label}.tif"


def is_kept(task: RunTask, results: Path) -> bool:
    """Whether the volume on the disk is of this run, not of other parameters, code or data."""
    return identity_of(results / volume_name(task)) == task.identity


def write_volume(path: Path, values: NDArray[np.float32], identity: str = "") -> None:
    """Write a volume [z, y, x] in 1/mm as an uncompressed TIFF stack, whole or not at all.

    `identity` is the run's; a reader can tell by it whether the file is still that run's.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    text = {"axes": "ZYX", "unit": "1/mm", "run": identity}
    with replacing(path) as new:
        tifffile.imwrite(new, shape=values.shape, dtype=np.float32, photometric="minisblack", metadata=text)
        with tifffile.TiffFile(new) as laid_out:
            offset = laid_out.series[0].dataoffset
        if offset is None:
            raise RuntimeError(f"{new}: tifffile did not lay the volume out in one piece")
        handle = os.open(new, os.O_WRONLY)
        try:
            write_all(handle, np.ascontiguousarray(values, np.float32), offset)  # says why a disk refuses
        finally:
            os.close(handle)


def keep(path: Path, values: NDArray[np.float32], at_50kev: NDArray[np.float32] | None, identity: str) -> None:
    """Write a run's volume and its volume at 50 keV; without the latter, delete one of an earlier run of this name."""
    write_volume(path, values, identity)
    if at_50kev is None:
        at_50kev_of(path).unlink(missing_ok=True)
    else:
        write_volume(at_50kev_of(path), at_50kev, identity)


def at_50kev_of(path: Path) -> Path:
    """Return the path of the volume at 50 keV of a kept volume's run."""
    return path.parent / "50kev" / path.name


def own_at_50kev(path: Path, identity: str) -> Path | None:
    """Return the path of the volume at 50 keV of this run; None where it has none."""
    return at_50kev_of(path) if identity_of(at_50kev_of(path)) == identity else None


def identity_of(path: Path) -> str | None:
    """Return the identity of the run that wrote `path`; None where the file is missing or does not name it."""
    try:
        with tifffile.TiffFile(path) as file:
            found = json.loads(file.pages.first.description).get("run")
    except (OSError, *DAMAGED):
        return None
    return found if isinstance(found, str) and found else None


def map_volume(path: Path) -> NDArray[np.float32]:
    """Map a kept volume [z, y, x] in 1/mm, reading nothing yet.

    Raises InputError where the file is damaged.
    """
    try:
        return tifffile.memmap(path, mode="r")
    except DAMAGED as error:
        raise InputError(f"{path}: cannot be read ({error}); run the method again with --force") from None


def read_volume(path: Path) -> NDArray[np.float32]:
    """Read a kept volume [z, y, x] in 1/mm.

    Raises InputError where the file is missing or not a volume.
    """
    try:
        values = np.array(map_volume(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such volume; run the method again with --force") from None
    if values.ndim != 3:
        raise InputError(f"{path}: expected a volume [z, y, x], got shape {values.shape}")
    return values


def attached(details: Mapping[str, Any], geometry: Geometry) -> Intermediates:
    """Return the intermediates that a method attached, checked; {} where it attached none.

    `view` is an index, `trace` (not 0 in the metal's shadow) and `projection` (what was backprojected, −ln) are
    that view's [v, u], `prior` is [z, y, x] in 1/mm. Raises InputError for other names, shapes and views.
    """
    shapes = {"view": (), "trace": geometry.n_detector, "projection": geometry.n_detector, "prior": geometry.n_voxel}
    kinds = {"view": np.int64, "trace": np.bool_}
    found = {}
    for name, value in details.get(KEY, {}).items():
        if name not in shapes:
            raise InputError(f"details[{KEY!r}] has no entry {name!r}: expected {', '.join(shapes)}")
        array = np.asarray(value)
        if array.shape != shapes[name]:
            raise InputError(f"details[{KEY!r}][{name!r}] has shape {array.shape}, expected {shapes[name]}")
        found[name] = np.array(array != 0 if name == "trace" else array, kinds.get(name, np.float32))
    if found.keys() & {"trace", "projection"} and "view" not in found:
        raise InputError(f"details[{KEY!r}]: a trace or a projection needs its 'view'")
    if "view" in found and not 0 <= found["view"] < geometry.n_views:
        raise InputError(f"details[{KEY!r}]['view'] is {found['view']}, expected 0 … {geometry.n_views - 1}")
    return found


def intermediates_of(volume: Path) -> Path:
    """Return the path of the intermediates of a kept volume."""
    return volume.with_suffix(".npz")


def write_intermediates(path: Path, found: Intermediates, identity: str) -> None:
    """Write intermediates with the identity of their run, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {**found, _RUN: np.array(identity)}
    with replacing(path) as new, new.open("wb") as file:
        np.savez(file, **arrays)


def read_intermediates(path: Path, identity: str) -> Intermediates:
    """Read the intermediates of a run; {} where there are none, or the file is of another run.

    Raises InputError where the file is damaged.
    """
    try:
        found = read_arrays(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); delete it or run the method again with --force") from None
    return found if str(found.pop(_RUN, "")) == identity else {}


def recordable(details: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a volume's details that a record keeps: numbers, words, and lists and dicts of them.

    Arrays, tensors and other objects are left out, and entries of more than `LONGEST` bytes. A list that holds one is
    left out whole, since its positions have a meaning; a dict loses only that entry, and is left out if none remains.
    Numbers that are not finite become None.
    """
    found: dict[str, Any] = {}
    for name, value in _entries(details).items():
        try:
            line = msgspec.json.encode({name: value})  # null where a number is not finite
            if name not in ELSEWHERE and len(line) <= LONGEST:
                found |= msgspec.json.decode(line)
        except (ValueError, msgspec.MsgspecError):  # half a surrogate pair, or an integer of thousands of digits
            continue
    return found


def _entries(given: Mapping[Any, Any]) -> dict[str, Any]:
    found = {}
    for name, value in given.items():
        try:
            found[_word(name)] = _plain(value)
        except TypeError:
            continue
    return found


def _word(value: object) -> str:
    """Return a string without what a subclass adds; raises TypeError for anything else."""
    return str.__str__(value)  # pyright: ignore[reportArgumentType]


def _plain(value: object) -> Any:
    """Return a value in the types of JSON; raises TypeError where it has none."""
    if value is None or isinstance(value, bool):
        return value
    for kinds, plain in (((np.bool_,), bool), ((int, np.integer), int), ((float, np.floating), float)):
        if isinstance(value, kinds):
            return plain(value)
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        found = _entries(value)
        if value and not found:
            raise TypeError("a record keeps none of its entries")
        return found
    return _word(value)
