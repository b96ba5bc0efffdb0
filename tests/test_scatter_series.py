"""Scatter of level 3: photons of a few views, smoothed and interpolated, and what the simulator does with it."""

import dataclasses

import msgspec
import numpy as np
import pytest
from test_montecarlo import ALL, ball
from test_simulate import GEOMETRY, phantom, run, scanner

from ctsim.beam.spectrum import Spectrum, Tube
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.montecarlo import series
from ctsim.montecarlo.kernels.scoring_cpu import SINGLE, SQUARED
from ctsim.montecarlo.kernels.transport_cpu import CHUNKS
from ctsim.montecarlo.series import scatter_series
from ctsim.montecarlo.transport import PLANES, Source, scatter_image
from ctsim.montecarlo.world import World
from ctsim.phantoms.dataset import make_scene, plan_scene
from ctsim.phantoms.scene import Scene, build
from ctsim.scaninfo import read_info
from ctsim.scatter import Scatter, constant_fraction
from ctsim.settings import Simulation, Truth
from ctsim.simulate import scan_info, scatter_of

SIGMAS = 4.0
MONO = Spectrum(energies=np.array([60.0]), weights=np.array([1.0]))


def source(geometry=GEOMETRY, **more):
    return Source(spectrum=MONO, detector=ALL, n_detector=geometry.n_detector, **more)


def circle(**changes):
    small = {"n_voxel": (8, 8, 8), "d_voxel": (1.0, 1.0, 1.0), "d_detector": (1.0, 1.0), "dso": 200.0, "dsd": 400.0}
    return Geometry(**{**small, "n_detector": (60, 96), "n_views": 90, **changes})


@pytest.mark.parametrize("arc", [360.0, 200.0])
def test_waves_are_found_and_evaluated_exactly(monkeypatch, arc):
    """Photons without noise from a field of few waves give that field in every pixel of every view."""
    geometry = circle(arc_deg=arc)

    def field(view, v, u):
        """Intensity at the view (0 … 1) and the detector's place."""
        turn = np.cos(2 * np.pi * view) + 0.3 * np.sin(4 * np.pi * view) if arc == 360 else np.cos(3 * np.pi * view)
        return 5 + 0.5 * turn * np.cos(np.pi * u) + np.cos(2 * np.pi * v) * np.cos(3 * np.pi * u)

    def told(world, source, pose, histories, *, cells):
        view = told.view = (told.view + 1) % told.n
        fine = [(np.arange(64 * n) + 0.5) / (64 * n) for n in cells]
        values = field((view + 0.5) / told.n, fine[0][:, None], fine[1]).reshape(cells[0], 64, cells[1], 64)
        images = np.zeros((CHUNKS, PLANES, *cells))
        images[:, SINGLE] = values.mean((1, 3)) * histories.count / CHUNKS
        images[:, SQUARED] = 2 * images[:, SINGLE]
        return images

    told.n, told.view = len(series._few(geometry)), -1
    assert told.n < 30
    monkeypatch.setattr(series, "add_histories", told)
    found = scatter_series(phantom(), source(geometry), geometry, tolerance=0.01)
    assert found.error < 1e-9
    v, u = ((np.arange(n) + 0.5) / n for n in geometry.n_detector)
    for k in (0, 1, 44, 89):
        expected = field((k + 0.5) / 90, v[:, None], u)
        mean, squared = found.view(k)
        # float32 beside the blocks' weights, 1 − σ²/Y, of 64² rays a cell: 2e-4
        np.testing.assert_allclose(mean, expected, rtol=5e-4)
        np.testing.assert_allclose(squared, 2 * expected, rtol=5e-4)


def test_the_error_that_is_stated_is_no_less_than_the_error():
    """White noise of known strength on a smooth field: smoothing takes most of it, and what stays is known."""
    rng = np.random.default_rng(5)
    t, v, u = (np.arange(n, dtype=np.float64) for n in (24, 32, 32))
    truth = rng.normal(size=(24, 32, 32)) * np.exp(-(t[:, None, None] + v[:, None] + u) / 2)
    truth[0, 0, 0] = 3.0
    for sigma in (0.003, 0.03):
        off, stated = [], []
        for _ in range(10):
            halves = truth + sigma * np.sqrt(2) * rng.normal(size=(2, *truth.shape))
            kept, error = series._smooth(halves, (t, v, u))
            off.append(((kept * halves.mean(0) - truth) ** 2).sum() / 9)
            stated.append(error**2)
        raw = sigma**2 * truth.size / 9
        assert np.mean(off) < raw / 8  # it is worth the trouble
        assert 0.8 < np.mean(stated) / np.mean(off) < 4


