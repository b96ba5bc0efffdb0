import math

import numba
import numpy as np
import pytest
from scipy import stats

from ctsim import rng
from ctsim.detector.noise import Noise, detect, detect_tigre, flat_field, largest_p, pixel_pattern
from ctsim.errors import InputError
from ctsim.kernels import noise_cpu, noise_reference

KEY = rng.stream_key("scene", "photons", 0)
PHOTONS = Noise(electronic=0.0, adc_bits=None)
SIDE = 1000


def constant(value, shape=(SIDE, SIDE)):
    return np.full(shape, value, np.float32)


def draw(means, key=KEY):
    out = np.empty(len(means))
    noise_cpu.poisson(np.asarray(means, np.float64), key, out)
    return out


# --- Poisson numbers -----------------------------------------------------------------------------


@pytest.mark.parametrize("mean", [0.05, 0.7, 3.0, 9.99, 10.0, 14.0, 40.0, 300.0, 5000.0])
def test_poisson_numbers_pass_a_chi_square_test(mean):
    n = 1_000_000
    drawn = draw(np.full(n, mean)).astype(int)
    assert drawn.min() >= 0
    # Bins are single numbers with at least 10 expected draws, and the two tails.
    numbers = np.arange(drawn.max() + 2)
    keep = numbers[stats.poisson.pmf(numbers, mean) * n >= 10]
    first, last = keep[0], keep[-1]
    expected = stats.poisson.pmf(np.arange(first, last + 1), mean)
    expected[0] = stats.poisson.cdf(first, mean)
    expected[-1] = stats.poisson.sf(last - 1, mean)
    observed = np.bincount(np.clip(drawn, first, last) - first, minlength=len(expected))
    chi2 = ((observed - n * expected) ** 2 / (n * expected)).sum()
    # A right generator fails a 1e-4 test on one stream in 1e4; this stream is fixed and passes.
    assert stats.chi2.sf(chi2, len(expected) - 1) > 1e-4


@pytest.mark.parametrize("mean", [1e6, 1e9, 1e12])
def test_large_means_are_normal_and_whole(mean):
    n = 200_000
    drawn = draw(np.full(n, mean))
    assert (drawn == np.floor(drawn)).all()
    # Poisson differs from normal by skew/6 = 1.7e-4 at 1e6; a KS test of 2e5 numbers sees 2e-3.
    assert stats.kstest((drawn - mean) / math.sqrt(mean), "norm").pvalue > 1e-4


def test_rows_of_poisson_numbers_are_those_drawn_one_by_one():
    """Means on both sides of every limit of the kernel, in an order that mixes them within a row."""
    gen = np.random.default_rng(2)
    means = np.concatenate([10 ** gen.uniform(-2, 7, 4000), gen.uniform(8, 12, 1000), gen.uniform(900, 1200, 1000)])
    means[:4] = 0, 9.999999, 10, 1024  # of more than 1e7 the reference's plain formula knows too little
    gen.shuffle(means)
    expected = np.empty(means.size)
    noise_reference.poisson(means, KEY, expected)
    assert np.array_equal(draw(means), expected)


