"""The observer against closed forms for Gaussian channels, where template and AUC are known."""

import numpy as np
import pytest
from scipy.special import ndtr

from ctsim.benchmarks.scores.channels import N_CHANNELS, REACH, channels, laguerre_gauss
from ctsim.benchmarks.scores.observer import (
    Responses,
    auc,
    difference,
    known_background,
    normal_theory,
    varying_background,
    wilson,
)
from ctsim.geometry import Geometry

DRAWS = 100
ANATOMY = 0.02002  # the one value of the body without metal


def gaussian(rng, d, *, n=100, locations=1, spread=0.0):
    """Return responses whose ideal observer has the detectability `d`, at locations whose backgrounds differ.

    The covariance K is a random one, the same for all; the signal s is scaled to d² = sᵀ K⁻¹ s.
    """
    root = rng.normal(size=(N_CHANNELS, N_CHANNELS))
    signal = rng.normal(size=N_CHANNELS)
    signal *= d / np.sqrt(signal @ np.linalg.solve(root @ root.T, signal))
    absent, present = (rng.normal(size=(n, locations, N_CHANNELS)) @ root.T for _ in range(2))
    backgrounds = spread * rng.normal(size=(locations, N_CHANNELS)) @ root.T
    pairs = np.arange(n)
    return Responses(present=present + signal + backgrounds, absent=absent + backgrounds, pairs=pairs)


@pytest.mark.parametrize("d", [0.0, 1.0, 2.0])
def test_intervals_hold_the_closed_form(d):
    true = ndtr(d / np.sqrt(2))
    rng, n = np.random.default_rng(7), 60
    found = [gaussian(rng, d, locations=2) for _ in range(n)]
    areas = [known_background(one, DRAWS) for one in found]
    exact = [normal_theory(one.present[:, 0], one.absent[:, 0]) for one in found]
    # of 60 intervals that hold the truth in 95 of 100 cases, fewer than 51 do in 1 of 1000 cases
    assert sum(a.low <= true <= a.high for a in areas) >= 51
    assert sum(low <= true <= high for _, low, high in exact) >= 51
    mean, error = np.mean([a.auc for a in areas]), np.std([a.auc for a in areas]) / np.sqrt(n)
    # training on 80 + 80 scans costs the template of p channels (1 + 4p/(160 d²))^(-1/2) of d, and its covariance 2 %
    trained = d * (1 + 4 * N_CHANNELS / (160 * d**2)) ** -0.5 * (1 - N_CHANNELS / 160) ** 0.5 if d else 0.0
    assert abs(mean - ndtr(trained / np.sqrt(2))) < 3.5 * error


def test_scores_of_scans_trained_on_would_be_seen(monkeypatch):
    """Without a signal an observer that is tested on its training scans seems to see one."""
    monkeypatch.setattr("ctsim.benchmarks.scores.observer.np.setdiff1d", lambda everyone, _: everyone)
    rng = np.random.default_rng(7)
    areas = [known_background(gaussian(rng, 0.0), DRAWS) for _ in range(20)]
    assert np.mean([a.auc for a in areas]) > 0.55 and sum(a.low > 0.5 for a in areas) >= 5


def test_artefacts_that_vary_hide_what_noise_does_not():
    areas = []
    for spread in (0.0, 0.5, 1.0, 2.0):
        found = gaussian(np.random.default_rng(5), 2.5, n=60, locations=12, spread=spread)
        areas.append(varying_background(found, DRAWS))
        # a background that is the same in all scans of a location changes nothing for an observer trained there
        steady = gaussian(np.random.default_rng(5), 2.5, n=60, locations=12)
        assert known_background(found, DRAWS).auc == pytest.approx(known_background(steady, DRAWS).auc, abs=1e-9)
    values = [a.auc for a in areas]
    assert values == sorted(values, reverse=True) and values[0] > areas[1].high and values[-1] < 0.8
    # with equal backgrounds it has 11 times as many scans to train on: nearly the closed form
    assert abs(values[0] - ndtr(2.5 / np.sqrt(2))) < 0.01


