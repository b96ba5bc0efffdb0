"""Scans of Bruker SkyScan: a .log file next to 16-bit TIFF images, and a table of shifts (_TS.csv) where there is one.

Images are stored from the top row on, and the line of the optical axis is counted in the same way. Rotation Direction =
CC turns the object counter-clockwise as seen from above, so the source turns clockwise about it. Image Rotation is the
camera's turn, counter-clockwise in the image, in degrees.
"""

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.dataset.arrayfile import read_image
from ctsim.errors import InputError
from ctsim.geometry import MOST_PIXELS, MOST_VIEWS, Geometry
from ctsim.io.payload import beside, quoted
from ctsim.io.scans.scanfile import ScanFile, Stated, filters_of, grid_of, number, read_text, turn, whole

STEP = 0.0005  # degrees by which a log's Rotation Step is rounded
TURN = 0.005  # degrees of the camera whose correction moves no pixel of 5000 columns by half of it
MICRONS = tuple(f"image pixel size ({mu}m)" for mu in "µμ")  # a micro sign, and a Greek letter as lower case has it
DIRECTIONS = {"CC": -1.0, "CCW": -1.0, "CW": 1.0}
Fields = dict[str, str]


def open_scan(path: Path, stated: Stated) -> ScanFile:
    """Read the log of a scan (the file, or its folder) and list the images."""
    log = path if path.is_file() else _log_in(path)
    found = _fields(log)
    n_v = whole(log, found, "number of rows", most=MOST_PIXELS)
    n_u = whole(log, found, "number of columns", most=MOST_PIXELS)
    declared = whole(log, found, "number of files", most=MOST_VIEWS)
    images = _images(log, found)
    if len(images) < declared:
        raise InputError(f"{log} declares {declared} images, there are {len(images)} of its prefix next to it")
    geometry = _geometry(log, found, (n_v, n_u), len(images), stated)
    angle = number(log, found, "image rotation", default=0.0)
    table = _table(log)
    shifts = None if table is None else _shifts(table, len(images), (n_v, n_u))
    kvp = number(log, found, "source voltage (kv)", "source voltage (kvp)", default=0.0)
    text = found.get("filter", "")
    sheets = filters_of(text)
    notes = [f"{len(images)} images, the log declares {declared}"] if len(images) > declared else []
    notes += [f"Source Voltage (kV) = {kvp:g} is no voltage, so it counts as unknown"] if kvp < 0 else []
    notes += [f"the filter {quoted(text)} is not understood"] if sheets is None else []
    notes += [f"images were turned back by {angle:g}° (Image Rotation)"] if abs(angle) > TURN else []
    notes += ["images were moved back by the shifts of _TS.csv"] if shifts is not None else []
    resample = abs(angle) > TURN or shifts is not None
    return ScanFile(
        path=log,
        files=(log, *images, *([] if table is None else [table])),
        geometry=geometry,
        read=_reader(images, (n_v, n_u), angle if abs(angle) > TURN else 0.0, shifts),
        stored=_reader(images, (n_v, n_u), 0.0, None) if resample else None,
        dtype="float32" if resample else "uint16",
        axis_known=False,
        kvp=kvp if kvp > 0 else None,
        filters=sheets,
        notes=tuple(notes),
    )


def _log_in(folder: Path) -> Path:
    logs = [p for p in sorted(folder.iterdir()) if p.suffix.lower() == ".log" and not p.stem.endswith("_rec")]
    if len(logs) != 1:
        raise InputError(f"{folder} holds {len(logs)} logs of scans (.log, without _rec.log), expected one: name it")
    return logs[0]


def _fields(log: Path) -> Fields:
    """Return the entries of the sections System and Acquisition, keys in lower case."""
    found: Fields = {}
    section = ""
    for line in read_text(log).splitlines():
        if head := re.fullmatch(r"\s*\[(.*)\]\s*", line):
            section = head[1].strip().casefold()
        elif "=" in line and section in ("system", "acquisition"):
            key, _, value = line.partition("=")
            found.setdefault(" ".join(key.split()).casefold(), value.strip())
    if not found:
        raise InputError(f"{log} has no section [Acquisition]; expected the log of a SkyScan scan")
    return found


def _images(log: Path, found: Fields) -> list[Path]:
    """Return the images in the order of their numbers. Raises InputError where a number is missing or there twice."""
    by_prefix: dict[str, dict[int, Path]] = {}
    for path in sorted(log.parent.iterdir()):
        if name := re.fullmatch(r"(.*?)(\d{4,8})\.tiff?", path.name, re.IGNORECASE):
            images = by_prefix.setdefault(name[1].casefold(), {})
            if int(name[2]) in images:
                raise InputError(f"{path} and {images[int(name[2])].name} have one number, expected one image of each")
            images[int(name[2])] = beside(log, path.name)
    named = (found.get("filename prefix", ""), log.stem)
    images = next((by_prefix[n.casefold()] for n in named if n.casefold() in by_prefix), None)
    if images is None:
        raise InputError(f"{log} has no images next to it that are named {quoted(named[0])} and a number, .tif")
    first = min(images)
    missing = next((k for k in range(first, first + len(images)) if k not in images), None)
    if missing is not None:
        raise InputError(f"{log} lacks image {missing} of those that are next to it")
    return [images[k] for k in sorted(images)]


