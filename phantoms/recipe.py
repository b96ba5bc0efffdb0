"""What every recipe shares: its settings, and how labels and solids become a phantom."""

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from ctsim.errors import InputError
from ctsim.geometry import Triple
from ctsim.materials import material
from ctsim.phantoms.fields import LabelGrid
from ctsim.solids import Solid
from ctsim.types import Phantom

REACH = 0.92
"""Every object stays within this share of its cube: the radius is REACH·size/2, the half height at most that."""

FINEST = 200
"""The finest texture, in correlation lengths along the cube's edge."""

Millimetres = Annotated[float, msgspec.Meta(ge=1e-3, le=2000)]
Side = Annotated[int, msgspec.Meta(ge=1, le=2048)]
InsertCount = Annotated[int, msgspec.Meta(ge=0, le=16)]


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="recipe"):
    """Settings common to all recipes."""

    height: ClassVar[float] = REACH
    """Height of the object as a share of its cube's edge."""
    by_layers: ClassVar[bool] = True
    """Whether a layer of the labels can be drawn without the others."""

    n_voxel: tuple[Side, Side, Side] = (107, 107, 107)
    """Label grid (z, y, x) over the cube: how finely the body is drawn, never its shape."""
    size: Millimetres = 60.0
    """Edge of the object's cube in mm. The object stays inside 92 % of it."""
    metal: str = "Fe"
    """Material of the inserts; "none" leaves them out."""
    n_inserts: InsertCount | None = None
    """Number of inserts, instead of the recipe's own."""
    insert_mm: Millimetres | None = None
    """Diameter of the inserts in mm, instead of the recipe's own."""
    grid_shift: Triple = (0.0, 0.0, 0.0)
    """Shift of the label grid (z, y, x) in its voxels, at most half a one; the object stays where it is."""
    texture: float = 0.0
    """Relative standard deviation of the density within each tissue, in seven levels; 0 to 0.2."""
    texture_mm: Millimetres | None = None
    """Distance (mm) over which the density's correlation falls to a half; by default a thirtieth of `size`."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size) and 1e-3 <= self.size <= 2000):
            raise InputError(f"size must be within 0.001 to 2000 mm, got {self.size}")
        if not all(1 <= n <= 2048 for n in self.n_voxel):
            raise InputError(f"n_voxel must be within 1 to 2048 along every axis, got {self.n_voxel}")
        if self.n_inserts is not None and not 0 <= self.n_inserts <= 16:
            raise InputError(f"n_inserts must be 0 to 16, got {self.n_inserts}")
        if self.insert_mm is not None and not 1e-3 <= self.insert_mm <= 0.25 * self.size:
            raise InputError(
                f"insert_mm must be at least 0.001 mm and at most a quarter of size {self.size}: {self.insert_mm}"
            )
        if not all(abs(s) <= 0.5 for s in self.grid_shift):
            raise InputError(f"grid_shift must be within -0.5 to 0.5 voxels along every axis, got {self.grid_shift}")
        self.within("texture", 0.0, 0.2)
        if self.texture_mm is not None and not self.size / FINEST <= self.texture_mm <= self.size:
            raise InputError(
                f"texture_mm must be within size / {FINEST} and size = {self.size} mm, got {self.texture_mm}"
            )
        if self.metal != "none":
            self.known("metal")

    def known(self, key: str) -> None:
        """Raise `InputError` unless the setting `key` names a material."""
        try:
            material(getattr(self, key))
        except InputError as error:
            raise InputError(f"{key}: {error}") from None

    def within(self, key: str, low: float, high: float) -> None:
        """Raise `InputError` unless the setting `key` lies within [low, high]."""
        if not low <= getattr(self, key) <= high:
            raise InputError(f"{key} must be within {low} to {high}, got {getattr(self, key)}")

    @property
    def recipe(self) -> str:
        """The recipe's name in scene files."""
        return str(type(self).__struct_config__.tag)

    @property
    def d_voxel(self) -> Triple:
        """Voxel size of the label grid (z, y, x) in mm."""
        z, y, x = (self.size / n for n in self.n_voxel)
        return z, y, x


def assemble(labels: np.ndarray, grid: LabelGrid, materials: Sequence[str], solids: Sequence[Solid]) -> Phantom:
    """Make a phantom, adding the solids' materials to the table and clearing labels beyond the reach.

    The cleared rim makes the bounding cylinder that scene checks rely on hold for every seed.
    """
    z, y, x = grid.centres()
    limit, drawn = REACH * grid.half_box, labels[grid.layers]
    drawn[:, np.hypot(y[:, None], x) > limit] = 0
    drawn[np.abs(z[grid.layers]) > limit] = 0
    names = list(materials)
    for solid in solids:
        if solid.material not in names:
            names.append(solid.material)
    z, y, x = (s * d for s, d in zip(grid.shift, grid.d_voxel, strict=True))
    return Phantom(
        labels=labels,
        materials=tuple(names),
        d_voxel=grid.d_voxel,
        off_origin=(z, y, x),
        solids=tuple(solids),
        partial=grid.layers != slice(None),
    )
