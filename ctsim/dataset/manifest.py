"""What a data folder holds and whether it is still what was written: manifests, the index, verification.

Every scene folder has a `manifest.json` with the size and SHA-256 of each of its files; the data folder
has an `index.jsonl` with one line per finished scene (the last line of a name counts). Both say which code made
the scene. Names in them are joined to paths, so one that leaves its folder is refused.
"""

import hashlib
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ctsim.dataset.durable import append_synced, cut_torn, write_synced
from ctsim.dataset.locks import locked
from ctsim.errors import InputError

MANIFEST = "manifest.json"
INDEX = "index.jsonl"
PROGRESS = ".progress.json"
OWN = (MANIFEST, PROGRESS, f"{PROGRESS}.new")  # our own notes, in no manifest
FORMAT, WITHOUT_CODE = 3, 2  # the format that is written; the older one that is read, too
DTYPES = ("uint8", "uint16", "uint32", "int8", "int16", "int32", "float32", "float64")
_NOT_CONTENT = ("plan.json",)  # estimates of time and disk are no part of what a method sees
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}")
_FILE = re.compile(rf"{_NAME.pattern}(?:/{_NAME.pattern})*")


class FileEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file: its size and SHA-256, and for arrays the shape, dtype and byte offset of the data."""

    bytes: int
    sha256: str
    shape: tuple[int, ...] | None = None
    dtype: str | None = None
    offset: int | None = None


class About(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """What a trainer chooses scans by: whose body it is, its split, and what was drawn for it.

    `metal_share` is the share of all rays through pixel centres that meet metal; `drawn` values by key.
    """

    individual: str
    split: str = ""
    metal_share: float = 0.0
    drawn: dict[str, Any] = {}


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All files of one finished scene by their path inside its folder.

    `code` is the `ctsim.dataset.sources.source_hash` of what made it, empty in the format `WITHOUT_CODE`. `about` is
    there for scenes of a table with `count`.
    """

    format: int
    name: str
    scene_id: str
    plan_hash: str
    content_hash: str
    files: dict[str, FileEntry]
    code: str = ""
    about: About | None = None


