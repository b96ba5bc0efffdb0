"""What the headers of a measured scan leave open: its grid, its axis, its open field, its photons and its spectrum."""

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.beam.spectrum import TABLE_KVP, Tube, spectrum
from ctsim.benchmarks.importing import Flags
from ctsim.detector.response import Detector, response
from ctsim.errors import InputError
from ctsim.geometry import Geometry, few_views
from ctsim.io.scans.openfield import SAMPLED, open_field
from ctsim.io.scans.scanfile import ScanFile, filters_of
from ctsim.materials import attenuation
from ctsim.reconstruct.axis import MOST_ROWS, axis_shift
from ctsim.types import Scan

MOST_ACROSS = 512  # voxels along x and y unless --n-voxel says more
I0, E_MAX = 1e5, 90.0  # where nothing says better
HOLD_ONE_OF, MOST_HELD = 40, 12
SHADOW = 0.02  # P of a millimetre of water: more is the object's shadow
OFF_CENTRE = 0.1  # of the columns: a detector that is shifted so far misses rays where a view is held out
SAME = 1e-9  # of the source's distance, by which poses differ in rounding
DEEPEST = 500.0  # mm of water behind which the effective spectrum is sought


@dataclass(frozen=True, slots=True, kw_only=True)
class Settled:
    """All that is written of a scan but for its views; `kept` and `held` number the views in the source.

    `tube` is None where the spectrum is unknown; `axis` is the column of the axis, from the detector's middle.
    """

    geometry: Geometry
    kept: NDArray[np.int64]
    held: NDArray[np.int64]
    held_geometry: Geometry | None
    flat: NDArray[np.float32]
    dark: float
    level: float
    i0: float
    dtype: str
    integrals: bool
    tube: Tube | None
    kvp: float
    l0: float
    axis: float
    notes: tuple[str, ...]

    def counts(self, scan: ScanFile, view: int) -> NDArray[Any]:
        """Read a view of the source as counts of the stored type, [v, u]."""
        image = scan.read(view)
        if self.dtype == "uint16" and image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{scan.path} has views of {image.dtype} among those of 16 bits, expected one type")
        if self.integrals:
            image = self.i0 * np.exp(-np.asarray(image, np.float64))
        return np.asarray(image).astype(self.dtype)

    def text(self) -> str:
        """Say what was imported in one line."""
        g = self.geometry
        tube = "spectrum unknown" if self.tube is None else f"{self.tube.kvp:g} kV behind {self.tube.sheets()}"
        held = f", {len(self.held)} more held out" if len(self.held) else ""
        axis = f"{round(self.axis, 2) + 0.0:+.2f}"  # no -0.00
        sizes = [f"{d:.4g}" for d in g.d_voxel]
        size = sizes[0] if len({*sizes}) == 1 else " × ".join(sizes)
        return (
            f"{g.n_views} views of {g.n_detector[0]} × {g.n_detector[1]}{held}; axis {axis} columns from the "
            f"middle; open field {self.level:.5g}, {self.i0:.3g} photons; {tube}; "
            f"{' × '.join(map(str, g.n_voxel))} voxels of {size} mm (z × y × x)"
        )


def settle(scan: ScanFile, given: Flags) -> Settled:
    """Settle what the headers and the flags leave open, by looking at the views.

    Raises InputError where a flag cannot be followed.
    """
    notes = list(scan.notes)
    _check_sides(scan)
    geometry = _turned(_gridded(scan.geometry, given), given)
    first = scan.read(0)
    whole = scan.dtype == "uint16" and first.dtype in (np.uint8, np.uint16)
    flat, level, i0 = _opened(scan, geometry, given, notes)
    if scan.dead is not None:
        flat = np.where(scan.dead, np.float32(scan.dark), flat)  # as line integrals know a dead pixel
    axis = _axis(scan, geometry, flat, i0, given, notes)
    geometry = msgspec.structs.replace(
        geometry, off_detector=(geometry.off_detector[0], -axis * geometry.d_detector[1])
    )
    kept, held = _split(scan, geometry, axis, given, notes)
    tube, kvp = _tube(scan, given, notes)
    p = _shadows(scan, flat, level)
    return Settled(
        geometry=_of(geometry, kept) if len(held) else geometry,
        kept=kept,
        held=held,
        held_geometry=_of(geometry, held) if len(held) else None,
        flat=flat,
        dark=0.0 if scan.integrals else scan.dark,
        level=level,
        i0=i0,
        dtype="uint16" if whole and not scan.integrals else "float32",
        integrals=scan.integrals,
        tube=tube,
        kvp=kvp,
        l0=0.0 if tube is None or not p.size else water_path(tube, float(np.median(p))),
        axis=axis,
        notes=tuple(notes),
    )


def _check_sides(scan: ScanFile) -> None:
    """Refuse several views of one pose, of which nothing can be reconstructed."""
    poses = scan.geometry.pose_array()
    if len(poses) > 1 and np.ptp(poses, axis=0).max() <= SAME * scan.geometry.dso:
        raise InputError(f"{scan.path} has {len(poses)} views from one side, expected angles that differ")


