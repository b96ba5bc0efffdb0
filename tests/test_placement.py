"""A volume that is turned, or in another unit, is refused by name; a bad one in its place is not."""

import numpy as np
import pytest
from scipy import ndimage

from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.scores import placement
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import reconstruct as fdk

WATER = 0.02
HIPS = """
name = "hip"
seed = 1
phantom = { recipe = "hip", metal = "Ti", head = "CoCr", size = 180.0, n_voxel = [85, 85, 85] }
scanner = { preset = "c-arm", arc_deg = 360.0, n_voxel = [48, 48, 48], n_detector = [72, 72], n_views = 45 }
"""
CUP = """
name = "cup"
seed = 1
phantom = { recipe = "metal_rods", metal = "Al6061", n_voxel = [113, 113, 113], size = 120.0, insert_mm = 28.0 }

[scanner]
preset = "dental"
tube = { kvp = 50.0, filters = [{ material = "Al", thickness = 2.5 }] }
n_voxel = [48, 48, 48]
n_detector = [72, 72]
n_views = 45
"""


def body(shape=(12, 14, 16)):
    """Return a lopsided body of water with a bone and a cavity, in 1/mm."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n - 0.5 for n in shape), indexing="ij")
    values = WATER * (np.hypot(y / 0.4, x / 0.3) < 1) * (z > -0.3)
    values[(np.abs(z - 0.2) < 0.1) & (np.abs(y - 0.2) < 0.1) & (np.abs(x + 0.1) < 0.08)] = 2 * WATER
    values[(np.abs(z + 0.1) < 0.1) & (np.abs(y) < 0.1) & (np.abs(x - 0.12) < 0.08)] = 0
    return values.astype(np.float32)


def truth_of(reference):
    none = np.zeros(reference.shape, bool)
    return Truth(
        references={"effective": reference, "50kev": reference},
        metal=none, body=~none, tissue=~none, judged=~none, near_metal=none, d_voxel=(1.0, 1.0, 1.0), l0=10.0,
    )  # fmt: skip


def check(values, reference, unit="1/mm"):
    placement.check("mine", values, placement.tissue_of(truth_of(reference)), unit, WATER, "--unit")


def noisy(values, size=0.5, seed=0):
    return values + np.random.default_rng(seed).normal(0, size * WATER, values.shape).astype(np.float32)


def in_hu(values):
    return 1000 * (values / WATER - 1)


@pytest.mark.parametrize("turn", placement.TURNS[1:])
def test_each_turn_is_refused_by_name(turn):
    """A body that no turn leaves as it is, so that each of the 47 has a name of its own."""
    reference = body((14, 14, 14))
    wrong = placement.Turn((0, 1, 2), turn.flipped).apply(noisy(reference))
    wrong = np.transpose(wrong, np.argsort(turn.order))
    assert np.array_equal(turn.apply(wrong), noisy(reference))
    with pytest.raises(InputError, match=r"^mine looks (transposed|flipped)") as caught:
        check(wrong, reference)
    assert f"looks {turn.text}: correlation" in str(caught.value)


def test_a_transposed_shape_says_its_axes():
    reference = body()
    with pytest.raises(InputError, match=r"shape \(16, 14, 12\), expected \(12, 14, 16\).*seem to be x, y, z"):
        check(reference.T, reference)
    with pytest.raises(InputError, match=r"shape \(12, 14, 15\), expected \(12, 14, 16\)"):
        check(reference[:, :, 1:], reference)


@pytest.mark.parametrize("unit", placement.NAMES)
@pytest.mark.parametrize("stated", placement.NAMES)
def test_another_unit_is_refused_by_name(unit, stated):
    reference = body()
    values = {"1/mm": lambda v: v, "1/cm": lambda v: 10 * v, "hu": in_hu}[unit](noisy(reference))
    if unit == stated:
        check(values, reference, stated)
        # one rounding of float32 at 1000 HU, 2⁻²⁴ of 0.02 1/mm, and one of each conversion
        found = placement.to_attenuation(values, stated, WATER)
        np.testing.assert_allclose(found, noisy(reference), rtol=0, atol=4 * WATER * 3 * 2**-23)
        return
    with pytest.raises(InputError, match=f"looks like {placement.NAMES[unit]}: .* or --unit {unit}$"):
        check(values, reference, stated)


@pytest.mark.parametrize("size", [0.0, 1.0, 4.0])
def test_a_bad_volume_in_its_place_is_scored(size):
    """Noise of four times water's attenuation is no other unit and no mirror image."""
    reference = body()
    for seed in range(20):
        check(noisy(reference, size, seed), reference)