def test_a_draw_near_the_bound_of_its_test_is_judged_as_by_one_number_or_left_in_doubt():
    """Second uniform numbers are put next to the bound, where two roundings of it might differ."""
    gen = np.random.default_rng(4)
    means = 10 ** gen.uniform(1, 12, 20_000)
    words = gen.integers(0, 2**64, (2, means.size), np.uint64, endpoint=False)
    counts, marks = np.empty(means.size), np.empty(means.size, np.int64)
    noise_cpu.judge(means, words, counts, marks)
    b = 0.931 + 2.53 * np.sqrt(means)
    us = 0.5 - np.abs((words[0] >> np.uint64(11)) * 2.0**-53 - 0.5)
    likely = np.exp([noise_cpu.log_poisson(max(k, 1.0), mean) for k, mean in zip(counts, means, strict=True)])
    bound = likely * ((-0.059 + 0.02483 * b) / us**2 + b) / (1.1239 + 1.1328 / (b - 3.4))
    inside = (counts >= 10) & (bound > 1e-3) & (bound < 0.999) & ((us < 0.07) | (bound > 0.9277 - 3.6224 / (b - 2)))
    assert inside.sum() > 2000
    for off in (0, 40, -40, 10**6, -(10**6)):  # in 2^-32; the bound computed here is good to about 1e-9 of itself
        at = np.clip(np.floor(bound * 2**32) + off, 0, 2**32 - 1)
        noise_cpu.judge(means, np.stack([words[0], at.astype(np.uint64)]), counts, marks)
        v = (at + 0.5) * 2.0**-32
        single = np.array([noise_cpu.accepts(*given) for given in zip(counts, means, us, v, strict=True)])
        quick = (us >= 0.07) & (v <= 0.9277 - 3.6224 / (b - 2))
        sure = inside & (marks != 2)
        assert np.array_equal(marks[sure] == 1, (single | quick)[sure])
        if off == 0:
            assert np.mean(marks[inside] == 2) > 0.99
        elif abs(off) > 40:  # 2e-4 of the bound, and the margin is 1e-7 and 1e-12 of the mean
            assert np.mean(marks[inside & (means < 1e6)] == 2) < 0.01


@pytest.mark.parametrize("mean", [12.0, 100.0, 900.0, 1e4, 1e9, 1e12])
def test_log_probability_keeps_twelve_digits(mean):
    # Differences between neighbours are known exactly: log p(k+1) − log p(k) = log(mean/(k+1)). The values' own
    # error is 1e-12 (table: eps·k·log(mean) at k = 1024) and there are two of them.
    for z in (-2.5, -1.0, 0.0, 1.0, 4.0):
        k = np.floor(mean + z * math.sqrt(mean))
        step = noise_cpu.log_poisson(k + 1, mean) - noise_cpu.log_poisson(k, mean)
        assert step == pytest.approx(math.log1p((mean - k - 1) / (k + 1)), abs=2e-12)
    # Absolute value: Stirling at k = mean, −log(2π·mean)/2 − 1/(12·mean) + 1/(360·mean³) − 1/(1260·mean⁵).
    stirling = -0.5 * math.log(2 * math.pi * mean) - 1 / (12 * mean) + 1 / (360 * mean**3) - 1 / (1260 * mean**5)
    assert noise_cpu.log_poisson(mean, mean) == pytest.approx(stirling, abs=2e-11)


def test_gaussian_numbers_follow_the_inverse_distribution_to_seven_digits():
    words = np.concatenate([[0, 1, 2**31 - 1, 2**31, 2**32 - 1], rng.words(KEY, 500).ravel()]).astype(np.uint64)
    exact = np.array([noise_reference.normal(w) for w in words])
    fast = np.array([noise_cpu.normal(w) for w in words])
    # AS 241's 7-digit variant states one part in 1e7; the rounded coefficients add a little.
    np.testing.assert_allclose(fast, exact, rtol=2e-7)


# --- One view ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("noise", [Noise(), Noise(adc_bits=None), Noise(adc_bits=12, electronic=0.0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_kernel_writes_the_same_counts_as_the_reference(noise, dtype):
    gen = np.random.default_rng(1)
    m1 = np.exp(-gen.uniform(0, 11, (5, 7))).astype(dtype)
    m1[2, 3] = 0
    m2 = (1.3 * m1**0.9).astype(dtype)
    pattern = np.stack([gen.normal(1, 0.05, m1.shape), gen.normal(0, 0.05, m1.shape)]).astype(np.float32)
    pattern[0, 1, 1] = 0
    i0 = 3e4
    expected, bad = np.empty(m1.shape, noise.dtype), np.ones(5, np.uint8)
    scale = (i0, noise.electronic, noise.gain(i0), noise.dark, float(noise.full_scale))
    noise_reference.detect(m1, m2, pattern, *scale, KEY, expected, bad)
    counts = detect(m1, m2, noise=noise, i0=i0, key=KEY, pattern=pattern)
    assert counts.dtype == noise.dtype and not bad.any()
    if noise.has_adc:
        np.testing.assert_array_equal(counts, expected)
    else:
        # The Gaussian number is good to 1e-7 of itself, float32 to 6e-8 of the counts.
        np.testing.assert_allclose(counts, expected, rtol=1.2e-7, atol=5 * 6 * 2e-7)