def _geometry(log: Path, found: Fields, n_detector: tuple[int, int], n_views: int, stated: Stated) -> Geometry:
    dso = stated.dso or number(log, found, "object to source (mm)", "object to source")
    dsd = stated.dsd or number(log, found, "camera to source (mm)", "camera to source")
    if not 0 < dso < dsd:
        raise InputError(f"{log} has the source {dso:g} mm from the object and {dsd:g} mm from the camera")
    pixel = stated.pixel or number(log, found, "image pixel size (um)", *MICRONS) / 1000 * dsd / dso
    if not 0 < pixel < dsd:
        raise InputError(f"{log} has pixels of {pixel:g} mm, expected a positive size")
    word = found.get("rotation direction", "CC").upper()
    if word not in DIRECTIONS:
        raise InputError(f"{log} has Rotation Direction = {quoted(word)}, expected CC or CW")
    if (path := found.get("scanning trajectory", "ROUND").upper()) != "ROUND":
        raise InputError(f"{log} has Scanning Trajectory = {quoted(path)}, expected ROUND")
    sign = DIRECTIONS[word]
    step = number(log, found, "rotation step (deg)")
    if not 0 < step <= 180:
        raise InputError(f"{log} has Rotation Step (deg) = {step:g}, expected within 0 to 180")
    is_whole = found.get("use 360 rotation", "YES").upper() == "YES"
    start = sign * number(log, found, "scanning start angle", default=0.0)
    axis = number(log, found, "optical axis (line)", default=(n_detector[0] - 1) / 2)
    n_voxel, d_voxel = grid_of(dso, dsd, n_detector, (pixel, pixel))
    return Geometry(
        dso=dso,
        dsd=dsd,
        n_voxel=n_voxel,
        d_voxel=d_voxel,
        n_detector=n_detector,
        d_detector=(pixel, pixel),
        n_views=n_views,
        off_detector=((axis - (n_detector[0] - 1) / 2) * pixel, 0.0),
        **turn(sign * step, n_views, start, whole=is_whole, rounding=STEP),
    )


def _table(log: Path) -> Path | None:
    """Return the table of shifts next to the log; None where there is none."""
    names = {p.name.casefold(): p for p in log.parent.iterdir()}
    found = names.get(f"{log.stem}_ts.csv".casefold())
    return None if found is None else beside(log, found.name)


def _shifts(path: Path, n_views: int, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return how far each image moved, [view, (right, down)] in pixels.

    The table's first line names the columns; those that contain "x" and "y" count.
    """
    rows = list(csv.reader(re.sub(r"[;\t]", ",", read_text(path)).splitlines()))
    rows = [row for row in rows if any(cell.strip() for cell in row)]
    head = [cell.strip().casefold() for cell in rows[0]] if rows else []
    columns = [next((k for k, cell in enumerate(head) if letter in cell), -1) for letter in "xy"]
    try:
        values = np.array([[float(row[k]) for k in columns] for row in rows[1:]]).reshape(-1, 2)
    except (ValueError, IndexError):
        values = np.full((0, 2), np.nan)
    if -1 in columns or columns[0] == columns[1] or len(values) != n_views or not np.isfinite(values).all():
        raise InputError(f"{path} is no table of {n_views} shifts with columns x and y in pixels")
    if (out := np.abs(values) >= shape[::-1]).any():
        view, axis = np.argwhere(out)[0]
        raise InputError(
            f"{path} moves image {view} by {values[view, axis]:g} pixels in {'xy'[axis]}, off the panel of "
            f"{shape[0]} × {shape[1]}; expected a shift that leaves some of it there"
        )
    return values


def _reader(
    images: list[Path], shape: tuple[int, int], angle: float, shifts: NDArray[np.float64] | None
) -> Callable[[int], NDArray[Any]]:
    """Return a function that reads a view, turned and moved to where an upright camera sees it, row 0 at the bottom."""
    centre = (np.array(shape) - 1) / 2
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turned = np.array([[cos, -sin], [sin, cos]])  # (down, right) in the upright image -> in the stored one

    def read(view: int) -> NDArray[Any]:
        image = read_image(images[view], shape)
        if angle or shifts is not None:
            moved = np.zeros(2) if shifts is None else shifts[view, ::-1]
            offset: Any = centre + moved - turned @ centre
            image = ndimage.affine_transform(image.astype(np.float32), turned, offset, order=1, mode="nearest")
        return image[::-1]

    return read
