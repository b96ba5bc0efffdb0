"""How much readings count: fewer photons less, and edges less than a grid can explain."""

import dataclasses

import msgspec
import numpy as np
import pytest

from ctsim import new_scene, reconstruct_scan, score_volume, simulate_scene
from ctsim.dataset.store import list_scans, open_scan
from ctsim.geometry import Geometry
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.scatter import Scatter
from ctsim.reconstruct.splat import fast, level, verdict
from ctsim.reconstruct.splat.course import levels_of
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.level import coarser, evening_error, rays_met, weighted
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.part import Part
from ctsim.reconstruct.weights import DARK, doubt_edges, even_out, photon_weights

EDGES = fast.Settings().edges


def doubted(p, weights, edges, scatter):
    """Compute the weights pixel by pixel in float64, as the docstring defines them."""
    p = np.where(weights < 0, -np.log(np.exp(-p.astype(np.float64)) + scatter), p)
    bends, out = np.zeros(p.shape), weights.astype(np.float64)
    n_v, n_u = p.shape[1:]
    for view, v, u in zip(*np.nonzero(weights), strict=True):
        for near in ([(v - 1, u), (v + 1, u)], [(v, u - 1), (v, u + 1)]):
            inside = [(view, i, j) for i, j in near if 0 <= i < n_v and 0 <= j < n_u and weights[view, i, j] != 0]
            bends[view, v, u] = max(bends[view, v, u], abs(sum(p[at] - p[view, v, u] for at in inside)))
    for view, v, u in zip(*np.nonzero(weights > 0), strict=True):
        around = (view, slice(max(v - 1, 0), v + 2), slice(max(u - 1, 0), u + 2))
        dark = np.any((p[around] > DARK) & (weights[around] != 0))
        b = bends[around].max() if dark else bends[view, v, u]
        out[view, v, u] = 1 / (1 / out[view, v, u] + (b / edges) ** 2)
    return out