@pytest.mark.parametrize(("m1", "m2", "i0"), [(1.0, 1.35, 1e5), (0.02, 0.035, 1e5), (3e-4, 6e-4, 1e5), (0.5, 0.5, 40)])
def test_mean_and_variance_are_m1_and_m2(m1, m2, i0):
    relative = detect(constant(m1), constant(m2), noise=PHOTONS, i0=i0, key=KEY).astype(np.float64) / i0
    n = relative.size
    m1, m2 = float(np.float32(m1)), float(np.float32(m2))
    assert relative.mean() == pytest.approx(m1, abs=5 * math.sqrt(m2 / i0 / n))
    # Variance of a sample variance: (2 + 1/lambda)/n of its square, at most 0.16 % here; five of them is below 1 %.
    photons = i0 * m1**2 / m2
    tolerance = 5 * math.sqrt((2 + 1 / photons) / n)
    assert tolerance < 0.01
    assert relative.var() == pytest.approx(m2 / i0, rel=tolerance)
    assert stats.skew(relative.ravel()) == pytest.approx(1 / math.sqrt(photons), abs=5 * math.sqrt(15 / n))


def test_ten_photons_have_the_compound_skew_and_log_bias():
    """Against the real thing: a Poisson number of photons that each leave a random energy."""
    n_photons, n = 10.0, 1_000_000
    gen = np.random.default_rng(3)
    photons = gen.poisson(n_photons, n)
    energies = gen.uniform(20, 60, photons.sum())
    edges = np.concatenate([[0], np.cumsum(energies)])
    ends = np.cumsum(photons)
    absorbed = (edges[ends] - edges[ends - photons]) / (n_photons * 40)
    e2 = (60**3 - 20**3) / (3 * 40) / 40**2
    ours = detect(constant(1.0), constant(e2), noise=PHOTONS, i0=n_photons, key=KEY).astype(np.float64) / n_photons
    # Closed forms of the two skews: m3/m2^1.5/sqrt(N) = 0.3506 and sqrt(m2)/m1/sqrt(N) = 0.3291, 6 % apart.
    assert stats.skew(ours.ravel()) == pytest.approx(stats.skew(absorbed), rel=0.08)
    floor = 0.1
    bias = [-np.log(np.maximum(x, floor)).mean() for x in (ours, absorbed)]
    # The bias is var/2 = 0.054 and higher orders that differ through the skew: third order skew·var^1.5/3, 6 % of
    # which is 3e-4; and no photon at all 5e-5 more often, each −log 0.1: 1.2e-4. Sampling: 0.35/1e3 each.
    assert bias[0] == pytest.approx(bias[1], abs=4.2e-4 + 5 * 0.35e-3 * math.sqrt(2))
    assert 0.05 < bias[0] < 0.09


def test_a_photon_counter_is_pure_poisson():
    # a1 = a2 = d, the detection probability: m2 = m1/d, hence one photon is 1/(d·i0) of the open signal.
    d, i0, m1 = 0.5, 200.0, 0.25
    counts = detect(constant(m1), constant(m1 / d), noise=PHOTONS, i0=i0, key=KEY)
    detected = counts.astype(np.float64) * d
    # Poisson(25) to float32 precision, whole numbers.
    np.testing.assert_allclose(detected, np.rint(detected), atol=1e-4)
    n = counts.size
    assert detected.mean() == pytest.approx(25, abs=5 * math.sqrt(25 / n))
    assert detected.var() == pytest.approx(25, rel=5 * math.sqrt((2 + 1 / 25) / n))


