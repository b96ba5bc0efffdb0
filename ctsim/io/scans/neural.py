"""Scans in the layouts of R2-Gaussian (meta_data.json and .npy files) and NAF (a pickle): line integrals of TIGRE.

Rows are flipped against TIGRE's and ours. Views for testing are held out. Lengths are taken as mm, in any unit of the
scene: the volume is then in the inverse of that unit.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.arrayfile import read_array
from ctsim.dataset.interop import Library, projections_from
from ctsim.errors import InputError
from ctsim.geometry import MOST_VIEWS, Geometry
from ctsim.io.payload import quoted
from ctsim.io.scans.plainpickle import LARGEST, load_plain
from ctsim.io.scans.scanfile import TEXT, ScanFile, Stated

NAME = "meta_data.json"
NOTE = "lengths are those of the scene, taken as mm"
SAME = 1e-6  # half of the angle (radians) below which two views are one
Views = list[tuple[float, Callable[[], NDArray[Any]]]]


class _Frame(msgspec.Struct):
    file_path: str
    angle: float


class _Meta(msgspec.Struct):
    scanner: dict[str, Any]
    proj_train: list[_Frame]
    proj_test: list[_Frame] = []


def open_r2(path: Path, stated: Stated) -> ScanFile:
    """Read meta_data.json of a folder; views are read on request."""
    header = path if path.is_file() else path / NAME
    if not header.is_file():
        raise InputError(f"{path} holds no {NAME}")
    if header.stat().st_size > TEXT:
        raise InputError(f"{header} has more than {TEXT} bytes, expected a file of settings")
    try:
        meta = msgspec.json.decode(header.read_bytes(), type=_Meta)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{header} is no {NAME} of R2-Gaussian: {' '.join(str(error).split())[:200]}") from None
    shape = _numbers(header, meta.scanner, "nDetector", 2, whole=True)
    n_detector = (int(shape[0]), int(shape[1]))
    listed = [[(f.angle, _file(header, f.file_path)) for f in part] for part in (meta.proj_train, meta.proj_test)]
    train, test = ([(a, functools.partial(read_array, file, n_detector)) for a, file in part] for part in listed)
    files = (header, *dict.fromkeys(file for part in listed for _, file in part))
    return _scan(files, meta.scanner, train, test, n_detector)


def _file(header: Path, name: str) -> Path:
    """Return the file of a view. Raises InputError for one outside of the folder, or that is not there."""
    found = header.parent / name
    inside = header.parent.resolve()
    if not found.resolve().is_relative_to(inside) or not found.is_file():
        raise InputError(f"{header} names {quoted(name)}, expected a file in its folder or below")
    return found


def open_naf(path: Path, stated: Stated) -> ScanFile:
    """Read the pickle of a scan: only numbers, texts, lists, dicts and NumPy arrays of numbers."""
    if not path.is_file():
        raise InputError(f"{path} is a folder, expected a pickle")
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has more than {LARGEST} bytes, expected a pickle of NAF")
    found = load_plain(path)
    if not isinstance(found, dict) or not isinstance(found.get("train"), dict):
        raise InputError(f"{path} is no pickle of NAF: it has no dict 'train'")
    parts = [found["train"], found.get("val") if isinstance(found.get("val"), dict) else None]
    stacks = [_stack(path, part) for part in parts if part is not None]
    shape = stacks[0][1].shape[1:]
    views: list[Views] = [
        [(float(a), (lambda stack=stack, k=k: stack[k])) for k, a in enumerate(angles)] for angles, stack in stacks
    ]
    if any(stack.shape[1:] != shape for _, stack in stacks):
        raise InputError(f"{path} has views of several shapes")
    n_detector = (int(shape[0]), int(shape[1]))
    scanner = _rows_first(path, found, n_detector)
    return _scan((path,), scanner, views[0], views[1] if len(views) > 1 else [], n_detector)


def _rows_first(path: Path, scanner: dict[str, Any], shape: tuple[int, int]) -> dict[str, Any]:
    """Return a pickle's settings with those of the detector in TIGRE's order (v, u), v upwards.

    NAF's rays take them as (u, v), v downwards, its generator as TIGRE does. The number of pixels tells which it is.
    Raises InputError where that is the same both ways and the pixel or the offset is not.
    """
    keys = [key for key in ("dDetector", "sDetector", "offDetector") if key in scanner]
    counts = _numbers(path, scanner, "nDetector", 2, whole=True) if "nDetector" in scanner else shape
    turned = {key: _numbers(path, scanner, key, 2)[::-1] for key in keys}
    if "offDetector" in turned:
        turned["offDetector"] = (-turned["offDetector"][0], turned["offDetector"][1])
    if counts == shape and shape[0] != shape[1]:
        return scanner
    if counts == shape[::-1] and shape[0] != shape[1]:
        return scanner | turned
    if counts != shape:
        raise InputError(f"{path} has the nDetector {counts} and views of {shape} pixels")
    if unlike := [key for key in keys if not np.array_equal(turned[key], _numbers(path, scanner, key, 2))]:
        raise InputError(
            f"{path} has the {unlike[0]} {quoted(str(scanner[unlike[0]]))} on a square detector, where (u, v) and "
            "(v, u) cannot be told apart; expected equal numbers, and no offset"
        )
    return scanner


def _stack(path: Path, part: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[Any]]:
    angles, views = part.get("angles"), part.get("projections")
    angles = np.asarray(angles, np.float64).reshape(-1) if isinstance(angles, np.ndarray | list) else np.zeros(0)
    if not isinstance(views, np.ndarray) or views.ndim != 3 or views.dtype.kind not in "iuf":
        raise InputError(f"{path} has no array 'projections' [view, row, column]")
    if len(angles) != len(views) or min(views.shape[1:]) < 1:
        raise InputError(f"{path} has {len(angles)} angles for projections of the shape {views.shape}")
    return angles, views


def _scan(
    files: tuple[Path, ...], scanner: dict[str, Any], train: Views, test: Views, shape: tuple[int, int]
) -> ScanFile:
    path = files[0]
    train, test = _apart(train, test)
    views = [*train, *test]
    angles = np.degrees([a for a, _ in views])
    if not train or len(views) > MOST_VIEWS or not np.isfinite(angles).all():
        raise InputError(f"{path} lists {len(train)} views to reconstruct from, expected finite angles of at least one")
    if scanner.get("mode", "cone") != "cone":
        raise InputError(f"{path} has the mode {quoted(str(scanner.get('mode')))}, expected cone")
    d_detector = _sizes(path, scanner, "Detector", shape)
    n_x, n_y, n_z = (int(n) for n in _numbers(path, scanner, "nVoxel", 3, whole=True))
    d_x, d_y, d_z = _sizes(path, scanner, "Voxel", (n_x, n_y, n_z))
    o_x, o_y, o_z = _numbers(path, scanner, "offOrigin", 3, default=(0.0,) * 3)
    off_v, off_u = _numbers(path, scanner, "offDetector", 2, default=(0.0,) * 2)
    (dso,), (dsd,) = (_numbers(path, scanner, key, 1) for key in ("DSO", "DSD"))
    geometry = Geometry(
        dso=dso,
        dsd=dsd,
        n_voxel=(n_z, n_y, n_x),
        d_voxel=(d_z, d_y, d_x),
        n_detector=shape,
        d_detector=(d_detector[0], d_detector[1]),
        n_views=len(views),
        off_origin=(o_z, o_y, o_x),
        off_detector=(off_v, off_u),
        angles_deg=tuple(angles.tolist()),
    )

    def read(view: int) -> NDArray[Any]:
        return projections_from(Library.R2_GAUSSIAN, np.asarray(views[view][1](), np.float32)[None])[0]

    return ScanFile(
        path=path,
        files=files,
        geometry=geometry,
        read=read,
        integrals=True,
        held=tuple(range(len(train), len(views))),
        notes=(NOTE,),
    )


def _apart(train: Views, test: Views) -> tuple[Views, Views]:
    """Return the views to reconstruct from without those at the angle of a test view, and the test views.

    A view that is in both is held out from no method. Where nothing else is left, there are no test views.
    """
    held = np.array([a for a, _ in test])
    kept = [(a, read) for a, read in train if not np.any(np.abs(np.sin((held - a) / 2)) < SAME)]
    return (kept, test) if kept else (train, [])


def _sizes(path: Path, scanner: dict[str, Any], what: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the sizes of pixels or voxels: as stated, or from the extent."""
    if f"d{what}" in scanner:
        return _numbers(path, scanner, f"d{what}", len(counts))
    extents = _numbers(path, scanner, f"s{what}", len(counts))
    return tuple(s / n for s, n in zip(extents, counts, strict=True))


def _numbers(
    path: Path,
    scanner: dict[str, Any],
    key: str,
    count: int,
    *,
    whole: bool = False,
    default: tuple[float, ...] | None = None,
) -> tuple[float, ...]:
    """Return so many finite numbers. Raises InputError where they are not there, or not whole where they must be."""
    if key not in scanner and default is not None:
        return default
    try:
        values = np.asarray(scanner.get(key), np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.zeros(0)
    good = len(values) == count and bool(np.isfinite(values).all())
    if not good or (whole and not all(v == int(v) and 1 <= v < 2**31 for v in values)):
        kind = "whole numbers from 1 on" if whole else "finite numbers"
        raise InputError(f"{path} has the {key} {quoted(str(scanner.get(key)))}, expected {count} {kind}")
    return tuple(values.tolist())
