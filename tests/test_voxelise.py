"""Phantoms on the reconstruction grid: closed-form volumes, exact overlaps, paint order."""

import math

import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, MATERIAL, MATRIX, PARAMS, TORUS, Primitive, Solid, pack
from ctsim.tracer import voxelise
from ctsim.tracer.kernels import solids_reference, voxelise_cpu, voxelise_reference
from ctsim.types import Phantom

MATERIALS = ("air", "water", "Fe", "Ti")
MU = {"water": 0.02, "Fe": 1.5, "Ti": 0.5}


def geometry(shape, pitch, offset=(0.0, 0.0, 0.0)):
    return Geometry(
        dso=100, dsd=200, n_voxel=shape, d_voxel=pitch, off_origin=offset,
        n_detector=(4, 4), d_detector=(1.0, 1.0), n_views=4,
    )  # fmt: skip


def solid(kind, params, material="Fe", metal=True, **where):
    where.setdefault("centre", (0.0, 0.0, 0.0))
    return Solid(name="s", material=material, metal=metal, primitives=(Primitive(kind=kind, params=params, **where),))


def phantom(*solids, labels=None, pitch=(20.0, 20.0, 20.0), density=None):
    labels = np.ones((1, 1, 1), np.uint8) if labels is None else labels
    return Phantom(labels=labels, materials=MATERIALS, d_voxel=pitch, solids=solids, density=density)


VOLUMES = [
    (ELLIPSOID, (2.0, 2.0, 2.0), 4 / 3 * math.pi * 8),
    (ELLIPSOID, (1.0, 2.5, 4.0), 4 / 3 * math.pi * 10),
    (FRUSTUM, (3.0, 1.5, 1.5), math.pi * 1.5**2 * 6),
    (FRUSTUM, (3.0, 0.0, 2.0), math.pi / 3 * 6 * 4),
    (CAPSULE, (3.0, 1.0), math.pi * 6 + 4 / 3 * math.pi),
    (BOX, (1.0, 2.0, 3.5), 56.0),
    (BOX, (2.0, 0.03, 3.5), 8 * 2 * 0.03 * 3.5),
    (TORUS, (3.0, 1.0), 2 * math.pi**2 * 3),
]


@pytest.mark.parametrize(("kind", "params", "volume"), VOLUMES)
@pytest.mark.parametrize("pitch", [(0.5, 0.5, 0.5), (0.6, 0.45, 0.33)])
def test_solids_keep_their_volume(kind, params, volume, pitch):
    prim = solid(kind, params, centre=(0.1, 0.2, -0.13), axis=(0.3, -0.5, 0.7), spin=0.3)
    got = voxelise.fractions(phantom(prim), geometry((24, 28, 36), pitch))
    # Errors of single voxels are below 1/250 and of either sign; over a hundred surface voxels they average out.
    assert got["Fe"].sum(dtype=float) * math.prod(pitch) == pytest.approx(volume, rel=5e-4)
    total = sum(v.astype(float) for v in got.values())
    np.testing.assert_allclose(total, 1, atol=1e-5)
    assert all(v.dtype == np.float32 and v.min() >= 0 for v in got.values())


def sample(kernel, solids, grid, cells, dtype, sought=(False, False)):
    """Touched voxels [z, y, x] and, of those the fast kernel touches, the shares [k, channel] of Fe and Ti."""
    prims, shape = pack(solids, ("Fe", "Ti")), grid.n_voxel
    start, pitch = np.array([c[0] for c in grid.voxel_centres()]), np.array(grid.d_voxel)
    touched, listed = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    kernel.mark(prims, start, pitch, touched)
    voxelise_cpu.mark(prims, start, pitch, listed)
    index = np.flatnonzero(listed)
    first = np.searchsorted(index, np.arange(shape[0] + 1) * (shape[1] * shape[2]))
    share = np.zeros((len(index), 2), dtype)
    channel, sought = prims[:, MATERIAL].astype(np.int64), np.array(sought)
    kernel.cover(prims, channel, start, pitch, (cells,) * 3, shape, index, first, sought, share)
    return touched, share