def test_electronic_noise_is_gaussian_and_independent_of_the_photons():
    noise = Noise(electronic=5.0, adc_bits=None)
    dark = detect(constant(0.0), constant(0.0), noise=noise, i0=1e4, key=KEY).astype(np.float64)
    assert dark.min() < 0
    assert stats.kstest(dark.ravel() / 5.0, "norm").pvalue > 1e-4
    photons = detect(constant(1.0), constant(1.3), noise=PHOTONS, i0=1e4, key=KEY).astype(np.float64)
    both = detect(constant(1.0), constant(1.3), noise=noise, i0=1e4, key=KEY).astype(np.float64)
    # Counts of 1e4 in float32 are rounded to 1e-3 at most.
    np.testing.assert_allclose(both, photons + dark, atol=2e-3)
    five = 5 / math.sqrt(dark.size)
    assert abs(np.corrcoef(dark.ravel(), photons.ravel())[0, 1]) < five
    assert abs(np.corrcoef(photons[:, :-1].ravel(), photons[:, 1:].ravel())[0, 1]) < five
    other = detect(constant(1.0), constant(1.3), noise=PHOTONS, i0=1e4, key=rng.stream_key("scene", "photons", 1))
    assert abs(np.corrcoef(photons.ravel(), other.ravel())[0, 1]) < five


# --- Streams -------------------------------------------------------------------------------------


def test_the_number_of_threads_changes_nothing():
    gen = np.random.default_rng(2)
    m1 = np.exp(-gen.uniform(0, 9, (57, 43))).astype(np.float32)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            results.append(detect(m1, 1.3 * m1, noise=Noise(adc_bits=None), i0=1e4, key=KEY))
    finally:
        numba.set_num_threads(before)
    assert all(np.array_equal(results[0], r) for r in results)


def test_the_metal_free_twin_shares_every_pixel_it_can():
    gen = np.random.default_rng(4)
    body = np.exp(-gen.uniform(0, 3, (37, 41))).astype(np.float32)
    shadow = np.zeros(body.shape, bool)
    shadow[10:20, 5:30] = True
    metal = np.where(shadow, body * np.float32(1e-3), body)
    noise = Noise()
    with_metal = detect(metal, 1.4 * metal, noise=noise, i0=1e5, key=KEY)
    without = detect(body, 1.4 * body, noise=noise, i0=1e5, key=KEY)
    np.testing.assert_array_equal(with_metal[~shadow], without[~shadow])
    assert (with_metal[shadow] < without[shadow]).mean() > 0.99


# --- Read-out ------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_the_adc_rounds_and_saturates_above_a_pedestal(bits):
    noise = Noise(electronic=0.0, adc_bits=bits)
    full = 2**bits - 1
    assert noise.full_scale == full and noise.dark == round(0.02 * full)
    assert noise.dark + noise.gain(1e5) == pytest.approx(0.8 * full)
    # 1e12 photons: the signal's noise, 1e-6, moves a count by 0.05 at most; aim 0.2 off whole counts, both ways.
    aims = np.array([[noise.dark + 1.2, noise.dark + 100.8, 0.8 * full]])
    m1 = (aims - noise.dark) / noise.gain(1e12)
    counts = detect(m1, m1, noise=noise, i0=1e12, key=KEY)
    assert counts.dtype == np.uint16
    assert counts[0, :2].tolist() == [noise.dark + 1, noise.dark + 101]
    assert abs(counts[0, 2] - 0.8 * full) <= 0.8
    extremes = np.array([[0.0, 1.01 / 0.8 + 0.02, 1e3, 1e10]])
    assert detect(extremes, extremes, noise=noise, i0=1e12, key=KEY).tolist() == [[noise.dark, full, full, full]]


