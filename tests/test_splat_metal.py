"""Fine splats at the surface of metal, and the mean of intensities over sub-pixels."""

import numpy as np
import pytest

from ctsim.geometry import Geometry
from ctsim.reconstruct.splat import lattice, metal
from ctsim.reconstruct.splat.curve import DENSEST, METAL, MaterialCurve
from ctsim.reconstruct.splat.kernels import response_reference, step_cpu
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.level import weighted
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.part import FAINT, LONGER, LONGEST, Part
from ctsim.reconstruct.splat.response import make_response

RESPONSE = make_response("tube", e_max=90.0, basis="klein-nishina", theta=(0.5,))
CURVE = MaterialCurve.of(RESPONSE, 30.0)
GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(14, 18, 16), d_voxel=(1.0, 1.0, 1.0), off_origin=(0.5, -1.0, 2.0),
    n_detector=(36, 44), d_detector=(2.0, 2.0), n_views=12,
)  # fmt: skip
IRON = float(CURVE.knots[-2])


def part_of(volume, geometry=GEOMETRY):
    lattice = Lattice(geometry=geometry, support=volume > 0)
    return Part(geometry=geometry, lattice=lattice, curve=CURVE, u=lattice.gather(volume.astype(np.float32)))


@pytest.fixture
def volume():
    """Water with a block of iron, off the middle in every axis."""
    values = np.zeros(GEOMETRY.n_voxel, np.float32)
    values[2:12, 3:15, 2:14] = 0.99 * CURVE.water
    values[5:8, 9:12, 4:8] = IRON
    return values


def fit_of(volume, p=None, **more):
    p = np.zeros(GEOMETRY.shape, np.float32) if p is None else p
    data = weighted(GEOMETRY, p, np.ones(GEOMETRY.shape, np.bool_))
    return Fit(data=data, parts=[part_of(volume)], response=RESPONSE, tv=0.0, **more)


def test_the_surface_lies_around_metal_and_not_deep_in_it():
    values = np.zeros(GEOMETRY.n_voxel, np.float32)
    values[1:13, 1:17, 1:15] = CURVE.water
    values[3:11, 4:14, 3:13] = 1.01 * DENSEST * CURVE.water
    fine = metal.surface(part_of(values))
    deep = np.zeros_like(fine)
    deep[6:8, 7:11, 6:10] = True  # WITHIN voxels from the surface
    assert np.array_equal(fine, (values > 0) & ~deep) or not fine[deep].any()
    assert fine[3, 8, 8] and fine[1, 8, 8] and not fine[7, 9, 8]
    assert not metal.surface(part_of(np.minimum(values, CURVE.water))).any()


def test_a_split_changes_neither_volume_nor_readings_of_smooth_matter():
    """Without jumps finer splats hold the same matter, and sub-pixels have the same readings."""
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in GEOMETRY.n_voxel), indexing="ij")
    smooth = (0.5 * CURVE.water * np.exp(-(z**2 + y**2 + x**2) / 18)).astype(np.float32)
    smooth[smooth < 1e-3 * CURVE.water] = 0
    views, before = np.arange(12), fit_of(smooth)
    after = fit_of(smooth)
    fine = np.zeros(GEOMETRY.n_voxel, np.bool_)
    fine[4:11, 6:11, 5:12] = True
    after._split(fine)
    assert [part.finer for part in after.parts] == [1, 2] and np.array_equal(after.support, before.support)
    p, q = (fit.integrals(lambda u: u, views) for fit in (before, after))
    # at the seam wide splats lie over narrow ones: ± 15 % over half a voxel, of paths of a few voxels
    assert np.abs(p - q).max() < 0.08 * p.max()
    assert q.sum((1, 2)) == pytest.approx(p.sum((1, 2)), rel=1e-2)
    for axis, n in ((1, 36), (2, 44)):
        along = np.arange(n).reshape(-1, *[1] * (2 - axis))
        assert (q * along).sum((1, 2)) / q.sum((1, 2)) == pytest.approx(
            (p * along).sum((1, 2)) / p.sum((1, 2)), abs=0.02
        )
    assert after.volume().sum() == pytest.approx(before.volume().sum(), rel=1e-2)
    assert after.many_above(0.0)[1] == pytest.approx(before.many_above(0.0)[1])