@pytest.mark.parametrize("negative", [lambda v: -v, lambda v: 2 * WATER - v, lambda v: -v[:, ::-1]])
def test_a_negative_is_refused_by_name(negative):
    reference = np.maximum(body(), 0.9 * body()[:, ::-1])
    with pytest.raises(InputError, match=r"^mine looks like the negative of a volume: .* reference -0\.[5-9]\d$"):
        check(negative(noisy(reference, 0.1)), reference)


@pytest.mark.parametrize("level", [0.0, WATER])
def test_a_volume_of_one_value_is_refused(level):
    reference = body()
    with pytest.raises(InputError, match=f"^mine holds {level:g} in every voxel, expected a reconstruction"):
        check(np.full_like(reference, level), reference)


@pytest.mark.parametrize("values", [lambda v: 1000 * v, lambda v: np.round(255 * v / v.max())])
def test_what_is_stated_to_be_hu_has_air(values):
    """1/m, and grey values of 8 bits: their mean is near the reference's as HU, since 0 HU are water."""
    reference = body()
    with pytest.raises(InputError, match=r"^mine is not in HU: the air in it has -?[0-9.e-]+, expected -1000"):
        check(values(noisy(reference, 0.05)), reference, "hu")


@pytest.mark.parametrize("factor", [1000, 255 / 0.04])
def test_what_is_in_no_known_unit_is_offered_none(factor):
    """1/m and grey values of 8 bits: stated as 1/mm they are nearer to HU, which they are not."""
    reference = body()
    with pytest.raises(InputError, match=r"^mine is in none of 1/mm, 1/cm, HU: .* expected 1/mm$"):
        check(factor * noisy(reference, 0.05), reference)


def test_hu_without_an_attenuation_of_water_are_refused_in_one_sentence():
    with pytest.raises(InputError, match=r"^--unit hu needs the attenuation of water.*expected 1/mm or 1/cm"):
        placement.check("mine", in_hu(body()), body(), "hu", None)


def test_hu_that_are_cut_off_are_refused_by_name():
    reference = body()
    with pytest.raises(InputError, match=r"^mine is cut off at -400 HU, where air has -1000"):
        check(np.clip(in_hu(noisy(reference, 0.05)), -400, 400), reference, "hu")


def test_air_may_be_off_by_streaks_and_not_by_a_scale():
    reference = body()
    check(np.where(reference == 0, -501, in_hu(reference)), reference, "hu")
    with pytest.raises(InputError, match=r"^mine is not in HU: the air in it has -49\d"):
        check(np.where(reference == 0, -499, in_hu(reference)) + 50 * noisy(0 * reference), reference, "hu")


@pytest.mark.parametrize("blur", [0.0, 1.0, 1.5])
def test_a_cavity_and_what_lies_outside_the_circle_are_no_air_to_judge_by(blur):
    reference = np.full((32, 32, 32), WATER, np.float32)
    reference[14:18, 14:18, 14:18], reference[4:9, 20:28, 6:12] = 0, 2 * WATER
    check(in_hu(ndimage.gaussian_filter(reference, blur)), reference, "hu")
    y, x = np.ogrid[-1:1:64j, -1:1:64j]
    head = np.zeros((40, 64, 64), np.float32)
    head[:, np.hypot(y, x) < 0.8], head[10:14, 20:30, 20:24] = WATER, 2 * WATER
    outside = np.broadcast_to(np.hypot(y, x) > 1, head.shape)
    check(np.where(outside, 0, in_hu(ndimage.gaussian_filter(head, blur))), head, "hu")


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("voxels", [-2, -1, 1, 2])
def test_a_shift_is_not_called_a_flip(axis, voxels):
    """A ball off the middle: its image along an axis is the ball shifted along it."""
    z, y, x = np.meshgrid(*(np.arange(24) - 11.5 for _ in range(3)), indexing="ij")
    distance = np.sqrt((z - 0.5) ** 2 + (y - 0.5) ** 2 + (x - 0.5) ** 2)
    reference = WATER * np.clip(8.5 - distance, 0, 1).astype(np.float32)
    check(np.roll(reference, voxels, axis), reference)


