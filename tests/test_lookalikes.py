"""The objects on the table look like what they are called: nothing floats, no flat cut, metal where it is held.

Everything is read from the labels and the solids, never from the shapes' own formulas.
"""

import itertools
import math
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.recipes import BUILDERS, build_recipe
from ctsim.phantoms.scene import load_suite
from ctsim.solids import Primitive, Solid
from ctsim.types import Phantom

SUITES = Path(__file__).parent.parent / "benchmarks" / "suites"
KINDS = {str(kind.__struct_config__.tag): kind for kind in BUILDERS}
ORGANIC = ("walnut", "chicken", "bell_pepper", "broccoli")
N = 96
LEAST = 0.045 * (N / 2) ** 2  # faces: 40 mm² in the 60 mm cube, a disc of 7 mm; folds have smaller level walls
AROUND = np.ones((3, 3, 3))  # 26 neighbours: voxels that share a corner are joined
EACH = pytest.mark.parametrize(("name", "seed"), list(itertools.product(ORGANIC, (1, 2, 3))))
SEEDS = pytest.mark.parametrize("seed", (1, 2, 3))


@cache
def made(name: str, seed: int, **changes) -> Phantom:
    return build_recipe(KINDS[name](n_voxel=(N, N, N), **changes), seed)


def mask(phantom: Phantom, material: str) -> NDArray[np.bool_]:
    return phantom.labels == phantom.materials.index(material)


