"""Scans in the layout of the walnuts of CWI: scan_geom_corrected.geom and TIFF images, doi:10.1038/s41597-019-0235-y.

A line of the file holds a view's source, detector centre, u step and v step (x, y, z in mm each). Images hold columns
as rows, from the last on, and are numbered backwards: the last belongs to the first line. di*.tif are dark and io*.tif
open.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.arrayfile import image_shape, read_image
from ctsim.errors import InputError
from ctsim.geometry import MOST_VIEWS
from ctsim.io.payload import beside
from ctsim.io.scans.circle import as_circle
from ctsim.io.scans.scanfile import ScanFile, Stated, read_text

NAME = "scan_geom_corrected.geom"


def open_scan(path: Path, stated: Stated) -> ScanFile:
    """Read the vectors of a scan (the file, or its folder) and list the images."""
    header = path if path.is_file() else path / NAME
    if not header.is_file():
        raise InputError(f"{path} holds no {NAME}")
    poses = _poses(header)
    images, opens, darks = (_listed(header, prefix) for prefix in ("scan_", "io", "di"))
    if len(images) != len(poses):
        raise InputError(f"{header} has {len(poses)} lines, there are {len(images)} images scan_*.tif next to it")
    if not opens:
        raise InputError(f"{header} has no open image io*.tif next to it")
    columns, rows = stored = image_shape(images[0])
    dark = _mean(darks, stored) if darks else np.zeros((rows, columns))
    circle = as_circle(poses, (rows, columns))
    return ScanFile(
        path=header,
        files=(header, *images, *opens, *darks),
        geometry=circle.geometry,
        read=_reader(images[::-1], stored, dark, circle.turned),
        flat=circle.turned(_mean(opens, stored) - dark).astype(np.float32),
        notes=(circle.note,),
    )


def _poses(header: Path) -> NDArray[np.float64]:
    lines = [line.split() for line in read_text(header).splitlines() if line.strip()]
    try:
        poses = np.array([[float(word) for word in line] for line in lines], np.float64)
    except ValueError:
        poses = np.zeros(0)
    if poses.ndim != 2 or poses.shape[-1] != 12 or not 1 <= len(poses) <= MOST_VIEWS or not np.isfinite(poses).all():
        raise InputError(f"{header} is no table of 12 finite numbers a line")
    return poses


def _listed(header: Path, prefix: str) -> list[Path]:
    """Return the images of a prefix in the order of their numbers."""
    names = {
        int(found[1]): path.name
        for path in sorted(header.parent.iterdir())
        if (found := re.fullmatch(rf"{prefix}(\d{{1,8}})\.tiff?", path.name))
    }
    return [beside(header, names[k]) for k in sorted(names)]


def _upright(image: NDArray[Any]) -> NDArray[Any]:
    """Return an image [row, column] as the vectors have it."""
    return image[::-1].T


def _mean(paths: list[Path], shape: tuple[int, int]) -> NDArray[np.float64]:
    total = np.zeros(shape)
    for path in paths:
        total += read_image(path, shape)
    return _upright(total / len(paths))


def _reader(
    images: list[Path],
    shape: tuple[int, int],
    dark: NDArray[np.float64],
    turned: Callable[[NDArray[Any]], NDArray[Any]],
) -> Callable[[int], NDArray[Any]]:
    def read(view: int) -> NDArray[Any]:
        return turned(_upright(read_image(images[view], shape)) - dark).astype(np.float32)

    return read
