"""Detector blur and lag: widths, edges and noise spectra against closed forms, twins, and going on after a stop."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from ctsim import rng
from ctsim.beam.spectrum import Tube
from ctsim.detector.noise import Noise, detect, photons, pixel_pattern, read_out
from ctsim.detector.panel import CUT, LATE, Blur, Lag, Panel, kernels, response, taps
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels import noise_cpu, noise_reference
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views
from ctsim.solids import ELLIPSOID, Primitive, Solid
from ctsim.types import Phantom, Scanner

FWHM = math.sqrt(8 * math.log(2))
GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(8, 8, 8), d_voxel=(2.0,) * 3, n_detector=(60, 70), d_detector=(0.5, 0.6), n_views=7
)
STOPPED = 1 - math.exp(-attenuation("GOS", np.array([60.0]))[0] * 0.1)  # of the photons, by the ideal detector
LAG = (Lag(share=0.05, decay=0.2), Lag(share=0.02, decay=0.5))


def rows(n):
    return np.tile(np.array([0, n]), (n, 1))


# --- blur ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.5])
def test_the_kernel_has_the_gaussians_moments_and_a_pixels(sigma):
    pixel = 0.4
    found = taps(sigma * FWHM * pixel, pixel)
    d = np.arange(found.size) - found.size // 2
    assert abs(found.sum() - 1) < 1e-14 and np.array_equal(found, found[::-1])
    # sums of a smooth function at whole numbers miss its moments by exp(−2π²σ²), 6e-5 at σ = 0.7, and the cut tails
    for power, moment in ((2, sigma**2 + 1 / 12), (4, 3 * sigma**4 + sigma**2 / 2 + 1 / 80)):
        np.testing.assert_allclose((d**power * found).sum(), moment, rtol=5e-3 if sigma < 1 else 2e-4)
    # what a pixel d away collects, by the error function
    share = [(math.erf((x + 0.5) / sigma / 2**0.5) - math.erf((x - 0.5) / sigma / 2**0.5)) / 2 for x in d]
    np.testing.assert_allclose(found, share, atol=CUT)


def test_a_knife_edge_gives_the_mtf_of_both_gaussians():
    pixel, sigmas, tail = (0.3, 0.5), (1.3, 4.0), 0.25
    blur = Blur(fwhm=sigmas[0] * FWHM * pixel[1], tail=tail, tail_fwhm=sigmas[1] * FWHM * pixel[1])
    n = 128
    edge = np.zeros((40, n), np.float32)
    edge[:, n // 2 :] = 1.0
    line = np.diff(Panel(blur, (), pixel).spread(edge)[20].astype(float))
    f = np.linspace(0, 0.5, 60)
    mtf = np.abs(np.exp(-2j * np.pi * f[:, None] * np.arange(line.size)) @ line)
    gauss = [np.exp(-2 * (np.pi * s * f) ** 2) for s in sigmas]
    expected = ((1 - tail) * gauss[0] + tail * gauss[1]) * np.sinc(f)
    # aliases are 2·exp(−2π²σ²/4)·sinc(½) = 3e-4 at most; cut tails 1e-6; float32 1e-7 over 128 samples
    np.testing.assert_allclose(mtf, expected, atol=4e-4)
    assert expected[30] < 0.4


def test_axes_have_the_pixels_of_their_own_and_light_stays_on_the_panel():
    blur = Blur(fwhm=1.2)
    point = np.zeros((41, 43), np.float32)
    point[20, 21] = 1.0
    image = Panel(blur, (), (0.3, 0.6)).spread(point).astype(float)
    v, u = (np.arange(n) - n // 2 for n in image.shape)
    for widths, d, pixel in ((image.sum(1), v, 0.3), (image.sum(0), u, 0.6)):
        np.testing.assert_allclose((widths * d**2).sum(), (1.2 / FWHM / pixel) ** 2 + 1 / 12, rtol=2e-3)
    corner = np.zeros((41, 43), np.float32)
    corner[0, 0] = 1.0
    panel = Panel(blur, (), (0.3, 0.6))
    np.testing.assert_allclose(panel.spread(corner).sum(), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(panel.spread(np.ones((41, 43), np.float32)), 1.0)


def test_noise_is_white_times_the_mtf_squared_plus_white_electronics():
    n, views, margin, most, i0, sigma = 150, 24, 12, 8, 1e4, 0.8
    blur = Blur(fwhm=sigma * FWHM * 0.5)
    quantum = 1 / (i0 * STOPPED)  # variance of a pixel's photons in the open field, of one energy
    electronic = 0.4 * math.sqrt(quantum)
    noise = Noise(electronic=electronic * i0, adc_bits=None)
    geometry = msgspec.structs.replace(GEOMETRY, n_detector=(n, n), d_detector=(0.5, 0.5), n_views=views)
    scanner = msgspec.structs.replace(machine(noise=noise, geometry=geometry, blur=blur), i0=i0)
    _, out = scan(body(ball(0.0, 0.0, 0.001)), scanner, truth=Truth(twin=False))  # all but empty
    x = out["counts"].astype(float) / i0 - 1
    inner, shifts = x[:, margin:-margin, margin:-margin], range(-most, most + 1)

    def covary(a, b):
        return (inner * np.roll(x, (a, b), (1, 2))[:, margin:-margin, margin:-margin]).mean()

    covariance = np.array([[covary(a, b) for b in shifts] for a in shifts])
    # taps by the error function, over ±6 standard deviations
    d = np.arange(-5, 6)
    share = [math.erf((k + 0.5) / sigma / 2**0.5) - math.erf((k - 0.5) / sigma / 2**0.5) for k in d]
    along = np.array(share) / 2
    square, pixels = (along**2).sum(), views * (n - 2 * margin) ** 2
    variance = quantum * square**2 + electronic**2
    # covariances of normal numbers: var = Σ C(d)²/pixels, where Σ C² = quantum²·(Σ k⋆k²)² + 2·… + electronic⁴
    power = np.convolve(along, along)
    squares = quantum**2 * (power**2).sum() ** 2 + 2 * quantum * square**2 * electronic**2 + electronic**4
    assert covariance[most, most] == pytest.approx(variance, abs=4 * math.sqrt(2 * squares / pixels))
    f = np.linspace(0, 0.5, 12)
    waves = np.exp(-2j * np.pi * f[:, None] * np.array(shifts))
    nps = np.real(np.einsum("fa,ab,gb->fg", waves, covariance, waves))
    mtf = np.cos(2 * np.pi * f[:, None] * d) @ along
    expected = quantum * np.multiply.outer(mtf, mtf) ** 2 + electronic**2
    # the spectrum sums 17² covariances; where the noise is white their errors are independent, at f = 0 they add up
    # to a periodogram of cells of 17² pixels: relative error √(2·17²/pixels)
    error = 5 * (expected + 0.06 * electronic**2) * math.sqrt(2 * (2 * most + 1) ** 2 / pixels)
    np.testing.assert_array_less(np.abs(nps - expected), error)
    assert expected[-1, -1] < 1.2 * electronic**2 < 0.2 * expected[0, 0]


@pytest.mark.parametrize(
    "noise", [Noise(), Noise(adc_bits=None), Noise(model="none"), Noise(fixed_pattern=0.05, dead_fraction=0.1)]
)
def test_reading_out_what_was_drawn_is_detecting_it(noise):
    m1 = np.random.default_rng(1).random((20, 30)).astype(np.float32)
    m2, key, i0 = 1.2 * m1, rng.stream_key("a", "view", 3), 1e4
    pattern = pixel_pattern(m1.shape, noise=noise, scene_id="a")
    whole = detect(m1, m2, noise=noise, i0=i0, key=key, pattern=pattern)
    parts = read_out(photons(m1, m2, noise=noise, i0=i0, key=key), noise=noise, i0=i0, key=key, pattern=pattern)
    assert parts.dtype == whole.dtype
    # float32 of the photons moves a count that lies at a half
    np.testing.assert_allclose(parts.astype(float), whole, atol=1 if noise.has_adc else 2e-3, rtol=1e-6)
    assert (parts != whole).mean() < 0.05 or not noise.has_adc


def test_the_fast_read_out_is_the_reference():
    noise, key, i0 = Noise(fixed_pattern=0.1, dead_fraction=0.1), rng.stream_key("b", "view", 0), 1e3
    drawn = (np.random.default_rng(2).random((5, 7)) * 1.2 * i0).astype(np.float32)
    pattern = pixel_pattern(drawn.shape, noise=noise, scene_id="b")
    given = drawn, pattern, i0, noise.electronic, noise.gain(i0), noise.dark, float(noise.full_scale), key
    fast, slow = np.empty(drawn.shape, np.uint16), np.empty(drawn.shape, np.uint16)
    noise_cpu.read_out(*given, fast)
    noise_reference.read_out(*given, slow)
    np.testing.assert_array_equal(fast, slow)


# --- lag ----------------------------------------------------------------------------------------------


def test_a_step_of_the_signal_is_followed_in_closed_form():
    parts = (Lag(share=0.04, decay=0.6), Lag(share=0.03, decay=0.85))
    panel = Panel(None, parts, (0.5, 0.5))
    signal = [1.0] * 60 + [0.0] * 12
    seen = np.array([panel.see("counts", np.full((2, 3), s, np.float32))[1, 2] for s in signal])
    k = np.arange(60)
    np.testing.assert_allclose(seen[:60], 1 - sum(p.share * p.decay**k for p in parts), atol=LATE + 1e-6)
    k = np.arange(12)
    np.testing.assert_allclose(seen[60:], sum(p.share * p.decay**k for p in parts), atol=LATE + 1e-6)
    assert seen[60] == pytest.approx(0.07, abs=1e-3)


def test_what_comes_too_early_is_at_most_what_is_stated():
    parts = (Lag(share=0.1, decay=0.98), Lag(share=0.3, decay=0.0))
    found = response(parts)
    assert found.sum() == pytest.approx(1, abs=1e-14)
    n = found.size - 1
    assert 0.1 * 0.98**n <= LATE < 0.1 * 0.98 ** (n - 1)
    assert found[0] == pytest.approx(0.6) and found[1] == pytest.approx(0.1 * 0.02 + 0.3)
    assert response(()).tolist() == [1.0]
    panel = Panel(None, parts, (1.0, 1.0))
    one = np.ones((1, 1), np.float32)
    assert panel.see("counts", one)[0, 0] == panel.see("twin", one)[0, 0] == np.float32(0.6)


# --- scans --------------------------------------------------------------------------------------------


def ball(x, y, radius, metal=True):
    piece = Primitive(kind=ELLIPSOID, centre=(x, y, 0.0), params=(radius,) * 3)
    return Solid(name="ball", material="Fe" if metal else "water", primitives=(piece,), metal=metal)


def body(*solids):
    names = ("air", "water", "Fe")
    return Phantom(labels=np.zeros((1, 1, 1), np.uint8), materials=names, d_voxel=(1.0,) * 3, solids=solids)


BODY = body(ball(0.0, 0.0, 5.0, metal=False), ball(2.0, 1.0, 1.0))


def machine(noise=None, geometry=GEOMETRY, **detector):
    tube = Tube(model="mono", kvp=60.0, filters=())
    return Scanner(geometry=geometry, noise=noise or Noise(), tube=tube, detector=Detector(kind="ideal", **detector))


def scan(phantom, scanner, first_view=0, truth=None, **changes):
    plan = make_plan(phantom, scanner, Simulation(), truth or Truth(), "scene")
    plan = dataclasses.replace(plan, **changes)
    views = [out for _, out in simulate_views(plan, phantom, scanner, first_view)]
    return plan, {name: np.stack([view[name] for view in views]) for name in views[0]}


@pytest.mark.parametrize("detector", [{"blur": Blur(fwhm=1.5)}, {"lag": LAG}, {"blur": Blur(fwhm=1.5), "lag": LAG}])
def test_the_twin_is_the_scan_of_the_body_without_metal_to_the_last_count(detector):
    scanner = machine(noise=Noise(fixed_pattern=0.02), **detector)
    plan, out = scan(BODY, scanner)
    _, alone = scan(BODY.without_metal(), scanner, rule=plan.rule, materials=plan.materials, tissues=plan.tissues)
    np.testing.assert_array_equal(out["metal_free/counts"], alone["counts"])
    changed = out["counts"] != out["metal_free/counts"]
    assert 0 < changed.mean() < 0.6


def test_counts_change_no_farther_from_metal_than_the_kernel_reaches():
    scanner = machine(blur=Blur(fwhm=1.2))
    _, sharp = scan(BODY, machine())
    _, out = scan(BODY, scanner)
    reach_v, reach_u = Panel(scanner.detector.blur, (), GEOMETRY.d_detector).reach
    # where light of an average pixel is, cut at 1e-6 of it: ±4.9 σ
    assert (reach_v, reach_u) == (math.ceil(4.892 * 1.2 / FWHM / 0.5 - 0.5), math.ceil(4.892 * 1.2 / FWHM / 0.6 - 0.5))
    for k in range(GEOMETRY.n_views):
        metal = sharp["counts"][k] != sharp["metal_free/counts"][k]
        near = np.zeros(metal.shape, bool)
        for v, u in np.argwhere(metal):
            near[max(v - reach_v, 0) : v + reach_v + 1, max(u - reach_u, 0) : u + reach_u + 1] = True
        changed = out["counts"][k] != out["metal_free/counts"][k]
        assert changed.any() and not (changed & ~near).any()


@pytest.mark.parametrize("first", [1, 3, 6])
def test_a_scan_with_lag_goes_on_with_the_same_bytes(first):
    scanner = machine(lag=LAG, blur=Blur(fwhm=0.8), geometry=msgspec.structs.replace(GEOMETRY, n_views=7))
    truth = Truth(noise_free=True)
    assert response(LAG).size - 1 > 1
    _, whole = scan(BODY, scanner, truth=truth)
    _, rest = scan(BODY, scanner, first, truth=truth)
    for name, stack in whole.items():
        np.testing.assert_array_equal(stack[first:], rest[name], name)


def test_only_the_views_that_matter_are_made_again(monkeypatch):
    made = []
    monkeypatch.setattr(
        "ctsim.readout.stream_key", lambda scene, what, k: made.append(k) or rng.stream_key(scene, what, k)
    )
    n = 20
    scanner = machine(lag=LAG, geometry=msgspec.structs.replace(GEOMETRY, n_views=n))
    scan(body(ball(2.0, 1.0, 1.0)), scanner, n - 1, Truth(twin=False))
    frames = response(LAG).size - 1
    assert made == list(range(n - 1 - frames, n)) and frames < n - 1


def test_truth_without_noise_is_the_mean_of_the_counts():
    scanner = machine(noise=Noise(electronic=0.0, adc_bits=None), blur=Blur(fwhm=1.5), lag=LAG)
    truth = Truth(noise_free=True, scatter_free=True)
    _, out = scan(BODY, msgspec.structs.replace(scanner, i0=1e12), truth=truth)
    for twin in ("", "metal_free/"):
        # the photons' noise is 1e-6 in the open field; the darkest pixels have 1 % of it
        np.testing.assert_allclose(-np.log(out[f"{twin}counts"] / 1e12), out[f"{twin}noise_free"], atol=1e-4)


def test_the_flat_is_blurred_like_the_scan():
    nothing = body(ball(0.0, 0.0, 0.01))
    scanner = machine(noise=Noise(n_flats=0), blur=Blur(fwhm=2.0, tail=0.2, tail_fwhm=6.0))
    plan, _ = scan(nothing, scanner)
    flat = flat_image(plan, scanner)
    expected = scanner.noise.dark + scanner.noise.gain(scanner.i0)
    np.testing.assert_allclose(flat, expected, rtol=1e-6)
    noisy = machine(noise=Noise(n_flats=16, electronic=0.0), blur=Blur(fwhm=2.0))
    plan, _ = scan(nothing, noisy)
    ((_, v, u),) = kernels(noisy.detector.blur, GEOMETRY.d_detector)
    inner = flat_image(plan, noisy)[10:-10, 10:-10].astype(float)
    spread = math.sqrt((v**2).sum() * (u**2).sum() / 16 / noisy.i0 / STOPPED) * noisy.noise.gain(noisy.i0)
    # 2000 pixels, of which about 2000/40 are independent: 10 % of a standard deviation, thrice; the ADC adds 0.1 counts
    assert inner.std() == pytest.approx(spread, rel=0.3)


def test_the_plan_says_what_the_panel_does():
    plan, _ = scan(BODY, machine())
    assert not plan.runs("lag") and not plan.runs("detector blur") and "detector blur, lag" in plan.text()
    plan, _ = scan(BODY, machine(blur=Blur(fwhm=0.4, tail=0.1, tail_fwhm=2.0), lag=LAG))
    assert "detector blur (0.4 mm and 2 mm)" in plan.text()
    assert f"lag (of the last {response(LAG).size - 1} views)" in plan.text()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Blur(fwhm=0.0), r"blur: fwhm must be within \(0, 50\] mm"),
        (lambda: Blur(fwhm=math.nan), "fwhm must be within"),
        (lambda: Blur(fwhm=1.0, tail=0.1), "tail and tail_fwhm need each other"),
        (lambda: Blur(fwhm=1.0, tail_fwhm=2.0), "tail and tail_fwhm need each other"),
        (lambda: Blur(fwhm=1.0, tail=1.5, tail_fwhm=2.0), r"tail must be a share within \[0, 1\]"),
        (lambda: Lag(share=-0.1, decay=0.5), r"lag: share must be within \[0, 1\)"),
        (lambda: Lag(share=0.1, decay=0.99), r"lag: decay must be within \[0, 0.98\]"),
        (lambda: Detector(lag=(Lag(share=0.6, decay=0.5),) * 2), "add up to less than 1, got 1.2"),
        (lambda: Detector(kind="counting", blur=Blur(fwhm=0.2)), "expected neither blur nor lag"),
        (lambda: machine(noise=Noise(model="tigre"), lag=LAG), "expected neither detector.blur nor detector.lag"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(make, words):
    with pytest.raises(InputError, match=words):
        make()
