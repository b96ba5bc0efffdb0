"""Dark readings: what they still say to a fit of splats, and what a fit says of metal that it does not explain."""

import dataclasses
import math
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch

from ctsim import score_volume
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.dataset.store import list_scans, open_scan
from ctsim.geometry import Geometry
from ctsim.reconstruct import starved
from ctsim.reconstruct.beyond import seen_beyond
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.scatter import Scatter
from ctsim.reconstruct.splat import verdict
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.fast import reconstruct
from ctsim.reconstruct.splat.level import Data, coarser, never_read
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.response import make_response
from ctsim.reconstruct.starved import WEIGHT, Below, weights_and_bounds
from ctsim.types import Scan, Status

GEOMETRY = Geometry(
    dso=200.0,
    dsd=300.0,
    n_voxel=(16, 16, 16),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(32, 40),
    d_detector=(1.0, 1.0),
    n_views=8,
)
I0, NOISE, DARK = 1e5, 6.0, 50.0


def scan_of(p, noise=NOISE, seed=0, whole=False) -> Scan:
    """Counts behind `p`, one for each photon, with the noise of the photons and Gaussian noise of the readout."""
    draws = np.random.default_rng(seed)
    counts = DARK + draws.poisson(I0 * np.exp(-np.broadcast_to(p, GEOMETRY.shape))) + draws.normal(0, noise, p.shape)
    counts = torch.from_numpy(np.rint(counts).astype(np.int32)) if whole else torch.from_numpy(counts).float()
    return Scan(geometry=GEOMETRY, counts=counts, flat=torch.full((32, 40), I0 + DARK), i0=I0, dark=DARK)


def bounds_of(scan, scatter=0.0):
    given = scatter if isinstance(scatter, Scatter) else Scatter(floor=scatter)
    p, clamped = line_integrals(scan, slice(None))
    weights = weights_and_bounds(scan, p.numpy(), ~clamped.numpy(), given, Below.of(scan).noise)
    return p.numpy(), weights


def test_a_dark_reading_bounds_its_ray_from_below_and_a_bright_one_is_read():
    true = np.random.default_rng(1).choice([0.5, 3.0, 7.0, 9.0, 15.0], GEOMETRY.shape)
    p, weights = bounds_of(scan_of(true))
    starving = weights < 0
    assert np.all(weights[starving] == np.float32(-WEIGHT))
    assert not starving[true < 7].any() and starving[true == 15].mean() > 0.95  # 2 σ of one side
    # a bound is wrong where noise takes 2 σ and more off a reading: 2.3 % of those near it, and 3 σ of 3000 readings
    assert (p > true)[starving].mean() < 0.031 and p[starving].min() > math.log(I0 / (5 * NOISE))
    read = line_integrals(scan_of(true), slice(None))[0].numpy()
    assert np.array_equal(p[~starving], read[~starving])
    np.testing.assert_allclose(weights[~starving], np.exp(-read[~starving]), rtol=1e-6)


def test_a_faint_open_field_bounds_by_its_own_photons():
    """Behind a bow-tie a pixel of a fifth of the mean beam sees nothing already at P 1.6 below the others'."""
    scan = scan_of(np.full(GEOMETRY.shape, 25.0))
    share = np.ones((32, 40), np.float32)
    share[:, :4] = 0.2
    flat = torch.from_numpy(share / share.mean() * np.float32(I0)) + DARK
    p, weights = bounds_of(dataclasses.replace(scan, flat=flat))
    dark = np.broadcast_to(weights < 0, p.shape)
    bright, faint = p[:, :, 4:][dark[:, :, 4:]], p[:, :, :4][dark[:, :, :4]]
    # the same readings and the same noise over an open field of a fifth: ln 5 lower in every quantile
    assert np.median(bright) - np.median(faint) == pytest.approx(math.log(5), abs=0.05)


def test_scatter_takes_its_share_of_a_bound():
    scan = scan_of(-np.log(np.exp(-np.full(GEOMETRY.shape, 15.0)) + 0.01), noise=0.0)
    p, weights = bounds_of(scan, scatter=0.01)
    assert (weights < 0).mean() > 0.99  # 1000 photons, 3 % of noise
    np.testing.assert_allclose(p[weights < 0], -math.log(starved.DOUBT * 0.01), atol=0.5)
    assert not (bounds_of(scan)[1] < 0).any()  # without it they are readings


