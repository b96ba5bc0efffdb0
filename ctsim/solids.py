"""Analytic solids: inserts that are ray-traced exactly instead of being voxelised.

A solid is a value made of one or more *primitives* of one material. Kernels see primitives only, as
rows of a flat float64 array (see `PRIMITIVE_COLUMNS`), in paint order: a later one replaces an earlier
one, and all replace the voxel background.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError

ELLIPSOID, FRUSTUM, CAPSULE, BOX, TORUS = range(5)

# kind, material index, world→local matrix row-major (9), local origin offset (3), parameters (4),
# bounding sphere centre (3) and radius (1). local = matrix @ world + offset; the matrix is a rotation.
KIND, MATERIAL, MATRIX, OFFSET, PARAMS, BOUND = 0, 1, slice(2, 11), slice(11, 14), slice(14, 18), slice(18, 22)
PRIMITIVE_COLUMNS = 22

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Primitive:
    """One convex piece (or a torus) of a solid, in world coordinates x, y, z (mm).

    `params` in the local frame, whose z axis is `axis` and whose origin is `centre`:
    ellipsoid (rx, ry, rz, –); frustum (half length, radius at −half, radius at +half, –);
    capsule (half length of the axis segment, radius, –, –); box (half x, half y, half z, –);
    torus (major, minor radius, –, –), ring in the local xy plane.
    """

    kind: int
    centre: Vector
    params: tuple[float, ...]
    axis: Vector = (0.0, 0.0, 1.0)
    spin: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite([*self.centre, *self.params, *self.axis, self.spin])):
            raise InputError("a solid's centre, axis and sizes must be finite")
        if min(self.params) < 0:
            raise InputError(f"a solid's sizes must not be negative, got {self.params}")
        if math.hypot(*self.axis) == 0:
            raise InputError("a solid's axis must not be the zero vector")

    def rotation(self) -> NDArray[np.float64]:
        """World→local rotation: rows are the local axes; `spin` turns about the axis (radians)."""
        w = np.asarray(self.axis, np.float64) / math.hypot(*self.axis)
        helper = np.eye(3)[np.argmin(np.abs(w))]
        u = np.cross(helper, w)
        u /= np.linalg.norm(u)
        v = np.cross(w, u)
        if w[2] == 1.0:  # keep upright solids aligned with the world axes
            u, v = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
        c, s = math.cos(self.spin), math.sin(self.spin)
        return np.stack([c * u + s * v, c * v - s * u, w])

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere about the centre (mm)."""
        p = self.params
        if self.kind == ELLIPSOID:
            return max(p[:3])
        if self.kind == FRUSTUM:
            return math.hypot(p[0], max(p[1], p[2]))
        if self.kind == BOX:
            return math.hypot(*p[:3])
        return p[0] + p[1]

    def row(self, material: int) -> NDArray[np.float64]:
        """Pack into one kernel row; `material` is the index the kernel accumulates under."""
        row = np.zeros(PRIMITIVE_COLUMNS)
        matrix = self.rotation()
        row[KIND], row[MATERIAL] = self.kind, material
        row[MATRIX] = matrix.ravel()
        row[OFFSET] = -matrix @ np.asarray(self.centre)
        row[PARAMS.start : PARAMS.start + len(self.params)] = self.params
        row[BOUND] = (*self.centre, self.radius)
        return row


@dataclass(frozen=True, slots=True, kw_only=True)
class Solid:
    """A named union of primitives of one material. `metal` marks it as an insert to be masked."""

    name: str
    material: str
    primitives: tuple[Primitive, ...]
    metal: bool = False


def pack(solids: Sequence[Solid], materials: Sequence[str]) -> NDArray[np.float64]:
    """Flatten solids to [primitive, PRIMITIVE_COLUMNS]; zero-volume primitives are left out."""
    rows = []
    for solid in solids:
        if solid.material not in materials:
            raise InputError(f"solid {solid.name!r}: material {solid.material!r} is not among {list(materials)}")
        index = materials.index(solid.material)
        rows += [p.row(index) for p in solid.primitives if not _is_flat(p)]
    return np.array(rows).reshape(-1, PRIMITIVE_COLUMNS)


def _is_flat(primitive: Primitive) -> bool:
    p = primitive.params
    if primitive.kind == FRUSTUM:
        return p[0] == 0 or max(p[1], p[2]) == 0
    if primitive.kind in (CAPSULE, TORUS):
        return p[1] == 0
    return min(p[:3]) == 0
