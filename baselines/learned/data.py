"""What learned rows are trained on: the inputs of a dataset's scans and of their twins, and the truth.

A scene becomes one file of float16 arrays [z, y, x] in multiples of the scan's water: "fdk", "limar", "nmar",
"truth" and "twin", which is FDK of the twin; "bare" and "bare_truth", FDK and truth of the twin in the twin's water;
"metal". The file's name has a hash of the scan's content, so that another scan of that name is another file.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.learned.inputs import HIGHEST, LOWEST, SOURCES, Inputs, blind, told
from ctsim.baselines.limar import Bridging
from ctsim.dataset.manifest import IndexLine, read_index
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.errors import InputError

SPLITS = ("train", "val", "test")
ARRAYS = (*SOURCES, "truth", "twin", "metal", "bare", "bare_truth")


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """The scenes of a dataset by split, and a hash of the content of all scans that are trained or validated on.

    `hashes` are those of each scan's content, by name.
    """

    names: dict[str, tuple[str, ...]]
    hashes: dict[str, str]
    digest: str


def listed(data: Path) -> Listed:
    """List the scenes of a dataset by split. Raises InputError where a split has none."""
    by_split: dict[str, list[IndexLine]] = {split: [] for split in SPLITS}
    for line in read_index(data).values():
        by_split.get(line.about.split if line.about else "", []).append(line)
    names = {split: tuple(sorted(line.name for line in lines)) for split, lines in by_split.items()}
    if empty := [split for split in SPLITS if not names[split]]:
        raise InputError(f"{data}: no scan in split {empty[0]!r}; expected a dataset of the suite train")
    hashes = sorted(f"{split} {line.content_hash}" for split in SPLITS[:2] for line in by_split[split])
    contents = {line.name: line.content_hash for lines in by_split.values() for line in lines}
    return Listed(names=names, hashes=contents, digest=hashlib.sha256("\n".join(hashes).encode()).hexdigest())


def about(
    architecture: Mapping[str, str | int], digest: str, scenes: Mapping[str, int], target: str = "effective"
) -> dict[str, object]:
    """Return what weights say of their network and its data; the target is the "effective" reference or the "twin"."""
    return {
        "architecture": dict(architecture),
        "unit": "water as FDK of the scan shows it",
        "clip": [LOWEST, HIGHEST],
        "data": {"suite": "train", "scenes": dict(scenes), "sha256": digest},
        "target": target,
    }


def prepare(data: Path, name: str, content_hash: str, folder: Path) -> Path:
    """Write the arrays of a scene unless those of this content are there, and return their file."""
    digest = hashlib.sha256(" ".join((content_hash, *ARRAYS)).encode()).hexdigest()
    path = folder / f"{name}-{digest[:12]}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, **arrays(open_scan(data / name)))  # pyright: ignore[reportArgumentType]
        part.replace(path)
    return path


def arrays(stored: StoredScan) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of a scene. Raises InputError for a scan without metal or twin."""
    twin = stored.metal_free
    if twin is None or not stored.info.metal:
        raise InputError(f"{stored.place}: expected a scan with metal and its twin without")
    metal = np.asarray(stored.metal) > 0
    scan = dataclasses.replace(stored.scan, metal=torch.from_numpy(metal))
    seen, bare = told(scan, Bridging()), blind(twin.scan, Bridging())
    if min(seen.water, bare.water) <= 0:
        raise InputError(f"{stored.place}: nothing stands out from air")
    found: dict[str, NDArray[np.generic]] = {name: _half(seen.scaled(name)) for name in SOURCES}
    twin_values = np.clip(bare.sources["fdk"] / np.float32(seen.water), LOWEST, HIGHEST)
    found |= {"truth": _truth(stored, seen), "twin": _half(twin_values), "metal": metal}
    return found | {"bare": _half(bare.scaled("fdk")), "bare_truth": _truth(twin, bare)}


def _truth(stored: StoredScan, by: Inputs) -> NDArray[np.float16]:
    return _half(np.clip(np.asarray(stored.reference("effective")) / by.water, LOWEST, HIGHEST))


def _half(values: NDArray[np.floating]) -> NDArray[np.float16]:
    return values.astype(np.float16)


def slices_of(scenes: list[dict[str, NDArray[np.generic]]], n: int) -> dict[str, NDArray[np.float16]]:
    """Return `n` slices of each scene, [slice, 1, y, x]: three quarters of them from those that LIMAR changes.

    Values are rounded to 1/128 of water, an eighth of the noise of a fine scan, so that files compress.
    """
    parts: dict[str, list[NDArray[np.float16]]] = {}
    for scene in scenes:
        fdk, limar = scene["fdk"].astype(np.float32), scene["limar"].astype(np.float32)
        changed = np.abs(limar - fdk).max((1, 2)) > 0.02
        few = min(3 * n // 4, int(changed.sum()))
        chosen = [*_even(np.flatnonzero(changed), few), *_even(np.flatnonzero(~changed), n - few)]
        for name in ("fdk", "limar", "truth", "twin", "metal", "bare", "bare_truth"):
            values = scene[name][np.sort(np.array(chosen, np.intp)), None]
            rounded = np.round(values.astype(np.float32) * 128) / 128
            parts.setdefault(name, []).append(_half(rounded))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _even(found: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Return `n` of some numbers, spread evenly; all of them where there are no more."""
    return found if n >= len(found) else found[(np.arange(n) * len(found)) // max(n, 1)]
