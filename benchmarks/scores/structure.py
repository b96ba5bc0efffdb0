"""The protocol `structure`: soft tissue between and around metal that reads as bone or as air.

Streaks between pieces of metal look like structure: PSNR over the whole body hardly counts a bar of false bone, a
reader of the image sees nothing else. Volumes are [z, y, x] in 1/mm.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import convex_hull_image

from ctsim.benchmarks.scores.artefact import MAX_PIECES, near_mm, pieces_of
from ctsim.benchmarks.scores.metrics import Mask, erode
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import COLUMNS, Score
from ctsim.benchmarks.scores.soft import SOFT_HU, SoftLayout

BONE_HU = 1000.0
"""What attenuates twice as much as water reads as bone, whatever cortical bone has under a soft spectrum."""
REGION = (
    "soft tissue without its outermost voxel, within 5 mm or 6 voxels (the greater) of the metal or between two pieces "
    "of it, outside the metal dilated by 2 voxels"
)
NO_METAL = "the scan holds no metal"
NONE_LEFT = "no soft tissue lies near the metal or between its pieces"


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureLayout:
    """Where false structure is looked for: masks [z, y, x], and the HU of bone and of air.

    `near` goes up to `reach` (mm) from the metal.
    """

    near: Mask
    reach: float
    between: Mask
    soft: SoftLayout
    bone: float
    air: float = -1000.0


def structure_layout(soft: SoftLayout | str, truth: Truth, bone: float | None) -> StructureLayout | str:
    """Choose the region; a sentence where there is none. `bone` is μ of cortical bone over that of water."""
    if isinstance(soft, str):
        return soft
    if not truth.metal.any() or bone is None:
        return NO_METAL
    inside = erode(soft.region) & soft.region
    found = StructureLayout(
        near=inside & soft.near,
        reach=near_mm(truth.d_voxel),
        between=inside & between_metal(truth),
        soft=soft,
        bone=(bone - 1) * 1000,
    )
    return found if (found.near | found.between).any() else NONE_LEFT


def between_metal(truth: Truth) -> Mask:
    """Return the voxels between two pieces of metal: in each slice, the convex hulls of all pairs of pieces."""
    pieces, _ = pieces_of(truth.metal, MAX_PIECES)
    found = np.zeros_like(truth.metal)
    for z in np.flatnonzero(pieces.any((1, 2))):
        here = pieces[z]
        for a, b in itertools.combinations([k for k in np.unique(here) if k], 2):
            pair = (here == a) | (here == b)
            box = ndimage.find_objects(pair.astype(np.uint8))[0]
            found[z][box] |= convex_hull_image(pair[box])
    return found & truth.tissue


def structure_score(values: NDArray[Any], layout: StructureLayout | str) -> Score:
    """Score false bone and false air; all None with the reason where the layout is a sentence.

    A voxel reads as bone above `BONE_HU`, or where it is nearer to cortical bone than to its own reference if that is
    less, but not within `SOFT_HU` of its reference, which may hold a part of bone; as air where it is nearer to air.
    """
    if isinstance(layout, str):
        return Score.none(REGION, COLUMNS["structure"], layout)
    region = layout.near | layout.between
    reference = layout.soft.reference[region]
    hu = (values[region].astype(np.float64) / layout.soft.water - 1) * 1000
    bone = hu > np.maximum(np.minimum((reference + layout.bone) / 2, BONE_HU), reference + SOFT_HU)
    air = hu < (reference + layout.air) / 2
    parts = {"": np.ones_like(bone), "_near": layout.near[region], "_between": layout.between[region]}
    found: dict[str, float | None] = {}
    for end, part in parts.items():
        found[f"false_bone{end}"] = float(bone[part].mean()) if part.any() else None
        found[f"false_air{end}"] = float(air[part].mean()) if part.any() else None
    error = (hu - reference)[parts["_between"]]
    found["bias_between"] = float(error.mean()) if error.size else None
    found["rmse_between"] = math.sqrt(float(np.mean(error**2))) if error.size else None
    return Score(
        region=REGION,
        reference="effective spectrum, in HU",
        alignment="none",
        data_range=None,
        n_voxels=int(region.sum()),
        values=found,
        note=f"{int(layout.near.sum())} voxels within {layout.reach:.3g} mm of metal, "
        f"{int(layout.between.sum())} between pieces; cortical bone {layout.bone:.0f} HU",
    )
