"""The table of formats of measured scans. Their modules are imported when they are needed."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ctsim.dataset.arrayfile import decoding
from ctsim.errors import InputError
from ctsim.io.extra import load
from ctsim.io.scans.scanfile import ScanFile, Stated


class Format(NamedTuple):
    """A format: its name in sentences, its module and the function there, and whether a path looks like one.

    `lengths` says that the user may state lengths.
    """

    kind: str
    module: str
    function: str
    fits: Callable[[Path], bool]
    lengths: bool = False


def _has(*ends: str) -> Callable[[Path], bool]:
    """Return whether a path is a file of such an end, or a folder that holds one."""

    def fits(path: Path) -> bool:
        names = [p.name for p in path.iterdir()] if path.is_dir() else [path.name]
        return any(name.lower().endswith(ends) for name in names)

    return fits


SCANS = {
    "walnut": Format("scan in the layout of CWI's walnuts", "ctsim.io.scans.walnut", "open_scan", _has(".geom")),
    "r2": Format("folder of R2-Gaussian", "ctsim.io.scans.neural", "open_r2", _has("meta_data.json")),
    "skyscan": Format("SkyScan scan", "ctsim.io.scans.skyscan", "open_scan", _has(".log"), lengths=True),
    "hdf5": Format(
        "scan in HDF5",
        "ctsim.io.scans.exchange",
        "open_scan",
        _has(".h5", ".hdf5", ".hdf", ".nxs", ".nx"),
        lengths=True,
    ),
    "naf": Format("pickle of NAF", "ctsim.io.scans.neural", "open_naf", _has(".pickle", ".pkl")),
}
"""name -> format; the first that fits is taken."""


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Begin what is wrong with a scan with its path, where it does not name a file: what a geometry refuses."""
    try:
        yield
    except InputError as error:
        known = str(error).startswith(str(path)) or str(error).startswith(str(path.parent))
        raise InputError(str(error) if known else f"{path}: {error}") from None


def open_scan(path: Path, name: str = "auto", stated: Stated | None = None) -> ScanFile:
    """Read the headers of a scan in a format of `SCANS`, found by the files' names unless it is named.

    Raises InputError, a sentence that begins with the path, for what cannot be read or is no such scan.
    """
    if not path.exists():
        raise InputError(f"{path} cannot be read (No such file or directory); expected a scan")
    chosen = SCANS[name] if name in SCANS else next((f for f in SCANS.values() if f.fits(path)), None)
    if chosen is None:
        raise InputError(f"{path} is no scan of a known format ({', '.join(f.kind for f in SCANS.values())})")
    stated = stated or Stated()
    if stated != Stated() and not chosen.lengths:
        raise InputError(
            f"{path} is a {chosen.kind}, which states its lengths; expected neither --dso, --dsd nor --pixel"
        )
    reader = getattr(load(chosen.module, path), chosen.function)
    with decoding(path, chosen.kind), _naming(path):
        scan: ScanFile = reader(path, stated)

    def read(view: int) -> NDArray[Any]:
        with decoding(path, chosen.kind):
            return scan.read(view)

    return dataclasses.replace(scan, read=read)