def test_readings_are_means_of_intensities_over_sub_pixels(volume):
    """Against the reference response on the sums of both parts' own sub-pixels, in float64."""
    fit, views = fit_of(volume), np.arange(12)
    fit._split(metal.surface(fit.parts[0]))
    rest, fine = fit.parts
    coarse = [rest.projector.pictures(rest.paths(views)[:, k]).astype(np.float64) for k in (0, 1)]
    own = [fine.projector.pictures(fine.paths(views)[:, k]).astype(np.float64) for k in (0, 1)]
    la, lb = (a.repeat(2, 1).repeat(2, 2) + b for a, b in zip(coarse, own, strict=True))
    p, _, _ = response_reference.evaluate(RESPONSE.a, RESPONSE.b, RESPONSE.eta, la.ravel(), lb.ravel())
    intensity = np.exp(-p).reshape(12, 36, 2, 44, 2).mean((2, 4))
    found = fit.fitted(views)
    assert np.abs(found + np.log(intensity)).max() < 2e-5
    one_ray = evaluate_mean(la, lb)
    assert np.abs(one_ray - found).max() > 0.3  # what one ray a pixel would read at an edge


def evaluate_mean(la, lb):
    means = [v.reshape(12, 36, 2, 44, 2).mean((2, 4)).ravel() for v in (la, lb)]
    p, _, _ = response_reference.evaluate(RESPONSE.a, RESPONSE.b, RESPONSE.eta, *means)
    return p.reshape(12, 36, 44)


@pytest.mark.parametrize("which", [0, 1])
def test_slopes_are_the_derivatives_of_the_readings(volume, which):
    """The sum over a view's pixels of g·dP, by back-projection and by differences of float32 readings."""
    fit, views = fit_of(volume), np.array([2])
    fit._split(metal.surface(fit.parts[0]))
    part, rng = fit.parts[which], np.random.default_rng(3)
    g = rng.standard_normal((1, 36, 44)).astype(np.float32)
    _, slopes = fit._seen([part.paths(views) for part in fit.parts])
    pixels = fit.parts[0].projector.arranged(g)
    by_density = part.back(slopes[which], pixels, views).astype(np.float64) / part.lattice.unit
    u, way = part.u.copy(), rng.uniform(0.5, 1, len(part.u)).astype(np.float32)
    step = 1e-2
    part.u = (u * (1 + step * way)).astype(np.float32)
    up, more = fit.fitted(views).astype(np.float64), CURVE.densities_of(part.u).astype(np.float64)
    part.u = (u * (1 - step * way)).astype(np.float32)
    down, less = fit.fitted(views).astype(np.float64), CURVE.densities_of(part.u).astype(np.float64)
    assert (g * (up - down)).sum() == pytest.approx((by_density * (more - less)).sum(), rel=2e-3)


@pytest.mark.parametrize("finer", [1, 2])
def test_slopes_are_multiplied_by_their_pixels_and_scratch_becomes_zero(finer):
    rng, scratch = np.random.default_rng(2), 3
    slopes = rng.random((2, 2, 5 * finer, 7 * finer + scratch)).astype(np.float32)
    pixels = rng.random((2, 5, 7 + scratch)).astype(np.float32)
    expected = slopes * np.pad(pixels[..., :7].repeat(finer, 1).repeat(finer, 2), [(0, 0), (0, 0), (0, 3)])[:, None]
    out = np.full_like(slopes, np.nan)
    step_cpu.multiply(slopes, pixels, finer, scratch, out)
    np.testing.assert_array_equal(out, expected)
    step_cpu.multiply(slopes, pixels, finer, scratch, slopes)
    np.testing.assert_array_equal(slopes, expected)


