"""The filtration that splats find: the rule by which it is chosen, and scans of known filters."""

import dataclasses
import math
import types
from typing import Any

import numpy as np
import pytest

import ctsim
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat import fast, filtration
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.fast import Settings, reconstruct
from ctsim.reconstruct.splat.filtration import PLAUSIBLE, USUAL, Filtration, found
from ctsim.reconstruct.splat.level import Data, by_photons, edges_doubted, thinned
from ctsim.reconstruct.splat.response import evaluate


class Tried:
    """A misfit by filtration in place of coarse fits, and the filtrations that were asked for."""

    def __init__(self, monkeypatch, misfit):
        self.asked = []
        monkeypatch.setattr(filtration, "rays_of", lambda fit: None)
        monkeypatch.setattr(filtration, "misfit", lambda fit, rays: misfit(fit))

    def __call__(self, value):
        self.asked.append(value)
        return value


def valley(at, steepness=0.1):
    """A misfit that is least at a filtration: its logarithm grows with the square of the distance of logarithms."""
    return lambda t: math.exp(steepness * math.log(max(t, 1e-3) / at) ** 2)


@pytest.mark.parametrize("at", [5.7, 1.0, 0.35])
def test_the_middle_of_a_valley_is_found_with_its_width(monkeypatch, at):
    """On a parabola the likely filtrations are those of a normal distribution, PLAUSIBLE at two standard deviations."""
    tried = Tried(monkeypatch, valley(at, steepness=0.5))
    got, width = found(tried), math.sqrt(math.log(PLAUSIBLE) / 0.5)
    assert got.value == pytest.approx(at, rel=0.02) and got.low < at < got.high
    assert math.log(got.high / got.low) == pytest.approx(2 * width, rel=0.2)  # between values a factor of 2 apart
    assert len(set(tried.asked)) == len(tried.asked) and USUAL in tried.asked and not got.sentence


@pytest.mark.parametrize("flat", [2.0, 4.0, 8.0])
def test_behind_a_slope_all_that_explain_a_scan_alike_are_plausible(monkeypatch, flat):
    got = found(Tried(monkeypatch, lambda t: max(flat / t, 1.0)))
    assert got.high == 20 and flat / 1.2 < got.low <= flat < got.value < 20
    assert got.value == pytest.approx(math.sqrt(flat * 20), rel=0.15)


def test_where_all_explain_a_scan_alike_the_middle_is_taken_and_said(monkeypatch):
    got = found(Tried(monkeypatch, lambda t: 1.0))
    middle = 0.1 * math.exp((-1 + math.log(200)) / 2)  # of a scale that is linear up to 0.1 mm and logarithmic above
    assert got.value == pytest.approx(middle, abs=1e-3) and (got.low, got.high) == (0, 20)
    assert "does not tell its beam" in got.sentence and "0 to 20 mm Al" in got.sentence


@pytest.mark.parametrize("at", [0.0, 0.03, 0.07])
def test_beams_without_a_filter_are_found(monkeypatch, at):
    """The misfit grows with the square of the difference, as thin filters harden a beam."""
    tried = Tried(monkeypatch, lambda t: math.exp((filtration.scale(t) - filtration.scale(at)) ** 2))
    got = found(tried)
    assert got.value == pytest.approx(at, abs=0.015) and got.low <= at <= got.high < 0.15
    assert ("softer than any" in got.sentence) == (at < 0.03) and min(tried.asked) == 0


def test_a_scan_behind_a_thin_filter_tells_its_beam(monkeypatch):
    """From nothing to a twentieth of a millimetre the ratio is endless, and the beams are nearly the same."""
    got = found(Tried(monkeypatch, lambda t: math.exp(4 * max(t - 0.05, 0))))
    assert got.low == 0 and 0.05 < got.high < 0.1 and "softer than any" in got.sentence


def soft_valley(at):
    return lambda t: math.exp((filtration.scale(t) - filtration.scale(at)) ** 2)


