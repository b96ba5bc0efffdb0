"""Whether the object goes on where the unknowns end: beyond the detector's edge or the reconstruction grid.

Iterative methods and splats explain all of a ray's attenuation within the grid and the field of view. What lies beyond
is then put into voxels that do not hold it, and the residual need not show it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.reconstruct.redundancy import ray_weights

SIGMAS, LEAST = 5.0, 0.1
"""A ray is attenuated above this many standard deviations of photon noise, and above this: a screen that has not glowed
before leaves the first views up to 0.06 too dark."""
NEARLY = 0.98  # of the farthest that is seen from the axis
SHARE = 1e-3  # of a side's pixels; a tenth of that, of all rays, where they miss the grid


@dataclass(frozen=True, slots=True, kw_only=True)
class Beyond:
    """Attenuated rays that miss all unknowns, and the attenuated pixels by the detector's edge.

    `sides` holds only the edges where the object leaves what is reconstructed.
    """

    missing: int
    sides: dict[str, int]

    @property
    def sentence(self) -> str:
        """What is wrong, or nothing; rows do not tell an object that ends with the grid from one that goes on."""
        parts = [f"{self.missing} attenuated rays miss the reconstruction grid"] if self.missing else []
        columns = [name for name in self.sides if "column" in name]
        parts += [f"the object reaches over the detector's {' and '.join(columns)}"] if columns else []
        return f"{' and '.join(parts)}, so values are wrong towards the border" if parts else ""

    def details(self) -> dict[str, object]:
        """Return the counts for a result's details."""
        return {"attenuated_rays_beyond": self.missing, "attenuated_edges": dict(self.sides)}


def seen_beyond(
    data: NDArray[np.float32], geometry: Geometry, i0: float, lengths: NDArray[np.float32] | None = None
) -> Beyond:
    """Count attenuated rays beyond the unknowns.

    `data` are the line integrals [view, v, u], `lengths` those through the unknowns in mm; without them no ray is said
    to miss all. The first and last row count where rays leave the grid upwards or downwards at all, a column where
    nothing farther out is seen from the other side, as it is beyond the short side of an offset detector.
    """

    def lit(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        return p > np.maximum(LEAST, SIGMAS * np.sqrt(np.exp(np.maximum(p, 0)) / np.float32(i0)))

    missing = 0 if lengths is None else int((lit(data) & (lengths == 0)).sum())
    radius = field_radius(geometry)
    first, last = _reaches(geometry)
    edges = {"first column": lit(data[:, :, 0])} if first >= NEARLY * min(radius, last) else {}
    edges |= {"last column": lit(data[:, :, -1])} if last >= NEARLY * min(radius, first) else {}
    if _leaves_through_the_ends(geometry, radius):
        edges |= {"first row": lit(data[:, 0]), "last row": lit(data[:, -1])}
    return Beyond(
        missing=missing if missing > 0.1 * SHARE * data.size else 0,
        sides={name: int(edge.sum()) for name, edge in edges.items() if edge.sum() > SHARE * edge.size},
    )


def field_radius(geometry: Geometry) -> float:
    """Return the radius in mm of the field of view, infinite where poses are given."""
    return math.inf if geometry.poses is not None else ray_weights(geometry).radius


def _reaches(geometry: Geometry) -> tuple[float, float]:
    """Return how far from the axis (mm) the rays to the first and to the last column pass."""
    half, off = geometry.n_detector[1] / 2 * geometry.d_detector[1], geometry.off_detector[1]
    first, last = (abs(u) * geometry.dso / math.hypot(geometry.dsd, u) for u in (off - half, off + half))
    return first, last


def _leaves_through_the_ends(geometry: Geometry, radius: float) -> bool:
    if geometry.poses is not None:
        return True
    n_v, d_v = geometry.n_detector[0], geometry.d_detector[0]
    highest = (n_v / 2 * d_v + abs(geometry.off_detector[0])) * (geometry.dso + radius) / geometry.dsd
    return highest > geometry.n_voxel[0] / 2 * geometry.d_voxel[0] - abs(geometry.off_origin[0])