def test_rounding_adds_a_twelfth_of_a_count():
    noise = Noise(electronic=20.0, adc_bits=8)
    i0, n = 1e4, SIDE * SIDE
    counts = detect(constant(0.5), constant(0.5), noise=noise, i0=i0, key=KEY).astype(np.float64)
    variance = (noise.gain(i0) / i0) ** 2 * (0.5 * i0 + 20**2) + 1 / 12
    # Sheppard's correction is exact to exp(−2π²σ²), 1e-9 at σ = 1.45 counts.
    assert counts.var() == pytest.approx(variance, rel=5 * math.sqrt(2 / n))
    assert counts.mean() == pytest.approx(noise.dark + 0.5 * noise.gain(i0), abs=5 * math.sqrt(variance / n))


def test_negative_signals_stay_without_an_adc_and_clip_at_zero_with_one():
    dark = constant(0.0, (50, 60))
    adc = detect(dark, dark, noise=Noise(electronic=50.0, pedestal=0.0), i0=100, key=KEY)
    photons = detect(dark, dark, noise=Noise(electronic=50.0, adc_bits=None), i0=100, key=KEY)
    assert (photons < 0).mean() == pytest.approx(0.5, abs=5 * 0.5 / math.sqrt(dark.size))
    np.testing.assert_array_equal(adc == 0, photons * Noise(pedestal=0.0).gain(100) / 100 < 0.5)


def test_fixed_pattern_scales_the_signal_and_dead_pixels_read_the_pedestal():
    noise = Noise(fixed_pattern=0.05, dead_fraction=0.01, n_flats=0)
    shape = (300, 400)
    pattern = pixel_pattern(shape, noise=noise, scene_id="scene")
    assert pattern is not None
    np.testing.assert_array_equal(pattern, pixel_pattern(shape, noise=noise, scene_id="scene"))
    gains, bends = pattern
    dead = gains == 0
    n = gains.size
    assert dead.mean() == pytest.approx(0.01, abs=5 * math.sqrt(0.01 / n))
    assert gains[~dead].std() == pytest.approx(0.05, rel=5 / math.sqrt(2 * n))
    assert gains[~dead].mean() == pytest.approx(1.0, abs=5 * 0.05 / math.sqrt(n))
    assert bends.std() == pytest.approx(0.005, rel=5 / math.sqrt(2 * n))
    assert abs(np.corrcoef(gains[~dead], bends[~dead])[0, 1]) < 5 / math.sqrt(n)
    counts = detect(constant(0.5, shape), constant(0.5, shape), noise=noise, i0=1e8, key=KEY, pattern=pattern)
    flat = flat_field(open_field(shape), noise=noise, i0=1e8, scene_id="scene", pattern=pattern)
    assert (counts[dead] == noise.dark).all() and (flat[dead] == noise.dark).all()
    relative = (counts[~dead] - noise.dark) / (flat[~dead] - noise.dark)
    # Noise of 1.4e-4 relative and rounding of half a count in 2e4, six standard deviations of the first.
    left = 0.5 * (1 + 0.5 * bends[~dead])
    np.testing.assert_allclose(relative, left, atol=0.5 * 6 * 1.7e-4 + 0.5 / 4e4)
    assert pixel_pattern(shape, noise=Noise(), scene_id="scene") is None


@pytest.mark.parametrize("residual", [0.0, 0.1, 1.0])
def test_what_the_flat_leaves_of_a_fixed_pattern_grows_as_the_signal_falls(residual):
    noise = Noise(model="none", fixed_pattern=0.02, pattern_residual=residual)
    shape = (60, 70)
    pattern = pixel_pattern(shape, noise=noise, scene_id="scene")
    assert pattern is not None
    flat = flat_field(open_field(shape), noise=noise, i0=1e5, scene_id="scene", pattern=pattern).astype(np.float64)
    for signal in (1.0, 0.5, 0.01, 0.0001):
        m1 = constant(signal, shape)
        counts = detect(m1, m1, noise=noise, i0=1e5, key=KEY, pattern=pattern)
        error = -np.log(counts / flat) + math.log(signal)
        # closed form: a gain that is 1 + b(1 − s) times the open field's; float32 rounds counts and flat, 6e-8 each
        np.testing.assert_allclose(error, -np.log1p(pattern[1].astype(np.float64) * (1 - signal)), rtol=0, atol=4e-7)
        spread = 0.02 * residual * (1 - signal)
        assert error.std() == pytest.approx(spread, rel=6 / math.sqrt(2 * m1.size), abs=4e-7)