class Grids:
    """Misfits by filtration on a coarse and on a soft fit's grid, and what was asked of the latter."""

    def __init__(self, monkeypatch, coarse, soft):
        self.asked = []
        of = {"coarse": coarse, "soft": soft}
        monkeypatch.setattr(filtration, "rays_of", lambda fit: None)
        monkeypatch.setattr(filtration, "misfit", lambda fit, rays: of[fit[0]](fit[1]))

    def coarse(self, t):
        return "coarse", t

    def soft(self, t):
        self.asked.append(t)
        return "soft", t


@pytest.mark.parametrize(("at", "screen"), [(-0.1, True), (-0.05, True), (0.02, True), (0.02, False), (0.0, False)])
def test_where_there_may_be_no_filter_a_finer_grid_and_thinner_screens_are_tried(monkeypatch, at, screen):
    grids = Grids(monkeypatch, soft_valley(0.06), soft_valley(at))
    got = found(grids.coarse, None, grids.soft, screen_assumed=screen)
    assert got.value == pytest.approx(at, abs=0.015) and got.low <= at <= got.high
    assert grids.asked[0] == 0 and (min(grids.asked) < 0) == screen and len(set(grids.asked)) == len(grids.asked)
    assert ("softer than any" in got.sentence) == (not screen)
    described = got.described()
    assert described.get("screen") == (pytest.approx(0.2 + got.value) if got.value < 0 else None)


def test_a_screen_thinner_than_any_that_is_tried_is_said(monkeypatch):
    grids = Grids(monkeypatch, soft_valley(0.0), lambda t: math.exp(10 * t))
    got = found(grids.coarse, None, grids.soft, screen_assumed=True)
    assert got.low == -0.15 and f"-0.15 to {got.high:g} mm Al explain it alike (below 0: none, and a" in got.sentence
    assert "thinner than 0.2 mm of GOS" in got.sentence
    flat = found(grids.coarse, None, Grids(monkeypatch, soft_valley(0.0), lambda t: 1.0).soft, screen_assumed=True)
    assert "does not tell its beam" in flat.sentence and "-0.15 to 20 mm Al explain it alike (below" in flat.sentence


@pytest.mark.parametrize("coarse", [soft_valley(0.25), lambda t: 1.0, lambda t: max(1.0, t / 4)])
def test_behind_a_filter_and_where_a_scan_tells_no_beam_no_softer_one_is_tried(monkeypatch, coarse):
    grids = Grids(monkeypatch, coarse, soft_valley(-0.1))
    got = found(grids.coarse, None, grids.soft, screen_assumed=True)
    assert not grids.asked and got == found(grids.coarse)


def test_soft_fits_that_show_nothing_leave_what_was_found(monkeypatch):
    grids = Grids(monkeypatch, soft_valley(0.06), soft_valley(-0.1))
    assert found(grids.coarse, None, lambda t: None, screen_assumed=True) == found(grids.coarse)
    assert found(grids.coarse, None, lambda t: grids.soft(t) if t == 0 else None, screen_assumed=True) == found(
        grids.coarse
    )


def test_a_filtration_below_none_is_a_thinner_screen():
    assumed, thinner = Settings().make_response(90.0, 0.0), Settings().make_response(90.0, -0.1)
    told = Settings(detector={"kind": "gos", "thickness": 0.1}).make_response(90.0, 0.0)
    np.testing.assert_array_equal(thinner.eta, told.eta)
    assert thinner.described()["theta"] == [0.0]
    a, b = (np.full((1, 1), 10 * density, np.float32) for density in MaterialCurve.of(assumed, 0.0).of_water)
    softer, harder = (evaluate(response, a, b)[0].item() for response in (thinner, assumed))
    assert softer > harder + 0.02


def test_the_scale_of_filtrations_is_smooth_and_has_an_inverse():
    t = np.array([0.0, 0.02, 0.1, 0.25, 20.0])
    np.testing.assert_allclose(filtration.from_scale(filtration.scale(t)), t, atol=1e-15)
    steps = np.diff(filtration.scale([0.1 - 1e-6, 0.1, 0.1 + 1e-6]))
    np.testing.assert_allclose(steps, 1e-5, rtol=1e-4)