def _gridded(geometry: Geometry, given: Flags) -> Geometry:
    """Return the geometry with cubic voxels that cover the extent of its own grid."""
    if given.n_voxel is not None and not 1 <= given.n_voxel <= 2**14:
        raise InputError(f"--n-voxel must be within 1 to {2**14}, got {given.n_voxel}")
    if given.voxel is not None and not 0 < given.voxel < 1e3:
        raise InputError(f"--voxel must be within 0 to 1000 mm, got {given.voxel}")
    if given.n_voxel is None and given.voxel is None and max(geometry.n_voxel) <= MOST_ACROSS:
        return geometry
    high, _, wide = geometry.s_voxel
    across = given.n_voxel or (min(geometry.n_voxel[2], MOST_ACROSS) if given.voxel is None else 0)
    size = given.voxel or wide / across
    across = across or max(1, math.ceil(wide / size - 1e-9))
    along = max(1, min(math.ceil(high / size - 1e-9), 2**14))
    return msgspec.structs.replace(geometry, n_voxel=(along, across, across), d_voxel=(size, size, size))


def _turned(geometry: Geometry, given: Flags) -> Geometry:
    """Return the geometry with the way of turning that --turn says."""
    if given.turn == "file":
        return geometry
    if geometry.poses is not None:
        raise InputError("--turn: the scan's views are poses, which say how the source turns")
    sign = -1.0 if given.turn == "clockwise" else 1.0
    angles = geometry.angles_deg
    if angles is None:
        return msgspec.structs.replace(geometry, arc_deg=sign * abs(geometry.arc_deg))
    if sign * (angles[-1] - angles[0]) >= 0:
        return geometry
    return msgspec.structs.replace(geometry, angles_deg=tuple(2 * angles[0] - a for a in angles))


def _opened(
    scan: ScanFile, geometry: Geometry, given: Flags, notes: list[str]
) -> tuple[NDArray[np.float32], float, float]:
    """Return the open field [v, u], its level above the pedestal, and the photons in it."""
    if given.i0 is not None and not 0 < given.i0 < 1e15:
        raise InputError(f"--i0 must be positive, got {given.i0}")
    if scan.integrals:
        i0 = given.i0 or I0
        if given.i0 is None:
            notes.append(f"line integrals do not tell the photons: {I0:g} assumed, or --i0")
        return np.full(geometry.n_detector, i0, np.float32), i0, i0
    known = None if scan.flat is None else float(np.median(scan.flat)) - scan.dark
    found = open_field(scan.stored or scan.read, geometry.n_views, scan.dark, known)
    if not (math.isfinite(found.level) and found.level > 0):
        raise InputError(f"{scan.path} has no reading above its dark level, {scan.dark:g}")
    if found.note:
        notes.append(found.note)
    if given.i0 is None and found.photons is None:
        notes.append(f"there is no open column to measure the noise in: {I0:g} photons assumed, or --i0")
    photons = given.i0 or found.photons or I0
    flat = scan.flat if scan.flat is not None else np.full(geometry.n_detector, scan.dark + found.level, np.float32)
    return flat, found.level, photons


def _axis(
    scan: ScanFile, geometry: Geometry, flat: NDArray[np.float32], i0: float, given: Flags, notes: list[str]
) -> float:
    """Return the axis in columns from the detector's middle."""
    stated = -geometry.off_detector[1] / geometry.d_detector[1]
    asked = given.center or ("file" if scan.axis_known or not _is_turn(geometry) else "auto")
    if geometry.poses is not None and asked != "file":
        raise InputError("--center: the scan's views are poses, which say where the axis is")
    if asked == "file":
        if not scan.axis_known:
            notes.append("the format does not state the axis: the detector's middle assumed, or --center PIXELS")
        return stated
    if asked == "auto":
        return axis_shift(_middle_rows(scan, geometry, flat, i0))
    try:
        axis = float(asked)
    except ValueError:
        raise InputError(f"--center: expected auto, file or a number of pixels, got {asked!r}") from None
    if not abs(axis) < geometry.n_detector[1]:
        raise InputError(f"--center: expected less than the {geometry.n_detector[1]} columns there are, got {axis:g}")
    return axis


def _is_turn(geometry: Geometry) -> bool:
    """Whether the views end where they began."""
    if geometry.angles_deg is None:
        return geometry.poses is None and abs(geometry.arc_deg) >= 360 - 1e-9
    angles = np.unique(np.round(np.mod(geometry.angles_deg, 360.0), 6))
    return len(angles) > 3 and bool(np.diff(angles, append=angles[0] + 360).max() < 1.5 * 360 / len(angles))