def test_a_reading_is_restated_with_the_mean_scatter_in_place_of_its_own():
    source = np.random.default_rng(2).uniform(0.01, 0.03, (8, 16, 20)).astype(np.float32)
    source[3] *= 2  # views differ
    scatter = Scatter(floor=0.002, gain=0.5, source=source, step=(2, 2))
    own = np.stack([scatter.of(view, (32, 40)) for view in range(8)])
    true = np.broadcast_to(np.linspace(0.1, 4.0, 40), GEOMETRY.shape).copy()
    true[:, :3] = 15
    scan = scan_of(-np.log(np.exp(-true) + own), noise=0.0)
    p, weights = bounds_of(scan, scatter)
    read, share = weights > 0, (scan.counts.numpy() - DARK) / I0 - own
    assert read[:, 3:].all() and (weights[:, :3] < 0).mean() > 0.99
    np.testing.assert_allclose(np.exp(-p)[read], (share + scatter.mean)[read], rtol=1e-4)
    allowed = np.maximum(share, 0) + starved.UNSEEN / I0 + starved.DOUBT * own
    np.testing.assert_allclose(np.exp(-p)[weights < 0], allowed[weights < 0], rtol=1e-4)


def test_what_is_dead_or_not_finite_says_nothing():
    scan = scan_of(np.full(GEOMETRY.shape, 15.0))
    scan.counts[0, 0, :5] = torch.tensor([math.nan, math.inf, -math.inf, math.nan, math.inf])
    scan.flat[5, 5] = DARK
    _, weights = bounds_of(scan)
    assert not weights[0, 0, :4].any() and not weights[:, 5, 5].any() and (weights[1:, 6:] < 0).mean() > 0.9


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("noise", [0.3, 3.0, 30.0])
def test_noise_is_told_by_what_is_below_the_dark_level(noise, whole):
    """Readings of half a count and less, rounded, tell none."""
    below = Below.of(scan_of(np.full(GEOMETRY.shape, 15.0), noise, whole=whole))
    expected = 0.0 if whole and noise < 1 else noise / I0
    rounding = 0.5 / noise if whole else 0.0  # at most, of a reading
    assert below.noise == pytest.approx(expected, rel=0.06 + rounding) and not below.sentence  # 0.03 photons a reading
    assert Below.of(scan_of(np.full(GEOMETRY.shape, 2.0), noise)).noise == 0.0


@pytest.mark.parametrize("true", [15.0, np.linspace(2, 15, math.prod(GEOMETRY.shape)).reshape(GEOMETRY.shape)])
def test_a_dark_level_that_is_too_high_is_said(true):
    scan = scan_of(np.broadcast_to(true, GEOMETRY.shape))
    assert not Below.of(scan).sentence
    assert "is the scan's dark level right?" in Below.of(dataclasses.replace(scan, dark=DARK + 5 * NOISE)).sentence


def test_four_bounds_make_a_coarse_one_and_one_reading_among_them_a_reading():
    p, weights = np.full(GEOMETRY.shape, 8.0, np.float32), np.full(GEOMETRY.shape, -WEIGHT, np.float32)
    p[0, 2, 2], weights[0, 2, 2] = 1.0, math.exp(-1)
    weights[0, 4:6, 4:6] = 0
    coarse = coarser(Data(geometry=GEOMETRY, p=p, weights=weights, scatter=0.01))
    assert coarse.weights[0, 0, 0] == np.float32(-WEIGHT) and coarse.p[0, 0, 0] == pytest.approx(8.0, rel=1e-5)
    mixed = (math.exp(-1) + 3 * (math.exp(-8) + 0.01)) / 4
    assert coarse.p[0, 1, 1] == pytest.approx(-math.log(mixed), rel=1e-5)
    assert coarse.weights[0, 1, 1] == pytest.approx(mixed, rel=1e-5) and coarse.weights[0, 2, 2] == 0


def test_an_offset_detector_is_not_short_where_the_other_side_sees():
    lit = np.ones(GEOMETRY.shape, np.float32)
    assert set(seen_beyond(lit, GEOMETRY, I0).sides) >= {"first column", "last column"}
    shifted = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 8.0))
    sides = seen_beyond(lit, shifted, I0).sides
    assert "last column" in sides and "first column" not in sides