def open_field(shape, m2=1.0):
    return np.ones(shape, np.float32), np.full(shape, m2, np.float32)


def test_a_flat_field_is_the_mean_of_its_flats():
    i0, shape, m2_open = 1e4, (200, 300), 1.4
    noise = Noise(n_flats=16, electronic=10.0)
    flat = flat_field(open_field(shape, m2_open), noise=noise, i0=i0, scene_id="scene").astype(np.float64)
    gain, n = noise.gain(i0), flat.size
    variance = (gain**2 * (m2_open / i0 + (10 / i0) ** 2) + 1 / 12) / 16
    assert flat.var() == pytest.approx(variance, rel=5 * math.sqrt(2 / n))
    assert flat.mean() == pytest.approx(noise.dark + gain, abs=5 * math.sqrt(variance / n))
    perfect = flat_field(open_field(shape), noise=Noise(n_flats=0), i0=i0, scene_id="scene")
    assert (perfect == np.float32(noise.dark + gain)).all()
    photons = flat_field(open_field(shape), noise=Noise(n_flats=0, adc_bits=None), i0=i0, scene_id="scene")
    assert (photons == i0).all()


def test_none_draws_and_rounds_nothing():
    m1 = np.array([[0.0, 0.123456789, 1.0]])
    counts = detect(m1, m1, noise=Noise(model="none"), i0=1e5, key=KEY)
    assert counts.dtype == np.float32
    np.testing.assert_array_equal(counts, (m1 * 1e5).astype(np.float32))
    assert Noise(model="none").dark == 0 and Noise(model="none").gain(1e5) == 1e5


@pytest.mark.parametrize("noise", [Noise(), Noise(adc_bits=None), Noise(model="tigre"), Noise(model="none")])
@pytest.mark.parametrize("i0", [1e-3, 10.0, 1e12])
def test_extreme_signals_stay_finite(noise, i0):
    m1 = np.array([[0.0, 1e-300, 1e-30, 1e-3, 1.0, 1e3, 1e10]])
    for moment in (m1, m1.astype(np.float32)):
        if noise.model == "tigre":
            counts = detect_tigre(moment, top=largest_p(moment), noise=noise, i0=i0, key=KEY)
        else:
            counts = detect(moment, 1.5 * moment, noise=noise, i0=i0, key=KEY)
        assert np.isfinite(counts).all()


# --- TIGRE's noise -------------------------------------------------------------------------------


def test_tigre_noise_makes_tissue_too_noisy_and_a_metal_shadow_too_quiet():
    i0, electronic, top = 1e4, 5.0, 8.0
    tissue, metal = 0.7, top
    m1 = np.full((400, 500), np.exp(-tissue))
    m1[:, 250:] = np.exp(-metal)
    spread = {}
    for model in ("compound", "tigre"):
        noise = Noise(model=model, electronic=electronic, adc_bits=None)
        if model == "tigre":
            counts = detect_tigre(m1, top=largest_p(m1), noise=noise, i0=i0, key=KEY)
        else:
            counts = detect(m1, m1, noise=noise, i0=i0, key=KEY)
        relative = counts.astype(np.float64) / (i0 * m1)
        spread[model] = relative[:, :250].std(), relative[:, 250:].std()
    # True: sqrt(N + e²)/N at N = i0·exp(−p). TIGRE: `top` times that at N = i0·exp(−p/top); to first order in the
    # draw, whose relative spread s <= 0.017 enters as (1+x)^8 − 1 with a second-order share of 49/4·s² = 0.3 %.
    # Sampling: 1/sqrt(2·1e5) = 0.22 %, five of them 1.1 %.
    for k, p in enumerate((tissue, metal)):
        right, wrong = i0 * math.exp(-p), i0 * math.exp(-p / top)
        assert spread["compound"][k] == pytest.approx(math.sqrt(right + electronic**2) / right, rel=0.012)
        assert spread["tigre"][k] == pytest.approx(top * math.sqrt(wrong + electronic**2) / wrong, rel=0.015)
    assert 5.5 < spread["tigre"][0] / spread["compound"][0] < 6.5
    assert 10 < spread["compound"][1] / spread["tigre"][1] < 13


