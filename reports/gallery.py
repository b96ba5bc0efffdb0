"""A picture of all recipes: one individual of each body, in two slices through its metal."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctsim.benchmarks.scalebar import scale_bar
from ctsim.benchmarks.studies.methods.panels import METAL, cut
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.recipes import BUILDERS, build_recipe
from ctsim.tracer.voxelise import attenuation_volume, metal_mask
from ctsim.types import Phantom

KEV = 60.0
LOW, HIGH = -1000.0, 1500.0  # HU at 60 keV
COLUMNS, CELL = 4, 1.9  # recipes in a row; inches


def drawable() -> tuple[type[Recipe], ...]:
    """Return the recipes that need nothing but their defaults: all but those that read a file."""
    return tuple(kind for kind in BUILDERS if all(not item.required for item in msgspec.structs.fields(kind)))


def gallery(kinds: Sequence[type[Recipe]] = (), *, n_voxel: int = 128, seed: int = 1) -> Figure:
    """Draw recipes with their defaults (`kinds`, by default all that need no file), a slice normal to z over one to y.

    `n_voxel` is the edge of both grids, the body's and the picture's.
    """
    kinds = kinds or drawable()
    rows = -(-len(kinds) // COLUMNS)
    columns = min(COLUMNS, len(kinds))
    figure = Figure(figsize=(CELL * columns, (2 * CELL + 0.1) * rows + 0.3), layout="constrained")
    grid = figure.subplots(2 * rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for k, kind in enumerate(kinds):
        row, column = divmod(k, COLUMNS)
        _draw(grid[2 * row : 2 * row + 2, column], kind(n_voxel=(n_voxel, n_voxel, n_voxel)), n_voxel, seed)
    figure.suptitle(
        f"upper: normal to z, lower: normal to y; {LOW:g} to {HIGH:g} HU at {KEV:g} keV; metal yellow", fontsize=9
    )
    return figure


def _draw(cells: NDArray[np.object_], recipe: Recipe, n: int, seed: int) -> None:
    """Draw one individual of a recipe into two cells."""
    phantom = build_recipe(recipe, seed)
    volume, metal, d_voxel = in_hu(phantom, recipe.size, n)
    at = cut(metal, phantom_body(volume))
    for axes, axis in zip(cells, (0, 1), strict=True):
        _show(axes, np.take(volume, at[axis], axis), np.take(metal, at[axis], axis), d_voxel)
    materials = sorted({s.material for s in phantom.solids if s.metal})
    cells[0].set_title(f"{recipe.recipe}\n{', '.join(materials)}, {recipe.size:g} mm", fontsize=8)


def _show(axes: Axes, image: NDArray[np.floating[Any]], metal: NDArray[np.bool_], d_voxel: float) -> None:
    axes.imshow(image, cmap="gray", vmin=LOW, vmax=HIGH, origin="lower", interpolation="nearest")
    over = np.ma.masked_where(~metal, metal)
    axes.imshow(over, cmap=ListedColormap([METAL]), origin="lower", interpolation="nearest")
    scale_bar(axes, image.shape, d_voxel)


def in_hu(phantom: Phantom, size: float, n: int) -> tuple[NDArray[np.floating[Any]], NDArray[np.bool_], float]:
    """Return a phantom on a cube of `size` mm in n³ voxels: HU at 60 keV and the metal, [z, y, x]; the voxel in mm."""
    d = size / n
    grid = Geometry(
        dso=2 * size, dsd=4 * size, n_voxel=(n, n, n), d_voxel=(d, d, d), n_detector=(1, 1), d_detector=(1.0, 1.0),
        n_views=1,
    )  # fmt: skip
    at = np.array([KEV])
    mu = {name: 0.0 if name == "air" else float(attenuation(name, at)[0]) for name in phantom.materials}
    volume = attenuation_volume(phantom, grid, mu) / float(attenuation("water", at)[0])
    return 1000.0 * (volume - 1), metal_mask(phantom, grid) > 0, d


def phantom_body(volume: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return where a volume in HU is no air."""
    return volume > -900
