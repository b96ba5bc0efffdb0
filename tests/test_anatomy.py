"""Drawn bodies are whole: bone inside the skin, nothing floats in air, nothing organic is cut along the grid.

The checks read labels and solids only, never a recipe's formulas. A row of ROWS declares what one body
may do; another body is another row.
"""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.phantoms.bodies.jaw import Jaw
from ctsim.phantoms.bodies.lung import Lung
from ctsim.phantoms.bodies.random import Random
from ctsim.phantoms.bodies.teeth import Teeth
from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.recipes import build_recipe
from ctsim.solids import CAPSULE, ELLIPSOID, Solid
from ctsim.types import Phantom

SEEDS = (1, 2, 3)
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Row:
    """What is declared of a body: its bones, their cover in mm, the gas they may touch, where it is cut.

    `cover` is the least depth of bone under the skin, centre to centre of voxels: half a pitch on either side more
    than the tissue between them. `gas` says that bone may border on gas inside the body,
    and `cut` gives, by axis, the share of the cube's half edge beyond which the specimen ends in a plane.
    """

    kind: type[Recipe]
    bones: tuple[str, ...] = ("cortical_bone",)
    cover: float = 0.0
    gas: bool = False
    cut: dict[str, float] = field(default_factory=dict)


ROWS = (
    # the chest is cut at neck and belly, the head above the nose's floor and below the chin
    Row(Lung, cover=1.0, cut={"z": 0.75}),
    Row(Teeth, cover=1.0, cut={"z": 0.75}),  # crowns (dentin, enamel) stand in the mouth's air: not among the bones
    Row(Jaw, cover=1.0, cut={"z": 0.75}),
    Row(Random, cover=1.0, gas=True),  # its organs are strewn: one of gas may lie beside one of bone
)
NAMES = [str(row.kind.__struct_config__.tag) for row in ROWS]
EACH = pytest.mark.parametrize("row", ROWS, ids=NAMES)
SEEDED = pytest.mark.parametrize("seed", SEEDS)


@cache
def body(kind: type[Recipe], seed: int, n: tuple[int, int, int] = (96, 96, 96)) -> Phantom:
    return build_recipe(kind(n_voxel=n), seed)


def part(phantom: Phantom, *names: str) -> Mask:
    """Where the body consists of one of these materials."""
    return np.isin(phantom.labels, [phantom.materials.index(name) for name in names])


def outside(labels: NDArray[np.uint8]) -> Mask:
    """Air that reaches the grid's border: what the body lies in, other than gas in its hollows."""
    air, _ = ndimage.label(np.pad(labels == 0, 1, constant_values=True))
    return (air == air[0, 0, 0])[1:-1, 1:-1, 1:-1]


def hull(labels: NDArray[np.uint8], d_voxel: tuple[float, float, float], ball: float = 2.5) -> Mask:
    """The body with its hollows filled, and without what a ball of this radius in mm cannot enter (spikes, ridges)."""
    filled = np.pad(~outside(labels), 1)
    core = ndimage.distance_transform_edt(filled, d_voxel) > ball
    return (ndimage.distance_transform_edt(~core, d_voxel) <= ball)[1:-1, 1:-1, 1:-1]


def depth(labels: NDArray[np.uint8], d_voxel: tuple[float, float, float]) -> NDArray[np.float64]:
    """Distance in mm from a voxel's centre to the nearest centre in the air outside."""
    pad = np.pad(outside(labels), 1, constant_values=True)
    return ndimage.distance_transform_edt(~pad, d_voxel)[1:-1, 1:-1, 1:-1]


def pieces(mask: Mask) -> list[int]:
    """Numbers of voxels of the parts that hang together by faces, edges or corners, largest first."""
    index, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    return sorted(np.bincount(index.ravel())[1:].tolist(), reverse=True)


def flats(mask: Mask, axis: int, least: int = 30) -> list[int]:
    """Planes between slabs of `axis` in which the mask's surface has a ruler-straight face of `least` cells or more.

    `mask` has cells four times as fine along `axis` as across. A rounded surface goes on in the next slabs: of a
    bowl of height ~ r^p the first slab takes an area of 1 and the three after it 4^(2/p) - 1, which is 3 for a ball
    and 0.41 for the flattest superellipsoid drawn, p = 8. A cut ends at its edge: beside a square of 12 by 12 cells
    walls that fall off at 45 degrees leave three rims of a quarter of a cell, 3·48/4/144 = 0.25, and steeper ones
    less. The bound of 0.3 lies between.
    """
    slabs = np.moveaxis(mask, axis, 0)
    found = set()
    for face in (slabs[1:] & ~slabs[:-1], slabs[:-1] & ~slabs[1:]):
        for k in np.flatnonzero(face.sum((1, 2)) >= least):
            index, _ = ndimage.label(face[k])
            size = np.bincount(index.ravel())
            for i in np.flatnonzero(size[1:] >= least) + 1:
                near = ndimage.binary_dilation(index == i, np.ones((3, 3)), iterations=3)
                beside = np.delete(face[max(k - 3, 0) : k + 4], min(k, 3), axis=0)
                if beside[:, near].sum() < 0.3 * size[i]:
                    found.add(int(k) + 1)
    return sorted(found)


def ruled(row: Row, seed: int) -> list[str]:
    """Name the flat faces of the body and its tissues, each as material, axis and share of the half edge."""
    found = []
    for axis, name in enumerate("zyx"):
        n = tuple(192 if k == axis else 48 for k in range(3))
        phantom = body(row.kind, seed, (n[0], n[1], n[2]))
        masks = {"body": phantom.labels > 0} | {m: part(phantom, m) for m in phantom.materials[1:]}
        for tissue, mask in masks.items():
            places = [2 * k / 192 - 1 for k in flats(mask, axis)]
            found += [f"{tissue}: {name} = {at:.2f}" for at in places if abs(at) < row.cut.get(name, 1)]
    return found


