"""Phantoms on the reconstruction grid: closed-form volumes, exact overlaps, paint order."""

import math

import numpy as np
import pytest

from ctsim import voxelise
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels import solids_cpu
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid
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


@pytest.mark.parametrize(("kind", "params", "volume"), VOLUMES)
def test_each_voxel_agrees_with_dense_sampling(kind, params, volume):
    """Midpoint sampling of 24³ points per surface voxel errs by about 1/24² there; the bound adds both errors."""
    prim = solid(kind, params, centre=(0.1, 0.2, -0.13), axis=(0.3, -0.5, 0.7), spin=0.3)
    grid = geometry((7, 11, 9), (1.1, 0.9, 1.0))
    got = voxelise.fractions(phantom(prim), grid)["Fe"]
    row, (z, y, x) = prim.primitives[0].row(2), grid.voxel_centres()
    sub = (np.arange(24) + 0.5) / 24 - 0.5
    for at in np.argwhere((got > 0) & (got < 1))[::5]:
        k, j, i = at
        hits = sum(
            solids_cpu.inside(row, x[i] + dx, y[j] + 0.9 * dy, z[k] + 1.1 * dz)
            for dz in sub for dy in sub for dx in sub
        )  # fmt: skip
        assert got[k, j, i] == pytest.approx(hits / 24**3, abs=1 / 250 + 2 / 24**2)


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
    import numba

    body = phantom(solid(TORUS, (2.0, 0.6)), solid(CAPSULE, (2.0, 0.5), "Ti", axis=(1, 1, 0)))
    grid, before = geometry((9, 11, 13), (0.6, 0.7, 0.5)), numba.get_num_threads()
    try:
        volumes = []
        for n in {1, before}:
            numba.set_num_threads(n)
            volumes.append(voxelise.attenuation_volume(body, grid, MU))
    finally:
        numba.set_num_threads(before)
    assert all(np.array_equal(volumes[0], v) for v in volumes)
