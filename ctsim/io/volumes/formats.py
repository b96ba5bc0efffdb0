"""The table of formats: who reads and who writes each of them. Their modules are imported when they are needed."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ctsim.dataset.arrayfile import decoding
from ctsim.errors import InputError
from ctsim.io.extra import load
from ctsim.io.volumes.volumefile import VolumeFile


class Format(NamedTuple):
    """A format: its name in sentences, the ends of its files' names, and the module with `open_volume`.

    Where volumes are written in it, `writer` is the module with `write_volume`, and `ends` are the names that it takes.
    """

    kind: str
    suffixes: tuple[str, ...]
    module: str
    writer: str = ""
    ends: tuple[str, ...] = ()


DICOM = Format(
    "folder of DICOM slices", (".dcm", ".ima"), "ctsim.io.volumes.dicom", "ctsim.io.volumes.dicomwrite", ("",)
)
NIFTI = Format(
    "NIfTI file", (".nii", ".nii.gz"), "ctsim.io.volumes.nifti", "ctsim.io.volumes.nifti", (".nii", ".nii.gz")
)
METAIMAGE = Format("MetaImage", (".mha", ".mhd"), "ctsim.io.volumes.metaimage", "ctsim.io.volumes.metaimage", (".mha",))
NRRD = Format("NRRD file", (".nrrd", ".nhdr"), "ctsim.io.volumes.nrrd")
PLAIN = Format("TIFF stack or .npy array", (".tif", ".tiff", ".npy"), "ctsim.io.volumes.plain")
FORMATS = {"dicom": DICOM, "nifti": NIFTI, "mha": METAIMAGE, "nrrd": NRRD, "plain": PLAIN}


def open_volume(path: Path) -> VolumeFile:
    """Read the headers of a CT volume; a folder is one of DICOM slices, a name of no known end is taken for TIFF.

    Raises InputError, a sentence that begins with the path, for what cannot be read or is no single volume.
    """
    named = next((f for f in FORMATS.values() if path.name.lower().endswith(f.suffixes)), None)
    if not path.exists():
        kinds = named.kind if named else ", ".join(f.kind for f in FORMATS.values())
        raise InputError(f"{path} cannot be read (No such file or directory); expected a {kinds}")
    found = DICOM if path.is_dir() else named or PLAIN
    reader = load(found.module, path)
    with decoding(path, found.kind):
        volume: VolumeFile = reader.open_volume(path)

    def read() -> NDArray[Any]:
        with decoding(path, found.kind):
            return volume.read()

    return dataclasses.replace(volume, read=read)