@pytest.mark.parametrize(("kind", "params", "volume"), VOLUMES)
def test_each_voxel_agrees_with_the_reference(kind, params, volume):
    """Of a voxel's n³ sample points about 1.5n² parts are cut, each wrong by 1/√12 of a part: 0.35/n² rms.

    To this the fast kernel adds 1/1600 rms. Single voxels get its 1/250 and six times the rms of the points.
    """
    prim, n = solid(kind, params, centre=(0.1, 0.2, -0.13), axis=(0.3, -0.5, 0.7), spin=0.3), 24
    grid = geometry((5, 7, 11), (1.3, 1.1, 0.9))
    touched, fast = sample(voxelise_cpu, [prim], grid, 8, np.float32)
    held, slow = sample(voxelise_reference, [prim], grid, n, np.float64)
    cut = (slow[:, 0] > 0) & (slow[:, 0] < 1)
    assert cut.sum() > 30
    assert np.sqrt(np.mean((fast - slow)[cut, 0] ** 2)) < 1 / 1600 + 0.35 / n**2
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1 / 250 + 6 * 0.35 / n**2)
    assert not slow[:, 1].any() and not fast[:, 1].any()
    assert not (held > touched).any()


@pytest.mark.parametrize("sought", [(True, False), (False, True), (True, True)])
def test_a_slice_is_left_where_half_a_voxel_of_what_is_sought_is_found(sought):
    solids = [solid(ELLIPSOID, (2.5, 2.0, 2.2)), solid(BOX, (0.9, 0.9, 0.9), "Ti", centre=(1.1, 0.6, 0.2))]
    grid = geometry((6, 5, 5), (0.9, 0.9, 0.9))
    _, fast = sample(voxelise_cpu, solids, grid, 8, np.float32, sought)
    _, slow = sample(voxelise_reference, solids, grid, 24, np.float64, sought)
    _, whole = sample(voxelise_cpu, solids, grid, 8, np.float32)
    assert np.array_equal(fast.any(1), slow.any(1)) and 0 < fast.any(1).sum() < whole.any(1).sum()
    assert np.array_equal(fast[fast.any(1)], whole[fast.any(1)])


@pytest.mark.parametrize("tilt", [0.0, 0.4])
@pytest.mark.parametrize("pitch", [0.2, 0.7, 1.3])
def test_planes_with_metal_are_those_of_the_mask(tilt, pitch):
    """Of a thin plate, a rod, and a ball that lies in a hole of tissue."""
    solids = (
        solid(BOX, (3.0, 2.0, 0.3), axis=(tilt, 0.1, 1.0)),
        solid(CAPSULE, (3.0, 0.4), "Ti", centre=(-2.0, 1.0, 2.0), axis=(0.3, 0.2, 1.0)),
        solid(BOX, (2.0, 2.0, 2.0), "water", metal=False, centre=(1.0, 0.0, -4.0)),
        solid(ELLIPSOID, (0.8, 0.8, 0.8), centre=(1.0, 0.0, -4.0)),
    )
    n = round(14 / pitch)
    body, grid = phantom(*solids), geometry((n, n, n), (pitch,) * 3)
    planes = voxelise.metal_planes(body, grid)
    assert np.array_equal(planes, voxelise.metal_mask(body, grid).any((1, 2))) and 0 < planes.sum() < n


def test_solids_that_cross_agree_with_the_reference():
    """Beside the errors of one surface: where two cross, 24 of 512 sub-cells may be wrong by a quarter each."""
    solids = (
        solid(ELLIPSOID, (2.5, 2.0, 2.2), axis=(1, 2, 3)),
        solid(FRUSTUM, (3.0, 0.8, 1.2), "Ti", centre=(0.3, 0.0, 0.2), axis=(1, 0.3, 0.2)),
        solid(BOX, (0.5, 2.6, 0.7), centre=(-0.4, 0.5, 0.0), axis=(0.2, 0.1, 1)),
    )
    grid = geometry((5, 7, 11), (1.1, 0.9, 0.7))
    _, fast = sample(voxelise_cpu, solids, grid, 8, np.float32)
    _, slow = sample(voxelise_reference, solids, grid, 24, np.float64)
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1 / 250 + 6 * 0.35 / 24**2 + 24 / 4 / 512)
    assert ((slow > 0.1).sum(1) == 2).sum() > 5  # voxels that both materials share
    _, swapped = sample(voxelise_reference, solids[::-1], grid, 24, np.float64)
    assert np.abs(swapped - slow).max() > 0.5