def test_differences_are_paired():
    rng = np.random.default_rng(11)
    one = gaussian(rng, 1.5)
    noise = [rng.normal(0, 0.2, one.present.shape) for _ in range(2)]
    near = Responses(present=one.present + noise[0], absent=one.absent + noise[1], pairs=one.pairs)
    apart = gaussian(rng, 1.5)
    a, b, c = (known_background(r, 500) for r in (one, near, apart))
    assert difference(a, known_background(one, 500)) == (0.0, 0.0, 0.0)
    value, low, high = difference(b, a)
    assert low <= value <= high and value == pytest.approx(b.auc - a.auc)
    _, wide_low, wide_high = difference(c, a)
    assert high - low < 0.6 * (wide_high - wide_low)


def test_auc_counts_ties_half_and_weights_as_repeats():
    present, absent = np.array([1.0, 2.0, 2.0]), np.array([0.0, 2.0])
    assert auc(present, absent) == pytest.approx((1 + 1 + 1 + 0 + 0.5 + 0.5) / 6)
    weighted = auc(present[:2], absent, np.array([1.0, 2.0]), np.array([1.0, 1.0]))
    assert weighted == pytest.approx(float(auc(present, absent)))
    silent = Responses(present=np.zeros((20, 2, 5)), absent=np.zeros((20, 2, 5)), pairs=np.arange(20))
    assert known_background(silent, DRAWS).auc == varying_background(silent, DRAWS).auc == 0.5


def one_value(n, locations, relative):
    """Return responses to volumes of one value, of which noise and all lesions together change `relative`."""
    rng, weights = np.random.default_rng(3), np.random.default_rng(4).normal(size=(locations, N_CHANNELS))
    values = [0.02 * (1 + relative * (shift + rng.normal(size=n))) for shift in (1.0, 0.0)]
    present, absent = (np.float32(v).astype(float)[:, None, None] * weights for v in values)
    # the nine digits of a record
    rounded = [np.array([float(f"{r:.9g}") for r in x.ravel()]).reshape(x.shape) for x in (present, absent)]
    return values, Responses(present=rounded[0], absent=rounded[1], pairs=np.arange(n))


@pytest.mark.parametrize("relative", [1e-3, 1e-4, 1e-5])
def test_volumes_of_one_value_are_told_by_that_value_alone(relative):
    """Four of five directions hold only rounding: no template may follow them, and all locations say the same."""
    (with_lesions, without), found = one_value(100, 3, relative)
    folds = [np.arange(100) % 5 == f for f in range(5)]
    expected = np.mean([auc(with_lesions[f], without[f]) for f in folds])
    for k in range(3):
        here = found.at(np.array([k]))
        assert known_background(here, DRAWS).auc == pytest.approx(expected, abs=5e-3)  # float32 ties some pairs
        value, low, high = normal_theory(here.present[:, 0], here.absent[:, 0])
        assert low < ndtr(1 / np.sqrt(2)) < high and value == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("locations", [2, 3])
def test_an_observer_of_other_locations_follows_no_rounding(locations):
    """Less the anatomy, whose one value is another, rounding is still that of the volumes."""
    (with_lesions, without), found = one_value(100, locations, 1e-4)
    weights = np.random.default_rng(4).normal(size=(locations, N_CHANNELS))
    exact = (v[:, None, None] * weights for v in (with_lesions, without))
    present, absent = (x - ANATOMY * weights for x in exact)
    expected = varying_background(Responses(present=present, absent=absent, pairs=found.pairs), DRAWS)
    largest = max(np.abs(found.present).max(), np.abs(found.absent).max())
    less = Responses(
        present=found.present - ANATOMY * weights,
        absent=found.absent - ANATOMY * weights,
        pairs=found.pairs,
        scale=float(largest),
    )
    got = varying_background(less, DRAWS)
    assert (got.auc, got.low, got.high) == pytest.approx((expected.auc, expected.low, expected.high), abs=5e-3)


def test_theory_is_certain_of_what_nothing_hides():
    rng = np.random.default_rng(8)
    noise = [rng.normal(size=(20, N_CHANNELS)) for _ in range(2)]
    for kind in noise:
        kind[:, -1] = 3.0
    noise[0][:, -1] += 0.1
    assert normal_theory(*noise) == (1.0, 1.0, 1.0)
    # a difference of 1e5 deviations, where the noncentral F distribution has no value
    assert normal_theory(1e5 + noise[0][:, :1], noise[1][:, :1]) == (1.0, 1.0, 1.0)


