"""Scans in HDF5: Data Exchange (DXchange), read and written, and NXtomo. Images are stored from the top row on.

An angle turns the object counter-clockwise as seen from above, so the source turns clockwise about it. Lengths are read
with their attribute `units`. Data that lie in other files are refused.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.arrayfile import LENGTHS, check_size, check_volume
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.io.h5file import writing
from ctsim.io.payload import quoted
from ctsim.io.scans.scanfile import ScanFile, Stated, grid_of

RADIANS = 4.4 * math.pi  # two turns and what overlaps; a scan over so few degrees must state its unit
PIECE = 2**28  # bytes of a chunk that is decoded at once
ANGLES = ("deg", "rad", "°")
PROJECTION, FLAT, DARK = 0, 1, 2  # NXtomo's image_key
SOURCE, DETECTOR = "measurement/instrument/source", "measurement/instrument/detector"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """What a file says: the dataset of images by `name`, which of them are views, and their angles in degrees.

    `flat` and `dark` are mean images in the file's order of rows; `lengths` are from the axis to source and detector
    and `pixels` the sizes (v, u) in mm. None is what is not there.
    """

    name: str
    views: NDArray[np.int64]
    angles: NDArray[np.float64]
    flat: NDArray[np.float64] | None
    dark: NDArray[np.float64] | None
    shape: tuple[int, int]
    lengths: tuple[float | None, float | None]
    pixels: tuple[float | None, float | None]


def open_scan(path: Path, stated: Stated) -> ScanFile:
    """Read what an HDF5 file says of a scan; lengths that it lacks are those `stated`."""
    if not path.is_file():
        raise InputError(f"{path} is a folder, expected an HDF5 file")
    with h5py.File(path, "r") as file:
        entry = _entry(file)
        found = _dxchange(path, file) if entry is None else _nxtomo(path, file, entry)
    return _scan(path, stated, found)


def write_scan(path: Path, geometry: Geometry, counts: NDArray[Any], flat: NDArray[np.float32], dark: float) -> None:
    """Write counts [view, v, u], the open field [v, u] and the level `dark` that both include, in Data Exchange.

    The format has no place for a grid, nor for the axis, which its readers search. Lengths are mm, angles degrees.
    """
    levels = {"data_white": flat, "data_dark": np.full(flat.shape, dark, np.float32)}
    lengths = {
        f"{SOURCE}/distance": geometry.dso,
        f"{DETECTOR}/distance": geometry.dsd - geometry.dso,
        f"{DETECTOR}/pixel_size_y": geometry.d_detector[0],
        f"{DETECTOR}/pixel_size_x": geometry.d_detector[1],
    }
    with writing(path) as (file, _):
        file["implements"] = "exchange:measurement"
        file["exchange/data"] = counts[:, ::-1]
        for name, image in levels.items():
            file[f"exchange/{name}"] = image[None, ::-1]
        file["exchange/theta"] = -np.degrees(geometry.angles)
        file["exchange/theta"].attrs["units"] = "deg"
        for name, length in lengths.items():
            file[name] = length
            file[name].attrs["units"] = "mm"


def _entry(file: h5py.File) -> str | None:
    """Return the name of the NXtomo entry; None where the file is of Data Exchange."""
    if "exchange" in file:
        return None
    outer = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
    inner = [f"{name}/{group}" for name in outer if isinstance(file[name], h5py.Group) for group in file[name]]
    for name in (*file, *inner):
        if _get(file, f"{name}/instrument/detector/image_key") is not None:
            return name
    raise InputError(f"{file.filename} holds neither a group exchange nor an entry of NXtomo")


def _get(file: h5py.File, name: str) -> Any:
    """Return an object by its path, None where it is not there. Raises InputError where it lies in another file."""
    at: Any = file
    for part in name.split("/"):
        if not isinstance(at, h5py.Group) or at.get(part, getlink=True) is None:
            return None
        link = at.get(part, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise InputError(f"{file.filename}: {quoted(name)} lies in another file, which is not opened")
        at = at[part] if isinstance(link, h5py.HardLink) else _followed(file, at, link)
    if isinstance(at, h5py.Dataset) and (at.is_virtual or at.external):
        raise InputError(f"{file.filename}: {quoted(name)} lies in another file, which is not opened")
    return at


def _followed(file: h5py.File, group: h5py.Group, link: Any) -> Any:
    """Return what a soft link names, which must be a hard one."""
    target = link.path if link.path.startswith("/") else f"{group.name}/{link.path}"
    at: Any = file
    for part in filter(None, target.split("/")):
        if not isinstance(at, h5py.Group) or not isinstance(at.get(part, getlink=True), h5py.HardLink):
            raise InputError(f"{file.filename}: the link {quoted(link.path)} does not lead to its own data")
        at = at[part]
    return at


def _stack(path: Path, file: h5py.File, name: str, *, needed: bool = False) -> Any:
    """Return a dataset of images [n, row, column], checked; None where there is none."""
    found = _get(file, name)
    if found is None and not needed:
        return None
    if not isinstance(found, h5py.Dataset) or found.shape is None or len(found.shape) != 3:
        raise InputError(f"{path} has no images [view, row, column] in {quoted(name)}")
    check_volume(path, found.shape, found.dtype)
    size, there = math.prod(found.shape) * found.dtype.itemsize, found.id.get_storage_size()
    if found.chunks is None and size > min(there, path.stat().st_size):
        raise InputError(f"{path} holds {there} bytes of {quoted(name)}, which declares {size}")
    check_size(path, size, there)
    if found.chunks is not None and math.prod(found.chunks) * found.dtype.itemsize > PIECE:
        raise InputError(
            f"{path} has chunks of {found.chunks} values in {quoted(name)}, expected at most {PIECE} bytes"
        )
    return found


def _values(path: Path, file: h5py.File, name: str, count: int) -> NDArray[np.float64] | None:
    """Return a list of so many numbers; None where there is none."""
    found = _get(file, name)
    if found is None:
        return None
    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "iuf" or found.size != count:
        raise InputError(f"{path}: {quoted(name)} is no list of {count} numbers")
    values = np.asarray(found[()], np.float64).reshape(-1)
    if not np.isfinite(values).all():
        raise InputError(f"{path}: {quoted(name)} holds numbers that are not finite")
    return values


def _length(path: Path, file: h5py.File, name: str) -> float | None:
    """Return a length in mm without its sign; None where there is none."""
    values = _values(path, file, name, 1)
    if values is None:
        return None
    unit = _unit(file, name) or "mm"
    if unit not in LENGTHS:
        raise InputError(f"{path}: {quoted(name)} is in {quoted(unit)}, expected mm, m, cm, um or another length")
    return abs(float(values[0])) * LENGTHS[unit]


def _unit(file: h5py.File, name: str) -> str:
    """Return the attribute `units` in lower case, which some writers store as a list of one."""
    unit = _get(file, name).attrs.get("units", "")
    if isinstance(unit, np.ndarray) and unit.size == 1:
        unit = unit.item()
    text = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return text.strip().lower()


def _angles(path: Path, file: h5py.File, name: str, count: int) -> NDArray[np.float64]:
    """Return angles in degrees."""
    values = _values(path, file, name, count)
    if values is None:
        raise InputError(f"{path} has no angles in {quoted(name)}, which such a scan needs")
    unit, span = _unit(file, name), float(np.ptp(values))
    if not unit and 0 < span <= RADIANS:
        raise InputError(
            f"{path}: {quoted(name)} has no attribute units and spans {span:.4g}, which may be radians; "
            "expected units of deg or rad"
        )
    if unit and not unit.startswith(ANGLES):
        raise InputError(f"{path}: {quoted(name)} is in {quoted(unit)}, expected deg or rad")
    return np.degrees(values) if unit.startswith("rad") else values


def _dxchange(path: Path, file: h5py.File) -> _Found:
    data = _stack(path, file, "exchange/data", needed=True)
    n = data.shape[0]
    flats, darks = (_stack(path, file, f"exchange/data_{kind}") for kind in ("white", "dark"))
    near, far = (_length(path, file, f"{group}/distance") for group in (SOURCE, DETECTOR))
    return _Found(
        name="exchange/data",
        views=np.arange(n),
        angles=_angles(path, file, "exchange/theta", n),
        flat=None if flats is None else _mean(flats),
        dark=None if darks is None else _mean(darks),
        shape=data.shape[1:],
        lengths=(near, far),
        pixels=(_length(path, file, f"{DETECTOR}/pixel_size_y"), _length(path, file, f"{DETECTOR}/pixel_size_x")),
    )


def _nxtomo(path: Path, file: h5py.File, entry: str) -> _Found:
    detector, source = f"{entry}/instrument/detector", f"{entry}/instrument/source"
    data = _stack(path, file, f"{detector}/data", needed=True)
    n = data.shape[0]
    keys = _values(path, file, f"{detector}/image_key", n)
    angles = _angles(path, file, f"{entry}/sample/rotation_angle", n)
    assert keys is not None
    views = np.flatnonzero(keys == PROJECTION)
    if not views.size:
        raise InputError(f"{path} has no projection: no image_key is {PROJECTION}")
    return _Found(
        name=f"{detector}/data",
        views=views,
        angles=angles[views],
        flat=_mean(data, np.flatnonzero(keys == FLAT)),
        dark=_mean(data, np.flatnonzero(keys == DARK)),
        shape=data.shape[1:],
        lengths=(_length(path, file, f"{source}/distance"), _length(path, file, f"{detector}/distance")),
        pixels=(_length(path, file, f"{detector}/y_pixel_size"), _length(path, file, f"{detector}/x_pixel_size")),
    )


def _mean(images: Any, which: NDArray[np.int64] | None = None) -> NDArray[np.float64] | None:
    """Return the mean of images [row, column], read one by one; None of none."""
    chosen = np.arange(images.shape[0]) if which is None else which
    total = np.zeros(images.shape[1:])
    for k in chosen:
        total += images[int(k)]
    return total / len(chosen) if len(chosen) else None


def _scan(path: Path, stated: Stated, found: _Found) -> ScanFile:
    near, far = found.lengths
    dso = stated.needed(path, "dso", near)
    dsd = stated.needed(path, "dsd", None if near is None or far is None else near + far)
    d_v, d_u = (stated.needed(path, "pixel", size) for size in found.pixels)
    if not 0 < dso < dsd or min(d_v, d_u) <= 0:
        raise InputError(f"{path} has the source {dso:g} mm from the axis and {dsd:g} mm from pixels of {d_u:g} mm")
    if any(image is not None and image.shape != found.shape for image in (found.flat, found.dark)):
        raise InputError(f"{path} has open or dark images of another shape than {found.shape}")
    n_voxel, d_voxel = grid_of(dso, dsd, found.shape, (d_v, d_u))
    pedestal = np.zeros(found.shape) if found.dark is None else found.dark
    return ScanFile(
        path=path,
        files=(path,),
        geometry=Geometry(
            dso=dso,
            dsd=dsd,
            n_voxel=n_voxel,
            d_voxel=d_voxel,
            n_detector=found.shape,
            d_detector=(d_v, d_u),
            n_views=len(found.views),
            angles_deg=tuple((-found.angles).tolist()),
        ),
        read=_reader(path, found.name, found.views, pedestal),
        flat=None if found.flat is None else (found.flat - pedestal)[::-1].astype(np.float32),
        axis_known=False,
    )


def _reader(
    path: Path, name: str, views: NDArray[np.int64], pedestal: NDArray[np.float64]
) -> Callable[[int], NDArray[Any]]:
    """Return a function that reads a view above the dark image, row 0 at the bottom."""

    def read(view: int) -> NDArray[Any]:
        with h5py.File(path, "r") as file:
            image = _stack(path, file, name, needed=True)[int(views[view])]
        return (image - pedestal)[::-1].astype(np.float32)

    return read
