"""Lattices projected by columns, against splat by splat."""

import msgspec
import numba
import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH, decay, load, spread, store
from ctsim.reconstruct.splat.columns import LatticeProjector
from ctsim.reconstruct.splat.kernels import separable_cpu as kernels
from ctsim.reconstruct.splat.kernels import splat_reference as reference
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.project import CUTOFF, Projector

GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(11, 14, 12),
    d_voxel=(0.8, 0.8, 0.9),
    n_detector=(30, 34),
    d_detector=(1.3, 1.2),
    n_views=7,
    off_origin=(1.5, -0.3, 0.2),
    off_detector=(3.4, -0.7),
)
VIEWS = np.array([0, 2, 5])


def lattice_of(geometry):
    support = np.random.default_rng(3).random(geometry.n_voxel) < 0.6
    return Lattice(geometry=geometry, support=support)


def both(geometry, lattice):
    """Forward projections by columns and splat by splat, exactly."""
    values = np.random.default_rng(0).uniform(-1, 1, (len(lattice), 2)).astype(np.float32)
    splats = lattice.splats(values * np.float32(lattice.unit))
    exact = Projector(geometry=geometry, tolerance=0).forward(splats.shapes(), splats.densities, VIEWS)
    projector = LatticeProjector(geometry, lattice)
    found = projector.pictures(projector.forward(values, VIEWS))
    return found, exact[..., : geometry.n_detector[1]], values


def shifted(geometry, **changes):
    return msgspec.structs.replace(geometry, **changes)


@pytest.mark.parametrize(
    "geometry",
    [
        GEOMETRY,
        shifted(GEOMETRY, off_detector=(0.0, 12.0)),
        shifted(GEOMETRY, n_detector=(6, 5)),
        shifted(GEOMETRY, d_detector=(0.15, 0.15)),
    ],
    ids=["whole", "shifted", "truncated", "fine"],
)
def test_columns_agree_with_splats(geometry):
    lattice = lattice_of(geometry)
    projector = LatticeProjector(geometry, lattice)
    assert projector.by_columns
    found, exact, _ = both(geometry, lattice)
    # S_uv is left out, within uv/dsd² = (20/400)² = 2.5e-3 of S_uu; EWA within 1e-3 of a peak; a handful overlap
    peak = np.abs(exact).max()
    assert np.abs(found - exact).max() < 4e-3 * peak
    found, exact = found.astype(np.float64), exact.astype(np.float64)
    assert found.sum() == pytest.approx(exact.sum(), abs=1e-3 * np.abs(exact).sum())


def test_exact_splats_are_those_of_the_exact_projector_and_its_transpose():
    lattice = lattice_of(GEOMETRY)
    projector, exact = LatticeProjector(GEOMETRY, lattice, exact=True), Projector(geometry=GEOMETRY, tolerance=0)
    assert not projector.by_columns
    values = np.random.default_rng(0).uniform(-1, 1, (len(lattice), 2)).astype(np.float32)
    shapes, ewa = lattice.splats(values).shapes(), LatticeProjector(GEOMETRY, lattice)
    found, expected = projector.forward(values, VIEWS), exact.forward(shapes, values, VIEWS)
    np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(projector.pictures(found), ewa.pictures(ewa.forward(values, VIEWS)))
    images = projector.arranged(np.random.default_rng(1).random((len(VIEWS), 2, *GEOMETRY.n_detector), np.float32))
    np.testing.assert_array_equal(projector.adjoint(images, VIEWS), exact.adjoint(shapes, images, VIEWS))


