"""Whether a method works on the very grid that a scan's phantom was drawn on.

Edges then fall between voxels as they never do in a real object, which flatters the method (an inverse crime).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.scaninfo import LabelGrid

KEY, SHARED = "grid", "shared_grid"
CLOSE = 0.01
"""Two faces are one if they are this close, in voxels of the finer grid."""
MOST = 0.9


def with_grid(details: Mapping[str, Any], geometry: Geometry, labels: LabelGrid | None) -> dict[str, Any]:
    """Return a method's details, with the grid it shares with the labels under "shared_grid", if it shares one.

    A method that fits on another grid than the volume's says so as details["grid"], its voxels (z, y, x).
    """
    found = details.get(KEY, geometry.n_voxel)
    if labels is None or not _is_grid(found) or not coincide(found, geometry, labels):
        return dict(details)
    return {**details, SHARED: [int(n) for n in found]}


def _is_grid(found: Any) -> bool:
    return isinstance(found, Sequence) and len(found) == 3 and all(isinstance(n, int) and n > 0 for n in found)


def coincide(n_voxel: Sequence[int], geometry: Geometry, labels: LabelGrid) -> bool:
    """Whether nearly all faces of the coarser of two grids lie on faces of the finer one, along every axis.

    The first has `n_voxel` (z, y, x) over the box of the geometry's volume.
    """
    extent = np.multiply(geometry.n_voxel, geometry.d_voxel)
    own = (_faces(n, e / n, o) for n, e, o in zip(n_voxel, extent, geometry.off_origin, strict=True))
    theirs = (_faces(*axis) for axis in zip(labels.n_voxel, labels.d_voxel, labels.off_origin, strict=True))
    return all(_share(*sorted(pair, key=_pitch)) > MOST for pair in zip(own, theirs, strict=True))


def _faces(n: int, d: float, middle: float) -> NDArray[np.float64]:
    return np.asarray(middle + (np.arange(n + 1) - n / 2) * d, np.float64)


def _pitch(faces: NDArray[np.float64]) -> float:
    return float(faces[1] - faces[0])


def _share(fine: NDArray[np.float64], coarse: NDArray[np.float64]) -> float:
    """Return the share of the coarse grid's faces within the fine grid that lie on one of its faces."""
    places = (coarse - fine[0]) / _pitch(fine)
    inside = places[(places > -CLOSE) & (places < len(fine) - 1 + CLOSE)]
    return float(np.mean(np.abs(inside - np.round(inside)) <= CLOSE)) if inside.size else 0.0


def shared_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Say in one sentence which runs share a grid with the labels, of {run: its details}; "" if none does."""
    runs = [f"{name} ({' x '.join(map(str, d[SHARED]))})" for name, d in found.items() if SHARED in d]
    if not runs:
        return ""
    told = "the labels lie on the grid of the method, which flatters it (phantom.grid_shift moves them)"
    return f"{told}: {', '.join(runs)}"
