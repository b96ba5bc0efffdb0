"""Bodies of analytic solids alone: rods in water, and in a printed cup."""

import math

import numpy as np

from ctsim.phantoms.fields import LabelGrid
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.phantoms.shapes import cylinder
from ctsim.types import Phantom


class Validation(Recipe, frozen=True, kw_only=True, tag="validation"):
    """Three rods in a water cylinder of 55/60 of the cube; rods of 5, 6 and 8 mm at 60 mm."""

    metal: str = "Al"


def validation(grid: LabelGrid, rng: np.random.Generator, params: Validation) -> Phantom:
    """Three rods in a water cylinder (diameter 55 mm in a 60 mm cube), all analytic; labels are air.

    The layout is fixed: with the seed only its angle turns (seed-dependent, so that no rod pair
    aligns with the first view by construction).
    """
    unit = grid.half_box
    half = 0.9 * unit
    solids = [cylinder("water", "water", (55 / 60 * unit, 2 * half), metal=False)]
    turn = rng.uniform(0, 2 * math.pi)
    if params.metal != "none":
        count = 3 if params.n_inserts is None else params.n_inserts
        for k in range(count):
            angle = turn + 2 * math.pi * k / count
            diameter = params.insert_mm or (5.0, 6.0, 8.0)[k % 3] * unit / 30
            centre = (0.5 * unit * math.cos(angle), 0.5 * unit * math.sin(angle), 0.0)
            solids.append(cylinder(f"rod{k}", params.metal, (diameter / 2, 1.7 * unit), centre=centre))
    return assemble(np.zeros(grid.n, np.uint8), grid, ("air",), solids)


class MetalRods(Recipe, frozen=True, kw_only=True, tag="metal_rods"):
    """Three alloy rods in a water-filled PLA cylinder (Al6061 by default)."""

    metal: str = "Al6061"


def metal_rods(grid: LabelGrid, rng: np.random.Generator, params: MetalRods) -> Phantom:
    """Draw a printed PLA cup with lid, water up to a level, and rods of unequal width set into its floor."""
    unit = grid.half_box
    level = rng.uniform(0.60, 0.76)
    middle = (0.0, 0.0, (level - 0.78) / 2 * unit)
    solids = [
        cylinder("cup", "PLA", (0.86 * unit, 1.8 * unit), metal=False),
        cylinder("air space", "air", (0.78 * unit, 1.6 * unit), centre=(0.0, 0.0, 0.02 * unit), metal=False),
        cylinder("water", "water", (0.78 * unit, (level + 0.78) * unit), centre=middle, metal=False),
    ]
    if params.metal != "none":
        total, turn = 3 if params.n_inserts is None else params.n_inserts, rng.uniform(0, 2 * math.pi)
        for k in range(total):
            angle = turn + 2 * math.pi * k / total
            r = (0.46 + 0.06 * rng.uniform(-1, 1)) * unit
            width = params.insert_mm or (4.0, 6.0, 8.0)[k % 3] * unit / 30
            centre = (r * math.cos(angle), r * math.sin(angle), -0.09 * unit)
            solids.append(cylinder(f"rod{k}", params.metal, (width / 2, 1.44 * unit), centre=centre))
    return assemble(np.zeros(grid.n, np.uint8), grid, ("air",), solids)