def test_each_column_is_its_product_of_gaussians_to_float32():
    lattice = lattice_of(GEOMETRY)
    projector, exact = LatticeProjector(GEOMETRY, lattice), Projector(geometry=GEOMETRY, tolerance=np.inf)
    shapes = lattice.splats(np.zeros((len(lattice), 1), np.float32)).shapes().astype(np.float64)
    for splat, view in zip(np.random.default_rng(2).integers(0, len(lattice), 12), np.arange(12) % 7, strict=True):
        one = np.zeros((len(lattice), 2), np.float32)
        one[splat] = 1, -2
        found = projector.pictures(projector.forward(one, np.array([view])))[0]
        camera = exact.cameras[view]
        (expected,) = reference.separable_weights(shapes[:, [splat]], camera, *GEOMETRY.n_detector)
        peak, inside = expected.max(), expected > 3 * expected.max() * np.exp(-0.5 * CUTOFF**2)
        # float32 knows the row, up to 30, to 2e-6, hence a shadow of half a row to a few of these
        np.testing.assert_allclose(found[0][inside], expected[inside], rtol=1e-4, atol=1e-5 * peak)
        beyond = found[0][~inside]
        assert np.minimum(abs(beyond), abs(beyond - expected[~inside])).max() < 1e-5 * peak  # cut off, or right
        np.testing.assert_allclose(found[1], -2 * found[0], rtol=1e-6)


@numba.njit
def powers(exponents, least, out):
    for k in range(0, exponents.shape[1], WIDTH):
        store(out, 0, k, decay(load(exponents, 0, k), spread(least)))


def test_powers_of_two_are_right_down_to_the_cutoff_and_none_beyond():
    exponents = np.linspace(-300, 0, 1 << 16, dtype=np.float32)[None]
    least, found = np.float32(-0.5 * np.log2(np.e) * CUTOFF**2), np.empty_like(exponents)
    powers(exponents, least, found)
    np.testing.assert_allclose(found, np.where(exponents >= least, 2.0**exponents, 0), rtol=4e-6, atol=0)


@pytest.mark.parametrize(
    ("height", "d_z", "in_step"),
    [
        *((height, 0.8, False) for height in (0.3, 1.0, 3.0)),  # 0.2, 0.6 and 1.9 splats a row
        *((height, 0.8, True) for height in (1.15, 1.3, 1.6, 2.0, 2.6)),  # 0.7 to 1.6
        (0.4, 0.2, True),  # splats that reach four rows
        (0.04, 0.02, False),  # that reach nineteen
    ],
)
@pytest.mark.parametrize("way", ["up", "down"])
def test_tall_runs_hold_every_pair_of_splat_and_row(height, d_z, in_step, way):
    """In step where splats are as far apart as rows and few rows wide, and rows go up; in pairs elsewhere."""
    n_v = int(100 * d_z / height)  # the shadow has half as many again
    geometry = shifted(GEOMETRY, n_voxel=(70, 3, 2), n_detector=(n_v, 9), d_detector=(height, 1.2))
    geometry = shifted(geometry, d_voxel=(d_z, 0.8, 0.9))
    a_row, sigma = height / 2 / d_z, 0.45 * (d_z * 0.8 * 0.9) ** (1 / 3) * 2 / height
    _, n = kernels._passing.py_func(a_row, a_row * CUTOFF * (sigma**2 + 1 / 12) ** 0.5)
    assert kernels._in_step.py_func(a_row, n) == in_step
    if way == "down":
        geometry = downwards(geometry)
    support = np.ones(geometry.n_voxel, bool)
    support[[0, 7, 40, 41, 58, 69], 1] = False
    lattice = Lattice(geometry=geometry, support=support)
    projector, camera = LatticeProjector(geometry, lattice), Projector(geometry=geometry, tolerance=np.inf).cameras[2]
    assert projector.by_columns
    r = np.random.default_rng(8)
    values, picture = r.uniform(-1, 1, (len(lattice), 2)).astype(np.float32), r.uniform(-1, 1, (2, n_v, 9))
    weights, rim = cut_off(lattice, camera, n_v, 9)
    # a row is known to three roundings of up to n_v, hence a shadow to CUTOFF/√S_vv of these, S_vv > 1/12
    share = 1e-5 + CUTOFF * 12**0.5 * 3 * n_v * 2.0**-24
    found = projector.pictures(projector.forward(values, np.array([2])))[0]
    bound = np.einsum("svu,sc->cvu", share * weights + rim, np.abs(values))
    assert np.all(np.abs(found - np.einsum("svu,sc->cvu", weights, values)) <= bound)
    sums = projector.adjoint(projector.arranged(picture[None].astype(np.float32)), np.array([2]))
    bound = np.einsum("svu,cvu->sc", share * weights + rim, np.abs(picture))
    assert np.all(np.abs(sums - np.einsum("svu,cvu->sc", weights, picture)) <= bound + 1e-7 * np.abs(sums).max())