@pytest.mark.parametrize(
    ("kind", "params", "volume", "surface"),
    [
        (ELLIPSOID, (2.0, 2.0, 2.0), 4 / 3 * math.pi * 8, 16 * math.pi),
        (FRUSTUM, (3.0, 1.5, 1.5), math.pi * 1.5**2 * 6, 2 * math.pi * 1.5 * (6 + 1.5)),
        (TORUS, (3.0, 1.0), 2 * math.pi**2 * 3, 4 * math.pi**2 * 3),
    ],
)
def test_the_reference_keeps_closed_form_volumes(kind, params, volume, surface):
    """A surface A cuts about 1.5·A/h² parts of size h, each wrong by h³/√12; four standard deviations."""
    prim, n = solid(kind, params, centre=(0.1, 0.2, -0.13), axis=(0.3, -0.5, 0.7)), 12
    _, share = sample(voxelise_reference, [prim], geometry((9, 10, 11), (1.0, 1.0, 1.0)), n, np.float64)
    assert share.sum() == pytest.approx(volume, abs=4 * math.sqrt(1.5 * surface / 12) / n**2)


@pytest.mark.parametrize(("kind", "params"), [(ELLIPSOID, (2.0, 2, 2)), (CAPSULE, (3.0, 1.0)), (TORUS, (3.0, 1.0))])
def test_the_share_of_a_cell_agrees_with_the_reference(kind, params):
    """The fast kernel takes every face as if it ran along the cell.

    A face normal to a space diagonal errs most: with the distribution of the sum of three uniform numbers,
    t(3/4 − 1/√3) − t³/3 at its maximum, 0.048. A curvature 1/r adds w/8r, the points two of their 1/24².
    """
    row, rng, width = solid(kind, params, axis=(0.3, -0.5, 0.7)).primitives[0].row(2), np.random.default_rng(0), 0.1
    errors = []
    while len(errors) < 100:
        x, y, z = rng.uniform(-row[21], row[21], 3)
        want = voxelise_reference.share(row, x, y, z, width) if abs(voxelise_cpu.bound(row, x, y, z)) < width else 0
        if 0 < want < 1:
            errors.append(voxelise_cpu.share(row, x, y, z, width) - want)
    assert np.abs(errors).max() < 0.048 + width / 8 + 2 / 24**2
    assert abs(np.mean(errors)) < 4 * np.std(errors) / 10  # of either sign, so that they average out in a voxel


@pytest.mark.parametrize(("kind", "params", "volume"), VOLUMES)
def test_the_bound_never_exceeds_the_distance(kind, params, volume):
    """The stretch between a point inside and one outside is as long as both distances, so no bound may be longer."""
    row, rng = solid(kind, params, axis=(0.3, -0.5, 0.7)).primitives[0].row(2), np.random.default_rng(0)
    reach = 1.2 * row[PARAMS][:3] if kind == BOX else row[21]  # a thin box would hold no point of a cube
    points = rng.uniform(-1, 1, (600, 3)) * reach @ row[MATRIX].reshape(3, 3)
    bound = np.array([voxelise_cpu.bound(row, *p) for p in points])
    inside = np.array([solids_reference.inside(row, *p) for p in points])
    assert inside.sum() > 20 and (~inside).sum() > 20
    np.testing.assert_array_equal(bound <= 0, inside)
    apart = np.linalg.norm(points[inside][:, None] - points[~inside][None], axis=2)
    assert (bound[~inside][None] - bound[inside][:, None] <= apart + 1e-12).all()


@pytest.mark.parametrize("dense", [False, True])
def test_averages_equal_the_reference(dense):
    rng = np.random.default_rng(3)
    labels = rng.integers(0, 4, (5, 7, 11)).astype(np.uint8)
    density = rng.uniform(0.5, 1.5, labels.shape).astype(np.float32) if dense else np.zeros((0, 0, 0), np.float32)
    body, grid = phantom(labels=labels, pitch=(0.5, 0.4, 0.3)), geometry((7, 11, 5), (0.4, 0.3, 0.9), (0.1, 0.2, 0.4))
    axes = [voxelise._overlap(body, grid, axis) for axis in range(3)]
    first, weights, counts = (tuple(part) for part in zip(*axes, strict=True))
    fast, slow = np.empty(grid.n_voxel, np.float32), np.empty(grid.n_voxel)
    for kernel, out in ((voxelise_cpu, fast), (voxelise_reference, slow)):
        kernel.average(labels, density, np.array([0, 0.02, 1.5, 0.5]), first, weights, counts, out)
    np.testing.assert_allclose(fast, slow, rtol=2**-23)  # float64 sums, rounded once to float32
    assert slow.min() == 0 and slow.max() > 0.5


