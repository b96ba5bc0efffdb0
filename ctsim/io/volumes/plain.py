"""TIFF stacks and .npy arrays [z, y, x] in the patient's frame; of their headers an ImageJ TIFF's spacing is read."""

from pathlib import Path

from ctsim.dataset.arrayfile import describe_array, read_array, stated_spacing
from ctsim.io.volumes.frame import Axes
from ctsim.io.volumes.volumefile import VolumeFile


def open_volume(path: Path) -> VolumeFile:
    """Read shape, type and, where it is stated, spacing of a TIFF stack or a .npy array."""
    shape, dtype = describe_array(path)
    spacing = None if path.suffix.lower() == ".npy" else stated_spacing(path)
    axes = None if spacing is None else Axes(order=(0, 1, 2), flipped=(False, False, False), spacing=spacing)
    return VolumeFile(path=path, files=(path,), shape=shape, dtype=dtype, read=lambda: read_array(path), axes=axes)
