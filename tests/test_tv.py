"""Total variation, and what is particular to the methods that lower it."""

import numpy as np
import pytest
import torch
from iterative_scans import GEOMETRY, MU, RADIUS, TINY, distance, matrix, one_thread, scan_of, sphere, tiny  # noqa: F401

from ctsim.baselines.iterative import System, watch
from ctsim.baselines.sart import sart
from ctsim.baselines.tv_methods import asd_pocs, awpcsd, fista_tv
from ctsim.reconstruct.kernels.tv_reference import primal, slopes
from ctsim.reconstruct.projector import forward
from ctsim.reconstruct.tv import Denoiser, SparseDenoiser, axis_ratios, denoiser_on, descend, total_variation


def test_fista_keeps_its_promise():
    # Beck and Teboulle, theorem 4.4: F(x_k) − F(x*) ≤ 2 L ‖x*‖² / (k + 1)² from x_0 = 0.
    scan, tv = tiny(), 0.01
    system, ratios, values, volumes = System(scan), axis_ratios(TINY), [], []
    best = fista_tv(scan, iterations=400, tv=tv, tv_iterations=60)
    tau, curvature = best.details["tau"], 1 / best.details["step_sizes"][0]

    def objective(volume):
        lacking = forward(volume, TINY).numpy().astype(float) - system.data
        return 0.5 * (lacking**2).sum() + tau * total_variation(volume.numpy().transpose(1, 2, 0).copy(), ratios)

    def measure(views, seconds, volume):
        values.append(objective(volume))
        volumes.append(volume)

    with watch(measure):
        fista_tv(scan, iterations=40, tv=tv, tv_iterations=60)
    least, square = objective(best.values), float((best.values.double() ** 2).sum())
    allowed = 2 * curvature * square / (np.arange(40) + 2.0) ** 2
    assert (np.array(values) - least <= allowed + 1e-6 * values[0]).all()
    assert (np.array(values) >= least - 1e-6 * values[0]).all()
    assert tau > 0 and values[0] > 1.5 * least


def test_fista_by_hand():
    scan, a = tiny(), matrix(TINY)
    volume = fista_tv(scan, iterations=7, tv=0.0, positivity=False)
    p, step = System(scan).data.ravel().astype(float), volume.details["step_sizes"][0]
    x = ahead = np.zeros(a.shape[1])
    t = 1.0
    for _ in range(7):
        after, t_after = ahead + step * a.T @ (p - a @ ahead), (1 + np.sqrt(1 + 4 * t * t)) / 2
        x, ahead, t = after, after + (t - 1) / t_after * (after - x), t_after
    np.testing.assert_allclose(volume.values.numpy().ravel(), x, rtol=0, atol=1e-5 * np.abs(x).max())


def test_step_bound_is_above_the_largest_eigenvalue_and_near():
    scan = tiny()
    exact = np.linalg.norm(matrix(TINY), 2) ** 2
    bound = 1 / fista_tv(scan, iterations=1).details["step_sizes"][0]
    assert exact <= bound < 1.5 * exact


RATIOS = np.array([0.5, 1.0, 0.8], np.float32)


@pytest.mark.parametrize("positivity", [True, False])
@pytest.mark.parametrize("tau", [0.05, 0.5])
def test_denoiser_closes_the_duality_gap(positivity, tau):
    rng = np.random.default_rng(2)
    b = (rng.standard_normal((5, 7, 11)) + 0.3).astype(np.float32)
    support = rng.random(b.shape) < 0.9
    gaps = []
    for iterations in (3, 30, 300):
        denoiser = Denoiser(support, RATIOS, positivity)
        x = denoiser.run(b, tau, iterations)
        assert (x[~support] == 0).all() and (x.min() >= 0 or not positivity)
        field = denoiser.dual.astype(float)
        assert np.sqrt((field**2).sum(0)).max() <= 1 + 1e-6
        # Primal minus dual value bounds how far either is from the optimum, by weak duality.
        value = 0.5 * ((x.astype(float) - b) ** 2).sum() + tau * np.sqrt((slopes(x, RATIOS) ** 2).sum(0)).sum()
        inner = primal(b, field, tau, RATIOS, support, positivity)
        gaps.append((value - 0.5 * ((b.astype(float) ** 2).sum() - (inner**2).sum())) / value)
    # FGP's gap falls like 1/k² (1/k without its momentum: 3e-3 and 5e-5 here); float32 holds sums to some 1e-6.
    assert gaps[0] > gaps[1] > -1e-6 and gaps[1] < 1e-3
    assert -1e-6 < gaps[2] < 5e-6


def fgp(b, tau, iterations, dual, support):
    """Fast gradient projection from a dual field on, each array a new one: the volume and its dual field."""
    step, ahead, t = 1 / (4 * float((RATIOS**2).sum()) * tau), dual, 1.0
    for _ in range(iterations):
        field, after = (
            ahead + step * slopes(primal(b, ahead, tau, RATIOS, support, True), RATIOS),
            (1 + np.sqrt(1 + 4 * t * t)) / 2,
        )
        field = field / np.maximum(np.sqrt((field**2).sum(0)), 1)
        ahead, dual, t = field + (t - 1) / after * (field - dual), field, after
    return primal(b, dual, tau, RATIOS, support, True), dual


def test_a_second_denoising_starts_from_the_dual_field_of_the_first_and_nothing_else():
    rng = np.random.default_rng(3)
    support = rng.random((5, 7, 11)) < 0.9
    denoiser, dual = Denoiser(support, RATIOS, True), np.zeros((3, *support.shape))
    for tau in (0.3, 0.2):
        b = (rng.standard_normal(support.shape) + 0.3).astype(np.float32)
        found, (expected, dual) = denoiser.run(b, tau, 6), fgp(b, tau, 6, dual, support)
        # values up to 3 in float32, 2⁻²² apart, a few roundings in each of a dozen iterations
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
        np.testing.assert_allclose(denoiser.dual, dual, rtol=0, atol=1e-5)
    assert np.abs(expected - fgp(b, tau, 6, 0 * dual, support)[0]).max() > 1e-3  # a cold start is seen


