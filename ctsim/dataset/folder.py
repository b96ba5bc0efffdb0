"""A data folder as the next run finds it: which scenes are finished, and what ended runs left next to them.

A scene is written in `.NAME.partial/` under the lock `.NAME.lock`; a scene that is replaced waits as `.NAME.old`.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from ctsim.dataset import durable
from ctsim.dataset import manifest as mf
from ctsim.dataset.locks import Busy, Lock, lock
from ctsim.dataset.sources import source_hash
from ctsim.errors import InputError

SHOWN = 10  # names in a sentence
_UNWRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT)


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """What an unfinished scene says of itself: `views` are safe on the disk, stacks begin at `offsets` of their files.

    `code` is empty where it was begun before that was noted.
    """

    scene_id: str
    plan_hash: str
    views: int
    offsets: dict[str, int]
    code: str = ""


def partial_of(data_dir: Path, name: str) -> Path:
    """Return the folder in which a scene is written."""
    return data_dir / f".{name}.partial"


def lock_of(data_dir: Path, name: str) -> Lock:
    """Take the lock of whoever writes a scene. Raises `Busy` when another process has it."""
    return lock(data_dir / f".{name}.lock", f"the scene {name!r}")


def read_progress(partial: Path) -> Progress | None:
    """Return what an unfinished scene says of itself; None where it says nothing that can be read."""
    try:
        return msgspec.json.decode((partial / mf.PROGRESS).read_bytes(), type=Progress)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def unfinished(data_dir: Path) -> dict[str, Progress]:
    """Return what the unfinished scenes of a data folder say of themselves, by name."""
    found = {path.name[1:].removesuffix(".partial"): read_progress(path) for path in data_dir.glob(".*.partial")}
    return {name: progress for name, progress in found.items() if progress is not None}


def finished(data_dir: Path, name: str, scene_id: str) -> mf.Manifest | None:
    """Return the manifest of this very scene where it is there, finished, by any code; reads only.

    Raises
    ------
    InputError
        When the folder of that name holds something else.
    """
    folder = data_dir / name
    if not folder.exists():
        return None
    found = mf.read_manifest(folder)
    if found.scene_id != scene_id:
        raise InputError(
            f"{folder}: holds another scene ({found.scene_id[:12]}, expected {scene_id[:12]}); "
            "choose another folder or replace it with --force"
        )
    return found


def is_complete(data_dir: str | Path, name: str, scene_id: str) -> bool:
    """Say whether this very scene is already there, finished. See `finished`."""
    return finished(Path(data_dir), name, scene_id) is not None


def recover(data_dir: Path) -> None:
    """Bring back scenes that a run was just replacing when it ended, on a system that cannot swap two folders."""
    for old in data_dir.glob(".*.old"):
        name = old.name[1:].removesuffix(".old")
        if not (data_dir / name).exists():
            with contextlib.suppress(Busy), lock_of(data_dir, name):
                durable.recover(data_dir / name)


def tidy(data_dir: Path, scenes: Iterable[mf.Manifest]) -> list[str]:
    """Remove what ended runs left next to finished scenes; return what is to be said of it.

    An unfinished replacement is removed where it would become what is already there. What somebody writes just now
    stays, and on a disk that cannot be written to all stays.
    """
    hidden = {path.name for path in data_dir.glob(".*")}
    said = []
    for scene in scenes:
        left = any(f".{scene.name}{end}" in hidden for end in (".partial", ".lock", ".old"))
        if not left and not os.path.exists(f"{data_dir}/{scene.name}/{mf.PROGRESS}"):
            continue
        folder, partial = data_dir / scene.name, partial_of(data_dir, scene.name)
        try:
            with contextlib.suppress(Busy), lock_of(data_dir, scene.name):
                said += _tidy(folder, partial, scene)
        except OSError as error:
            if error.errno not in _UNWRITABLE:
                raise
            said += [_replacement(partial)] if partial.is_dir() else []
    return said


def _tidy(folder: Path, partial: Path, scene: mf.Manifest) -> list[str]:
    """Remove what ended runs left of a finished scene; its lock is held."""
    durable.recover(folder)
    (folder / mf.PROGRESS).unlink(missing_ok=True)  # the run ended between the rename and this
    if not partial.is_dir():
        return []
    progress, code = read_progress(partial), source_hash()
    of_use = progress is not None and progress.views and progress.code == code
    if of_use and progress and (progress.scene_id, progress.code) != (scene.scene_id, scene.code):
        return [_replacement(partial)]
    shutil.rmtree(partial)
    return [f"{partial}: removed, an unfinished replacement"]


def _replacement(partial: Path) -> str:
    return f"{partial}: an unfinished replacement; --force goes on with it, delete it to do without"


def remarks(data_dir: Path) -> list[str]:
    """List what is no fault of a data folder but worth knowing: scenes of other code, unfinished replacements."""
    index = mf.read_index(data_dir)
    said = [other_code([line for line in index.values() if line.code != source_hash()], len(index))]
    said += [
        _replacement(partial)
        for partial in sorted(data_dir.glob(".*.partial"))
        if (data_dir / partial.name[1:].removesuffix(".partial")).is_dir()
    ]
    return [text for text in said if text]


def other_code(scenes: Sequence[mf.Manifest | mf.IndexLine], of: int) -> str:
    """Say which of the `of` finished scenes were made by other code than this; empty where none was."""
    if not scenes:
        return ""
    names = listing([scene.name for scene in scenes])
    only = "" if len(scenes) == of else " --only NAME …"
    return (
        f"{len(scenes)} of {of} scenes were made by other code of the simulator, so this code may make other data of "
        f"them: {names}; make-dataset --force{only} makes them again"
    )


def mixture(scenes: Iterable[tuple[str, str]]) -> str:
    """Say which of the scenes (name, code) were made by which code; empty where it was the same for all."""
    by: dict[str, list[str]] = {}
    for name, code in scenes:
        by.setdefault(code, []).append(name)
    if len(by) < 2:
        return ""
    groups = "; ".join(f"{listing(names)} by {code or 'code that is not noted'}" for code, names in by.items())
    return (
        f"the scenes were made by different code of the simulator, so their scores may not compare: {groups}; "
        "make-dataset --force makes them again"
    )


def listing(names: Sequence[str]) -> str:
    """Return names for a sentence, the first of many."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