@pytest.mark.parametrize("which", [0, 1])
def test_metal_and_fine_splats_step_by_their_own_curvature_and_the_rest_together(volume, which):
    """By the formula, in float64; what the ramp spreads over tissue is asked of it."""
    fit, views = fit_of(volume), np.array([2, 7])
    fit._split(metal.surface(fit.parts[0]))
    fit.parts[0].u[::7], fit.parts[0].u[1::7] = 1.5 * METAL * CURVE.water, 0
    part, rng, length = fit.parts[which], np.random.default_rng(4), 0.7
    _, slopes = fit._seen([one.paths(views) for one in fit.parts])
    pixels = fit.parts[0].projector.arranged(rng.standard_normal((2, 36, 44)).astype(np.float32))
    part.curvature[...] = rng.uniform(0.1, 10, part.curvature.shape)
    part.measured, u = 12, part.u.astype(np.float64)
    gradient = CURVE.transpose(part.u, part.back(slopes[which], pixels, views)).astype(np.float64)
    bend = CURVE.transpose(part.u, part.curvature).astype(np.float64) * len(views) / 12
    limit = np.inf if which else METAL * CURVE.water
    roots = np.sqrt(np.maximum(u, FAINT * CURVE.water) / bend)
    tissue = (u < limit) & (which == 0)
    if which == 0:
        roots[tissue] = np.minimum(roots[tissue], LONGEST * np.median(roots[tissue]))
    halves = roots * gradient * length * (LONGER if which else 1)
    if which == 0:
        assert tissue.any() and not tissue.all()
        spread = part.lattice.spread(part.u, np.float32(limit), halves.astype(np.float32), len(views))
        halves[tissue] = spread[part.lattice.index][tissue]
    part.move(slopes[which], pixels, views, length)
    expected = np.clip(u + roots * halves, 0, CURVE.knots[-1])
    np.testing.assert_allclose(part.u, expected, rtol=1e-5, atol=1e-5 * np.abs(roots * halves).max())
    assert np.abs(part.u - u).max() > 0.01 * IRON


def test_a_volume_is_the_sum_of_its_pieces(volume, monkeypatch):
    part = part_of(volume)
    whole = part.densities(GEOMETRY), part.volume(GEOMETRY)
    monkeypatch.setattr(lattice, "PIECE", len(part.u) // 3)
    assert len(list(part.lattice.pieces(part.u[:, None]))) > 2
    for found, expected in zip((part.densities(GEOMETRY), part.volume(GEOMETRY)), whole, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.max())


def test_fine_metal_explains_readings_that_one_grid_does_not(volume):
    """Readings of a finer block of iron whose faces cut pixels: the fit with fine metal misses half as much."""
    truth = fit_of(volume)
    truth._split(metal.surface(truth.parts[0]))
    views = np.arange(12)
    inside = truth.parts[1].u > DENSEST * CURVE.water
    truth.parts[1].u[:] = np.where(inside, np.float32(IRON), np.float32(CURVE.water))
    p = truth.fitted(views)
    missed = {}
    for metal_from in (None, 4):
        fit = fit_of(volume, p, metal_from=metal_from)
        assert fit.run(12, lambda fit, whole: True)
        missed[metal_from] = float(np.sqrt(np.mean((fit.fitted(views) - p) ** 2)))
    assert missed[4] < 0.5 * missed[None], missed


def test_an_object_of_metal_alone_stays_on_one_grid(volume):
    fit = fit_of(np.where(volume > CURVE.water, volume, 0))
    fit._split(fit.support)
    assert fit.fine is None and len(fit.parts) == 1


def test_a_split_keeps_the_curvature_of_the_tissue(volume):
    fit = fit_of(volume, fit_of(volume).fitted(np.arange(12)))
    assert fit.run(1, lambda fit, whole: True)
    whole = fit.parts[0]
    a_view = [whole.lattice.scattered(whole.curvature[:, k]) / whole.measured for k in (0, 1)]
    fit._split(metal.surface(whole))
    rest, fine = fit.parts
    for k in (0, 1):
        assert np.array_equal(rest.curvature[:, k] / rest.measured, rest.lattice.gather(a_view[k]))
    assert fine.measured == 0 and not fine.curvature.any()
