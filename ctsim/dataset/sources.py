"""Which code makes a scan: a hash of the sources of the simulator and of the phantoms."""

import functools
import hashlib
from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable

from ctsim.errors import InputError

PHANTOMS = "ctsim/phantoms/"
NOT_OF_DATA = ("api.py", "baselines", "benchmarks", "reconstruct", "reports")  # what no scan depends on
TEXT, TABLES = ".py", ".npz"  # what a package's results depend on; `NOTICE.txt` is for people


@functools.cache
def source_hash() -> str:
    """Return 16 hexadecimal digits for the sources that make data, remembered as this process runs them."""
    return hash_of(resources.files("ctsim"))


def hash_of(package: Traversable) -> str:
    """Hash the sources and tables of the package `ctsim` by content; its path and line ends do not matter.

    Raises InputError where the sources of the simulator or of the phantoms are missing.
    """
    digest = hashlib.sha256()
    files = dict(_files(package, "ctsim", NOT_OF_DATA))
    sources = {name.startswith(PHANTOMS) for name in files if name.endswith(TEXT)}
    for of_phantoms, name in ((False, "ctsim"), (True, "ctsim.phantoms")):
        if of_phantoms not in sources:
            raise InputError(f"{package}: the package {name} has no sources, which tell what code makes a scan")
    for name, file in sorted(files.items()):
        data = file.read_bytes()
        if name.endswith(TEXT):
            data = data.replace(b"\r\n", b"\n")
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()[:16]


def _files(folder: Traversable, where: str, left_out: tuple[str, ...] = ()) -> Iterator[tuple[str, Traversable]]:
    """Yield sources and tables with their names, such as ctsim/kernels/noise_cpu.py."""
    for entry in folder.iterdir():
        if entry.name in ("__pycache__", *left_out):
            continue
        if entry.is_dir():
            yield from _files(entry, f"{where}/{entry.name}")
        elif entry.name.endswith((TEXT, TABLES)):
            yield f"{where}/{entry.name}", entry
