"""A scan on disk, read without copying, and the way to write one (see `ctsim.dataset.writer`).

A scene's folder holds counts.tif [view, v, u], flat.tif, the references, labels and metal mask
[z, y, x], scene.toml, scan.json, plan.json, manifest.json, the ground truth that was asked for, and
`metal_free/`, the twin without metal. Row 0 of an image is the bottom of the detector.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ctsim.dataset import manifest as mf
from ctsim.dataset.manifest import list_scans, verify
from ctsim.dataset.tiffstack import map_array
from ctsim.dataset.writer import SceneWriter, Stack, is_complete
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.scaninfo import ScanInfo, read_info

if TYPE_CHECKING:
    from ctsim.types import Scan

__all__ = ["SceneWriter", "Stack", "StoredScan", "is_complete", "list_scans", "open_scan", "verify"]

_TWIN = "metal_free/"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredScan:
    """A finished scan on disk. `scan` is what a method gets; the rest is ground truth for judging it.

    It holds no open file: arrays are memory-mapped when they are asked for, each time again and copy-on-write, so that
    nothing is read before it is used and neither the files nor another one's arrays ever change. `info` is scan.json;
    `code` hashes the code of the simulator that made it (empty: not noted); `metal_free` is the paired twin.
    """

    folder: Path
    name: str
    scene_id: str
    content_hash: str
    code: str
    info: ScanInfo
    files: dict[str, mf.FileEntry]
    prefix: str = ""
    metal_free: "StoredScan | None" = None

    @property
    def scan(self) -> "Scan":
        """Map the scan again: what is written into it stays with the one who asked.

        Raises
        ------
        InputError
            When a file cannot be mapped, and when the open field has no usable pixel.
        """
        import torch  # seconds that listing and verifying do without

        from ctsim.types import Scan

        counts, flat = (torch.from_numpy(_map(self.folder, self.files, name)) for name in _readings(self.prefix))
        info, name = self.info, f"{self.name}/{self.prefix}".rstrip("/")
        try:
            return Scan(
                geometry=info.geometry,
                counts=counts,
                flat=flat,
                dark=info.dark,
                i0=info.i0,
                e_max=info.e_max,
                name=name,
            )
        except InputError as error:
            raise InputError(f"{self.folder}: {error}") from None

    @property
    def geometry(self) -> Geometry:
        """Return the scan's geometry."""
        return self.info.geometry

    @property
    def l0(self) -> float:
        """Return the scene's median water-equivalent path in mm."""
        return self.info.l0

    @property
    def kerma(self) -> float | None:
        """Return the scan's air kerma (mGy) at the isocentre; None where scan.json of an older scan lacks it."""
        return self.info.scan_kerma

    @property
    def phantom(self) -> str:
        """Return a hash of what lies where on the reconstruction grid; "" where the scan has no labels."""
        entry = self.files.get("labels.tif")
        return (
            "" if entry is None else hashlib.sha256(f"{entry.sha256} {self.info.materials}".encode()).hexdigest()[:12]
        )

    @property
    def has_truth(self) -> bool:
        """Whether there is a truth to judge volumes by, as of every simulated scan and of no measured one."""
        return any(f"{name}.tif" in self.files for name in ("labels", "metal", "reference_effective"))

    @property
    def labels(self) -> NDArray[np.uint8]:
        """Return the label volume, uint8 [z, y, x]."""
        return self.array("labels")

    @property
    def metal(self) -> NDArray[np.uint8]:
        """Return the metal mask, uint8 [z, y, x]."""
        return self.array("metal")

    def reference(self, which: str) -> NDArray[np.float32]:
        """Return the true attenuation, "effective" (effective spectrum) or "50kev": float32 [z, y, x] in 1/mm."""
        return self.array(f"reference_{which}")

    def array(self, name: str) -> NDArray[Any]:
        """Map one stored array, such as "noise_free".

        Raises
        ------
        InputError
            When the scan was written without it.
        """
        return _map(self.folder, self.files, self.prefix + name)


def open_scan(folder: str | Path) -> StoredScan:
    """Open a finished scan: its files are found and measured, none but its JSON is read.

    Raises
    ------
    InputError
        When the folder is half-written, damaged (a file missing or of another size), of another format, or its
        scan.json says what cannot be.
    """
    folder = Path(folder)
    manifest = mf.read_manifest(folder)
    problems = mf.check_sizes(folder, manifest)
    if problems:
        raise InputError(f"damaged dataset: {problems[0]}" + (f" (and {len(problems) - 1} more)" * (len(problems) > 1)))
    info = read_info(folder / "scan.json")
    twin = _open(folder, manifest, info, _TWIN, None) if f"{_TWIN}counts.tif" in manifest.files else None
    return _open(folder, manifest, info, "", twin)


def _open(folder: Path, manifest: mf.Manifest, info: ScanInfo, prefix: str, twin: StoredScan | None) -> StoredScan:
    for name, shape in zip(_readings(prefix), (info.geometry.shape, info.geometry.n_detector), strict=True):
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
    )


def _readings(prefix: str) -> tuple[str, str]:
    """Return the names of a scan's counts and of its open field, which a twin shares."""
    return f"{prefix}counts", "flat"


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