def test_fine_fits_are_made_around_what_coarse_ones_find(monkeypatch):
    coarse, fine = [], []
    monkeypatch.setattr(filtration, "rays_of", lambda fit: None)
    monkeypatch.setattr(filtration, "misfit", lambda fit, rays: valley(8.0 if fit[0] == "coarse" else 5.7, 1.0)(fit[1]))
    got = found(lambda t: coarse.append(t) or ("coarse", t), lambda t: fine.append(t) or ("fine", t))
    assert got.value == pytest.approx(5.7, rel=0.02) and coarse[0] == USUAL
    assert fine[0] == 8.0 and sorted(fine) == [2.0, 4.0, 8.0, 14.0]


@pytest.mark.parametrize("higher", [1.3, 1.02])
def test_fine_fits_are_made_in_the_deeper_of_two_valleys(monkeypatch, higher):
    """As between aluminium rods at 50 kV: half a millimetre lies in a valley of its own."""

    def two(t):
        return min(higher * valley(0.5, 1.0)(t), valley(8.0, 1.0)(t))

    fine = []
    got = found(Tried(monkeypatch, two), lambda t: fine.append(t) or t)
    assert got.value == pytest.approx(8.0, rel=0.1) and min(fine) == 4.0
    alone = found(Tried(monkeypatch, two), lambda t: None)
    assert alone.value == pytest.approx(8.0, rel=0.1) and alone.low > 4 and not alone.sentence
    near = Tried(monkeypatch, two)
    assert found(near).value == pytest.approx(0.5, rel=0.1) and max(near.asked) == 1.0


def test_fine_fits_that_show_nothing_leave_what_coarse_ones_found(monkeypatch):
    coarse = found(Tried(monkeypatch, valley(2.0)))
    assert found(Tried(monkeypatch, valley(2.0)), lambda t: None) == coarse
    assert found(Tried(monkeypatch, valley(2.0)), lambda t: 2.0 if t == 2.0 else None) == coarse  # no neighbour of it


def test_fine_fits_are_asked_where_coarse_ones_show_nothing(monkeypatch):
    assert found(lambda t: None, Tried(monkeypatch, valley(1.0))) == found(Tried(monkeypatch, valley(1.0)))


def test_hard_beams_that_look_alike_have_no_upper_limit(monkeypatch):
    got = found(Tried(monkeypatch, lambda t: max(2.0 / t, 1.0)))
    assert got.high == 20 and 1 < got.low < 2.5
    assert f"no upper limit of its filtration: {got.low:g} to 20 mm Al" in got.sentence
    assert not found(Tried(monkeypatch, valley(8.0, 1.0))).sentence


@pytest.mark.parametrize("n_views", [234, 235, 236])  # 118 are π/2 · 75
def test_every_second_view_is_taken_with_its_readings(n_views):
    whole = Geometry(
        dso=100, dsd=200, n_voxel=(99, 75, 8), d_voxel=(1, 1, 1), n_detector=(3, 4), d_detector=(2, 3), n_views=n_views,
        off_detector=(0.5, 0.25), arc_deg=200.0,
    )  # fmt: skip
    p = np.arange(n_views * 12, dtype=np.float32).reshape(whole.shape)
    given = Data(geometry=whole, p=p, weights=p + 1, scatter=0.25)
    got, step = thinned(given), 1 if n_views < 235 else 2
    assert (got is given) == (step == 1) and got.scatter == 0.25
    assert np.array_equal(got.p, p[::step]) and np.array_equal(got.weights, p[::step] + 1)
    assert np.array_equal(got.geometry.pose_array(), whole.pose_array()[::step])
    assert got.geometry.n_detector == (3, 4) and got.geometry.n_voxel == (99, 75, 8)


def levels_in_name(sizes, views):
    return [
        Data(
            geometry=Geometry(
                dso=100, dsd=200, n_voxel=(n, n, n), d_voxel=(1, 1, 1), n_detector=(2, 2), d_detector=(1, 1), n_views=v
            ),
            p=np.zeros((v, 2, 2), np.float32),
            weights=np.ones((v, 2, 2), np.float32),
        )
        for n, v in zip(sizes, views, strict=True)
    ]