def cut_off(lattice, camera, n_v, n_u):
    """Return the weights [splat, v, u] within the cutoff, and those so close to it that rounding may decide."""
    shapes = lattice.splats(np.zeros((len(lattice), 1), np.float32)).shapes().astype(np.float64)
    weights, (_, boxed) = (reference.separable_weights(shapes, camera, n_v, n_u), reference.spreads(shapes, camera))
    u, v = (c[:, None] for c in reference.shadow(shapes, camera)[0].T)
    along_v, along_u = (
        (np.arange(n_v) - v) ** 2 / boxed[:, 1, 1, None],
        (np.arange(n_u) - u) ** 2 / boxed[:, 0, 0, None],
    )
    farthest = np.maximum(along_v[:, :, None], along_u[:, None])
    return weights * (farthest <= CUTOFF**2), weights * (abs(farthest - CUTOFF**2) < 1e-2)


def downwards(geometry):
    """Return the geometry with the detector's rows counted from the top."""
    poses = geometry.pose_array()
    poses[:, 9:12] *= -1
    return shifted(geometry, poses=tuple(tuple(row) for row in poses.tolist()))


def on_the_rim(geometry, lattice, below):
    """Shift the detector so that the cutoff of the only splat in view 0 is so many rows below a row."""

    def rim(geometry):
        projector, place = LatticeProjector(geometry, lattice), np.empty(kernels.PLACE)
        x, y, z = map(float, lattice.positions[0])
        camera = projector._projector.cameras[0]
        assert kernels._place(camera, x, y, lattice.scale, place)
        return kernels._row(camera, place, z) + kernels._reach_v(camera, place, z, z)

    v, u = geometry.off_detector
    per_mm = rim(shifted(geometry, off_detector=(v + 1, u))) - rim(geometry)
    lacking = np.ceil(rim(geometry)) - below - rim(geometry)
    return shifted(geometry, off_detector=(v + lacking / per_mm, u))


def matrices(geometry, lattice):
    """Weights of view 0 as projecting and its transpose have them, [splat, pixel]."""
    projector, view = LatticeProjector(geometry, lattice), np.array([0])
    splats = np.eye(len(lattice), dtype=np.float32)[:, :, None].repeat(2, 2)
    forward = np.stack([projector.pictures(projector.forward(one, view))[0, 0].ravel() for one in splats])
    pixels = np.eye(forward.shape[1], dtype=np.float32).reshape(-1, 1, 1, *geometry.n_detector).repeat(2, 2)
    return forward, np.stack([projector.adjoint(projector.arranged(one), view)[:, 0] for one in pixels], 1)


@pytest.mark.slow
@pytest.mark.parametrize("z", range(2, 8))
def test_rounding_at_the_cutoff_is_the_same_in_both_directions(z):
    geometry, support = shifted(GEOMETRY, n_detector=(13, 11)), np.zeros(GEOMETRY.n_voxel, bool)
    support[z, 7, 7] = True
    lattice, taken = Lattice(geometry=geometry, support=support), set()
    for below in np.linspace(-2e-6, 2e-6, 21):
        forward, back = matrices(on_the_rim(geometry, lattice, below), lattice)
        assert np.array_equal(forward > 0, back > 0)
        taken.add(np.count_nonzero(forward.reshape(13, 11).any(1)))
    assert len(taken) > 1  # the row at the rim was in and out


@pytest.mark.parametrize("case", ["up", "down", "coarse"])
def test_both_directions_take_the_same_pairs(case):
    geometry = shifted(GEOMETRY, n_detector=(13, 11))
    if case == "coarse":
        geometry = shifted(geometry, n_detector=(3, 2), d_detector=(8.0, 8.0))
    if case == "down":
        geometry = downwards(geometry)
    support = np.zeros(geometry.n_voxel, bool)
    support[1:10, 6, 5], support[[0, 2, 3, 7], 7, 7] = True, True
    lattice = Lattice(geometry=geometry, support=support)
    forward, back = matrices(geometry, lattice)
    assert np.array_equal(forward > 0, back > 0) and np.count_nonzero(forward) > len(lattice)
    np.testing.assert_allclose(forward, back, rtol=1e-5)