@pytest.mark.slow
@EACH
@SEEDED
def test_bone_lies_inside_the_skin(row: Row, seed: int) -> None:
    phantom = body(row.kind, seed)
    bone = part(phantom, *row.bones)
    assert bone.any()
    assert depth(phantom.labels, phantom.d_voxel)[bone].min() >= row.cover
    assert not (bone & ~hull(phantom.labels, phantom.d_voxel)).any()


@EACH
@SEEDED
def test_nothing_floats_in_air(row: Row, seed: int) -> None:
    phantom = body(row.kind, seed)
    assert len(pieces(phantom.labels > 0)) == 1
    if not row.gas:
        beside_air = ndimage.binary_dilation(phantom.labels == 0)
        assert not (part(phantom, *row.bones) & beside_air).any()


@pytest.mark.slow
@EACH
@SEEDED
def test_nothing_is_cut_along_the_grid(row: Row, seed: int) -> None:
    assert ruled(row, seed) == []


@pytest.mark.parametrize("n", [(128, 128, 128), (64, 96, 128)], ids=str)
def test_the_spine_is_covered_at_other_grids(n: tuple[int, int, int]) -> None:
    phantom = body(Lung, 1, n)
    bone = part(phantom, "cortical_bone")
    assert depth(phantom.labels, phantom.d_voxel)[bone].min() >= 1.0 - max(phantom.d_voxel) / 2


@SEEDED
def test_muscle_and_fat_lie_behind_the_thoracic_spine(seed: int) -> None:
    phantom = body(Lung, seed)
    z, y, x = ((np.arange(96) + 0.5 - 48) * d for d in phantom.d_voxel)
    here = np.ix_(np.abs(z) < 20, y < 0, np.abs(x) < 1.0)  # midline slices, above and below the cuts
    bone, fat = part(phantom, "cortical_bone")[here], part(phantom, "adipose")[here]
    skin = (~outside(phantom.labels)[here]).argmax(1)  # first voxel of the back
    thick = bone.argmax(1)[bone.any(1)] - skin[bone.any(1)]
    # a chest of 25 cm in 60/37 of the depth here: 1 cm of skin and fat over a spinous process is 1.4 mm, 2 voxels
    assert thick.min() >= 2
    assert fat.any(1)[bone.any(1)].mean() > 0.95


def cells(phantom: Phantom, solid: Solid) -> Mask:
    """Voxels whose centre lies in a ball or a rod with round ends."""
    (one,) = solid.primitives
    z, y, x = ((np.arange(n) + 0.5 - n / 2) * d for n, d in zip(phantom.labels.shape, phantom.d_voxel, strict=True))
    at = np.stack(np.meshgrid(z, y, x, indexing="ij"), -1)[..., ::-1] - np.asarray(one.centre)
    assert one.kind in (CAPSULE, ELLIPSOID)
    half, radius = one.params[:2] if one.kind == CAPSULE else (0.0, one.params[0])
    along = at @ one.rotation()[2]
    return np.linalg.norm(at, axis=-1) ** 2 - along**2 + np.maximum(np.abs(along) - half, 0) ** 2 <= radius**2


@SEEDED
def test_metal_of_the_thorax_lies_where_the_recipe_says(seed: int) -> None:
    phantom = body(Lung, seed)
    deep = depth(phantom.labels, phantom.d_voxel)
    to_bone = ndimage.distance_transform_edt(~part(phantom, "cortical_bone"), phantom.d_voxel)
    metal = {solid.name: cells(phantom, solid) for solid in phantom.solids}
    assert {name[:3] for name in metal} == {"rod", "bal"}
    for name, inside in metal.items():
        assert deep[inside].min() >= 1.0, name
        if name.startswith("rod"):  # beside the spine: bone in reach in every slice, never across the cord
            slices = inside.any((1, 2))
            assert np.where(inside, to_bone, np.inf).min((1, 2))[slices].max() < 3.0, name
            assert not inside[:, :, 46:50].any(), name
        else:  # in heart and liver
            assert part(phantom, "soft_tissue", "adipose")[inside].all(), name


def test_the_detectors_tell_good_from_bad() -> None:
    x = (np.arange(96) + 0.5 - 48) / 40
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    ball = (x**2 + y**2 + z**2 < 1).astype(np.uint8)
    spike = ball | ((np.abs(x) < 0.05) & (np.abs(y) < 0.05) & (np.abs(z) < 1.15)).astype(np.uint8)
    one = (1.0, 1.0, 1.0)
    assert not (spike.astype(bool) & ~hull(spike, one) & (np.abs(z) < 0.9)).any()
    assert (spike.astype(bool) & ~hull(spike, one)).any()
    assert np.abs(depth(ball, one)[47, 47, 47] - 40) < 1
    hollow = ball * (x**2 + y**2 + z**2 > 0.3)
    assert np.array_equal(outside(hollow), ball == 0)
    assert len(pieces((hollow > 0) | (x**2 + y**2 + z**2 < 0.1))) == 2


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("power", [2, 4, 8])
def test_flats_are_cuts_and_not_bulges(axis: int, power: int) -> None:
    n = [192 if k == axis else 48 for k in range(3)]
    grids = np.meshgrid(*((np.arange(k) + 0.5 - k / 2) / (k / 2) for k in n), indexing="ij")
    egg = sum(np.abs(g / 0.77) ** power for g in grids) < 1
    assert flats(egg, axis) == []
    plane = (np.asarray(grids[axis]) < 0.5) & (egg if power == 2 else True)
    assert flats(egg & plane, axis) == [144]
    assert flats(~(egg & plane), axis) == [144]