def test_aligned_box_is_exact():
    got = voxelise.fractions(phantom(solid(BOX, (1.25, 1.1, 0.6))), geometry((4, 4, 4), (1.0, 1.0, 1.0)))["Fe"]
    x, y, z = ([max(min(i + 1, h) - max(i, -h), 0) for i in range(-2, 2)] for h in (1.25, 1.1, 0.6))
    np.testing.assert_allclose(got, np.einsum("k,j,i->kji", z, y, x), atol=1e-6)


def test_coinciding_grids_are_exact():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 4, (5, 7, 11)).astype(np.uint8)
    density = rng.uniform(0.5, 1.5, labels.shape).astype(np.float32)
    body = phantom(labels=labels, pitch=(0.3, 0.2, 0.7), density=density)
    grid = geometry((5, 7, 11), (0.3, 0.2, 0.7))
    got = voxelise.fractions(body, grid)
    for k, name in enumerate(MATERIALS):
        np.testing.assert_array_equal(got[name], (labels == k) * (density if k else np.float32(1)))
    np.testing.assert_array_equal(voxelise.label_volume(body, grid), labels)
    table = np.array([0, 0.02, 1.5, 0.5])
    np.testing.assert_allclose(voxelise.attenuation_volume(body, grid, MU), table[labels] * density, rtol=1e-6)
    assert not voxelise.metal_mask(body, grid).any()  # labels are body, whatever their material


def test_other_grids_average_by_overlap():
    """Integer refinement is a block mean; a shifted, larger grid keeps the mass and adds air."""
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 4, (10, 14, 22)).astype(np.uint8)
    body = phantom(labels=labels, pitch=(0.5, 0.5, 0.5))
    got = voxelise.fractions(body, geometry((5, 7, 11), (1.0, 1.0, 1.0)))
    for k, name in enumerate(MATERIALS):
        want = (labels == k).reshape(5, 2, 7, 2, 11, 2).mean((1, 3, 5))
        np.testing.assert_allclose(got[name], want, atol=1e-6)
    pitch = (0.37, 0.91, 0.7)
    shifted = voxelise.fractions(body, geometry((20, 12, 22), pitch, (0.4, -0.3, 0.9)))
    for k, name in enumerate(MATERIALS[1:], 1):
        mass = shifted[name].sum(dtype=float) * math.prod(pitch)
        assert mass == pytest.approx((labels == k).sum() * 0.125, rel=1e-5)
    np.testing.assert_allclose(sum(shifted.values()), 1, atol=1e-5)


@pytest.mark.parametrize("pitch", [(1.0, 1.0, 1.0), (0.37, 0.91, 0.7), (1.5, 1.5, 1.5)])
def test_labels_are_what_fills_most_of_a_voxel_with_and_without_solids(pitch):
    """The pass over the body that serves all materials finds what one over each material finds, ties included."""
    labels = np.random.default_rng(2).integers(0, 4, (10, 14, 22)).astype(np.uint8)
    labels[:4] = 1
    parts = solid(ELLIPSOID, (1.8, 1.2, 2.2)), solid(BOX, (1.0, 2.0, 0.5), "Ti", metal=False, centre=(2.0, 0.3, -1.0))
    grid = geometry((8, 9, 13), pitch, (0.4, -0.3, 0.2))
    for solids in ((), parts):
        body = phantom(*solids, labels=labels, pitch=(0.5, 0.5, 0.5))
        want = np.stack(list(voxelise.fractions(body, grid).values())).argmax(0)  # the first of equals
        assert len(np.unique(want)) == 4
        np.testing.assert_array_equal(voxelise.label_volume(body, grid), want)
        shared = voxelise.label_volume(body, grid, voxelise.cover_of(body, grid), voxelise.body_labels(body, grid))
        np.testing.assert_array_equal(shared, want)


