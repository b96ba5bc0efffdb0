import dataclasses
import math

import numpy as np
import pytest
from scipy import ndimage

from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.protocol import Truth, field_of_view
from ctsim.benchmarks.scores.soft import NO_HU, Edges, mtf50, soft_layout, soft_score
from ctsim.benchmarks.scores.structure import between_metal, structure_layout, structure_score
from ctsim.geometry import Geometry

WATER = 0.02
NAMES = ("air", "muscle", "adipose", "bone", "Fe")
HU = (-1000.0, 60.0, -100.0, 1500.0, 9000.0)
SHAPE, D = (48, 56, 64), (0.5, 0.5, 0.5)
RODS = ((24, 28, 20), (24, 28, 44))


def bodies(rods=RODS):
    """A box of muscle with a block of fat, one of bone, and rods of iron along z."""
    labels = np.zeros(SHAPE, np.uint8)
    labels[4:-4, 4:-4, 4:-4] = 1
    labels[10:40, 34:50, 8:30] = 2
    labels[10:40, 8:16, 40:56] = 3
    for _, y, x in rods:
        labels[8:40, y - 1 : y + 2, x - 1 : x + 2] = 4
    return labels


def truth_of(labels):
    metal, body = labels == 4, labels > 0
    near = metrics.dilate(metal, 2) if metal.any() else metal
    judged = metrics.dilate(body, 4)
    reference = (np.array(HU)[labels] / 1000 + 1) * WATER
    return Truth(
        references={"effective": reference.astype(np.float32)}, metal=metal, body=body, tissue=judged & ~near,
        judged=judged, near_metal=near, d_voxel=D, l0=1.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scan():
    labels = bodies()
    truth = truth_of(labels)
    soft = soft_layout(labels, truth, NAMES, WATER)
    return labels, truth, soft, structure_layout(soft, truth, 2.5)


def volume(scan, hu=0.0):
    """The truth with an error in HU, in float64."""
    return (scan[2].reference + hu + 1000) / 1000 * WATER


def scored(scan, hu=0.0):
    return soft_score(volume(scan, hu), scan[2]).values


def test_the_classes_are_those_near_water(scan):
    soft = scan[2]
    assert set(soft.classes) == {"muscle", "adipose"} and soft.pair == ("muscle", "adipose")
    assert not (soft.region & (np.isin(scan[0], (0, 3, 4)))).any()


def test_the_truth_is_perfect(scan):
    score = soft_score(volume(scan), scan[2])
    # the reference is float32: 2^-24 of 1.06 water is less than 1e-4 HU
    assert score.values["rmse"] < 1e-4 and score.values["contrast"] == pytest.approx(1, abs=1e-6)


def test_an_offset_is_bias_everywhere_and_nothing_else(scan):
    values = scored(scan, 10.0)
    # 20·log10(1000/10) = 40 dB; the reference's rounding is below 1e-4 HU of 10
    assert values["psnr3d"] == pytest.approx(40, abs=1e-3)
    assert (values["bias:muscle"], values["rmse:adipose"]) == pytest.approx((10, 10), abs=1e-3)
    assert values["contrast"] == pytest.approx(1, abs=1e-6) and values["noise_far"] < 1e-3


def test_fat_as_muscle_leaves_no_contrast(scan):
    painted = np.where(scan[2].classes["adipose"], 160.0, 0.0)
    values = scored(scan, painted)
    assert values["contrast"] == pytest.approx(0, abs=1e-6) and values["bias:adipose"] == pytest.approx(160, abs=1e-3)
    assert values["bias:muscle"] == pytest.approx(0, abs=1e-3)


def test_white_noise_has_its_deviation_and_no_grain(scan):
    sigma = 40.0
    noise = sigma * np.random.default_rng(1).standard_normal(SHAPE)
    values = scored(scan, noise)
    soft = scan[2]
    for where, mask in (("near", soft.wide & soft.near), ("far", soft.wide & ~soft.near)):
        n = int(mask.sum())
        assert n > 1000
        # five standard errors: σ/√(2n) of a deviation, 1/√n of a correlation (over three axes less); means of 5³ voxels
        # make neighbours' squares share less than 1 % of their variance
        assert values[f"noise_{where}"] == pytest.approx(sigma, abs=5 * sigma / math.sqrt(2 * n) * 1.01)
        assert abs(values[f"grain_{where}"]) < 5 / math.sqrt(n)
    even = min(int(soft.even[name].sum()) for name in soft.pair)
    assert values["cnr"] == pytest.approx(160 / sigma, rel=5 / math.sqrt(even))
    swapped = scored(scan, noise - np.where(soft.classes["muscle"], 320.0, 0.0))
    assert swapped["contrast"] == pytest.approx(-1, abs=0.05)
    assert swapped["cnr"] == pytest.approx(-160 / sigma, rel=5 / math.sqrt(even))


def test_a_volume_without_deviation_has_no_cnr(vessel):
    """One value inside, up to rounding: its contrast over rounding would be any number."""
    for exact in (0.0, 5e-3):
        rest = exact * np.random.default_rng(5).standard_normal(SHAPE) - np.where(vessel[2].classes["adipose"], 0, 160)
        assert scored(vessel, rest)["cnr"] is None and scored(vessel, rest)["fine_cnr"] is None
    noise = 0.02 * np.random.default_rng(5).standard_normal(SHAPE)
    assert scored(vessel, noise)["cnr"] > 0 and scored(vessel, noise)["fine_cnr"] > 0


VESSEL = (slice(18, 34), slice(30, 33), slice(24, 26))


@pytest.fixture(scope="module")
def vessel():
    """A box of muscle with a block of fat, in it a vessel 3 by 2 voxels thick that ends next to a piece of bone."""
    labels = np.zeros(SHAPE, np.uint8)
    labels[4:-4, 4:-4, 4:-4] = 1
    labels[12:36, 20:44, 14:40] = 2
    labels[35:41, 28:35, 22:28] = 3
    labels[VESSEL] = 1
    return labels, None, soft_layout(labels, truth_of(labels), NAMES, WATER), None


def test_fine_structures_are_vessels_away_from_bone(vessel):
    fine = vessel[2].fine
    expected = np.zeros(SHAPE, bool)
    expected[16:33, 28:35, 22:28] = True  # the vessel and 2 voxels around it, as far as 2 voxels from the bone
    assert np.array_equal(fine, expected)


@pytest.mark.parametrize("left", [-0.5, 0.0, 0.5, 1.0])
def test_the_contrast_of_a_vessel_is_the_share_that_is_left(vessel, left):
    sigma = 20.0
    painted = sigma * np.random.default_rng(4).standard_normal(SHAPE)
    painted[VESSEL] -= 160 * (1 - left)
    values = scored(vessel, painted)
    places = np.argwhere(vessel[2].fine)
    reference = vessel[2].reference
    # the deviation from the mean of what is fine within 4 voxels, place by place
    deviation = [
        reference[tuple(p)] - reference[tuple((places[np.abs(places - p).max(1) <= 4]).T)].mean() for p in places
    ]
    power = float(np.sum(np.square(deviation)))
    # white noise without its local mean has at most its own variance, so the share is off by σ/√power at most
    assert values["fine_contrast"] == pytest.approx(left, abs=4 * sigma / math.sqrt(power))
    # the residual is that noise: of about 150 voxels in a mean, so 1 % less than σ; its RMS is known to 1/√(2n)
    n = len(places)
    expected = values["fine_contrast"] * math.sqrt(power / n) / sigma
    assert values["fine_cnr"] == pytest.approx(expected, rel=0.02 + 4 / math.sqrt(2 * n))


@pytest.mark.parametrize("spoilt", [0.09, 0.11])
def test_fine_structures_that_noise_would_decide_have_no_share(vessel, spoilt):
    """The vessel at the contrast at which noise of 100 HU would change the share left by `spoilt`."""
    layout, around = vessel[2], 9
    weight = ndimage.uniform_filter(layout.fine.astype(float), around)
    inside = np.where(layout.fine, layout.reference, 0.0)
    deviation = (inside - ndimage.uniform_filter(inside, around) / np.maximum(weight, 1e-9))[layout.fine]
    faint, fat = layout.reference.copy(), layout.reference[16, 28, 22]
    faint[VESSEL] = fat + 100 / spoilt / np.linalg.norm(deviation) * (faint[VESSEL] - fat)
    values = soft_score((faint + 1000) / 1000 * WATER, dataclasses.replace(layout, reference=faint)).values
    if spoilt > 0.1:
        assert values["fine_contrast"] is None and values["fine_cnr"] is None
    else:
        assert values["fine_contrast"] == pytest.approx(1)


def test_edges_of_large_voxels_are_near_metal_too():
    """Of voxels of 3 mm the centre of a cube of 12 is 18 mm or more from the metal, unless metal is in it."""
    labels = bodies(rods=((24, 28, 44),))
    truth = dataclasses.replace(truth_of(labels), d_voxel=(3.0, 3.0, 3.0))
    edges = soft_layout(labels, truth, NAMES, WATER).edges
    assert len(edges["near"].corners) and len(edges["far"].corners)
    centres = edges["near"].corners + 6
    away = ndimage.distance_transform_edt(labels != 4)[tuple(centres.T)]
    assert away.min() > 6 and 10 / 3 < away.max() <= 12
    fine = dataclasses.replace(truth, d_voxel=(0.5, 0.5, 0.5))
    centres = soft_layout(labels, fine, NAMES, WATER).edges["near"].corners + 6
    assert 12 < ndimage.distance_transform_edt(labels != 4)[tuple(centres.T)].max() <= 20  # 10 mm


def test_smooth_noise_has_grain(scan):
    noise = ndimage.gaussian_filter(np.random.default_rng(2).standard_normal(SHAPE), 0.8)
    # neighbours of white noise behind a Gaussian of σ correlate by exp(−1/(4σ²)) = 0.68; without the local mean, less
    assert 0.4 < scored(scan, 40 * noise / noise.std())["grain_far"] < 0.68


def test_noise_near_metal_is_told_from_noise_far(scan):
    noise = 50 * np.random.default_rng(3).standard_normal(SHAPE) * scan[2].near
    values = scored(scan, noise)
    assert values["noise_near"] > 40 and values["noise_far"] < 0.5 * values["noise_near"]


def test_errors_of_the_metals_edge_are_no_noise(scan):
    """They reach one voxel into the tissue that is left out: 300 HU in 60 % of a cube that began there were noise."""
    metal = scan[1].metal
    edge = np.where(metrics.dilate(metal, 2) & ~metal, 2000.0, 0.0)
    values = scored(scan, edge)
    assert values["noise_near"] < 1e-9 and values["noise_far"] < 1e-9
    noise = 20 * np.random.default_rng(7).standard_normal(SHAPE)
    assert scored(scan, edge + noise)["noise_near"] == pytest.approx(20, rel=0.1)


def test_what_lies_beyond_the_field_of_view_is_no_noise(scan):
    labels, truth = scan[:2]
    seen = np.arange(SHAPE[2])[None, None] < 40
    judged = dataclasses.replace(truth, judged=truth.judged & seen, tissue=truth.tissue & seen)
    found = soft_layout(labels, judged, NAMES, WATER)
    noise = 50 * np.random.default_rng(8).standard_normal(SHAPE) * ~seen
    values = soft_score(volume(scan, noise), found).values
    assert values["noise_near"] < 1e-9 and values["noise_far"] < 1e-9


def test_the_worst_class_is_named_by_its_value(scan):
    labels = scan[0]
    values = scored(scan, np.where(labels == 2, -70.0, np.where(labels == 1, 30.0, 0.0)))
    assert values["worst_bias"] == pytest.approx(-70) == pytest.approx(values["bias:adipose"])
    assert values["worst_rmse"] == pytest.approx(70)


@pytest.mark.parametrize("sigma", [0.55, 1.07, 1.6, 2.6])
def test_the_sharpness_of_a_blur_is_its_closed_form(sigma):
    rng, pitch = np.random.default_rng(4), 0.5
    blocks = np.kron(rng.standard_normal((12, 12, 12)), np.ones((4, 4, 4))) * 100
    corners = np.stack(np.meshgrid(*[np.arange(6, 30, 6)] * 3, indexing="ij"), -1).reshape(-1, 3)
    edges = Edges.of(blocks, corners)
    blurred = ndimage.gaussian_filter(blocks, sigma)
    expected = math.sqrt(math.log(2) / 2) / (math.pi * sigma) / pitch  # exp(−2π²σ²f²) = 1/2
    # a gain exp(−cσ²) is taken as linear between neighbouring σ², which are at most 0.36 σ² apart: off by cσ²·0.36²/8
    # of σ², half of that of σ, with cσ² of 2 or less where the modulation is: 1.6 %
    assert mtf50(blurred, edges, pitch) == pytest.approx(expected, rel=0.016)
    # neither gain nor offset counts; noise averages out over 64 cubes of 12³ voxels
    noisy = 0.5 * blurred + 300 + 20 * rng.standard_normal(blocks.shape)
    assert mtf50(noisy, edges, pitch) == pytest.approx(expected, rel=0.05)


def test_the_sharpness_ends_at_the_grid_and_needs_structure():
    rng, pitch = np.random.default_rng(5), 0.5
    blocks = np.kron(rng.standard_normal((12, 12, 12)), np.ones((4, 4, 4))) * 100
    corners = np.stack(np.meshgrid(*[np.arange(6, 30, 6)] * 3, indexing="ij"), -1).reshape(-1, 3)
    edges = Edges.of(blocks, corners)
    assert mtf50(blocks, edges, pitch) == 0.5 / pitch
    assert mtf50(ndimage.gaussian_filter(blocks, 8), edges, pitch) == pytest.approx(
        math.sqrt(math.log(2) / 2) / (math.pi * 4) / pitch, rel=1e-6
    )  # the widest blur that is tried
    assert mtf50(-blocks, edges, pitch) is None and mtf50(np.zeros_like(blocks), edges, pitch) is None
    assert mtf50(blocks, Edges.of(blocks, corners[:7]), pitch) is None


def test_without_hu_or_soft_tissue_there_is_a_reason(scan):
    labels, truth = scan[:2]
    assert soft_layout(labels, truth, NAMES, None) == NO_HU
    bone = np.where(labels == 1, 3, np.where(labels == 2, 3, labels)).astype(np.uint8)
    reason = soft_layout(bone, truth_of(bone), NAMES, WATER)
    assert isinstance(reason, str) and "within 300 HU" in reason
    score = soft_score(volume(scan), reason)
    assert score.note == reason and set(score.values.values()) == {None}


def structures(scan, hu=0.0):
    return structure_score(volume(scan, hu), scan[3]).values


def test_the_truth_has_no_false_structure(scan):
    values = structures(scan)
    assert all(values[f"false_{what}{end}"] == 0 for what in ("bone", "air") for end in ("", "_near", "_between"))


def test_what_lies_between_is_within_the_hull_of_two_pieces(scan):
    found = between_metal(scan[1])
    assert found[20, 28, 32] and not found[20, 34, 32] and not found[44].any() and not found[20, 28, 50]


def test_a_painted_bar_is_counted(scan):
    layout = scan[3]
    bar = np.zeros(SHAPE, bool)
    bar[20:23, 28, 26:38] = True
    share = (bar & layout.between).sum() / layout.between.sum()
    assert 0 < share < 1
    values = structures(scan, np.where(bar, 1000.0, 0.0))
    assert values["false_bone_between"] == pytest.approx(share, rel=1e-12) and values["false_air_between"] == 0
    assert values["rmse_between"] == pytest.approx(1000 * math.sqrt(share), rel=1e-6)
    assert values["bias_between"] == pytest.approx(1000 * share, rel=1e-6)
    # bone has 1500 HU, muscle 60: half-way are 720 more than muscle's own
    assert structures(scan, np.where(bar, 719.0, 0.0))["false_bone"] == 0
    assert structures(scan, np.where(bar, 721.0, 0.0))["false_bone"] > 0
    # where bone has 4000 HU, half-way would be 2030: false bone begins at 1000, which is 940 more than muscle
    dense = (*scan[:3], structure_layout(scan[2], truth_of(scan[0]), 5.0))
    assert structures(dense, np.where(bar, 939.0, 0.0))["false_bone"] == 0
    assert structures(dense, np.where(bar, 941.0, 0.0))["false_bone"] > 0
    # a voxel of muscle that holds some bone has 950 HU: what is as it should be is not false, 290 more is not yet
    partly = dataclasses.replace(
        dense[3], soft=dataclasses.replace(scan[2], reference=np.where(bar, 950.0, scan[2].reference))
    )
    for more, false in ((0.0, False), (290.0, False), (310.0, True)):
        painted = np.where(bar, 950.0 - scan[2].reference + more, 0.0)
        assert (structure_score(volume(scan, painted), partly).values["false_bone"] > 0) == false
    # air lies 1060 below muscle
    assert structures(scan, np.where(bar, -529.0, 0.0))["false_air"] == 0
    assert structures(scan, np.where(bar, -531.0, 0.0))["false_air"] > 0


def test_one_piece_has_nothing_between_and_no_metal_has_a_reason(scan):
    labels = bodies(RODS[:1])
    truth = truth_of(labels)
    soft = soft_layout(labels, truth, NAMES, WATER)
    values = structure_score(volume(scan), structure_layout(soft, truth, 2.5)).values
    assert values["false_bone_between"] is None and values["false_bone"] == 0
    assert (
        structure_layout(soft, dataclasses.replace(truth, metal=np.zeros(SHAPE, bool)), 2.5)
        == "the scan holds no metal"
    )


@pytest.mark.parametrize("size", [1.4, 2.0])
def test_soft_tissue_is_near_metal_on_coarse_voxels(size):
    labels = bodies(RODS[:1])
    truth = dataclasses.replace(truth_of(labels), d_voxel=(size,) * 3)
    soft = soft_layout(labels, truth, NAMES, WATER)
    found = structure_layout(soft, truth, 2.5)
    # the rod is 3 voxels wide: along x the first voxel that counts is 4 from its surface voxel, the last is 6
    assert found.near[24, 28, :20].nonzero()[0].tolist() == [13, 14, 15]
    painted = np.where(np.arange(SHAPE[2]) < 20, 1000.0, 0.0)
    values = structure_score(volume((labels, truth, soft), painted), found).values
    assert 0.2 < values["false_bone_near"] < 0.8
    noisy = 40 * np.random.default_rng(2).standard_normal(SHAPE)
    assert scored((labels, truth, soft), noisy)["noise_near"] == pytest.approx(40, rel=0.1)


@pytest.mark.parametrize(
    "changes", [{}, {"off_detector": (3.0, 0.0)}, {"off_detector": (0.0, 4.0)}, {"arc_deg": 200.0}]
)
def test_the_field_of_view_is_what_every_view_sees(changes):
    g = Geometry(
        **{
            "dso": 100.0, "dsd": 180.0, "n_voxel": (24, 26, 28), "d_voxel": (2.0, 1.5, 1.5), "n_detector": (40, 40),
            "d_detector": (1.2, 1.4), "n_views": 720, **changes,
        }
    )  # fmt: skip
    z, y, x = (v.astype(np.float64) for v in np.meshgrid(*g.voxel_centres(), indexing="ij"))
    (half_v, half_u), (off_v, off_u) = np.array(g.s_detector) / 2, g.off_detector
    seen, ever = np.ones(g.n_voxel, bool), np.zeros(g.n_voxel, bool)
    for phi in g.angles:
        depth = g.dso - (x * np.cos(phi) + y * np.sin(phi))
        u = g.dsd / depth * (y * np.cos(phi) - x * np.sin(phi)) - off_u
        v = g.dsd / depth * z - off_v
        inside = (np.abs(v) <= half_v) & (np.abs(u) <= half_u)
        seen &= inside
        ever |= inside
    found = field_of_view(g)
    if g.off_detector[1]:
        assert found[~ever].sum() == 0  # a shifted detector sees each voxel of its field in some views only
    else:
        # 720 views lie at most 0.25° off the nearest and farthest point: 0.1 % of the radius; a full turn is assumed
        apart = seen != found
        assert (found & ~seen).sum() <= 0.002 * found.size
        assert apart.mean() < (0.01 if g.is_full_turn else 0.2)
