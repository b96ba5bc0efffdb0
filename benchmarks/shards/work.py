"""What `make-dataset shards` does: divide scans into shards by split, reconstruct them, write what is missing."""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from ctsim.benchmarks.engine.host import open_jobs
from ctsim.benchmarks.engine.process import Lost
from ctsim.benchmarks.engine.terminal import Bar
from ctsim.benchmarks.shards import Flags
from ctsim.dataset.manifest import IndexLine, read_index
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.errors import InputError
from ctsim.human import human_bytes, human_choice
from ctsim.io.extra import load
from ctsim.reconstruct.fdk import reconstruct
from ctsim.reconstruct.log import LineIntegrals

FORMAT = "ctsim.io.shards"
REST = "all"  # name of the shards of scans that are in no split


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """A shard to write, as it travels to a worker."""

    path: Path
    data: Path
    scans: tuple[IndexLine, ...]
    items: tuple[str, ...]
    of: int


def main(argv: list[str]) -> int:
    """Run the command; return 0."""
    given: Any = tyro.cli(Flags, prog="make-dataset shards", args=argv)
    shards(given)
    return 0


def shards(given: Flags) -> None:
    """Write the shards that are missing, and say what there is.

    Raises InputError for a data folder that cannot be read, unknown items, and items that a scan lacks.
    """
    form = load(FORMAT, given.out)
    if unknown := [item for item in given.items if item not in form.ITEMS]:
        raise InputError(f"--items {unknown[0]}: expected some of {human_choice(form.ITEMS, unknown[0])}")
    if given.scans_per_shard < 1:
        raise InputError(f"--scans-per-shard {given.scans_per_shard}: expected 1 or more")
    if given.out.is_file():
        raise InputError(f"{given.out}: is a file, expected a folder")
    wanted = list(_divided(given))
    if others := sorted({*given.out.glob("*.h5")} - {given.out / shard.path.name for shard in wanted}):
        raise InputError(
            f"{others[0]}: is not among the shards of {given.data}, so its scans may be read twice; "
            "delete it, or name another folder"
        )
    todo = [shard for shard in wanted if not _is_there(shard, form)]
    with open_jobs(given.workers, None) as pool, Bar(len(wanted), "shard", len(wanted) - len(todo)) as bar:
        if pool is None:
            for shard in todo:
                write(shard)
                bar.at(bar.done + 1, shard.path.name)
        else:
            for answer in pool.answers(write, todo):
                if answer is not None:
                    number, end = answer
                    if isinstance(end, Lost):
                        raise InputError(f"{todo[number].path}: {end.reason}; expected fewer workers")
                    bar.at(bar.done + 1, todo[number].path.name)
    size = sum(shard.path.stat().st_size for shard in wanted)
    n_scans = sum(len(shard.scans) for shard in wanted)
    sys.stdout.write(f"{given.out}: {n_scans} scans in {len(wanted)} shards, {human_bytes(size)}\n")


def _divided(given: Flags) -> Iterator[Shard]:
    """Yield the shards of a data folder: split by split, in the order of its index."""
    by_split: dict[str, list[IndexLine]] = {}
    for line in read_index(given.data).values():
        by_split.setdefault(line.about.split if line.about and line.about.split else REST, []).append(line)
    data = given.data.resolve()
    for split, lines in by_split.items():
        starts = range(0, len(lines), given.scans_per_shard)
        for number, first in enumerate(starts):
            chosen = tuple(lines[first : first + given.scans_per_shard])
            path = given.out.resolve() / f"{split}-{number:05d}.h5"
            yield Shard(path=path, data=data, scans=chosen, items=given.items, of=len(starts))


def _is_there(shard: Shard, form: ModuleType) -> bool:
    """Say whether a shard is there with these very scans, for which the same items were asked."""
    if not shard.path.exists():
        return False
    try:
        found = form.contents(shard.path)
    except InputError:
        return False
    same = [(e.name, e.content_hash) for e in found.scans] == [(s.name, s.content_hash) for s in shard.scans]
    return same and {*found.items} == {*shard.items} and found.of <= shard.of  # more scans may have come


def write(shard: Shard) -> None:
    """Be the worker: reconstruct a shard's scans and write them."""
    form = load(FORMAT, shard.path)
    form.write(shard.path, (_scan(shard, line, form) for line in shard.scans), shard.items, shard.of)


def _scan(shard: Shard, line: IndexLine, form: ModuleType) -> tuple[Any, dict[str, NDArray[Any]], str]:
    stored = open_scan(shard.data / line.name)
    about = line.about
    entry = form.Entry(
        name=line.name,
        content_hash=line.content_hash,
        individual=about.individual if about else "",
        split=about.split if about else "",
    )
    arrays = arrays_of(stored, shard.items)
    if missing := [item for item in shard.items if item not in arrays]:
        without = (
            "was written without; see truth in its scene.toml" if stored.has_truth else "is a measured scan without it"
        )
        raise InputError(f"--items {missing[0]}: {stored.folder} {without}")
    scene = stored.folder / "scene.toml"  # an imported scan has none
    return entry, arrays, scene.read_text(encoding="utf-8") if scene.exists() else ""


def arrays_of(stored: StoredScan, items: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Return the arrays of a scan by item, all that it has where none is named; without metal it is its own twin.

    A measured scan, whose metal nobody knows, has p and fdk.
    """
    scans, found = {"p": stored, "fdk": stored}, dict[str, NDArray[Any]]()
    twin = stored.metal_free if stored.info.metal or not stored.has_truth else stored
    if twin is not None:
        scans |= {"twin_p": twin, "twin": twin}
    for item, source in scans.items():
        if items and item not in items:
            continue
        scan = source.scan
        is_stack = item.endswith("p")
        found[item] = LineIntegrals(scan).of(slice(None))[0] if is_stack else reconstruct(scan).values.numpy()
    if not stored.has_truth:
        return found
    truth: dict[str, Callable[[], NDArray[Any]]] = {
        "reference": lambda: stored.reference("effective"),
        "metal": lambda: stored.metal,
    }
    if "trace.tif" in stored.files:
        truth["trace"] = lambda: stored.array("trace")
    elif not stored.info.metal:
        truth["trace"] = lambda: np.zeros(stored.geometry.shape, np.uint8)
    return found | {item: read() for item, read in truth.items() if not items or item in items}
