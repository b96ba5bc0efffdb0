"""Filtered backprojection for a cone beam on a circular orbit (Feldkamp, Davis, Kress).

Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1, 1984, doi:10.1364/JOSAA.1.000612. Projections
[view, v, u], volume [z, y, x] in 1/mm; voxels outside the scan's field of view are zero.
"""

from collections.abc import Callable

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError, Unsuited
from ctsim.geometry import Geometry
from ctsim.reconstruct.filters import RAMP, Filter, filter_rows, padded_length, ramp_response
from ctsim.reconstruct.kernels.backproject_cpu import backproject
from ctsim.reconstruct.log import LineIntegrals, how_it_ended, is_blind
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.redundancy import RayWeights, ray_weights
from ctsim.reconstruct.settings import keywords
from ctsim.types import Scan, Volume

CHUNK_BYTES = 1 << 25


class Settings(Filter, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The filter."""


class Plain(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Nothing to set."""


@keywords(Plain)
def ramp(scan: Scan, settings: Plain) -> Volume:
    """Reconstruct `scan` by FDK with the plain ramp up to the Nyquist frequency; otherwise as `reconstruct`."""
    return reconstruct(scan, window=RAMP.window, cutoff=RAMP.cutoff)


@keywords(Settings)
@primary
def reconstruct(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan` by FDK without any correction; keywords are those of `Settings`.

    Details hold the clamped pixels, the number of views backprojected (`view_updates`) and how redundant rays were
    weighted. Where no pixel has signal the volume is empty and the status an error. Raises InputError for a geometry
    given by poses.
    """
    clamped, logarithm = 0, LineIntegrals(scan)

    def read(views: slice) -> NDArray[np.float32]:
        nonlocal clamped
        p, mask = logarithm.of(views)
        clamped += int(mask.sum())
        return p

    weights = _orbit_weights(scan.geometry)
    values = torch.from_numpy(_run(read, scan.geometry, weights, settings.window, settings.cutoff))
    status, reason = how_it_ended(values, scan, clamped)
    if is_blind(scan, clamped):
        values = torch.zeros_like(values)
    details = {
        "window": settings.window,
        "cutoff": settings.cutoff,
        "view_updates": scan.geometry.n_views,
        "clamped_pixels": clamped,
        "count_floor": logarithm.floor,
        "rays": weights.kind,
        "field_of_view_mm": weights.radius,
    }
    if weights.note:
        details["limitation"] = weights.note
    return Volume(values=values, status=status, reason=reason, details=details)


def fdk(projections: torch.Tensor, geometry: Geometry, *, window: str = "ram-lak", cutoff: float = 1.0) -> torch.Tensor:
    """Reconstruct line integrals, float32 [view, v, u] → [z, y, x] in 1/mm.

    Raises InputError when the shapes disagree, the orbit is not circular or the window is unknown.
    """
    if tuple(projections.shape) != geometry.shape:
        raise InputError(f"projections have shape {tuple(projections.shape)}, the geometry says {geometry.shape}")
    if projections.device.type != "cpu":
        raise InputError(f"fdk runs on the CPU only, the projections are on {projections.device}")

    def read(views: slice) -> NDArray[np.float32]:
        return np.array(projections[views].detach().numpy(), np.float32)

    return fdk_stream(read, geometry, window=window, cutoff=cutoff)


def fdk_stream(
    read: Callable[[slice], NDArray[np.float32]], geometry: Geometry, *, window: str = "ram-lak", cutoff: float = 1.0
) -> torch.Tensor:
    """Reconstruct line integrals that `read` hands out a few views at a time, [view, v, u] → [z, y, x] in 1/mm.

    `read` gets a slice of views, in order, and returns an array that may be overwritten. Raises InputError when
    the orbit is not circular or the window is unknown.
    """
    return torch.from_numpy(_run(read, geometry, _orbit_weights(geometry), window, cutoff))


def add_fdk(
    read: Callable[[slice], NDArray[np.float32]],
    geometry: Geometry,
    rows: slice,
    volume: torch.Tensor,
    how: Filter = RAMP,
) -> None:
    """Add to a volume [z, y, x] what line integrals add to it that are 0 outside some detector rows.

    `read` as in `fdk_stream`, with all rows. Only those are filtered, and only the slices that they reach are gone
    through: FDK is linear, so a correction of few rows need not reconstruct the rest again. `how` is the filter that
    the volume was made with.
    """
    last = geometry.n_detector[0]
    rows = slice(max(rows.start - 1, 0), min(rows.stop + 1, last))  # the 0 next to them belongs to their interpolation
    planes = _planes(geometry, rows)
    if planes.stop <= planes.start:
        return
    part = msgspec.structs.replace(
        geometry,
        n_detector=(rows.stop - rows.start, geometry.n_detector[1]),
        n_voxel=(planes.stop - planes.start, *geometry.n_voxel[1:]),
        off_detector=(_moved(geometry.off_detector[0], geometry.d_detector[0], last, rows), geometry.off_detector[1]),
        off_origin=(
            _moved(geometry.off_origin[0], geometry.d_voxel[0], geometry.n_voxel[0], planes),
            *geometry.off_origin[1:],
        ),
    )

    def cut(views: slice) -> NDArray[np.float32]:
        return np.ascontiguousarray(read(views)[:, rows])

    volume[planes] += torch.from_numpy(_run(cut, part, _orbit_weights(geometry), how.window, how.cutoff))


def _moved(offset: float, pitch: float, n: int, part: slice) -> float:
    """Return the offset of a part of n pixels or slices."""
    return offset + ((part.start + part.stop - 1) / 2 - (n - 1) / 2) * pitch


def _planes(geometry: Geometry, rows: slice) -> slice:
    """Return the slices of the volume that detector rows see within the field of view."""
    n, d, off = geometry.n_detector[0], geometry.d_detector[0], geometry.off_detector[0]
    edges = (np.array([rows.start - 0.5, rows.stop - 0.5]) - (n - 1) / 2) * d + off
    radius = _orbit_weights(geometry).radius
    heights = np.outer(edges, (geometry.dso + np.array([-radius, radius])) / geometry.dsd)
    z = geometry.voxel_centres()[0]
    first, after = np.searchsorted(z, [heights.min(), heights.max()])
    return slice(max(int(first) - 1, 0), min(int(after) + 1, len(z)))


def _orbit_weights(geometry: Geometry) -> RayWeights:
    if geometry.poses is not None:
        raise Unsuited("FDK needs a circular orbit: give angles_deg or arc_deg instead of poses")
    return ray_weights(geometry)


def _run(
    read: Callable[[slice], NDArray[np.float32]],
    geometry: Geometry,
    weights: RayWeights,
    window: str,
    cutoff: float,
) -> NDArray[np.float32]:
    """Weight, filter and backproject a few views at a time; `read` gives line integrals that may be overwritten.

    The filter works on the detector scaled to the isocentre.
    """
    before, after = weights.margin
    n_v, n_u = geometry.n_detector[0], geometry.n_detector[1] + before + after
    n_fft = padded_length(n_u)
    cosine = _cosine_weights(geometry)
    off_u = geometry.off_detector[1] + (after - before) / 2 * geometry.d_detector[1]
    orbit = np.array([geometry.dso, geometry.dsd, *geometry.d_detector, geometry.off_detector[0], off_u])
    grid = np.array([*geometry.d_voxel, *geometry.off_origin, weights.radius])
    ramp = ramp_response(n_fft, geometry.d_detector[1] * geometry.dso / geometry.dsd, window, cutoff)
    volume = np.zeros(geometry.n_voxel, np.float32)
    chunk = max(1, min(64, CHUNK_BYTES // (4 * n_v * n_fft)))
    for first in range(0, geometry.n_views, chunk):
        views = slice(first, min(first + chunk, geometry.n_views))
        p = read(views)
        p *= cosine
        p *= weights.values[views, None, :]
        if before or after:
            p = np.pad(p, ((0, 0), (0, 0), (before, after)))
        backproject(filter_rows(p, ramp, n_fft), geometry.angles[views], orbit, grid, volume)
    return volume


def _cosine_weights(geometry: Geometry) -> NDArray[np.float32]:
    """Cosine of the angle between each ray and the central ray, [v, u]."""
    (n_v, n_u), (d_v, d_u), (off_v, off_u) = geometry.n_detector, geometry.d_detector, geometry.off_detector
    v = (np.arange(n_v) - (n_v - 1) / 2) * d_v + off_v
    u = (np.arange(n_u) - (n_u - 1) / 2) * d_u + off_u
    return (geometry.dsd / np.sqrt(geometry.dsd**2 + u[None, :] ** 2 + v[:, None] ** 2)).astype(np.float32)