def _middle_rows(scan: ScanFile, geometry: Geometry, flat: NDArray[np.float32], i0: float) -> Scan:
    """Return the scan's rows around the plane of its orbit."""
    n_v, d_v, off = geometry.n_detector[0], geometry.d_detector[0], geometry.off_detector[0]
    centre = (n_v - 1) / 2 - off / d_v
    first = int(np.clip(round(centre) - MOST_ROWS // 2, 0, max(n_v - MOST_ROWS, 0)))
    rows = slice(first, min(first + MOST_ROWS, n_v))
    part = msgspec.structs.replace(
        geometry,
        n_detector=(rows.stop - rows.start, geometry.n_detector[1]),
        off_detector=(off + ((rows.start + rows.stop - 1) / 2 - (n_v - 1) / 2) * d_v, 0.0),
    )
    views = np.stack([np.asarray(scan.read(k)[rows], np.float32) for k in range(geometry.n_views)])
    if scan.integrals:
        return Scan.from_line_integrals(views, part, e_max=E_MAX, i0=i0)
    open_rows = torch.from_numpy(np.ascontiguousarray(flat[rows]))
    return Scan(geometry=part, counts=torch.from_numpy(views), flat=open_rows, dark=scan.dark, i0=i0)


def _split(
    scan: ScanFile, geometry: Geometry, axis: float, given: Flags, notes: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the views that methods get and those held out, evenly chosen."""
    n = geometry.n_views
    if scan.held and given.hold is None:
        return np.setdiff1d(np.arange(n), scan.held), np.array(scan.held, np.int64)
    wanted = min(n // HOLD_ONE_OF, MOST_HELD) if given.hold is None else given.hold
    if not 0 <= wanted <= n // 4:
        raise InputError(f"--hold must be within 0 to {n // 4}, a quarter of the views, got {wanted}")
    if given.hold is None and wanted and abs(axis) > OFF_CENTRE * geometry.n_detector[1]:
        notes.append("no view is held out, since the shifted detector needs all of them; --hold N does")
        wanted = 0
    held = ((np.arange(wanted) + 0.5) * n / max(wanted, 1)).astype(np.int64)
    return np.setdiff1d(np.arange(n), held), held


def _of(geometry: Geometry, views: NDArray[np.int64]) -> Geometry:
    """Return the geometry of some of the views."""
    n = len(views)
    if geometry.poses is not None:
        return msgspec.structs.replace(geometry, n_views=n, poses=tuple(geometry.poses[k] for k in views))
    angles = tuple(float(a) for a in np.degrees(geometry.angles)[views])
    return msgspec.structs.replace(geometry, n_views=n, angles_deg=angles)


def _tube(scan: ScanFile, given: Flags, notes: list[str]) -> tuple[Tube | None, float]:
    """Return the tube where voltage and filter are known, and the highest energy."""
    kvp = given.kv if given.kv is not None else scan.kvp
    sheets = scan.filters if given.filter is None else filters_of(given.filter)
    if given.filter is not None and sheets is None:
        raise InputError(f'--filter: expected such as "Al 0.5mm + Cu 0.1mm", or none, got {given.filter!r}')
    if given.kv is not None and not TABLE_KVP[0] <= given.kv <= TABLE_KVP[1]:
        raise InputError(f"--kv must be within {TABLE_KVP[0]:g} to {TABLE_KVP[1]:g}, got {given.kv:g}")
    if kvp is None:
        notes.append(f"the tube voltage is unknown: no HU, and {E_MAX:g} keV as the highest energy; --kv gives it")
        return None, E_MAX
    if sheets is None:
        notes.append("the filter is unknown: no HU; --filter gives it")
        return None, kvp
    if not TABLE_KVP[0] <= kvp <= TABLE_KVP[1]:
        notes.append(f"{kvp:g} kV is outside of the table of spectra: no HU; --kv gives another voltage")
        return None, max(kvp, 1.0)
    return Tube(kvp=kvp, filters=sheets), kvp


def _shadows(scan: ScanFile, flat: NDArray[np.float32], level: float) -> NDArray[np.float64]:
    """Return the line integrals of the pixels in the object's shadow, of up to 24 views."""
    views = [np.asarray(scan.read(int(k)), np.float64) for k in few_views(scan.geometry.n_views, SAMPLED)]
    if scan.integrals:
        p = np.concatenate([view.ravel() for view in views])
    else:
        share = [(view - scan.dark) / np.maximum(flat - scan.dark, 1e-6 * level) for view in views]
        p = -np.log(np.maximum(np.concatenate([s.ravel() for s in share]), 1e-6))
    return p[np.isfinite(p) & (p > SHADOW)]


def water_path(tube: Tube, p: float) -> float:
    """Return the millimetres of water behind which the detector's signal of this tube has fallen by exp(−p)."""
    found = spectrum(tube)
    signal = found.weights * response(Detector(), found.energies)[0]
    lengths = np.linspace(0.0, DEEPEST, 2001)
    left = signal @ np.exp(-np.outer(attenuation("water", found.energies), lengths))
    return float(np.interp(p, -np.log(left / left[0]), lengths))