def test_tigre_kernel_equals_its_reference():
    gen = np.random.default_rng(5)
    m1 = np.exp(-gen.uniform(0, 8, (5, 7)))
    m1[3, 2] = 0
    fast, slow = np.empty(m1.shape, np.float32), np.empty(m1.shape, np.float32)
    noise_cpu.detect_tigre(m1, 8.0, 1e4, 5.0, KEY, fast)
    noise_reference.detect_tigre(m1, 8.0, 1e4, 5.0, KEY, slow)
    # One Gaussian step of 5 photons, good to 5e-7, in 3e3 photons to the eighth power; float32 adds 6e-8.
    np.testing.assert_allclose(fast, slow, rtol=2e-7)


# --- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "gauss"}, "noise.model"),
        ({"electronic": -1.0}, "noise.electronic"),
        ({"electronic": float("nan")}, "noise.electronic"),
        ({"adc_bits": 24}, "noise.adc_bits"),
        ({"pedestal": 0.9}, "noise.pedestal < noise.adc_fill"),
        ({"adc_fill": 1.2}, "noise.adc_fill"),
        ({"n_flats": -1}, "noise.n_flats"),
        ({"fixed_pattern": 0.5}, "noise.fixed_pattern"),
        ({"pattern_residual": 1.5}, "noise.pattern_residual"),
        ({"model": "tigre", "fixed_pattern": 0.01}, "tigre.*fixed_pattern"),
        ({"model": "tigre", "dead_fraction": 0.01}, "tigre.*dead_fraction"),
        ({"dead_fraction": 1.0}, "noise.dead_fraction"),
    ],
)
def test_impossible_settings_are_refused_by_name(arguments, words):
    with pytest.raises(InputError, match=words):
        Noise(**arguments)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e-3])
def test_impossible_moments_are_refused(value):
    good = np.full((5, 7), 0.5)
    bad = good.copy()
    bad[3, 2] = value
    for model in ("compound", "none", "tigre"):
        with pytest.raises(InputError, match="m1"):
            if model == "tigre":
                detect_tigre(bad, top=1.0, noise=Noise(model=model), i0=1e4, key=KEY)
            else:
                detect(bad, good, noise=Noise(model=model), i0=1e4, key=KEY)
    with pytest.raises(InputError, match="row 3"):
        detect(good, bad, noise=Noise(), i0=1e4, key=KEY)
    bad[3, 2] = 0
    with pytest.raises(InputError, match="m2 > 0 where m1 > 0"):
        detect(good, bad, noise=Noise(), i0=1e4, key=KEY)


def test_wrong_shapes_and_types_are_refused():
    m = np.full((5, 7), 0.5)
    with pytest.raises(InputError, match="one shape"):
        detect(m, m[:4], noise=Noise(), i0=1e4, key=KEY)
    with pytest.raises(InputError, match="pattern"):
        detect(m, m, noise=Noise(), i0=1e4, key=KEY, pattern=constant(1.0, (5, 7)))
    with pytest.raises(InputError, match="counts must be"):
        detect(m, m, noise=Noise(), i0=1e4, key=KEY, known=(np.empty((5, 7), np.float32), np.zeros((5, 2), np.int64)))
    with pytest.raises(InputError, match="i0"):
        detect(m, m, noise=Noise(), i0=0.0, key=KEY)