def at(phantom: Phantom, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Labels at points [k, 3] (x, y, z in mm)."""
    index = np.floor(points / phantom.d_voxel[0] + N / 2).astype(int)
    return phantom.labels[index[:, 2], index[:, 1], index[:, 0]]


def axis_points(primitive: Primitive, count: int = 9) -> NDArray[np.float64]:
    """Points along the axis of a capsule or frustum: [count, 3]."""
    half = primitive.params[0]
    return np.asarray(primitive.centre) + np.linspace(-half, half, count)[:, None] * primitive.rotation()[2]


def pieces_of(inside: NDArray[np.bool_], joined: NDArray[np.float64] | None = None) -> NDArray[np.int64]:
    """Number the pieces of a mask from 1 on; voxels that share a face are joined, unless `joined` says which."""
    pieces = np.zeros(inside.shape, np.int64)
    ndimage.label(inside, joined, output=pieces)
    return pieces


def filled(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(ndimage.binary_fill_holes(inside), bool)


def skin_points(body: NDArray[np.bool_], d: float) -> NDArray[np.float64]:
    """Middles of the voxel faces between the body and the air around it: [k, 3], x, y, z in mm."""
    found = []
    for axis in range(3):
        faces = np.argwhere(np.diff(np.moveaxis(body, axis, 0), axis=0)).astype(float)
        faces[:, 0] += 0.5
        found.append(np.insert(faces[:, 1:], axis, faces[:, 0], axis=1))
    return (np.concatenate(found)[:, ::-1] + 0.5 - N / 2) * d


def flats(labels: NDArray[np.uint8], least: float) -> list[str]:
    """Find cuts across a grid axis: coplanar patches of at least `least` faces that end in an edge.

    A smooth surface that is level somewhere forms terraces there. Where it curves along both axes (radius R), the
    terrace one voxel on is at least as large as the level patch: the disc's area grows by 2πR a voxel. Where it curves
    along one only, the patch is at most 2√(2R) wide and the next two terraces are together (√2 − 1) = 0.41 of that.
    A flat that ends in an edge has but the edge's wall beside it. The line is drawn at a third.
    """
    found = []
    within = np.zeros((3, 3, 3))
    within[1] = 1
    for what, inside in {"body": labels > 0, **{str(k): labels == k for k in range(1, labels.max() + 1)}}.items():
        for axis, side in itertools.product(range(3), (1, -1)):
            layers = np.moveaxis(inside, axis, 0)[::side]
            faces = layers[:-1] & ~layers[1:]
            patches = pieces_of(faces, within)
            sizes = np.bincount(patches.ravel())
            layers_of = ndimage.find_objects(patches)
            for k in 1 + np.nonzero(sizes[1:] >= least)[0]:
                layer = layers_of[k - 1][0].start
                reach = math.ceil(math.sqrt(sizes[k] / math.pi))
                near = np.asarray(ndimage.distance_transform_edt(patches[layer] != k)) <= reach
                beside = sum(int((faces[j] & near).sum()) for j in (layer - 1, layer + 1) if 0 <= j < len(faces))
                if beside < sizes[k] / 3:
                    found.append(f"{what}, {'zyx'[axis]}: {sizes[k]} faces, {beside} beside")
    return found


def test_the_search_for_flats_tells_a_cut_from_a_round() -> None:
    z, y, x = np.ogrid[-1 : 1 : N * 1j, -1 : 1 : N * 1j, -1 : 1 : N * 1j]
    ball = x**2 + y**2 + z**2 < 0.64
    assert not flats(ball.astype(np.uint8), LEAST)
    lying = (x - np.clip(x, -0.5, 0.5)) ** 2 + y**2 + z**2 < 0.16
    assert not flats(lying.astype(np.uint8), LEAST)
    assert flats((ball & (z < 0.5)).astype(np.uint8), LEAST)
    assert not flats((ball & (z + 0.15 * x < 0.5)).astype(np.uint8), LEAST)  # a knife's cut is askew
    hole = (np.abs(x) < 0.1) & (y**2 + z**2 < 0.12)
    assert flats((ball & ~hole).astype(np.uint8), LEAST)


@EACH
def test_nothing_floats(name: str, seed: int) -> None:
    assert pieces_of(made(name, seed).labels > 0, AROUND).max() == 1


@pytest.mark.slow
@EACH
def test_no_flat_lies_across_an_axis(name: str, seed: int) -> None:
    assert flats(made(name, seed).labels, LEAST) == []


@SEEDS
def test_the_wire_lies_on_the_skin(seed: int) -> None:
    phantom = made("chicken", seed)
    d = phantom.d_voxel[0]
    (wire,) = [s for s in phantom.solids if s.metal]
    radius = wire.primitives[0].params[1]
    centreline = np.concatenate([axis_points(p) for p in wire.primitives])
    away, _ = KDTree(skin_points(phantom.labels > 0, d)).query(centreline)
    # its own radius, and the voxel by which the labels' skin may stand beside the drawn one
    assert away.max() <= radius + d
    turns = np.unwrap(np.arctan2(centreline[:, 1], centreline[:, 0]))
    assert abs(turns[-1] - turns[0]) / (2 * math.pi) == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize("changes", [{"turns": 0.3}, {"insert_mm": 6.0}, {"n_inserts": 3}])
def test_any_wire_is_wound_on_the_skin(changes) -> None:
    phantom = made("chicken", 1, **changes)
    metal = [s for s in phantom.solids if s.metal]
    assert len({s.name for s in metal}) == len(metal) == changes.get("n_inserts", 1)
    tree = KDTree(skin_points(phantom.labels > 0, phantom.d_voxel[0]))
    for wire in metal:
        away, _ = tree.query(np.concatenate([axis_points(p) for p in wire.primitives]))
        assert away.max() <= wire.primitives[0].params[1] + phantom.d_voxel[0]


@SEEDS
def test_the_chickens_bone_is_hollow_and_under_the_skin(seed: int) -> None:
    phantom = made("chicken", seed)
    bone, air = mask(phantom, "cortical_bone"), mask(phantom, "air")
    # Voxels that share a face with bone: a skin of at least one voxel everywhere.
    assert not (np.asarray(ndimage.binary_dilation(bone), bool) & air).any()
    layers = np.nonzero(bone.any((1, 2)))[0]
    marrow = []
    for k in layers[4:-4]:  # the ends are closed by the joints' own shells
        inner = filled(bone[k]) & mask(phantom, "adipose")[k]
        marrow.append(inner.sum() / np.count_nonzero(bone[k]))
    assert min(marrow) > 0.1


@SEEDS
def test_both_halves_of_the_walnut_are_full(seed: int) -> None:
    phantom = made("walnut", seed)
    kernel, shell = mask(phantom, "adipose"), mask(phantom, "cellulose")
    hollow = filled(shell) & ~shell
    rooms = pieces_of(hollow)  # which the membrane divides
    halves = sorted(np.bincount(rooms[kernel]))[-2:]
    assert halves[0] > 0.4 * sum(halves)
    assert 0.45 < kernel.sum() / hollow.sum() < 0.85


@SEEDS
def test_pins_pass_the_shell_and_leave_each_other_alone(seed: int) -> None:
    phantom = made("walnut", seed)
    pins = [s for s in phantom.solids if s.metal]
    assert len(pins) == 3
    shell = phantom.materials.index("cellulose")
    for pin in pins:
        ball, shank, _ = pin.primitives
        head = np.asarray(ball.centre)
        assert shell in at(phantom, axis_points(shank, 99)), pin.name
        outer = head + ball.params[0] * (head - shank.centre) / np.linalg.norm(head - shank.centre)
        assert at(phantom, outer[None]) == 0, pin.name  # the head stands out
    for one, other in itertools.combinations(pins, 2):
        a, b = (np.concatenate([axis_points(p, 60) for p in pin.primitives[1:]]) for pin in (one, other))
        gap = np.linalg.norm(a[:, None] - b[None], axis=2).min()
        assert gap > one.primitives[1].params[1] + other.primitives[1].params[1]


def rivet_axis(rivet: Solid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    head, tail, _ = rivet.primitives
    return np.asarray(head.centre), np.asarray(tail.centre)


@SEEDS
def test_rivets_pass_the_peppers_wall(seed: int) -> None:
    phantom = made("bell_pepper", seed)
    rivets = [s for s in phantom.solids if s.metal]
    assert len(rivets) == 3
    for rivet in rivets:
        head, tail = rivet_axis(rivet)
        along = (tail - head) / np.linalg.norm(tail - head)
        line = head + np.linspace(-2.0, np.linalg.norm(tail - head), 200)[:, None] * along
        seen = [phantom.materials[k] for k, _ in itertools.groupby(at(phantom, line))]
        assert seen[0] == "air" and seen[-1] == "air", seen  # from outside to the cavity
        assert "water" in seen and "cellulose" in seen, seen


@SEEDS
def test_no_seed_lies_outside_the_pepper(seed: int) -> None:
    phantom = made("bell_pepper", seed)
    outside = pieces_of(mask(phantom, "air"))
    closed = outside != outside[0, 0, 0]
    assert mask(phantom, "air")[closed].mean() > 0.2  # the cavity is sealed
    # In the dimple, a level cut meets the stalk and the wall about it, and nothing else.
    for layer in closed[int(0.65 * N) : int(0.85 * N)]:
        pieces = pieces_of(layer, np.ones((3, 3)))
        for k in range(1, pieces.max() + 1):
            found = np.argwhere(pieces == k)
            off = math.hypot(*(found.mean(0) + 0.5 - N / 2))
            assert len(found) >= 20 or off > 0.15 * N


@SEEDS
def test_rivets_sit_in_stem_and_florets(seed: int) -> None:
    phantom = made("broccoli", seed)
    rivets = [s for s in phantom.solids if s.metal]
    assert len(rivets) == 4
    for rivet in rivets[:2]:
        head, tail = rivet_axis(rivet)
        assert at(phantom, np.linspace(head, tail, 50)).all(), rivet.name
    for rivet in rivets[2:]:
        head, tail = rivet_axis(rivet)
        assert np.count_nonzero(at(phantom, np.linspace(head, tail, 50))) > 15, rivet.name


@SEEDS
def test_three_rods_stand_in_the_cups_floor(seed: int) -> None:
    phantom = made("metal_rods", seed)
    rods = [s for s in phantom.solids if s.metal]
    cup, space, water = [s.primitives[0] for s in phantom.solids if not s.metal]
    assert len(rods) == 3  # as in the paper
    floor = space.centre[2] - space.params[0]
    assert water.centre[2] - water.params[0] == pytest.approx(floor)
    for rod in rods:
        (piece,) = rod.primitives
        foot = piece.centre[2] - piece.params[0]
        assert cup.centre[2] - cup.params[0] < foot < floor, rod.name
        assert math.hypot(*piece.centre[:2]) + piece.params[1] < space.params[1], rod.name


def test_the_scanned_broccoli_is_not_the_synthetic_one() -> None:
    grown: dict[tuple[Recipe, int], NDArray[np.bool_]] = {}

    def head(suite: str) -> NDArray[np.bool_]:
        (one,) = [s for s in load_suite(SUITES / f"{suite}.toml") if s.phantom.recipe == "broccoli"]
        small = msgspec.structs.replace(one.phantom, n_voxel=(48, 48, 48))
        if (small, one.seed) not in grown:
            grown[small, one.seed] = build_recipe(small, one.seed).labels > 0
        return grown[small, one.seed]

    own = head("lookalike")
    for suite in ("quick", "core", "paper"):
        # two heads that fill the same part of the cube share some voxels; a head shares all with itself
        assert (own & head(suite)).sum() / (own | head(suite)).sum() < 0.9