SCENE = """
name = "small"
seed = 7
phantom = { recipe = "random", metal = "METAL", n_inserts = 1, insert_mm = 14.0, n_voxel = [97, 97, 97] }
scanner = { n_voxel = [56, 56, 56], n_detector = [98, 98], n_views = 80, i0 = 1e5 }
"""


def made(folder, metal):
    (folder / "scene.toml").write_text(SCENE.replace("METAL", metal), encoding="utf-8")
    assert make_dataset([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return open_scan(list_scans(folder / "data")[0])


@pytest.mark.slow
def test_dense_metal_is_not_hollow_and_is_said_to_be_uncertain(tmp_path, monkeypatch):
    stored = made(tmp_path, "W")
    with_bounds = reconstruct(stored.scan)
    monkeypatch.setattr(starved, "WEIGHT", 1e-12)
    without = reconstruct(stored.scan)
    scores = [score_volume(volume, stored, protocols="metal")["metal"] for volume in (with_bounds, without)]
    core = [score.values["core_ratio"] for score in scores]
    assert core[0] > 2 * core[1]  # 0.52 and 0.18
    assert "metal is thinner than the grid" in with_bounds.details["limitation"]
    assert with_bounds.details["metal_unread"] > 0.2 and "known from below" in with_bounds.details["limitation"]


@pytest.mark.parametrize(
    "runaway, status, said",
    [(10, Status.OK, ""), (200, Status.OK, "18 times iron"), (1001, Status.DIVERGED, "18 times iron")],
)
def test_splats_at_the_end_of_the_curve_are_said_and_many_are_divergence(runaway, status, said):
    """Of 100 000 splats: up to ten may be there, more are a limit, more than a hundredth a divergence."""
    curve = MaterialCurve.of(make_response("tube", e_max=90.0, basis="klein-nishina"), 30.0)
    u = np.full(100_000, curve.water, np.float32)
    u[:runaway] = curve.knots[-1]
    part = SimpleNamespace(u=u, curve=curve, finer=1)
    fit = Fit(data=None, parts=[part], response=None, tv=0.0)
    found, reason = verdict.verdict(fit, u)
    assert found is status and ("18 times the attenuation of iron" in reason) == (status is Status.DIVERGED)
    assert said in verdict.unexplained(fit, 0.1) and bool(said) == bool(verdict.unexplained(fit, 0.1))
    assert "missed by 0.7" in verdict.unexplained(fit, 0.7)


@pytest.mark.slow
def test_metal_that_explains_its_shadow_is_not_doubted(tmp_path):
    volume = reconstruct(made(tmp_path, "Ti").scan)
    assert "limitation" not in volume.details and volume.details["dark_misfit"] < 0.4
    assert volume.details["metal_unread"] < 0.05


def test_metal_that_no_view_reads_is_known_from_below_alone():
    """A shadow of 5 × 5 pixels in every view, of bounds but for what noise makes of them; then a view that reads it."""
    p, weights = np.ones(GEOMETRY.shape, np.float32), np.full(GEOMETRY.shape, 0.3, np.float32)
    v, u = (n // 2 for n in GEOMETRY.n_detector)
    weights[:, v - 2 : v + 3, u - 2 : u + 3] = -WEIGHT
    noisy = np.random.default_rng(3).random(weights.shape) < 0.1
    weights[noisy & (weights < 0)] = 1e-4
    fine = msgspec.structs.replace(GEOMETRY, n_voxel=(21, 21, 21), d_voxel=(0.5, 0.5, 0.5))
    data = Data(geometry=GEOMETRY, p=p, weights=weights)
    unread = never_read(data, fine)
    z, y, x = (np.abs(c) for c in fine.voxel_centres())
    far = np.maximum(z[:, None, None], np.hypot(y[:, None], x))
    magnified = GEOMETRY.d_detector[0] * GEOMETRY.dso / GEOMETRY.dsd
    assert unread[far < 1.2 * magnified].all() and not unread[far > 3 * magnified].any()
    assert (far < 1.2 * magnified).sum() > 10 and (far > 3 * magnified).sum() > 10
    weights[3, v - 2 : v + 3, u - 2 : u + 3] = 1e-4
    assert not never_read(data, fine)[far < 1.2 * magnified].any()


@pytest.mark.parametrize("share, said", [(None, ""), (0.05, ""), (0.45, "45% of the metal")])
def test_unread_metal_is_said(share, said):
    assert verdict.bounded(share).startswith(said) and bool(verdict.bounded(share)) == bool(said)