def test_later_solids_cover_earlier_ones():
    outer, inner = solid(ELLIPSOID, (3.0, 3, 3)), solid(ELLIPSOID, (2.0, 2, 2), "Ti")
    grid = geometry((20, 20, 20), (0.4, 0.4, 0.4))
    got = voxelise.fractions(phantom(outer, inner), grid)
    ball = 4 / 3 * math.pi * 0.4**-3
    assert got["Ti"].sum(dtype=float) == pytest.approx(8 * ball, rel=1e-3)
    assert got["Fe"].sum(dtype=float) == pytest.approx(19 * ball, rel=1e-3)
    hidden = voxelise.fractions(phantom(inner, outer), grid)
    assert hidden["Ti"].max() < 1e-6
    halves = [solid(BOX, (2.0, 2, 2), m, centre=(c, 0, 0)) for m, c in (("Fe", -1.9), ("Ti", 2.1))]
    touching = voxelise.fractions(phantom(*halves), grid)  # they meet at x = 0.1, inside a voxel
    np.testing.assert_allclose(touching["Fe"][10, 10, 10], 0.25, atol=1e-6)
    np.testing.assert_allclose(touching["Ti"][10, 10, 10], 0.75, atol=1e-6)


def test_a_hole_is_air_and_no_metal():
    plate, hole = solid(BOX, (3.0, 3, 1)), solid(FRUSTUM, (2.0, 1, 1), "air", metal=False)
    grid = geometry((11, 24, 24), (0.3, 0.3, 0.3))
    mask = voxelise.metal_mask(phantom(plate, hole), grid)
    assert mask.dtype == np.uint8
    assert mask[5, 12, 12] == 0 and mask[5, 12, 20] == 1
    labels = voxelise.label_volume(phantom(plate, hole), grid)
    assert labels[5, 12, 12] == 0 and labels[5, 12, 20] == 2 and labels[0, 0, 0] == 1


def test_metal_of_two_materials_counts_together():
    halves = [solid(BOX, (2.0, 2, 2), m, centre=(c, 0, 0)) for m, c in (("Fe", -2.0), ("Ti", 2.0))]
    grid = geometry((3, 3, 3), (1.0, 1.0, 1.0))  # the middle column is half Fe, half Ti
    assert voxelise.metal_mask(phantom(*halves), grid).all()
    assert voxelise.metal_mask(phantom(*halves).without_metal(), grid).sum() == 0


def test_attenuation_is_the_sum_of_fractions():
    rng = np.random.default_rng(2)
    labels = rng.integers(0, 2, (6, 6, 6)).astype(np.uint8)
    density = rng.uniform(0.5, 1.5, labels.shape).astype(np.float32)
    solids = (solid(TORUS, (2.0, 0.6)), solid(CAPSULE, (2.0, 0.5), "Ti", axis=(1, 1, 0)))
    body = phantom(*solids, labels=labels, pitch=(1.0, 1.0, 1.0), density=density)
    grid = geometry((9, 11, 13), (0.6, 0.7, 0.5), (0.1, 0.2, 0.0))
    shares = voxelise.fractions(body, grid)
    want = sum(shares[name] * MU[name] for name in MU)
    np.testing.assert_allclose(voxelise.attenuation_volume(body, grid, MU), want, atol=2e-6)
    with pytest.raises(InputError, match="missing: Ti"):
        voxelise.attenuation_volume(body, grid, {"water": 1.0, "Fe": 1.0})


def test_solids_outside_and_flat_ones_change_nothing():
    grid = geometry((5, 5, 5), (1.0, 1.0, 1.0))
    far, flat = solid(ELLIPSOID, (1.0, 1, 1), centre=(50.0, 0, 0)), solid(BOX, (1.0, 0.0, 1.0))
    got = voxelise.fractions(phantom(far, flat), grid)
    assert got["Fe"].max() == 0 and got["water"].min() == 1


def test_results_do_not_depend_on_the_number_of_threads():
    body = phantom(solid(TORUS, (2.0, 0.6)), solid(CAPSULE, (2.0, 0.5), "Ti", axis=(1, 1, 0)))
    grid = geometry((9, 11, 13), (0.6, 0.7, 0.5))
    one, several = one_and_several(lambda: voxelise.attenuation_volume(body, grid, MU))
    assert np.array_equal(one, several)
