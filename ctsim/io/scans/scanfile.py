"""A measured scan whose headers are read: geometry, tube, and a function that reads its views one by one."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import Filter
from ctsim.errors import InputError
from ctsim.geometry import Geometry, Pair, Triple
from ctsim.io.payload import quoted

TEXT = 2**24  # bytes of a file of settings; the longest that is known, 1200 views by 12 numbers, has 350 kB
_THICKNESS = r"(\d+(?:\.\d+)?)\s*(mm|um|µm)"
_MATERIAL = r"([A-Za-z]+)"
WORDS = {"aluminium": "Al", "aluminum": "Al", "copper": "Cu", "titanium": "Ti", "tin": "Sn"}
NONE = ("", "no", "none", "no filter", "nofilter", "air")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanFile:
    """What the headers of a scan say; `read` decodes a view [v, u], row 0 at the bottom.

    `geometry` has a grid that fits the field of view. Views are readings above a pedestal `dark`, to be compared with
    the open field `flat` [v, u]; without one the air next to the object is measured. With `integrals` views are −ln of
    transmissions. `axis_known` says that the file states where the axis is; `filters` is None where they are unknown.
    `stored` decodes a view as it was read out, where `read` turns or moves it; it may have another order of pixels.
    `held` numbers the views that the format sets apart for testing. `files` is all that is read, with `path`. Pixels
    that are `dead` [v, u] tell nothing; no format states them, an import finds them.
    """

    path: Path
    files: tuple[Path, ...]
    geometry: Geometry
    read: Callable[[int], NDArray[Any]]
    dtype: str = "float32"
    flat: NDArray[np.float32] | None = None
    dark: float = 0.0
    integrals: bool = False
    axis_known: bool = True
    kvp: float | None = None
    filters: tuple[Filter, ...] | None = None
    stored: Callable[[int], NDArray[Any]] | None = None
    held: tuple[int, ...] = ()
    dead: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Stated:
    """Lengths in mm that the user gives for a scan whose headers lack them."""

    dso: float | None = None
    dsd: float | None = None
    pixel: float | None = None

    def needed(self, path: Path, name: str, found: float | None) -> float:
        """Return the user's length, else that of the file. Raises InputError where there is neither."""
        own: float | None = getattr(self, name)
        if own is not None:
            return own
        if found is None:
            raise InputError(f"{path} does not say {_LENGTHS[name]}; expected --{name} MM")
        return found


_LENGTHS = {
    "dso": "how far the source is from the axis",
    "dsd": "how far the source is from the detector",
    "pixel": "how large a pixel is",
}


def grid_of(
    dso: float, dsd: float, n_detector: tuple[int, int], d_detector: Pair
) -> tuple[tuple[int, int, int], Triple]:
    """Return voxels (z, y, x) and their size for the field of view: a detector pixel, scaled to the axis."""
    shrink = dso / dsd
    n_v, n_u = n_detector
    return (n_v, n_u, n_u), (d_detector[0] * shrink, d_detector[1] * shrink, d_detector[1] * shrink)


def read_text(path: Path) -> str:
    """Read a file of settings. Raises InputError for one too large to be that."""
    if path.stat().st_size > TEXT:
        raise InputError(f"{path} has more than {TEXT} bytes, expected a file of settings")
    content = path.read_bytes()
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def filters_of(text: str) -> tuple[Filter, ...] | None:
    """Return the sheets that a text such as "Al 0.5mm" or "Cu 0.11 mm + Al 1 mm" names; None where it is unclear."""
    if text.strip().casefold() in NONE:
        return ()
    found = []
    for part in re.split(r"[+,&]| and ", text):
        first = re.fullmatch(rf"\s*{_MATERIAL}\s*{_THICKNESS}\s*", part)
        second = re.fullmatch(rf"\s*{_THICKNESS}\s*{_MATERIAL}\s*", part)
        if first:
            name, size, unit = first.groups()
        elif second:
            size, unit, name = second.groups()
        else:
            return None
        try:
            thickness = float(size) / (1.0 if unit == "mm" else 1000.0)
            found.append(Filter(material=WORDS.get(name.casefold(), name.capitalize()), thickness=thickness))
        except InputError:
            return None
    return tuple(found)


def turn(step: float, n_views: int, start: float, *, whole: bool, rounding: float = 0.0) -> dict[str, Any]:
    """Return a geometry's angles for even steps in degrees, negative for clockwise ones.

    Where a `whole` turn is declared and the steps, each rounded by up to `rounding`, end there, they are made to fit:
    n steps, or n − 1 where the last view repeats the first.
    """
    sign = 1.0 if step > 0 else -1.0
    for steps in (n_views, n_views - 1):
        if whole and steps > 0 and abs(steps * abs(step) - 360) <= steps * rounding + 1e-6:
            step = sign * 360 / steps
    arc = n_views * step
    if abs(arc) <= 360 + 1e-9:
        return {"start_deg": start, "arc_deg": sign * min(abs(arc), 360.0)}
    return {"start_deg": start, "angles_deg": tuple(start + k * step for k in range(n_views))}


def number(path: Path, found: dict[str, str], *keys: str, default: float | None = None) -> float:
    """Return the finite number of the first key that is there. Raises InputError where none is, or it is no number."""
    key = next((k for k in keys if k in found), None)
    if key is None:
        if default is None:
            raise InputError(f"{path} has no field {quoted(keys[0])}, which such a scan needs")
        return default
    try:
        value = float(found[key])
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path} has {quoted(key)} = {quoted(found[key])}, expected a finite number")
    return value


def whole(path: Path, found: dict[str, str], *keys: str, most: int) -> int:
    """Return a whole number within 1 to `most`; raises as `number`."""
    value = number(path, found, *keys)
    if value != int(value) or not 1 <= value <= most:
        raise InputError(f"{path} has {quoted(keys[0])} = {value:g}, expected a whole number within 1 to {most}")
    return int(value)