def test_splats_of_nothing_change_no_bit():
    """At the ends of a run, within it, and all of a run: they are skipped, or add zero."""
    lattice = lattice_of(GEOMETRY)
    values = np.random.default_rng(5).uniform(0.1, 1, (len(lattice), 2)).astype(np.float32)
    values[np.random.default_rng(6).random(len(lattice)) < 0.5] = 0
    z = lattice.positions[:, 2]
    values[(z < -2) | (z > 3) | (lattice.positions[:, 0] > 2)] = 0
    found = LatticeProjector(GEOMETRY, lattice).forward(values, VIEWS)
    hardly = np.where(values.any(1), np.float32(0), np.float32(1e-30))[:, None]  # no bit of a sum, but not zero
    whole = LatticeProjector(GEOMETRY, lattice).forward(values + hardly, VIEWS)
    assert np.array_equal(np.where(whole > 1e-25, whole, 0), np.where(found > 1e-25, found, 0))
    assert (found == 0).any() and (np.abs(whole) < 1e-25)[found == 0].all() and (found > 0.1).any()


def test_no_splats_and_no_views_are_none():
    lattice = Lattice(geometry=GEOMETRY, support=np.zeros(GEOMETRY.n_voxel, bool))
    projector = LatticeProjector(GEOMETRY, lattice)
    images = projector.forward(np.zeros((0, 2), np.float32), VIEWS)
    assert not images.any() and projector.adjoint(images, VIEWS).shape == (0, 2)
    some, none = lattice_of(GEOMETRY), np.array([], np.int64)
    projector = LatticeProjector(GEOMETRY, some)
    images = projector.forward(np.ones((len(some), 2), np.float32), none)
    assert images.shape[0] == 0 and not projector.adjoint(images, none).any()


def test_a_tilted_detector_goes_splat_by_splat():
    poses = GEOMETRY.pose_array()
    tilted = poses.copy()
    tilted[:, 9:11] += 0.05
    case = shifted(GEOMETRY, poses=tuple(tuple(row) for row in tilted.tolist()))
    lattice = lattice_of(case)
    projector = LatticeProjector(case, lattice)
    assert not projector.by_columns
    found, exact, _ = both(case, lattice)
    np.testing.assert_allclose(found, exact, atol=2e-3 * np.abs(exact).max())  # EWA against exact
    assert np.array_equal(projector.pictures(projector.arranged(found)), found)
    upright = shifted(GEOMETRY, poses=tuple(tuple(row) for row in poses.tolist()))
    assert LatticeProjector(upright, lattice_of(upright)).by_columns


@pytest.mark.parametrize("size", [(30, 34), (1, 1), (3, 9), (8, 8), (17, 4)])
@pytest.mark.parametrize(
    "scale",
    [(1, 1), (1.6, 1.2), (0.1, 0.1), (8, 8)],
    ids=["pixels", "as far apart as splats", "fine pixels", "coarse pixels"],
)
def test_the_transpose_is_one(size, scale):
    geometry = shifted(GEOMETRY, n_detector=size, d_detector=scale)
    lattice = lattice_of(geometry)
    projector = LatticeProjector(geometry, lattice)
    found, _, values = both(geometry, lattice)
    pictures = np.random.default_rng(1).uniform(-1, 1, found.shape).astype(np.float32)
    sums = projector.adjoint(projector.arranged(pictures), VIEWS).astype(np.float64)
    left = (found.astype(np.float64) * pictures).sum()
    assert found.any()
    assert (sums * values).sum() == pytest.approx(left, abs=1e-5 * float(np.abs(found * pictures).sum()))


def test_any_number_of_threads_gives_the_same_bits():
    lattice = lattice_of(GEOMETRY)
    projector = LatticeProjector(GEOMETRY, lattice)
    values = np.random.default_rng(0).uniform(-1, 1, (len(lattice), 2)).astype(np.float32)

    def both_ways():
        images = projector.forward(values, VIEWS)
        return images, projector.adjoint(projector.arranged(projector.pictures(images)), VIEWS)

    one, several = one_and_several(both_ways)
    assert all(np.array_equal(a, b) for a, b in zip(one, several, strict=True))
