"""TIFF stacks and .npy arrays [z, y, x]: they state neither spacing nor orientation that is read here."""

from pathlib import Path

from ctsim.dataset.arrayfile import describe_array, read_array
from ctsim.io.volumes.volumefile import VolumeFile


def open_volume(path: Path) -> VolumeFile:
    """Read shape and type of a TIFF stack or a .npy array, taken as [z, y, x] in the patient's frame."""
    shape, dtype = describe_array(path)
    return VolumeFile(path=path, files=(path,), shape=shape, dtype=dtype, read=lambda: read_array(path))