class IndexLine(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One finished scene in the index; `code` and `about` as in its manifest."""

    name: str
    scene_id: str
    content_hash: str
    code: str = ""
    about: About | None = None


class _Format(msgspec.Struct):
    format: int


def is_name(name: str) -> bool:
    """Say whether a scene can have this name, which is its folder's."""
    return _NAME.fullmatch(name) is not None and not is_reserved(name)


def is_reserved(name: str) -> bool:
    """Say whether no scene may have this name, which the data folder's index needs: on some disks in any case."""
    return f"{name}.".casefold().startswith(f"{INDEX}.")


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hex, reading it in blocks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_hash(files: dict[str, FileEntry]) -> str:
    """Hash what the files hold and how it is to be read, independent of their order and of the plan's estimates."""
    entries = [(path, entry) for path, entry in sorted(files.items()) if path not in _NOT_CONTENT]
    return hashlib.sha256(msgspec.json.encode(entries)).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Read a finished scene's manifest.

    Raises
    ------
    InputError
        When the folder is no finished scene, or its manifest is damaged or of another format.
    """
    path = folder / MANIFEST
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        if not folder.is_dir():
            raise InputError(f"{folder}: no such scene folder") from None
        raise InputError(f"{folder}: not a finished scene, {MANIFEST} is missing (was it interrupted?)") from None
    try:
        manifest = msgspec.json.decode(data, type=Manifest)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        _check_format(path, data)
        raise InputError(f"{path}: damaged manifest ({error})") from None
    _check_format(path, data, manifest)
    if bool(manifest.code) != (manifest.format > WITHOUT_CODE):
        raise InputError(f"{path}: damaged manifest (format {manifest.format} with the code {manifest.code!r})")
    own = folder.name if manifest.name == folder.name else os.path.basename(os.path.abspath(folder))
    if manifest.name != own or not is_name(own):
        raise InputError(f"{path}: names the scene {manifest.name!r}, expected its folder's name, {own!r}")
    for name in manifest.files:
        if not _FILE.fullmatch(name):
            raise InputError(f"{path}: names the file {name!r}, expected a path within the scene's folder")
    return manifest


def _check_format(path: Path, data: bytes, manifest: Manifest | None = None) -> None:
    """Refuse another format, also one that has other keys than a `Manifest`."""
    try:
        found = (manifest or msgspec.json.decode(data, type=_Format)).format
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return  # damaged
    if found not in (FORMAT, WITHOUT_CODE):
        raise InputError(f"{path}: format {found}, this version reads the formats {WITHOUT_CODE} and {FORMAT}")


def read_index(data_dir: Path) -> dict[str, IndexLine]:
    """Read the index: the last line of each name, in the order in which names first appeared.

    Raises
    ------
    InputError
        When there is no index or a line other than an unfinished last one cannot be read.
    """
    path = data_dir / INDEX
    try:
        lines = path.read_bytes().split(b"\n")
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{data_dir}: not a dataset folder, {INDEX} is missing") from None
    found: dict[str, IndexLine] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            entry = msgspec.json.decode(line, type=IndexLine)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            if number == len(lines):
                continue  # no newline: an append that was cut off, repeated by the next run
            raise InputError(f"{path}: line {number} is damaged ({error})") from None
        if not is_name(entry.name):
            raise InputError(
                f"{path}: line {number} names the scene {entry.name!r}, expected a folder's name of letters, digits "
                "and ._+-"
            )
        if entry.about and entry.about.split and not is_name(entry.about.split):
            raise InputError(
                f"{path}: line {number} names the split {entry.about.split!r}, expected letters, digits and ._+-"
            )
        found[entry.name] = entry
    return found


def append_index(data_dir: Path, *manifests: Manifest) -> None:
    """Append the lines of finished scenes to the index, except those that are already the last of their name."""
    entries = [
        IndexLine(name=m.name, scene_id=m.scene_id, content_hash=m.content_hash, code=m.code, about=m.about)
        for m in manifests
    ]
    with locked(data_dir / INDEX) as handle:
        cut_torn(handle)
        index = read_index(data_dir)
        new = [msgspec.json.encode(entry) + b"\n" for entry in entries if index.get(entry.name) != entry]
        append_synced(data_dir / INDEX, handle, b"".join(new))


def mend_index(data_dir: Path, manifests: Sequence[Manifest], names: Sequence[str]) -> None:
    """List these finished scenes where the index lacks them, and put the lines of `names` into that order.

    Others keep their place. Tables show scenes in the index's order, which so does not depend on which worker was
    faster. An index in order is only read, once.
    """
    try:
        index = read_index(data_dir)
    except InputError:
        if (data_dir / INDEX).exists():
            raise
        index = {}
    if lacking := [m for m in manifests if not is_listed(m, index)]:
        append_index(data_dir, *lacking)
        index = read_index(data_dir)
    if _arranged(index, names) != list(index):
        with locked(data_dir / INDEX):
            index = read_index(data_dir)
            lines = (msgspec.json.encode(index[name]) + b"\n" for name in _arranged(index, names))
            write_synced(data_dir / INDEX, b"".join(lines))


def is_listed(manifest: Manifest, index: Mapping[str, IndexLine]) -> bool:
    """Say whether the index names this very scan."""
    line = index.get(manifest.name)
    held = (manifest.scene_id, manifest.content_hash, manifest.code)
    return line is not None and (line.scene_id, line.content_hash, line.code) == held


def _arranged(index: Mapping[str, IndexLine], names: Sequence[str]) -> list[str]:
    """Return the names of the index, those of `names` in that order in the places that they have together."""
    inner, chosen = iter([name for name in names if name in index]), set(names)
    return [next(inner) if name in chosen else name for name in index]


def list_scans(data_dir: str | Path) -> tuple[Path, ...]:
    """Return the folders of all finished scenes in the order in which they were made.

    Raises
    ------
    InputError
        When there is no index, or a scene that it names is gone.
    """
    data_dir = Path(data_dir)
    folders = tuple(data_dir / name for name in read_index(data_dir))
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{data_dir / INDEX} names the scene {folder.name!r} but its folder is missing")
    return folders


def check_sizes(folder: Path, manifest: Manifest) -> list[str]:
    """List files that are missing, of another size than was written, or too small for their array (reads nothing)."""
    problems = []
    for name, entry in manifest.files.items():
        path = folder / name
        if not path.is_file():
            problems.append(f"{path}: missing")
        elif (size := path.stat().st_size) != entry.bytes:
            how = "truncated" if size < entry.bytes else "too long"
            problems.append(f"{path}: {how}, {size} bytes instead of {entry.bytes}")
        elif wrong := _array_problem(entry):
            problems.append(f"{path}: {wrong}, says {MANIFEST}")
    return problems


def _array_problem(entry: FileEntry) -> str:
    """Say why an entry's array cannot lie in its file; empty where it can, or where there is none."""
    shape, dtype, offset = entry.shape, entry.dtype, entry.offset
    if shape is None and dtype is None and offset is None:
        return ""
    if shape is None or dtype is None or offset is None:
        return "an array needs shape, dtype and offset"
    if dtype not in DTYPES:
        return f"dtype {dtype!r}, expected one of {', '.join(DTYPES)}"
    need = offset + math.prod(shape) * np.dtype(dtype).itemsize
    if min(shape, default=1) < 0 or offset < 0 or need > entry.bytes:
        return f"an array {shape} of {dtype} from byte {offset} on does not fit into {entry.bytes} bytes"
    return ""


def verify_scene(folder: str | Path) -> list[str]:
    """List everything that differs from what was written: missing, truncated, changed and extra files."""
    folder = Path(folder)
    try:
        return _differing(folder, read_manifest(folder))
    except InputError as error:
        return [str(error)]


def _differing(folder: Path, manifest: Manifest) -> list[str]:
    problems = check_sizes(folder, manifest)
    for name, entry in manifest.files.items():
        path = folder / name
        if path.is_file() and path.stat().st_size == entry.bytes and file_sha256(path) != entry.sha256:
            problems.append(f"{path}: changed, its SHA-256 is not the one written")
    if content_hash(manifest.files) != manifest.content_hash:
        problems.append(f"{folder / MANIFEST}: changed, its content hash does not fit its files")
    present = {str(p.relative_to(folder)) for p in folder.rglob("*") if not p.is_dir()}
    problems += [f"{folder / extra}: extra file" for extra in sorted(present - set(manifest.files) - set(OWN))]
    return problems


def verify(data_dir: str | Path) -> list[str]:
    """List every problem of a data folder; an empty list means that all is as it was written.

    Raises
    ------
    InputError
        When the folder does not exist or has no index.
    """
    data_dir = Path(data_dir)
    if not data_dir.is_dir():
        what = "is a file, expected a data folder" if data_dir.exists() else "no such folder"
        raise InputError(f"{data_dir}: {what}")
    index = read_index(data_dir)
    problems: list[str] = []
    for name in sorted({*index, *_scene_names(data_dir.iterdir())}):
        folder = data_dir / name
        if not folder.is_dir():
            problems.append(f"{folder}: missing, though {INDEX} names it")
            continue
        try:
            manifest = read_manifest(folder)
        except InputError as error:
            problems.append(str(error))
            continue
        problems += _differing(folder, manifest)
        if name not in index:
            problems.append(f"{folder}: not in {INDEX}")
        elif not is_listed(manifest, index):
            problems.append(f"{folder}: its content is not the one that {INDEX} names")
    for partial in sorted(data_dir.glob(".*.partial")):
        if not (data_dir / partial.name[1:].removesuffix(".partial")).is_dir():  # else see `folder.remarks`
            problems.append(f"{partial}: unfinished, make the scene again to go on from there")
    return problems


def _scene_names(paths: Iterable[Path]) -> set[str]:
    return {p.name for p in paths if p.is_dir() and not p.name.startswith(".")}