@pytest.mark.parametrize(
    ("sizes", "views", "fitted"),
    [
        ((24, 48, 96, 192), (30, 60, 120, 240), [[(24, 30), (48, 60)], [(24, 30), (48, 60), (96, 120)]]),
        ((48, 96, 192), (160, 320, 640), [[(48, 160)], [(48, 160), (96, 160)]]),
        ((24, 48, 96), (15, 30, 60), [[(24, 15), (48, 30)]]),  # 96 would take as long as the fit
        ((40, 80, 160), (10, 20, 40), [[(40, 10)], [(40, 10), (80, 20)]]),
        ((24, 48), (2, 4), [[(24, 2), (48, 4)]]),
        ((24, 48), (1, 3), None),
    ],
)
def test_filtrations_are_tried_on_grids_coarser_than_the_fit(monkeypatch, sizes, views, fitted):
    gone = []

    class Course:
        def __init__(self, levels, settings):
            self.levels = levels
            # passes over a grid that is alone are the sum
            assert settings.passes == ((8, 4) if len(levels) > 1 else (0, 6))

        def go(self, proceed):
            gone.append([(level.geometry.n_voxel[0], level.geometry.n_views) for level in self.levels])

    monkeypatch.setattr(fast, "_course", lambda levels, response, settings, **more: Course(levels, settings))
    got = fast.find_filtration(levels_in_name(sizes, views), types.SimpleNamespace(e_max=90.0), Settings())
    assert gone == (fitted or [])
    assert (got is None) == (fitted is None) and (got is None or got.value == USUAL)


@pytest.mark.parametrize(
    ("sizes", "views", "fitted"),
    [
        ((24, 48, 96, 192), (30, 60, 120, 240), [(24, 30), (48, 60), (96, 120)]),
        ((48, 96, 192), (160, 400, 640), [(48, 160), (96, 200)]),
        ((24, 48, 96), (15, 30, 60), [(24, 15), (48, 30), (96, 60)]),
        ((24, 48), (20, 40), [(24, 20), (48, 40)]),
    ],
)
def test_soft_beams_are_tried_off_edges_on_the_grid_after_that_of_the_coarse_search(monkeypatch, sizes, views, fitted):
    levels, seen = levels_in_name(sizes, views), []
    for level in levels:
        level.p[:, 0, 0] = 2.0

    class Course:
        def __init__(self, levels):
            self.levels = levels

        def go(self, proceed):
            seen.extend(self.levels)

    monkeypatch.setattr(fast, "_course", lambda levels, response, settings, **more: Course(levels))
    monkeypatch.setattr(fast, "found", lambda coarse, fine, soft, screen_assumed: soft(0.0))
    fast.find_filtration(levels, types.SimpleNamespace(e_max=90.0), Settings())
    assert [(level.geometry.n_voxel[0], level.geometry.n_views) for level in seen] == fitted
    lowered = [bool((level.weights < 0.99 * np.exp(-level.p)).any()) for level in seen]
    assert lowered == [False] * (len(seen) - 1) + [True]
    if len(seen) == len(levels):  # the fit's own grid, whose weights may have been evened out
        expected = edges_doubted(by_photons(levels[-1]), Settings().edges)
        np.testing.assert_array_equal(seen[-1].weights, expected.weights)
    assert all((level.weights == 1).all() for level in levels)


@dataclasses.dataclass
class Left:
    """A fit of nothing, which leaves all of `data.p`."""

    data: Any

    def fitted(self, views):
        return np.zeros(self.data.p[views].shape, np.float32)


def left(p):
    geometry = types.SimpleNamespace(n_views=len(p), n_detector=p.shape[1:])
    return Left(types.SimpleNamespace(p=p.astype(np.float32), geometry=geometry))