def islands():
    """Pieces that touch by an edge, that lie one voxel apart, within another's box, and at every border: [y, x, z]."""
    support = np.zeros((23, 26, 29), bool)
    support[0:3, 1:4, 0:2] = True
    support[3, 0, 0:2] = support[5, 0, 0:2] = True  # by an edge of the first, and one voxel from that
    support[8, 9:12, 8:10] = True
    support[8:20, 20, 4:20] = support[19, 6:20, 4:20] = True  # an angle, whose box holds the last one
    support[-2:, -3:, -4:] = True
    return support


@pytest.mark.parametrize("positivity", [True, False])
def test_islands_are_denoised_as_one_support_is_to_the_bit(positivity):
    rng, support = np.random.default_rng(4), islands()
    whole, sparse = Denoiser(support, RATIOS, positivity), denoiser_on(support, RATIOS, positivity)
    assert isinstance(sparse, SparseDenoiser) and 2 * sparse.dual.size < whole.dual.size
    for tau in (0.3, 0.2, 0.0):
        b = (rng.standard_normal(support.shape) + 0.5).astype(np.float32)
        expected = whole.run(b, tau, 6)
        np.testing.assert_array_equal(sparse.run(b, tau, 6).view(np.uint32), expected.view(np.uint32))
        assert np.abs(expected[support] - b[support]).max() > 0.1 or tau == 0


def test_a_support_that_fills_its_box_is_not_taken_apart():
    assert isinstance(denoiser_on(np.ones((6, 5, 4), bool), RATIOS, True), Denoiser)
    assert isinstance(denoiser_on(np.zeros((6, 5, 4), bool), RATIOS, True), Denoiser)
    assert isinstance(denoiser_on(np.zeros((0, 0, 0), bool), RATIOS, True), Denoiser)
    thin = np.zeros((40, 40, 40), bool)
    thin[::39], thin[:, ::39], thin[..., ::39] = True, True, True  # a hollow box is one island as large as its box
    assert isinstance(denoiser_on(thin, RATIOS, True), Denoiser)
    dust = np.zeros((60, 60, 60), bool)
    dust[::5, ::5, ::5] = True
    assert isinstance(denoiser_on(dust, RATIOS, True), Denoiser)


def test_total_variation_and_its_descent():
    rng = np.random.default_rng(6)
    x = rng.standard_normal((4, 5, 6)).astype(np.float32)
    assert total_variation(x, RATIOS) == pytest.approx(np.sqrt((slopes(x, RATIOS) ** 2).sum(0)).sum(), rel=1e-6)
    for delta in (np.inf, 0.7):
        least = 1e-4 * np.abs(x).max()
        held = np.exp(-((slopes(x.astype(float), RATIOS) / delta) ** 2))

        def smoothed(y, held=held, least=least):
            return np.sqrt((held * slopes(y, RATIOS) ** 2).sum(0) + least**2).sum()

        gradient = np.zeros(x.shape)
        for at in np.ndindex(x.shape):
            step = np.zeros(x.shape)
            step[at] = 1e-5
            gradient[at] = (smoothed(x + step) - smoothed(x - step)) / 2e-5
        moved = x.copy()
        descend(moved, 0.01, 1, RATIOS, delta)
        assert np.linalg.norm(moved - x) == pytest.approx(0.01, rel=1e-4)
        # x is stored to 2⁻²⁴·4, against a move of 0.01
        np.testing.assert_allclose((x - moved) / 0.01, gradient / np.linalg.norm(gradient), rtol=0, atol=1e-4)


def test_tv_methods_are_smoother_than_sart():
    scan = sphere()
    noise = torch.from_numpy(np.random.default_rng(1).standard_normal(GEOMETRY.shape) * 0.01)
    noisy = scan_of(-torch.log(scan.counts.double() / 1e9) + noise, GEOMETRY, i0=1e4)
    r = distance()
    plain = sart(noisy).values.numpy()[r < RADIUS - 2].std()
    for method in (fista_tv, asd_pocs, awpcsd):
        assert method(noisy).values.numpy()[r < RADIUS - 2].std() < 0.8 * plain


def test_settings_are_in_units_of_the_scans_water():
    """A sphere of half the attenuation comes back as half the volume, with all that is set by water halved."""
    scan = sphere()
    half = scan_of(-torch.log(scan.counts.double() / scan.i0) / 2, GEOMETRY)
    one, other = (fista_tv(s, iterations=3) for s in (scan, half))
    assert one.details["water_per_mm"] == pytest.approx(MU, rel=0.05)  # one pass, and a bin is 1 % wide or so
    assert other.details["water_per_mm"] == pytest.approx(0.5 * one.details["water_per_mm"], rel=1e-3)
    # The proximal map is homogeneous. Counts of float32 hold p, up to 0.4, to 6e-8, and water moves τ by 1e-3 at most,
    # hence a volume by as much of the ripples that τ flattens.
    torch.testing.assert_close(2 * other.values, one.values, rtol=0, atol=1e-3 * MU)
    # TV steps of AwPCSD go along a normalised gradient, which has no such bound; its edges follow water all the same.
    waters = [awpcsd(s, iterations=1).details["water_per_mm"] for s in (scan, half)]
    assert waters[1] == pytest.approx(0.5 * waters[0], rel=1e-3)
