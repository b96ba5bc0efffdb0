"""A scan on disk, read without copying, and the way to write one (see `ctsim.writer`).

A scene's folder holds counts.tif [view, v, u], flat.tif, the references, labels and metal mask
[z, y, x], scene.toml, scan.json, plan.json, manifest.json, the ground truth that was asked for, and
`metal_free/`, the twin without metal. Row 0 of an image is the bottom of the detector.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import manifest as mf
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.manifest import list_scans, verify
from ctsim.tiffstack import map_array
from ctsim.writer import SceneWriter, Stack, is_complete

if TYPE_CHECKING:
    from ctsim.types import Scan

__all__ = ["SceneWriter", "Stack", "StoredScan", "is_complete", "list_scans", "open_scan", "verify"]

_TWIN = "metal_free/"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredScan:
    """A finished scan on disk. `scan` is what a method gets; the rest is ground truth for judging it.

    Arrays are memory-mapped copy-on-write: nothing is read before it is used, the files never change.
    `info` is scan.json; `l0` the median water-equivalent path (mm). `metal_free` is the paired twin.
    """

    folder: Path
    name: str
    scene_id: str
    content_hash: str
    scan: "Scan"
    info: dict[str, Any]
    files: dict[str, mf.FileEntry]
    prefix: str = ""
    metal_free: "StoredScan | None" = None

    @property
    def geometry(self) -> Geometry:
        """Return the scan's geometry."""
        return self.scan.geometry

    @property
    def l0(self) -> float:
        """Return the scene's median water-equivalent path in mm."""
        return float(self.info["l0"])

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
    """Open a finished scan; the counts are mapped, not read.

    Raises
    ------
    InputError
        When the folder is half-written, damaged (a file missing or of another size) or of another format.
    """
    folder = Path(folder)
    manifest = mf.read_manifest(folder)
    problems = mf.check_sizes(folder, manifest)
    if problems:
        raise InputError(f"damaged dataset: {problems[0]}" + (f" (and {len(problems) - 1} more)" * (len(problems) > 1)))
    info = _read_info(folder / "scan.json")
    twin = _open(folder, manifest, info, _TWIN, None) if f"{_TWIN}counts.tif" in manifest.files else None
    return _open(folder, manifest, info, "", twin)


def _open(
    folder: Path, manifest: mf.Manifest, info: dict[str, Any], prefix: str, twin: StoredScan | None
) -> StoredScan:
    import torch  # seconds that listing and verifying do without

    from ctsim.types import Scan

    where = folder / "scan.json"
    counts, flat = (torch.from_numpy(_map(folder, manifest.files, name)) for name in (f"{prefix}counts", "flat"))
    try:
        scan = Scan(
            geometry=msgspec.convert(info["geometry"], Geometry),
            counts=counts,
            flat=flat,
            dark=float(info["dark"]),
            i0=float(info["i0"]),
            e_max=float(info["e_max"]),
        )
        float(info["l0"])
    except KeyError as error:
        raise InputError(f"{where}: the key {error} is missing") from None
    except (TypeError, ValueError) as error:  # msgspec's and our own errors are ValueErrors
        raise InputError(f"{where}: {error}") from None
    return StoredScan(
        folder=folder,
        name=manifest.name,
        scene_id=manifest.scene_id,
        content_hash=manifest.content_hash,
        scan=scan,
        info=info,
        files=manifest.files,
        prefix=prefix,
        metal_free=twin,
    )


def _read_info(path: Path) -> dict[str, Any]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        raise InputError(f"{path}: missing") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: damaged ({error})") from None


def _map(folder: Path, files: dict[str, mf.FileEntry], name: str) -> NDArray[Any]:
    entry = files.get(f"{name}.tif")
    if entry is None or entry.shape is None or entry.dtype is None or entry.offset is None:
        raise InputError(f"{folder}: was written without {name}.tif")
    path = folder / f"{name}.tif"
    try:
        return map_array(path, entry.shape, entry.dtype, entry.offset)
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be mapped ({error})") from error