def test_what_all_views_leave_alike_is_no_misfit():
    """A round body would explain it; what changes from view to view is no object's, and counts in full."""
    rng = np.random.default_rng(3)
    rays = rng.random((40, 64, 64)) < 0.9
    same = np.broadcast_to(np.linspace(-1, 1, 64), rays.shape)
    wave = np.cos(np.linspace(0, 2 * np.pi, 40, endpoint=False))[:, None, None] * np.ones(rays.shape)
    assert filtration.misfit(left(same), rays) < 0.03  # what is left out of averages differs by view
    assert filtration.misfit(left(wave), rays) == pytest.approx(math.sqrt(0.5), rel=0.015)  # a mean of 36 views
    assert filtration.misfit(left(wave + 5 * same), rays) == pytest.approx(math.sqrt(0.5), rel=0.02)


def test_pixels_that_count_in_few_views_do_not_weigh_down_the_misfit():
    """A mean over n views leaves n − 1 of them: white noise keeps its variance, whatever n is."""
    rng, rays = np.random.default_rng(5), np.zeros((60, 64, 64), bool)
    for view in range(60):
        rays[view, :, view % 20 * 3 : view % 20 * 3 + 4] = True  # a thin object far from the axis: three views a pixel
    noise = (rng.standard_normal((60, 1, 1)) * np.ones(rays.shape) for _ in range(20))
    squares = [filtration.misfit(left(each), rays) ** 2 for each in noise]
    assert math.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=4 / math.sqrt(2 * 20 * 40))  # of 40 free numbers each


def test_one_view_tells_nothing():
    assert filtration.misfit(left(np.ones((1, 64, 64))), np.ones((1, 64, 64), bool)) == math.inf
    assert filtration.misfit(left(np.zeros((9, 64, 64))), np.ones((9, 64, 64), bool)) == math.inf


def test_all_filtrations_are_judged_by_the_same_rays(monkeypatch):
    """Rays that the fit of each leaves out as metal's differ: with those of its own, a drumstick had two valleys."""
    judged = []
    monkeypatch.setattr(filtration, "rays_of", lambda fit: ("rays of", fit))
    monkeypatch.setattr(filtration, "misfit", lambda fit, rays: judged.append(rays) or valley(2.0)(fit))
    found(lambda t: t)
    assert len(judged) > 4 and set(judged) == {("rays of", USUAL)}


@pytest.mark.parametrize("fine", [False, True])
def test_the_last_search_does_not_try_what_lies_beyond_the_valley(monkeypatch, fine):
    tried = Tried(monkeypatch, valley(0.5, steepness=2.0))
    got = found(lambda t: None, tried) if fine else found(tried)
    assert got.value == pytest.approx(USUAL, rel=0.01) and sorted(tried.asked) == [0.25, 0.5, 1.0]


def test_a_scan_that_shows_nothing_leaves_the_usual_filtration():
    got = found(lambda value: None)
    assert got == Filtration(value=USUAL, low=0.0, high=20.0, misfits={}) and not got.sentence


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_a_trial_that_fails_is_left_out(monkeypatch, broken):
    got = found(Tried(monkeypatch, lambda t: 1.0 if t == USUAL else broken))
    assert got.value == USUAL and got.misfits == {USUAL: 1.0} and not got.sentence


def test_a_beam_softer_than_any_assumed_is_said(monkeypatch):
    got = found(Tried(monkeypatch, lambda t: 1 + t))
    assert f"softer than any that was tried, for which values are too low: 0 to {got.high:g} mm Al" in got.sentence
    assert "softer" not in found(Tried(monkeypatch, lambda t: 1 / t)).sentence
    assert not found(Tried(monkeypatch, valley(2.0, steepness=0.5))).sentence


def scan_behind(*filters, **changes):
    scanner = {
        "preset": "skyscan1273", "n_voxel": [40, 40, 40], "n_detector": [64, 64], "n_views": 60, "i0": 1e5,
        "tube": {"kvp": 90.0, "filters": [{"material": m, "thickness": t} for m, t in filters]},
    }  # fmt: skip
    phantom = {"recipe": "lung", "metal": "Ti", "n_voxel": [71, 71, 71], "size": 60.0}
    told = {"phantom": phantom, "scanner": scanner | changes, "simulation": {"scatter_error": 0.5}}
    return ctsim.simulate_scene(ctsim.new_scene(name="lung", seed=1, **told))


