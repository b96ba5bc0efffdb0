import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.metrics import window
from ctsim.benchmarks.scores.protocol import (
    AS_RETURNED,
    AT_50KEV,
    METAL_MARGIN,
    Truth,
    evaluate,
    tissue_range,
    truth_of,
)
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError
from ctsim.phantoms.dataset import simulate_scene
from ctsim.phantoms.scene import parse_suite


def volumes(shape=(13, 17, 19), seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    reference = ndimage.gaussian_filter(rng.random(shape), 1.0)
    return reference + noise * rng.standard_normal(shape), reference


def slicewise(values, reference, data_range):
    """The SSIM map of scikit-image, slice by slice along each axis."""
    maps = []
    for axis in range(3):
        pairs = zip(np.moveaxis(values, axis, 0), np.moveaxis(reference, axis, 0), strict=True)
        slices = [
            structural_similarity(
                a, b, data_range=data_range, full=True, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
            )[1]
            for a, b in pairs
        ]
        maps.append(np.moveaxis(np.stack(slices), 0, axis))
    return np.mean(maps, 0)


@pytest.mark.slow
def test_ssim_equals_scikit_image_slice_by_slice():
    values, reference = volumes()
    expected = slicewise(values, reference, 0.7).mean()
    # Same float64 sums in another order: some 1e3 terms of 1e-16, divided by c2 = 4e-4.
    assert metrics.ssim3d(values, reference, data_range=0.7) == pytest.approx(expected, abs=1e-10)


def test_ssim_in_a_region_equals_substitution_and_the_map():
    values, reference = volumes((23, 25, 29), seed=1)
    region = np.zeros(values.shape, bool)
    region[7:14, 8:15, 9:20] = True
    region[9:11, 10:12, 12:14] = False
    expected = slicewise(np.where(region, values, reference), reference, 0.5)[region].mean()
    assert metrics.ssim3d(values, reference, data_range=0.5, region=region) == pytest.approx(expected, abs=1e-10)


def test_ssim_of_float32_is_that_of_float64():
    values, reference = (v.astype(np.float32) for v in volumes(seed=2))
    expected = metrics.ssim3d(values.astype(float), reference.astype(float), data_range=1.0)
    assert metrics.ssim3d(values, reference, data_range=1.0) == pytest.approx(expected, abs=1e-12)


def test_what_is_not_judged_cannot_leak_in():
    values, reference = volumes()
    region = np.zeros(values.shape, bool)
    region[:, :9] = True
    spoilt = np.where(region, values, 1e6)
    for metric in (metrics.psnr3d, metrics.ssim3d):
        clean = metric(values, reference, data_range=1.0, region=region)
        assert metric(spoilt, reference, data_range=1.0, region=region) == clean
        assert metric(spoilt, reference, data_range=1.0) != pytest.approx(clean)


def test_window_is_the_gaussian_of_eleven_taps():
    impulse = np.zeros(21)
    impulse[10] = 1
    expected = ndimage.gaussian_filter1d(impulse, 1.5, truncate=3.5)
    np.testing.assert_allclose(window(), expected[5:16], atol=1e-15)
    assert expected[4] == 0


def test_psnr_closed_form_and_range():
    reference = np.zeros((5, 7, 11))
    values = np.full_like(reference, 0.1)
    assert metrics.psnr3d(values, reference, data_range=1.0) == pytest.approx(20.0, abs=1e-12)
    assert metrics.psnr3d(values, reference, data_range=10.0) == pytest.approx(40.0, abs=1e-12)
    region = np.zeros(reference.shape, bool)
    region[0] = True
    values[1:] = 5.0
    assert metrics.psnr3d(values, reference, data_range=1.0, region=region) == pytest.approx(20.0, abs=1e-12)


def test_identical_volumes_have_no_psnr_and_ssim_one():
    _, reference = volumes()
    assert metrics.psnr3d(reference, reference, data_range=1.0) is None
    assert metrics.ssim3d(reference, reference, data_range=1.0) == pytest.approx(1.0, abs=1e-12)


def test_small_volumes_have_a_ssim():
    values, reference = volumes((5, 7, 11))
    assert 0 < metrics.ssim3d(values, reference, data_range=1.0) < 1
    assert metrics.ssim3d_naf(values, reference) is None


def test_compatibility_columns():
    values, reference = volumes()
    reference[3] = 0  # a slice that R2-Gaussian's evaluation leaves out
    naf = structural_similarity(values, reference, win_size=7, data_range=2.0)
    assert metrics.ssim3d_naf(values, reference) == pytest.approx(naf, abs=1e-12)
    means = []
    for axis in range(3):
        scores = []
        for a, b in zip(np.moveaxis(values, axis, 0), np.moveaxis(reference, axis, 0), strict=True):
            if b.max() > 0:

                def g(f):
                    return ndimage.gaussian_filter(f, 1.5, truncate=3.5, mode="constant")

                mu, nu = g(a), g(b)
                va, vb, cov = g(a * a) - mu**2, g(b * b) - nu**2, g(a * b) - mu * nu
                top = (2 * mu * nu + 1e-4) * (2 * cov + 9e-4)
                scores.append((top / ((mu**2 + nu**2 + 1e-4) * (va + vb + 9e-4))).mean())
        means.append(np.mean(scores))
    assert metrics.ssim3d_r2(values, reference) == pytest.approx(np.mean(means), abs=1e-10)
    assert metrics.ssim3d_r2(values, np.zeros_like(reference)) is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_compatibility_columns_are_always_there_and_are_scikit_images(kind):
    t = truth()
    noise = 0.01 * np.random.default_rng(3).standard_normal(t.metal.shape)
    values, reference = (t.references["50kev"] + noise).astype(kind), t.references["50kev"]
    found = evaluate(values, t)["paper"].values
    # scikit-image sums float32 squares in float32: pairwise sums of 1e4 terms are good to some 1e-6, 4e-6 dB
    for name, data_range in (("psnr3d_full_gtmax", float(reference.max())), ("psnr3d_r2", 1.0)):
        expected = peak_signal_noise_ratio(reference, values, data_range=data_range)
        assert found[name] == pytest.approx(expected, abs=2e-5)
    # the trap: left to itself, scikit-image takes another range than the one stated, or refuses floats
    wrong = structural_similarity(reference.astype(float), values.astype(float), data_range=1.0, win_size=7)
    naf = structural_similarity(reference.astype(float), values.astype(float), data_range=2.0, win_size=7)
    # its filters of float32 volumes work in float32: variances of 1e-4 to 1e-7, against c2 = 4e-3
    assert found["ssim3d_naf"] == pytest.approx(naf, abs=1e-4) and abs(wrong - naf) > 1e-3
    assert found["ssim3d_r2"] == pytest.approx(zero_border(values, reference), abs=1e-6)


def zero_border(values, reference):
    """SSIM with peak 1 by torch's convolution, which pads with zeros, as R2-Gaussian computes it."""
    taps = torch.from_numpy(window())
    kernel = (taps[:, None] * taps[None])[None, None]
    scores = []
    for axis in range(3):
        pairs = zip(np.moveaxis(values, axis, 0), np.moveaxis(reference, axis, 0), strict=True)
        kept = [(a, b) for a, b in pairs if b.max() > 0]
        x, y = (torch.from_numpy(np.stack(v).astype(float))[:, None] for v in zip(*kept, strict=True))

        def mean(f):
            return torch.nn.functional.conv2d(f, kernel, padding=5)

        mu, nu = mean(x), mean(y)
        va, vb, cov = mean(x * x) - mu**2, mean(y * y) - nu**2, mean(x * y) - mu * nu
        top = (2 * mu * nu + 1e-4) * (2 * cov + 9e-4)
        scores.append(float((top / ((mu**2 + nu**2 + 1e-4) * (va + vb + 9e-4))).mean()))
    return np.mean(scores)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_a_range_must_be_positive(bad):
    values, reference = volumes((5, 7, 11))
    for metric in (metrics.psnr3d, metrics.ssim3d):
        with pytest.raises(InputError, match="data range must be positive"):
            metric(values, reference, data_range=bad)


def test_shapes_and_regions_are_checked():
    values, reference = volumes((5, 7, 11))
    with pytest.raises(InputError, match="one 3-D shape"):
        metrics.psnr3d(values, reference[1:], data_range=1.0)
    with pytest.raises(InputError, match="empty"):
        metrics.psnr3d(values, reference, data_range=1.0, region=np.zeros(values.shape, bool))


def test_gain_is_least_squares():
    _, reference = volumes()
    region = reference > 0.5
    values = np.where(region, reference / 1.25, 99.0)
    assert metrics.least_squares_gain(values, reference, region) == pytest.approx(1.25, rel=1e-12)
    assert metrics.least_squares_gain(np.zeros_like(values), reference, region) is None


def test_dilate_and_erode_count_steps():
    mask = np.zeros((9, 9, 9), bool)
    mask[4, 4, 4] = True
    grown = metrics.dilate(mask, 2)
    assert grown.sum() == 5**3 and grown[2:7, 2:7, 2:7].all()
    np.testing.assert_array_equal(metrics.erode(grown, 2), mask)


def ball(shape, centre, radius):
    z, y, x = np.ogrid[tuple(slice(n) for n in shape)]
    return (z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 <= radius**2


def test_boundary_of_a_shifted_slab_is_its_shift():
    truth = np.zeros((5, 7, 30), bool)
    truth[:, :, 10:20] = True
    found = np.roll(truth, 3, 2)
    assert metrics.boundary_rms(found, truth, (1.0, 1.0, 0.5)) == pytest.approx(1.5, abs=1e-12)
    assert metrics.boundary_rms(truth, truth, (1.0, 1.0, 0.5)) == 0
    assert metrics.boundary_rms(np.zeros_like(truth), truth, (1.0, 1.0, 1.0)) is None


def test_metal_metrics_of_a_scaled_metal():
    metal = ball((21, 22, 23), (10, 11, 12), 5)
    reference = np.where(metal, 0.4, 0.02)
    found = metrics.metal_metrics(reference * 0.5, reference, metal, np.ones_like(metal), (1.0, 1.0, 1.0))
    assert found == {"core_ratio": pytest.approx(0.5), "dice": 1.0, "boundary_rms": 0.0}
    small = ball((21, 22, 23), (10, 11, 12), 4)
    shrunk = metrics.metal_metrics(np.where(small, 0.4, 0.02), reference, metal, np.ones_like(metal), (1.0, 1.0, 1.0))
    assert shrunk["dice"] == pytest.approx(2 * small.sum() / (small.sum() + metal.sum()))
    # The balls' surfaces are one voxel apart, give or take the staircase of the voxels (< 0.5).
    assert 0.6 < shrunk["boundary_rms"] < 1.5


def test_a_metal_that_is_shifted_by_one_voxel():
    metal = np.zeros((12, 14, 30), bool)
    metal[2:10, 3:11, 8:18] = True
    reference = np.where(metal, 0.4, 0.02)
    found = metrics.metal_metrics(np.roll(reference, 1, 2), reference, metal, np.ones_like(metal), (3.0, 3.0, 0.5))
    # nine of ten slices overlap; of the core (8 of 10 slices, all still inside) nothing is lost
    assert found["dice"] == pytest.approx(0.9) and found["core_ratio"] == pytest.approx(1.0)
    # surface voxels: two end faces of 8 × 8, and per slice between them a ring of 28. Shifted, one end face lies
    # 0.5 mm outside; the other 0.5 mm inside, where only its inner 6 × 6 is off the surface: both ways the same
    n, off = 2 * 64 + 8 * 28, 64 + 36
    assert found["boundary_rms"] == pytest.approx(0.5 * math.sqrt(off / n), rel=1e-12)


def test_the_gain_is_fitted_where_it_is_judged():
    t = truth()
    seen = np.broadcast_to(np.arange(28) < 20, t.body.shape)
    cut = dataclasses.replace(t, judged=t.judged & seen, tissue=t.tissue & seen, cut=True)
    values = t.references["effective"] * np.where(seen, np.float32(0.8), np.float32(5))
    assert evaluate(values, cut)["aligned"].values["gain"] == pytest.approx(1.25, rel=1e-6)


def test_each_kind_of_metal_has_a_half_of_its_own():
    metal, kinds = np.zeros((13, 14, 30), bool), np.zeros((13, 14, 30), np.uint8)
    metal[3:10, 3:11, 5:25] = True
    kinds[3:10, 3:11, 5:15], kinds[3:10, 3:11, 15:25] = 4, 7
    kinds[3, 3, 5] = 0  # a voxel of metal whose label is another's
    values = np.where(kinds == 7, 10.0, np.where(metal, 1.0, 0.02))
    given = (values, values, metal, np.ones_like(metal), (1.0, 1.0, 1.0))
    assert metrics.metal_metrics(*given)["dice"] < 0.7  # half of the heavier one, or of both's median
    assert metrics.metal_metrics(*given, kinds) == {"core_ratio": 1.0, "dice": 1.0, "boundary_rms": 0.0}
    hollow = np.where(kinds == 7, 0.0, values)  # the heavier one vanished
    assert metrics.metal_metrics(hollow, *given[1:], kinds)["dice"] == pytest.approx(2 / 3, rel=0.01)
    one = metrics.metal_metrics(*given, np.where(metal, 4, 0).astype(np.uint8))
    assert one == metrics.metal_metrics(*given)


def test_half_maximum_is_half_of_the_core():
    metal = np.zeros((9, 9, 21), bool)
    metal[2:7, 2:7, 5:16] = True
    for level, dice in ((0.51, 2 * 5 * 5 * 11 / (5 * 5 * 11 + 5 * 5 * 13)), (0.49, 1.0)):
        values = np.where(metal, 1.0, 0.0)
        values[2:7, 2:7, [4, 16]] = level  # blurred to one more slice at each end
        found = metrics.metal_metrics(values, metal.astype(float), metal, np.ones_like(metal), (1.0, 1.0, 1.0))
        assert found["dice"] == pytest.approx(dice)


def test_a_thin_metal_says_that_its_core_is_all_of_it():
    t = truth()
    assert evaluate(t.references["effective"], t)["metal"].note == ""
    thin = np.zeros_like(t.metal)
    thin[10, 12, 10:18] = True
    score = evaluate(t.references["effective"], dataclasses.replace(t, metal=thin))["metal"]
    assert "too thin" in score.note and score.values["core_ratio"] == pytest.approx(1.0)


def test_metal_that_vanished_scores_zero():
    metal = ball((11, 12, 13), (5, 6, 6), 3)
    found = metrics.metal_metrics(np.zeros(metal.shape), np.where(metal, 1.0, 0), metal, metal, (1.0, 1.0, 1.0))
    assert found == {"core_ratio": 0.0, "dice": 0.0, "boundary_rms": None}


def truth(with_metal=True):
    shape = (20, 24, 28)
    body = ball(shape, (10, 12, 14), 7)
    metal = ball(shape, (10, 12, 14), 2) if with_metal else np.zeros(shape, bool)
    near = metrics.dilate(metal, 2)
    judged = metrics.dilate(body, 4)
    effective = np.where(metal, 0.5, np.where(body, 0.02, 0)).astype(np.float32)
    return Truth(
        references={"effective": effective, "50kev": effective * np.float32(1.1)},
        metal=metal,
        body=body,
        tissue=judged & ~near,
        judged=judged,
        near_metal=near,
        d_voxel=(1.0, 1.0, 1.0),
        l0=14.0,
    )


def test_a_pure_energy_scale_is_what_alignment_removes():
    t = truth()
    scores = evaluate(t.references["effective"] * np.float32(0.8), t)
    assert set(scores) == {"tissue", "aligned", "aligned_50kev", "paper", "metal"}
    assert scores["aligned"].values["gain"] == pytest.approx(1.25, rel=1e-6)
    assert scores["aligned_50kev"].values["gain"] == pytest.approx(1.375, rel=1e-6)
    # A fifth of the range is missing where the body is: MSE = 0.2²·R²·share of body in the region.
    share = (t.body & t.tissue).sum() / t.tissue.sum()
    assert scores["tissue"].values["psnr3d"] == pytest.approx(-10 * math.log10(0.04 * share), abs=1e-4)
    # What is left is float32 rounding: nothing at all, or beyond 100 dB.
    assert scores["aligned"].identical or scores["aligned"].values["psnr3d"] > 100
    assert scores["tissue"].data_range == pytest.approx(0.02)
    assert scores["paper"].data_range == pytest.approx(0.55)
    assert scores["metal"].values["core_ratio"] == pytest.approx(0.8, rel=1e-5)


def test_alignment_turns_no_sign():
    t = truth()
    negative = evaluate(-t.references["effective"], t)
    assert negative["aligned"].values == {**negative["tissue"].values, "gain": None}
    assert negative["aligned"].alignment == "none: no positive gain fits"
    assert negative["aligned"].values["psnr3d"] < 10


def test_a_method_that_knows_energies_is_held_against_50_kev_by_its_volume_at_50_kev():
    t = truth()
    delivered, true = t.references["effective"], t.references["50kev"]
    own, both = evaluate(delivered, t), evaluate(delivered, t, at_50kev=true)
    assert both["paper"].identical and both["aligned_50kev"].identical
    assert {name for name, score in both.items() if score.volume == AT_50KEV} == {"paper", "aligned_50kev"}
    assert {score.volume for score in own.values()} == {AS_RETURNED}
    assert own["paper"].values["psnr3d"] < 60
    assert {name for name in both if both[name] != own[name]} == {"paper", "aligned_50kev"}
    assert evaluate(delivered, t, at_50kev=true, anchor=True)["aligned_50kev"].identical


def test_a_perfect_volume_is_named_identical():
    t = truth()
    score = evaluate(t.references["effective"], t)["tissue"]
    assert score.identical and score.values["psnr3d"] is None and score.values["rmse"] == 0


def test_every_score_says_region_reference_and_range():
    for name, score in evaluate(truth().references["effective"] + np.float32(0.001), truth()).items():
        assert score.region and score.reference and score.alignment and score.n_voxels > 0, name
        assert name == "metal" or score.data_range > 0


def test_without_metal_there_is_no_metal_score():
    t = truth(with_metal=False)
    assert "metal" not in evaluate(t.references["effective"], t)
    assert tissue_range(t, "effective") == pytest.approx(0.02)
    assert set(evaluate(t.references["effective"], t, anchor=True)) == {"tissue", "aligned", "aligned_50kev"}


def test_metal_does_not_set_the_tissue_range():
    t = truth()
    assert tissue_range(t, "effective") < 0.1 < t.references["effective"].max()


def rods(diameter: float, **changes) -> ScanWithTruth:
    """Three iron rods in water, in voxels of 2.5 mm."""
    text = f'{{ recipe = "metal_rods", metal = "Fe", n_voxel = [24, 24, 24], insert_mm = {diameter} }}'
    more = "".join(f"{key} = {value}\n" for key, value in changes.items())
    scanner = "n_views = 2, n_detector = [8, 8], n_voxel = [24, 24, 24]"
    return simulate_scene(parse_suite(f'name = "rods"\nphantom = {text}\nscanner = {{ {scanner} }}\n{more}')[0])


def test_metal_thinner_than_a_voxel_is_not_judged_as_tissue():
    thin = rods(0.8)
    truth = truth_of(thin)
    assert not truth.metal.any()  # no voxel is half full
    more = thin.reference("effective") - thin.metal_free.reference("effective")
    touched = more > 0.05 * np.median(thin.metal_free.reference("effective")[truth.body])
    assert touched.sum() > 3 * 10 and more.max() > 0.02  # 1/mm, about water's own
    assert not (truth.tissue & metrics.dilate(touched, METAL_MARGIN)).any()
    blind = truth_of(rods(0.8, truth="{ twin = false }"))
    assert np.array_equal(blind.tissue, blind.judged)  # nothing tells where it is


def test_thick_metal_is_judged_by_its_mask_alone():
    thick = rods(8.0)
    truth = truth_of(thick)
    assert truth.metal.any() and np.array_equal(truth.near_metal, metrics.dilate(truth.metal, METAL_MARGIN))
