"""The circular orbit that is nearest to the poses of a scan, for FDK and for methods that begin with it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.io.scans.scanfile import grid_of

NEAR = 0.5  # pixels: poses that stray less from a circle are taken for one


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """A geometry: a circle if the poses are near one, else the poses; `turned` brings images [v, u] into its order."""

    geometry: Geometry
    turned: Callable[[NDArray[Any]], NDArray[Any]]
    note: str


def as_circle(poses: NDArray[np.float64], n_detector: tuple[int, int]) -> Circle:
    """Fit a circle about an axis along z to poses [view, 12].

    The grid stays around the origin of the poses, which need not lie on the axis. Raises InputError for poses that are
    no source before a detector.
    """
    source, centre, e_u, e_v = poses.reshape(-1, 4, 3).transpose(1, 0, 2)
    fitted = _fitted(source, centre, e_u, e_v, n_detector) if len(poses) > 2 else None
    if fitted is not None:
        geometry, flip_u, flip_v = fitted
        stray = _stray(poses, geometry, flip_u, flip_v)
        if stray <= NEAR:
            rows, columns = (slice(None, None, -1 if flip else 1) for flip in (flip_v, flip_u))
            note = f"the views stray at most {stray:.2g} pixels from a circle, which is used"
            return Circle(geometry=geometry, turned=lambda image: image[rows, columns], note=note)
    geometry = _as_they_are(poses, source, centre, e_u, e_v, n_detector)
    note = "the views are on no circle: FDK and methods that begin with it skip or refuse them"
    return Circle(geometry=geometry, turned=lambda image: image, note=note)


def _as_they_are(
    poses: NDArray[np.float64],
    source: NDArray[np.float64],
    centre: NDArray[np.float64],
    e_u: NDArray[np.float64],
    e_v: NDArray[np.float64],
    n_detector: tuple[int, int],
) -> Geometry:
    dso = float(np.linalg.norm(source, axis=1).mean())
    dsd = float(np.linalg.norm(centre - source, axis=1).mean())
    if not 0 < dso < dsd:
        raise InputError(f"the sources are {dso:g} mm from the origin and {dsd:g} mm from the detector on average")
    pixel = float(np.linalg.norm(e_v, axis=1).mean()), float(np.linalg.norm(e_u, axis=1).mean())
    n_voxel, d_voxel = grid_of(dso, dsd, n_detector, pixel)
    return Geometry(
        dso=dso,
        dsd=dsd,
        n_voxel=n_voxel,
        d_voxel=d_voxel,
        n_detector=n_detector,
        d_detector=pixel,
        n_views=len(poses),
        poses=tuple(tuple(row) for row in poses.tolist()),
    )


def _fitted(
    source: NDArray[np.float64],
    centre: NDArray[np.float64],
    e_u: NDArray[np.float64],
    e_v: NDArray[np.float64],
    n_detector: tuple[int, int],
) -> tuple[Geometry, bool, bool] | None:
    """Return the circle of least squares, and whether its columns and rows run the other way; None if there is none."""
    x, y = source[:, 0], source[:, 1]
    left = np.stack([2 * x, 2 * y, np.ones_like(x)], 1)
    (a, b, c), _, rank, _ = np.linalg.lstsq(left, x * x + y * y, rcond=None)
    square = c + a * a + b * b
    if rank < 3 or not square > 0:
        return None
    middle, dso = np.array([a, b, source[:, 2].mean()]), float(np.sqrt(square))
    out = (source - middle) * (1, 1, 0)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    along = np.stack([-out[:, 1], out[:, 0], np.zeros(len(out))], 1)
    moved = centre - middle
    dsd = dso - float((moved * out).sum(1).mean())
    if not 0 < dso < dsd:
        return None
    pixel = float(np.linalg.norm(e_v, axis=1).mean()), float(np.linalg.norm(e_u, axis=1).mean())
    if min(pixel) <= 0:
        return None
    n_voxel, d_voxel = grid_of(dso, dsd, n_detector, pixel)
    geometry = Geometry(
        dso=dso,
        dsd=dsd,
        n_voxel=n_voxel,
        d_voxel=d_voxel,
        n_detector=n_detector,
        d_detector=pixel,
        n_views=len(source),
        off_origin=(-float(middle[2]), -float(b), -float(a)),
        off_detector=(float(moved[:, 2].mean()), float((moved * along).sum(1).mean())),
        angles_deg=tuple(np.degrees(np.arctan2(out[:, 1], out[:, 0])).tolist()),
    )
    return geometry, bool((e_u * along).sum() < 0), bool(e_v[:, 2].sum() < 0)


def _stray(poses: NDArray[np.float64], geometry: Geometry, flip_u: bool, flip_v: bool) -> float:
    """Return how many pixels the rays of the corners and of the middle are off at most, at the detector."""
    z, y, x = geometry.off_origin
    fitted = geometry.pose_array() - np.concatenate([[x, y, z] * 2, np.zeros(6)])
    given = poses * np.repeat([1.0, 1.0, -1.0 if flip_u else 1.0, -1.0 if flip_v else 1.0], 3)
    half_v, half_u = ((n - 1) / 2 for n in geometry.n_detector)
    pixel = min(geometry.d_detector)
    grow = (geometry.dsd - geometry.dso) / geometry.dso
    off = given - fitted
    worst = 0.0
    for i, j in ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        at_detector = off[:, 3:6] + i * half_v * off[:, 9:] + j * half_u * off[:, 6:9]
        worst = max(
            worst, float((np.linalg.norm(at_detector, axis=1) + grow * np.linalg.norm(off[:, :3], axis=1)).max())
        )
    return worst / pixel