@pytest.mark.parametrize("n_views", [1, 2])
def test_scans_of_one_or_two_views_are_fitted_behind_the_usual_filtration(n_views):
    few = scan_behind(("Al", 0.5), n_views=n_views, scatter={"level": 0})
    volume = reconstruct(few.scan, Settings(passes=(1, 1)))
    assert volume.status == "ok" and "filtration" not in volume.details


COPPER = (("Al", 2.5), ("Cu", 0.2))


@pytest.fixture(scope="module")
def hard():
    return scan_behind(*COPPER)


def quality(stored, **settings):
    volume = reconstruct(stored.scan, Settings(**settings))
    score = ctsim.score_volume(volume, stored, protocols="tissue")["tissue"]
    return score.values["psnr3d"], volume.details.get("filtration")


def test_hard_beams_are_told_from_the_usual_one(hard):
    """Assumed behind copper, the usual filtration costs 2.9 dB; the one that is found is as good as the spectrum."""
    told = {"filters": [{"material": m, "thickness": t} for m, t in COPPER]}
    known, nothing = quality(hard, response="known", tube=told, detector={"kind": "gos", "thickness": 0.1})
    usual, given = quality(hard, filtration=USUAL)
    blind, got = quality(hard)
    assert nothing is None and given is None
    assert 8.7 / 2 < got["value"] < 8.7 * 2  # 8.7 mm harden water as this beam does (benchmarks/tools/beams.py)
    assert got["low"] <= got["value"] <= got["high"] and set(got["misfits"]) >= {"0.5", "8"}
    assert blind > usual + 2 and blind > known - 0.3


def test_the_usual_beam_is_found_to_be_one():
    value = quality(scan_behind(("Al", 0.5)))[1]["value"]
    assert 0.38 / 2 < value < 0.38 * 2


def test_a_tube_without_a_filter_before_a_thin_screen_is_found():
    """The assumed screen is twice as thick: before it even no filter is too hard, by 1.8 dB."""
    bare = scan_behind()
    none, _ = quality(bare, filtration=0)
    blind, got = quality(bare)
    known, _ = quality(bare, response="known", tube={"filters": []}, detector={"kind": "gos", "thickness": 0.1})
    told, of_told = quality(bare, detector={"kind": "gos", "thickness": 0.1})
    assert -0.15 < got["value"] < -0.02 and {"-0.1", "-0.05", "0"} <= set(got["misfits"])
    assert 0 <= of_told["value"] < 0.05
    assert blind > none + 1 and min(blind, told) > known - 1


def test_no_filtration_can_be_told():
    """0 is a filtration, not none given."""
    bare = scan_behind(n_views=12, n_voxel=[18, 18, 18], n_detector=[27, 27], scatter={"level": 0})
    assert reconstruct(bare.scan, Settings(filtration=0)).details["response"]["theta"] == [0.0]


def test_a_detector_that_is_told_replaces_the_assumed_one():
    """A counting detector sees a softer beam than a scintillator does."""
    counted = scan_behind(("Al", 0.5), detector={"kind": "counting"})
    known, _ = quality(
        counted,
        response="known",
        detector={"kind": "counting"},
        tube={"filters": [{"material": "Al", "thickness": 0.5}]},
    )
    blind, told = quality(counted)[0], quality(counted, detector={"kind": "counting"})[0]
    assert told > blind + 0.5 and told > known - 0.3


def test_a_fit_without_coarser_levels_finds_it_on_one(hard):
    assert quality(hard, passes=(0, 1))[1] == quality(hard, passes=(3, 1))[1]


def test_a_grid_too_coarse_for_the_edges_leaves_the_usual_filtration():
    """Searched on 18 voxels, 12 mm were found in a scan behind 0.5, and its error grew by half."""
    coarse = scan_behind(("Al", 0.5), n_voxel=[18, 18, 18], n_detector=[27, 27], n_views=12, scatter={"level": 0})
    volume = reconstruct(coarse.scan, Settings(fineness=1.5))
    assert max(volume.details["grid"]) < 2 * 32 and "filtration" not in volume.details
    assert volume.details["response"] == reconstruct(coarse.scan, Settings(filtration=USUAL)).details["response"]