@pytest.mark.slow
def test_level_3_is_the_scatter_of_long_runs_behind_metal_too():
    body, geometry = phantom(), msgspec.structs.replace(GEOMETRY, n_views=24)
    found = scatter_series(body, source(geometry), geometry, tolerance=0.02, stream="one")
    world, off, scale = World.of(body, 61.0), [], []
    cells = series._cells(geometry)
    for k in (0, 7, 15):
        long = scatter_image(world, source(geometry), geometry.pose(k), cells=cells, histories=1_000_000, stream="two")
        mine = found.view(k)[0].astype(np.float64)
        factor = [n // c for n, c in zip(mine.shape, cells, strict=True)]
        mine = mine.reshape(cells[0], factor[0], cells[1], factor[1]).mean((1, 3))
        off.append(((mine - long.scatter) ** 2).mean() - (long.error**2).mean())
        scale.append(long.scatter.mean())
    assert found.error <= 0.02
    assert np.sqrt(max(np.mean(off), 0)) / np.mean(scale) < 1.5 * found.error


def test_intensity_and_layer_of_a_pixel():
    """Half the photons behind a filter are as many as the filter lets through; scatter follows the primary photons."""
    body = dataclasses.replace(phantom(), solids=())
    world, n = World.of(body, 61.0), GEOMETRY.n_detector
    run = {"cells": (3, 3), "histories": 400_000}
    plain = scatter_image(world, source(), GEOMETRY.pose(0), **run)
    gain = np.linspace(0.5, 2.0, n[0] * n[1], dtype=np.float32).reshape(n)
    some = scatter_image(world, source(gain=gain), GEOMETRY.pose(0), **run)
    cell = gain.reshape(3, n[0] // 3, 3, n[1] // 3).mean((1, 3))
    sigma = np.sqrt(2.0 * 9 / 400_000 * plain.primary * cell)
    assert abs(some.primary - plain.primary * cell)[plain.primary > 0.9].max() < SIGMAS * sigma.max()
    layer = np.full(n, 2.0, np.float32)
    behind = scatter_image(world, source(layer=layer, layer_material="Al"), GEOMETRY.pose(0), **run)
    passed = np.exp(-2 * 0.0749)  # μ of aluminium at 60 keV, NIST: 0.2778 cm²/g · 2.699 g/cm³, per mm
    assert behind.primary.mean() / plain.primary.mean() == pytest.approx(passed, rel=0.01)
    assert behind.scatter.mean() / plain.scatter.mean() == pytest.approx(passed, rel=0.03)


def test_the_squared_signal_of_photons_that_all_count_alike():
    counting = dataclasses.replace(source(), detector=Detector(kind="counting", thickness=50.0, threshold=0.0))
    image = scatter_image(World.of(phantom(), 61.0), counting, GEOMETRY.pose(0), cells=(4, 4), histories=20_000)
    np.testing.assert_allclose(image.squared, image.scatter, rtol=1e-3)


@pytest.mark.parametrize("tube", [Tube(), Tube(heel=True, anode_deg=20.0)])
def test_the_simulator_adds_it_to_scan_and_twin_each_their_own(tube):
    truth = Truth(noise_free=True, scatter_free=True)
    geometry = msgspec.structs.replace(GEOMETRY, n_views=4)
    machine = scanner(tube=tube, scatter=Scatter(level=3), geometry=geometry)
    settings = Simulation(scatter_error=0.1)
    plan, out = run(phantom(), machine, settings, truth)
    assert plan.scatter_error == 0.1 and "10% of the scatter" in plan.text() and plan.to_dict()["scatter_error"] == 0.1
    added = {}
    for which in ("", "metal_free/"):
        p, bare = out[f"{which}noise_free"].astype(np.float64), out[f"{which}scatter_free"].astype(np.float64)
        added[which] = np.exp(-p) - np.exp(-bare)
        assert (added[which] > 0).all()
    assert abs(added[""] / added["metal_free/"] - 1).max() > 0.02  # metal takes scatter away, and makes some
    stated = scan_info(plan, phantom(), machine, scatter_of(plan, phantom(), machine))["scatter_fraction"]
    if not tube.heel:  # the images are relative to the open field, which a heel makes another in each pixel
        # P of about 1 in float32 is off by 1e-7, and so are intensities; scatter is 0.004 of the open field
        assert stated == pytest.approx(added[""].mean(), rel=1e-4)
        assert stated != pytest.approx(added["metal_free/"].mean(), rel=1e-4)
    _, other = run(phantom(), machine, settings, truth, first_view=2)
    np.testing.assert_array_equal(other["counts"], out["counts"][2:])
    np.testing.assert_array_equal(other["metal_free/counts"], out["metal_free/counts"][2:])


@pytest.mark.slow
def test_scan_json_says_how_much_scatter_there_is(tmp_path):
    scanner = {"preset": "ideal", "n_voxel": (8, 8, 8), "n_detector": (12, 12), "n_views": 4}
    scene = {"name": "one", "phantom": {"recipe": "validation", "n_voxel": (16, 16, 16), "size": 60.0, "metal": "Fe"}}
    for level, simulation in ((0, {}), (1, {}), (3, {"scatter_error": 0.3})):
        given = scene | {"scanner": scanner | {"scatter": {"level": level}}, "simulation": simulation}
        one = msgspec.convert(given, Scene)
        folder = make_scene(one, tmp_path / str(level))
        share = read_info(folder / "scan.json").scatter_fraction
        (series, *_) = scatter_of(plan_scene(one), build(one), one.resolve())
        expected = {0: 0.0, 1: constant_fraction(one.resolve().geometry)}
        assert share == (series.mean if series else expected[level])
        assert (share > 0) == (level > 0)


def test_another_error_keeps_the_noise():
    """Photon noise is drawn from the same stream, whatever precision the scatter has."""
    geometry = msgspec.structs.replace(GEOMETRY, n_views=2)
    machine = scanner(scatter=Scatter(level=3), geometry=geometry, noise=Noise())
    (_, one), (_, two) = (run(phantom(), machine, Simulation(scatter_error=e), Truth(twin=False)) for e in (0.3, 0.1))
    apart = one["counts"].astype(float) - two["counts"]
    assert 0 < abs(apart).max() < 0.05 * one["counts"].max()


def test_what_cannot_be_asked():
    with pytest.raises(InputError, match=r"scatter.level must be 0, 1 or 3, got 2"):
        Scatter(level=2)
    with pytest.raises(InputError, match=r"fraction = 0.1 needs scatter.level = 1, got level 3"):
        Scatter(level=3, fraction=0.1)
    with pytest.raises(InputError, match=r"grid_ratio = 8 needs scatter.level = 3, got level 1"):
        Scatter(level=1, grid_ratio=8)
    with pytest.raises(InputError, match=r"grid_ratio must be within \(0, 50\], got -1"):
        Scatter(level=3, grid_ratio=-1)


def test_a_grid_takes_scatter_away_and_leaves_the_rest():
    geometry = msgspec.structs.replace(GEOMETRY, n_views=2)
    truth = Truth(twin=False, noise_free=True, scatter_free=True)
    added = []
    for ratio in (None, 10.0):
        machine = scanner(scatter=Scatter(level=3, grid_ratio=ratio), geometry=geometry)
        _, out = run(phantom(), machine, Simulation(scatter_error=0.2), truth)
        added.append(np.exp(-out["noise_free"]) - np.exp(-out["scatter_free"]))
    assert 0.02 < added[1].mean() / added[0].mean() < 0.6


def test_photons_are_followed_from_poses_of_the_orbit():
    """Not from a chord between two views, which is nearer; given poses that jump are all used."""
    geometry = circle()
    poses = series._few(geometry)
    assert len(poses) == 24
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3], axis=1), geometry.dso, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 6:9], axis=1), geometry.d_detector[1], rtol=1e-12)
    given = geometry.pose_array()
    jumps = circle(poses=tuple(map(tuple, np.concatenate([given[:45], given[::-1][:45]]))))
    assert len(series._few(jumps)) == 90


def test_little_scatter_needs_no_small_share_of_it(monkeypatch):
    """An object of 5 mm scatters 2e-5 of the open field. 2 % of that would take 1e8 photons."""
    geometry = msgspec.structs.replace(GEOMETRY, n_views=2)
    small = ball("water", 2.5)
    found = scatter_series(small, source(geometry), geometry, tolerance=0.02)
    level = found.coefficients[0, 0, 0, 0]
    assert found.error > 0.02 and level > 0 and found.error * level <= series.NEGLIGIBLE
    monkeypatch.setattr(series, "NEGLIGIBLE", 0.0)
    monkeypatch.setattr(series, "MOST", found.histories // 2)
    with pytest.raises(InputError, match="scatter_error"):
        scatter_series(small, source(geometry), geometry, tolerance=0.02)


def test_an_error_that_is_not_reached_is_said(monkeypatch):
    monkeypatch.setattr(series, "MOST", series.FIRST)
    geometry = msgspec.structs.replace(GEOMETRY, n_views=2)
    with pytest.raises(InputError, match=r"simulation.scatter_error: 4.0e\+04 photons reach .* not 0.001; expected"):
        scatter_series(phantom(), source(geometry), geometry, tolerance=0.001)
