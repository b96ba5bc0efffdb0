"""A scan on disk, read without copying, and the way to write one (see `ctsim.dataset.writer`).

A scene's folder holds counts.tif [view, v, u], flat.tif, the references, labels and metal mask
[z, y, x], scene.toml, scan.json, plan.json, manifest.json, the ground truth that was asked for, and
`metal_free/`, the twin without metal. Row 0 of an image is the bottom of the detector.
"""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ctsim.dataset import manifest as mf
from ctsim.dataset.manifest import list_scans, verify
from ctsim.dataset.tiffstack import map_array
from ctsim.dataset.truth import ScanWithTruth, readings
from ctsim.dataset.writer import SceneWriter, Stack, is_complete
from ctsim.errors import InputError, check_kind
from ctsim.scaninfo import TWIN, ScanInfo, read_info

__all__ = ["SceneWriter", "Stack", "StoredScan", "is_complete", "list_scans", "open_scan", "verify"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredScan(ScanWithTruth):
    """A finished scan on disk. `scan` is what a method gets; the rest is ground truth for judging it.

    It holds no open file: arrays are memory-mapped when they are asked for, each time again and copy-on-write, so that
    nothing is read before it is used and neither the files nor another one's arrays ever change. `info` is scan.json;
    `code` hashes the code of the simulator that made it (empty: not noted); `metal_free` is the paired twin; `split` is
    that of a scene of a table with `count` (empty: none).
    """

    folder: Path
    content_hash: str
    code: str
    files: dict[str, mf.FileEntry] = field(hash=False)
    split: str = ""

    @property
    def place(self) -> str:
        """Return the folder."""
        return str(self.folder)

    @property
    def phantom(self) -> str:
        """Return a hash of what lies where on the reconstruction grid; "" where the scan has no labels."""
        entry = self.files.get("labels.tif")
        return (
            "" if entry is None else hashlib.sha256(f"{entry.sha256} {self.info.materials}".encode()).hexdigest()[:12]
        )

    @property
    def has_truth(self) -> bool:
        """Whether there is a truth to judge volumes by."""
        return any(f"{name}.tif" in self.files for name in ("labels", "metal", "reference_effective"))

    def file(self, name: str) -> NDArray[Any]:
        """Map an array of the folder by its name without .tif."""
        return _map(self.folder, self.files, name)

    def text(self, name: str) -> str | None:
        """Read a text file of the folder; None where there is none."""
        path = self.folder / name
        if not path.is_file():
            return None
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from error


def open_scan(folder: str | Path) -> StoredScan:
    """Open a finished scan: its files are found and measured, none but its JSON is read.

    Raises
    ------
    InputError
        When the folder is half-written, damaged (a file missing or of another size), of another format, or its
        scan.json says what cannot be.
    """
    check_kind("folder", folder, (str, Path), "the folder of a scan, as a text or a path")
    folder = Path(folder)
    manifest = mf.read_manifest(folder)
    problems = mf.check_sizes(folder, manifest)
    if problems:
        raise InputError(f"damaged dataset: {problems[0]}" + (f" (and {len(problems) - 1} more)" * (len(problems) > 1)))
    info = read_info(folder / "scan.json")
    twin = _open(folder, manifest, info, TWIN, None) if f"{TWIN}counts.tif" in manifest.files else None
    return _open(folder, manifest, info, "", twin)


def _open(folder: Path, manifest: mf.Manifest, info: ScanInfo, prefix: str, twin: StoredScan | None) -> StoredScan:
    for name, shape in zip(readings(prefix), (info.geometry.shape, info.geometry.n_detector), strict=True):
        found, _, _ = _place(folder, manifest.files, name)
        if found != shape:
            raise InputError(f"{folder / name}.tif: shape {found}, the geometry of scan.json says {shape}")
    return StoredScan(
        folder=folder,
        name=manifest.name,
        scene_id=manifest.scene_id,
        content_hash=manifest.content_hash,
        code=manifest.code,
        info=info,
        files=manifest.files,
        prefix=prefix,
        metal_free=twin,
        split=manifest.about.split if manifest.about else "",
    )


def _place(folder: Path, files: dict[str, mf.FileEntry], name: str) -> tuple[tuple[int, ...], str, int]:
    """Return an array's shape, dtype and byte offset; raises InputError where there is none of that name."""
    entry = files.get(f"{name}.tif")
    if entry is None or entry.shape is None or entry.dtype is None or entry.offset is None:
        raise InputError(f"{folder}: was written without {name}.tif")
    return entry.shape, entry.dtype, entry.offset


def _map(folder: Path, files: dict[str, mf.FileEntry], name: str) -> NDArray[Any]:
    shape, dtype, offset = _place(folder, files, name)
    path = folder / f"{name}.tif"
    try:
        return map_array(path, shape, dtype, offset)
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be mapped ({error})") from error
