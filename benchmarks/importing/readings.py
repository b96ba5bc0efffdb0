"""Readings of a measured scan that are no numbers: a few pixels are dead, and more than a few are refused."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.io.scans.scanfile import ScanFile
from ctsim.reconstruct.log import Filling

MOST_DEAD = 0.01  # of the pixels: detectors are sold with fewer defects, and more are a damaged file
LEAST = -50.0  # P: exp(50) photons for each of up to 1e15 are still a float32
LARGEST = float(np.finfo(np.float32).max)


def sound(scan: ScanFile) -> ScanFile:
    """Return the scan with finite readings: pixels that lack one in any view are `dead`, and interpolated in all.

    Raises InputError where more than a hundredth of the pixels are dead, and for line integrals below `LEAST`, whose
    exponential nothing holds. Looks at every view unless they are integers.
    """
    n_views, flat = scan.geometry.n_views, scan.flat
    if scan.dtype == "uint16" and scan.read(0).dtype.kind in "iu" and (flat is None or bool(np.isfinite(flat).all())):
        return scan  # whose other views are of the same type, or refused where they are written
    dead = np.zeros(scan.geometry.n_detector, np.bool_) if flat is None else ~_finite(flat)
    place = _place("the open field", dead)
    for view in range(n_views):
        image = _quietly(scan.read, view)
        bad = ~_finite(image)
        place = place or _place(f"view {view}", bad)
        if scan.integrals and (least := float(np.min(image, where=~bad, initial=0.0))) < LEAST:
            raise InputError(f"{scan.path}: a line integral of view {view} is {least:.4g}, expected {LEAST:g} or more")
        dead |= bad
    stored = None if scan.stored is None else _filled(scan.stored)
    if not dead.any():
        return dataclasses.replace(scan, stored=stored)
    n = int(dead.sum())
    if n == dead.size:
        raise InputError(f"{scan.path}: every pixel has readings that are not finite, the first in {place}")
    said = f"{n} of {dead.size} pixels have readings that are not finite, the first in {place}"
    if n > MOST_DEAD * dead.size:
        raise InputError(f"{scan.path}: {said}; expected at most {MOST_DEAD:.0%} of the pixels")
    return dataclasses.replace(
        scan,
        read=_filled(scan.read, dead),
        stored=stored,
        flat=None if flat is None else np.where(dead, scan.dark, flat).astype(np.float32),
        dead=dead,
        notes=(*scan.notes, f"{said}: such pixels count as dead and are interpolated"),
    )


def _place(where: str, bad: NDArray[np.bool_]) -> str:
    """Name the first bad pixel of an image; "" where there is none."""
    if not bad.any():
        return ""
    row, column = np.argwhere(bad)[0]
    return f"{where} at column {column} of row {row} from below"


def _quietly(read: Callable[[int], NDArray[Any]], view: int) -> NDArray[Any]:
    """Read a view without NumPy's warnings of values that are not finite, or too large for a float32."""
    with np.errstate(over="ignore", invalid="ignore"):
        return read(view)


def _finite(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Say which readings a float32 holds."""
    return np.abs(image) <= LARGEST


def _filled(
    read: Callable[[int], NDArray[Any]], dead: NDArray[np.bool_] | None = None
) -> Callable[[int], NDArray[Any]]:
    """Return a function that reads a view with its `dead` pixels interpolated, or all that are not finite."""
    known = None if dead is None else Filling.of(dead)

    def whole(view: int) -> NDArray[Any]:
        image = _quietly(read, view)
        filling = Filling.of(~_finite(image)) if dead is None else known
        if filling is None:
            return image
        with np.errstate(over="ignore"):
            image = np.array(image, np.float32, order="C")
        filling.fill(image)
        return image

    return whole