@pytest.mark.parametrize("edges, scatter", [(0.5, 0.0), (2.0, 0.03)])
@pytest.mark.parametrize("shape", [(3, 9, 11), (2, 1, 7), (2, 7, 1), (1, 1, 1)])
def test_edges_count_less_and_what_says_nothing_makes_none(shape, edges, scatter):
    draws = np.random.default_rng(3)
    p = draws.uniform(0, 4, shape).astype(np.float32)  # some neighbourhoods are dark and some are not
    weights = photon_weights(p, np.ones(p.shape, np.bool_))
    kind = draws.random(p.shape)
    weights[kind < 0.2], p[kind < 0.1] = 0, np.nan
    weights[kind > 0.9] = -0.002
    expected = doubted(p, weights, edges, scatter)
    doubt_edges(p, weights, edges, scatter)
    np.testing.assert_allclose(weights, expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("error", [0.0, 7.0, 250.0])
def test_evened_weights_are_inverse_variances_over_that_of_an_open_ray(error):
    p = np.linspace(0, 12, 48, dtype=np.float32).reshape(2, 4, 6)
    weights = photon_weights(p, np.arange(48).reshape(p.shape) % 5 > 0)
    weights[1, 2] = -0.002
    variance = np.exp(p.astype(np.float64)) + error  # of photons, and of all else
    expected = np.where(weights > 0, (1 + error) / variance, weights)
    even_out(weights, error)
    np.testing.assert_allclose(weights, expected, rtol=1e-5)


def smooth_data(dark, scatter):
    """A fifth of the rays that met something has p = `dark`, the others have 2.5; three fifths are open."""
    geometry = Geometry(
        dso=200.0, dsd=400.0, n_voxel=(8, 8, 8), d_voxel=(1, 1, 1), n_detector=(20, 20), d_detector=(1, 1), n_views=30
    )
    p = np.full(geometry.shape, 2.5, np.float32)
    p[:, :4] = dark
    p[..., :12] = -np.log1p(scatter) + np.random.default_rng(5).normal(0, 0.003, (30, 20, 12))
    return weighted(geometry, p, np.ones(p.shape, np.bool_), scatter)


@pytest.mark.parametrize("scatter", [0.0, 2e-4])
@pytest.mark.parametrize("dark", [3.1, 5.0, 7.5])
def test_dark_rays_come_to_weigh_half_as_much_as_usual_ones(dark, scatter):
    data = smooth_data(dark, scatter)
    found = evening_error(data, 1e6)
    assert found == pytest.approx(max(np.exp(dark) - 2 * np.exp(2.5), 0), rel=1e-5)
    even_out(data.weights, found)
    share = data.weights[0, 0, 15] / data.weights[0, 9, 15]
    assert share == pytest.approx(max(np.exp(2.5 - dark), 0.5), rel=1e-5)


def test_rays_that_read_mostly_scatter_do_not_come_to_weigh_more():
    """Behind p of 5 a share of 0.0067 is read. m is whole up to scatter of two fifths of that, and 0 from half on."""
    most = 40.0

    def found(share):
        return evening_error(smooth_data(5.0, share * np.exp(-5.0)), most)

    assert found(0.399) == most and found(0.501) == 0
    steps = [found(share) for share in np.arange(0.39, 0.52, 0.002)]
    assert max(np.abs(np.diff(steps))) < 0.03 * most
    assert found(3 / 7) == pytest.approx(0.75 * most, rel=0.01)  # scatter is three quarters of the primary


def test_weights_stay_where_a_tenth_of_the_rays_is_starved():
    """A body that grows thicker turns dark readings into bounds, and is left as it is from a tenth of them on."""

    def found(rows):
        data = smooth_data(5.0, 0.0)
        data.weights[:, -rows:, 12:] = -0.002
        return evening_error(data, 10.0)

    assert [found(rows) for rows in (1, 2)] == pytest.approx([10.0, 0.0])
    data = smooth_data(5.0, 0.0)
    data.weights[:, :4, 12:] = -0.002
    assert rays_met(data).dark == pytest.approx(np.exp(2.5), rel=1e-5)
    data = smooth_data(5.0, 0.0)
    data.weights[:, -1:, 12:] = -0.002
    data.weights[:15, -2:, 12:] = -0.002  # 0.075 of the rays
    assert rays_met(data).starved == pytest.approx(0.075, abs=0.005)
    assert evening_error(data, 10.0) == pytest.approx(5, abs=1)


def test_noise_of_dark_rays_is_no_edge():
    """Of 5000 photons 34 come through p of 5: noise alone makes second differences of 0.4."""
    data, draws = smooth_data(5.0, 0.0), np.random.default_rng(9)
    photons = draws.poisson(5e3 * np.exp(-data.p.astype(np.float64)))
    noisy = weighted(data.geometry, -np.log(np.maximum(photons, 1) / 5e3).astype(np.float32), photons > 0)
    found = rays_met(noisy)
    assert found.dark > 3 * found.usual and evening_error(noisy, 2.0) == 2.0
    assert "of the usual weight" in verdict.uneven(dataclasses.replace(noisy, error=2.0))


def test_bounds_next_to_readings_are_no_edge():
    """A bound's p lacks scatter: 4.6 and scatter of 0.01 read 3.9, which the row next to it does."""
    data = smooth_data(3.9, 0.01)
    data.p[:, 4, 12:] = 3.9  # three rows lie at the lower dark end, of which two are not next to its edge
    data.p[:, 0], data.weights[:, 0] = 4.6, -0.002
    assert rays_met(data).dark == pytest.approx(np.exp(3.9), rel=1e-3)


def test_the_usual_ray_is_the_median_of_readings():
    data = smooth_data(5.0, 0.0)
    data.p[:, 4:13, 12:] = 1.5  # off the edges 2 rows have 5, 5 rows 1.5 and 5 rows 2.5
    found = rays_met(data)
    assert (found.usual, found.dark) == pytest.approx((np.exp(2.5), np.exp(5.0)), rel=1e-5)
    data.weights[...] = 0
    assert evening_error(data, 10.0) == 0 and rays_met(data).dark == 1


def test_edges_are_doubted_in_weights_that_were_evened_out(monkeypatch, smallest):
    scan = open_scan(list_scans(smallest)[0]).scan
    monkeypatch.setattr(fast, "evening_error", lambda data, most: 12.0)
    data, _ = fast._weighted(scan, fast.Settings(), scan.geometry, Scatter(floor=0.0), 0.0)
    expected = photon_weights(data.p, data.weights > 0)
    even_out(expected, 12.0)
    doubt_edges(data.p, expected, EDGES)
    read = data.weights > 0
    assert np.array_equal(data.weights[read], expected[read]) and data.error == 12.0
    even_out(wrong := data.weights.copy(), 12.0)
    assert not np.allclose(wrong, data.weights)


def test_the_filtration_of_a_flat_scan_is_found_by_photons(monkeypatch, smallest):
    """Its finest grid is the only one; weights that were evened out find twice the filtration on a pelvis."""
    data = smooth_data(5.0, 0.0)
    geometry = msgspec.structs.replace(data.geometry, n_voxel=(1, 32, 32), d_voxel=(1, 0.25, 0.25))
    data.weights[:, 2] = -0.002
    read, weights = data.weights > 0, data.weights.copy()
    even_out(data.weights, 12.0)
    tried = []

    class Stop(Exception):
        pass

    def course(levels, *rest, **more):
        tried.extend(levels)
        raise Stop

    monkeypatch.setattr(fast, "_course", course)
    scan = open_scan(list_scans(smallest)[0]).scan
    with pytest.raises(Stop):
        fast.find_filtration([dataclasses.replace(data, geometry=geometry, error=12.0)], scan, fast.Settings())
    (only,) = tried
    assert np.array_equal(only.weights[read], weights[read]) and np.all(only.weights[:, 2] < 0) and only.error == 0


def test_coarser_grids_count_photons_alone():
    data = smooth_data(5.0, 0.0)
    even_out(data.weights, 12.0)
    coarse = level.coarser(dataclasses.replace(data, error=12.0))
    assert np.array_equal(coarse.weights, photon_weights(coarse.p, coarse.weights > 0)) and coarse.error == 0


@pytest.mark.parametrize(
    "dark, error, said", [(3.8, 0.0, False), (4.0, 0.0, True), (7.5, 200.0, True), (7.5, 600.0, False)]
)
def test_it_is_said_where_dark_rays_hardly_count(dark, error, said):
    """Weights of 1/(exp(p) + error): a share of 0.27, 0.22, 0.11 and 0.25 of those of p = 2.5."""
    sentence = verdict.uneven(dataclasses.replace(smooth_data(dark, 0.0), error=error))
    assert ("smeared" in sentence) == said


def test_a_volume_says_by_how_much_weights_were_evened_out(monkeypatch, smallest):
    monkeypatch.setattr(fast, "evening_error", lambda data, most: 12.0)
    monkeypatch.setattr(fast, "uneven", lambda data: f"{data.error:g} was not enough")
    details = fast.reconstruct(open_scan(list_scans(smallest)[0]).scan, passes=(0, 1), model_error=10.0).details
    assert details["evened_out"] == 12.0 and "12 was not enough" in details["limitation"]


def test_wire_all_over_an_object_makes_no_thick_body(monkeypatch):
    """Most rays that meet this drumstick lie at wire, with p of up to 4; nearly all others have p below 1.5."""
    scan = simulate_scene(wire(n=36)).scan
    p = line_integrals(scan, slice(None))[0].numpy()
    data = weighted(scan.geometry, p, np.ones(p.shape, np.bool_))
    assert evening_error(data, 1e6) == 0
    monkeypatch.setattr(level, "SMOOTH", np.inf)
    assert evening_error(data, 1e6) > 10


def test_weights_are_evened_out_no_further_than_noise_allows(monkeypatch, smallest):
    """At a tenth of the photons the same error of the model is a tenth of noise's variance; 0 leaves exp(−p)."""
    scan = open_scan(list_scans(smallest)[0]).scan
    given = []
    monkeypatch.setattr(level, "rays_met", lambda data: level.Rays(usual=2.0, dark=16.0, starved=0.0))
    monkeypatch.setattr(fast, "even_out", lambda weights, error: given.append(error))
    for model_error, i0 in ((0.02, 1e5), (0.02, 1e4), (0.01, 1e4), (0.0, 1e5)):
        few = dataclasses.replace(scan, i0=i0)
        settings = fast.Settings(model_error=model_error)
        fast._weighted(few, settings, scan.geometry, Scatter(floor=0.0), 0.0)
    assert given == pytest.approx([12.0, 4.0, 1.0, 0.0])


def test_what_only_dark_rays_tell_is_kept():
    """Stripes along the longer axis of a wide body: rays along them have p of 5.6, and to all others they are even.

    Behind weights exp(−p) the denoiser, which knows no dark rays, smooths them away (0.00); 0.49 of them is kept.
    """
    n, d = 96, 340 / 96
    geometry = Geometry(
        dso=1000.0,
        dsd=1500.0,
        n_voxel=(8, n, n),
        d_voxel=(d, d, d),
        n_detector=(16, 153),
        d_detector=(1.5 * d, 1.5 * d),
        n_views=120,
    )
    settings = fast.Settings(filtration=8.0)
    response = settings.make_response(120.0, 8.0)
    curve = MaterialCurve.of(response, 150.0)
    _, y, x = geometry.voxel_centres()
    x, y = x[None], y[:, None]
    inside, wave = (np.abs(x) < 100) & (np.abs(y) < 30), np.cos(2 * np.pi * y / (6 * d))
    body = np.where(np.hypot(x / 155, y / 60) < 1, 0.85, 0) + 0.1 * inside * wave
    truth = np.broadcast_to(curve.water * body, geometry.n_voxel).astype(np.float32)
    lattice = Lattice(geometry=geometry, support=truth > 0)
    part = Part(geometry=geometry, lattice=lattice, curve=curve, u=lattice.gather(truth), exact=False)
    every = np.ones(geometry.shape, np.bool_)
    nothing = weighted(geometry, np.zeros(geometry.shape, np.float32), every)
    p = Fit(data=nothing, parts=[part], response=response, tv=0.0).fitted(np.arange(geometry.n_views))

    def kept(error):
        levels = levels_of(weighted(geometry, p, every), coarse=True)
        even_out(levels[-1].weights, error)
        found = fast._course(levels, response, settings).go(lambda *state: True).volume()
        seen = (np.abs(x) < 60) & (np.abs(y) < 20)
        return np.sum(found[4] * wave, where=seen) / np.sum(truth[4] * wave, where=seen)

    assert kept(0.0) < 0.1 and kept(250.0) > 0.4


def test_a_ramp_keeps_its_weights_and_an_edge_does_not():
    p = np.broadcast_to(np.linspace(0, 2.4, 9, dtype=np.float32), (1, 5, 9)).copy()
    weights = photon_weights(p, np.ones(p.shape, np.bool_))
    before = weights.copy()
    doubt_edges(p, weights, EDGES)
    np.testing.assert_allclose(weights[..., 1:-1], before[..., 1:-1], rtol=1e-5)
    p[..., 4:] += EDGES
    doubt_edges(p, weights := before.copy(), EDGES)
    np.testing.assert_allclose(weights[0, :, 3], before[0, :, 3] / (1 + before[0, :, 3]), rtol=1e-5)


def test_the_search_has_the_finest_level_doubted_and_the_coarser_ones_by_photons(monkeypatch):
    scan = simulate_scene(wire(n=36))
    seen = []

    def stop(levels, *rest, **more):
        seen.extend(levels)
        raise RuntimeError

    monkeypatch.setattr(fast, "find_filtration", stop)
    with pytest.raises(RuntimeError):
        fast.reconstruct(scan.scan, scatter=0.0)
    finest = seen[-1]
    expected = np.where(finest.weights > 0, photon_weights(finest.p, finest.weights > 0), finest.weights)
    doubt_edges(finest.p, expected, EDGES, finest.scatter)
    assert np.array_equal(finest.weights, expected) and len(seen) > 1
    for coarse in seen[:-1]:
        read = coarse.weights > 0
        assert np.array_equal(coarse.weights[read], photon_weights(coarse.p, read)[read])


def test_coarse_levels_of_a_fit_count_what_no_coarse_grid_holds():
    """By an error of 0.005 of P, with fourfold photons on each coarser grid, but no more; then lowered at edges."""
    scan = simulate_scene(wire(n=36)).scan
    p = line_integrals(scan, slice(None))[0].numpy()
    finest = weighted(scan.geometry, p, np.ones(p.shape, np.bool_))
    levels = [coarser(coarser(finest)), coarser(finest), finest]
    one_row = msgspec.structs.replace(scan.geometry, n_detector=(1, scan.geometry.n_detector[1]))
    slab = weighted(one_row, p[:, 30:31], np.ones((len(p), 1, p.shape[2]), np.bool_))
    for data, found, error in zip(levels, level.doubted(levels, 1e5, EDGES), (40.0, 10.0, 0.0), strict=True):
        photons = photon_weights(data.p, data.weights > 0)
        assert np.array_equal(data.weights, photons)  # those of the data are left as they are
        expected = (1 + error) / (1 / photons + error)
        if error:
            doubt_edges(data.p, expected, EDGES)
        np.testing.assert_allclose(found.weights, expected, rtol=1e-5)
    most, flat = level.doubted(levels, 1e9, 1e6), level.doubted([coarser(slab), slab], 1e5, 1e6)
    np.testing.assert_allclose(most[0].weights, 161 / (1 / levels[0].weights + 160), rtol=1e-5)
    np.testing.assert_allclose(flat[0].weights, 6 / (1 / coarser(slab).weights + 5), rtol=1e-5)  # two pixels in one


def wire(n):
    """A drumstick with eight turns of iron wire on a grid of n voxels along an axis."""
    return new_scene(
        name="wire",
        phantom={"recipe": "chicken", "turns": 8.0, "n_voxel": [7 * n // 4] * 3, "size": 60.0},
        scanner={
            "preset": "skyscan1273",
            "n_voxel": [n] * 3,
            "n_detector": [2 * n, 2 * n],
            "n_views": 100,
            "i0": 1e5,
        },
        simulation={"scatter_error": 0.5},  # no score here sees how it is spread
    )


@pytest.mark.slow
def test_a_wire_is_no_disc():
    """A fit that trusts every bright pixel next to a wire makes discs of its turns; finer splats would hide some."""
    scan = simulate_scene(wire(n=44))
    found = [reconstruct_scan(scan, "splat", edges=edges, filtration=0.5, fine_metal=False) for edges in (EDGES, 1e6)]
    scores = [score_volume(volume, scan, protocols=["tissue", "metal"]) for volume in found]
    psnr, dice = ([score[a].values[b] for score in scores] for a, b in (("tissue", "psnr3d"), ("metal", "dice")))
    assert psnr[0] > psnr[1] + 1.5 and dice[0] > 1.5 * dice[1]
