"""The table of recipes: settings type → function that builds the phantom.

Every function is `(grid of labels, rng, params) -> Phantom`, seeded and independent of the
grid: shapes are drawn in units of the box, so 64³ and 256³ show the same object.
"""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from ctsim.errors import InputError
from ctsim.phantoms.bodies.broccoli import Broccoli, broccoli
from ctsim.phantoms.bodies.hip import Hip, hip
from ctsim.phantoms.bodies.jaw import Jaw, jaw
from ctsim.phantoms.bodies.lung import Lung, lung
from ctsim.phantoms.bodies.organic import BellPepper, Chicken, Walnut, bell_pepper, chicken, walnut
from ctsim.phantoms.bodies.random import Random, random
from ctsim.phantoms.bodies.rods import MetalRods, Validation, metal_rods, validation
from ctsim.phantoms.bodies.spine import Spine, spine
from ctsim.phantoms.bodies.teeth import Teeth, teeth
from ctsim.phantoms.bodies.volume import CtVolume, ct_volume
from ctsim.phantoms.fields import LabelGrid
from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.texture import textured
from ctsim.types import Phantom

AnyRecipe = (
    Validation
    | MetalRods
    | Lung
    | Teeth
    | Jaw
    | Broccoli
    | Walnut
    | Chicken
    | BellPepper
    | Random
    | CtVolume
    | Hip
    | Spine
)

Builder = Callable[[LabelGrid, np.random.Generator, Any], Phantom]

BUILDERS: dict[type[Recipe], Builder] = {
    Validation: validation,
    MetalRods: metal_rods,
    Lung: lung,
    Teeth: teeth,
    Jaw: jaw,
    Broccoli: broccoli,
    Walnut: walnut,
    Chicken: chicken,
    BellPepper: bell_pepper,
    Random: random,
    CtVolume: ct_volume,
    Hip: hip,
    Spine: spine,
}

NAMES = tuple(str(kind.__struct_config__.tag) for kind in BUILDERS)


def build_recipe(params: Recipe, seed: int, again: int = 0, layers: slice = slice(None)) -> Phantom:
    """Build the phantom of a recipe; the same settings and seed give the same phantom.

    `again` counts further draws of the same individual. Of the labels only `layers` are drawn, the others stay air;
    where a recipe cannot do that, all are drawn. Raises `InputError` when a whole phantom holds nothing to scan.
    """
    layers = layers if params.by_layers else slice(None)
    name = f"{params.recipe}/{seed}" + (f"/again {again}" if again else "")
    digest = hashlib.sha256(name.encode()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, np.uint32))
    grid = LabelGrid(n=params.n_voxel, d_voxel=params.d_voxel, shift=params.grid_shift, layers=layers)
    phantom = BUILDERS[type(params)](grid, rng, params)
    empty = not phantom.labels[layers].any()
    if layers != slice(None) and empty:
        return phantom
    if empty and not phantom.solids:
        raise InputError(
            f"recipe {params.recipe!r}: the scene is empty at n_voxel = {params.n_voxel}; expected a finer grid"
        )
    return textured(phantom, params, seed, layers) if params.texture else phantom
