"""Which code makes a scan: a hash of the sources of the simulator and of the phantoms."""

import functools
import hashlib
from collections.abc import Iterator, Mapping
from importlib import resources
from importlib.resources.abc import Traversable

from ctsim.errors import InputError

PACKAGES = ("ctsim", "phantoms")
TEXT, TABLES = ".py", ".npz"  # what a package's results depend on; `NOTICE.txt` is for people


@functools.cache
def source_hash() -> str:
    """Return 16 hexadecimal digits for the sources that make data, remembered as those that this process runs."""
    return hash_of({name: resources.files(name) for name in PACKAGES})


def hash_of(packages: Mapping[str, Traversable]) -> str:
    """Hash the sources and tables of packages by their content; where they lie and their line ends do not matter.

    Raises InputError for a package without sources, of which nothing could be told.
    """
    digest = hashlib.sha256()
    for package, folder in sorted(packages.items()):
        files = dict(_files(folder, package))
        if not any(name.endswith(TEXT) for name in files):
            raise InputError(f"{folder}: the package {package} has no sources, which tell what code makes a scan")
        for name, file in sorted(files.items()):
            data = file.read_bytes()
            if name.endswith(TEXT):
                data = data.replace(b"\r\n", b"\n")
            digest.update(f"{name}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()[:16]


def _files(folder: Traversable, where: str) -> Iterator[tuple[str, Traversable]]:
    """Yield sources and tables with their names, such as ctsim/kernels/noise_cpu.py."""
    for entry in folder.iterdir():
        if entry.is_dir():
            if entry.name != "__pycache__":
                yield from _files(entry, f"{where}/{entry.name}")
        elif entry.name.endswith((TEXT, TABLES)):
            yield f"{where}/{entry.name}", entry