def nearly_alike(seed):
    """Return a body that its mirror image differs from by little, with smooth errors that are larger than that."""
    reference = np.maximum(body(), 0.999 * body()[:, :, ::-1])
    reference[3:6, 5:8, 2] += 0.3 * WATER
    errors = ndimage.gaussian_filter(np.random.default_rng(seed).normal(0, 1, reference.shape), 1)
    return reference, (reference + 0.5 * WATER * errors / errors.std()).astype(np.float32)


@pytest.mark.parametrize("seed", range(10))
def test_a_nearly_symmetric_body_tells_how_a_clean_volume_lies(seed):
    reference, bad = nearly_alike(seed)
    good = reference + (bad - reference) / 20
    check(good, reference)
    with pytest.raises(InputError, match="looks flipped along x"):
        check(good[:, :, ::-1], reference)


@pytest.mark.parametrize("seed", range(20))
def test_errors_that_are_larger_than_what_tells_a_body_from_its_image_are_no_flip(seed):
    reference, bad = nearly_alike(seed)
    check(bad, reference)


def test_a_symmetric_body_has_no_orientation():
    reference = np.maximum(body(), body()[::-1])
    for seed in range(20):
        check(noisy(reference, 0.5, seed), reference)
    with pytest.raises(InputError, match=r"flipped along y:|flipped along z and y:"):
        check(noisy(reference)[:, ::-1], reference)


def test_numbers_that_are_not_finite_are_counted():
    values = body()
    values[0, 0, :3] = np.nan
    with pytest.raises(InputError, match=r"^mine has 3 of 2688 voxels that are not finite"):
        check(values, body())


@pytest.fixture(scope="module")
def hips(tmp_path_factory):
    """Both hips with implants of CoCr and Ti on 48³ voxels: 0.4 % of the variance tells left from right."""
    folder = tmp_path_factory.mktemp("hips")
    (folder / "scene.toml").write_text(HIPS, encoding="utf-8")
    assert make_dataset([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return open_scan(folder / "data" / "hip")


@pytest.mark.slow
@pytest.mark.parametrize("twin", [False, True], ids=["metal", "twin"])
def test_an_uncorrected_hip_is_accepted_as_it_is_and_refused_mirrored(hips, twin):
    scan = hips.metal_free.scan if twin else hips.scan
    reference, values = placement.reference_of(hips), fdk(scan).values.numpy()
    placement.check("mine", values, reference, "1/mm", None)
    for turn in (turn for turn in placement.TURNS[1:] if turn.order == (0, 1, 2)):
        with pytest.raises(InputError, match=f"^mine looks {turn.text}:"):
            placement.check("mine", turn.apply(values), reference, "1/mm", None)
    for axis in range(3):
        placement.check("mine", np.roll(values, 2, axis), reference, "1/mm", None)


@pytest.mark.slow
def test_a_blur_of_a_nearly_round_body_is_no_turn(tmp_path):
    """Three rods without metal are a cup of water, which little tells from its image."""
    (tmp_path / "scene.toml").write_text(CUP, encoding="utf-8")
    assert make_dataset([str(tmp_path / "scene.toml"), str(tmp_path / "data")]) == 0
    stored = open_scan(tmp_path / "data" / "cup")
    values, reference = fdk(stored.metal_free.scan).values.numpy(), placement.reference_of(stored)
    for blur in (0.7, 1.0, 2.0):
        placement.check("mine", ndimage.gaussian_filter(values, blur), reference, "1/mm", None)