def test_volumes_that_do_not_vary_tie_or_are_told_apart_for_certain():
    rng = np.random.default_rng(6)
    steady, anything = 0.02 * rng.normal(size=(3, N_CHANNELS)) + np.zeros((20, 1, 1)), gaussian(rng, 1.5, n=20)
    other = known_background(anything, DRAWS)
    for silent in (0 * steady, steady):
        same = Responses(present=silent, absent=silent, pairs=np.arange(20))
        for area in (known_background(same, DRAWS), varying_background(same, DRAWS)):
            assert (area.auc, area.low, area.high) == (0.5, 0.5, 0.5)  # no other scans would say another thing
            # so that the whole interval of a difference is the other's
            assert difference(area, other) == pytest.approx((0.5 - other.auc, 0.5 - other.high, 0.5 - other.low))
        assert normal_theory(silent[:, 0], silent[:, 0]) == (0.5, 0.5, 0.5)
    noise_free = Responses(present=1.01 * steady, absent=steady, pairs=np.arange(20))
    assert known_background(noise_free, DRAWS).auc == 1.0
    assert normal_theory(noise_free.present[:, 0], noise_free.absent[:, 0]) == (1.0, 1.0, 1.0)


def test_an_interval_at_1_is_wilsons():
    z = 1.959964
    assert wilson(1.0, 0.0, 50) == (pytest.approx(50 / (50 + z**2)), pytest.approx(1.0))
    share, n = 0.8, 40
    perfect = known_background(gaussian(np.random.default_rng(1), 20.0), DRAWS)
    worse = known_background(gaussian(np.random.default_rng(2), 1.0), DRAWS)
    assert perfect.auc == 1.0 and perfect.low < 0.97
    value, low, high = difference(perfect, worse)
    assert value - low == pytest.approx(np.hypot(1 - perfect.low, worse.high - worse.auc))
    assert high - value == pytest.approx(worse.auc - worse.low)
    assert wilson(share, np.sqrt(share * (1 - share) / n), 7) == pytest.approx(wilson(share, 0.0, n))


@pytest.mark.parametrize("dimensions", [2, 3])
def test_channels_are_orthogonal(dimensions):
    r = np.linspace(0, 6, 200_001)
    found = laguerre_gauss(r, 1.5, dimensions)
    gram = (found[:, None] * found[None] * r ** (dimensions - 1)).sum(-1)
    scale = np.sqrt(np.diag(gram))
    # the sum is a trapezoidal rule whose error falls with the square of the step, 3e-5
    assert np.abs(gram / np.outer(scale, scale) - np.eye(N_CHANNELS)).max() < 1e-6


def test_channels_lie_around_their_location():
    geometry = Geometry(
        dso=200.0,
        dsd=400.0,
        n_voxel=(15, 17, 19),
        d_voxel=(1.0, 0.8, 0.7),
        n_detector=(5, 7),
        d_detector=(1.0, 1.0),
        n_views=6,
    )
    at, diameter = (1.3, -0.6, 2.2), 3.0
    z, y, x = geometry.voxel_centres()
    for dimensions in (3, 2):
        found = channels(geometry, at, diameter, dimensions=dimensions)
        k, j, i = np.unravel_index(found.index, geometry.n_voxel)
        assert np.hypot(x[i] - at[0], y[j] - at[1]).max() <= REACH * diameter
        assert (np.abs(z[k] - at[2]).max() <= 0.5) if dimensions == 2 else (len(np.unique(k)) == 6)
        assert np.linalg.norm(found.weights, axis=1) == pytest.approx(np.ones(N_CHANNELS))
        volume = np.zeros(geometry.n_voxel, np.float32)
        volume[k[5], j[5], i[5]] = 2.0
        assert found.of(volume) == pytest.approx(2 * found.weights[:, 5])
        less = channels(geometry, at, diameter, seen=volume == 0, dimensions=dimensions)
        assert set(found.index) - set(less.index) == {found.index[5]} and not any(less.of(volume))
