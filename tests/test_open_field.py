"""Scatter found in the open field, and what the splat fit makes of it."""

import warnings

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.scores.protocol import metal_score, tissue_score, truth_of
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.scatter import SPREAD, Scatter, scatter_of
from ctsim.reconstruct.splat.fast import reconstruct

SCENE = """
name = "scattering"
seed = 7
phantom = { recipe = "lung", metal = "Fe", n_voxel = [56, 56, 56] }
scanner = { n_voxel = [40, 40, 40], n_detector = [64, 64], n_views = 60, scatter = { level = 1, fraction = 0.05 } }
"""
FOLLOWED = """
name = "followed"
seed = 7
phantom = { recipe = "lung", metal = "Fe", n_voxel = [56, 56, 56], size = 60.0 }
scanner = { preset = "skyscan1273", n_voxel = [40, 40, 40], n_detector = [64, 64], n_views = 24 }
truth = { scatter_free = true, noise_free = true }
"""
TRUE = ("noise_free", "scatter_free")
VIEWS, SIZE, I0 = 40, 48, 1e4
GEOMETRY = Geometry(
    dso=250.0,
    dsd=500.0,
    n_voxel=(40, 40, 40),
    d_voxel=(1.5, 1.5, 1.5),
    n_detector=(SIZE, SIZE),
    d_detector=(2.8, 2.8),
    n_views=VIEWS,
)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scattering")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    assert make_dataset([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return open_scan(list_scans(folder / "data")[0])


def readings(scatter, half_width=12, darkest=1e-3, gain=1.0):
    """A dark slab in the middle of the detector, photons counted, flats with a pattern of their own."""
    rng = np.random.default_rng(3)
    primary = np.ones((VIEWS, SIZE, SIZE))
    primary[:, :, SIZE // 2 - half_width : SIZE // 2 + half_width] = darkest
    flat = 1 + rng.normal(size=(SIZE, SIZE)) / np.sqrt(10 * I0)
    seen = np.maximum(rng.poisson(gain * I0 * (primary + scatter)), 1) / (I0 * flat)
    return (-np.log(seen)).astype(np.float32), np.ones(primary.shape, bool)


def found(p, valid):
    return scatter_of(p, valid, GEOMETRY, I0)


@pytest.mark.parametrize("scatter", [0.003, 0.011, 0.3, 2.0])
def test_a_constant_is_found_within_five_deviations_and_what_is_cut_off(scatter):
    # the flats' noise is the same in every view, and of open blocks those darker by 2 deviations are left out
    blocks, photons = SIZE * (SIZE - 28), np.sqrt((1 + scatter) / I0)
    noise = np.sqrt(photons**2 / VIEWS + (1 + scatter) ** 2 / (10 * I0)) / np.sqrt(blocks)
    cut = 0.055 * photons  # the mean of a Gaussian above −2
    dark = 2.1 * np.sqrt(scatter / I0) / 3  # of averages over nine dark blocks, a fiftieth may hold less
    assert found(*readings(scatter)).mean == pytest.approx(scatter, abs=5 * noise + cut + dark)


def test_noise_and_the_flats_pattern_pass_for_no_scatter():
    assert found(*readings(0.0)).mean == 0


def test_without_a_pixel_that_stays_open_no_scatter_is_found():
    assert found(*readings(0.011, half_width=SIZE // 2)).mean == 0
    p, valid = readings(0.011)
    assert found(p, np.zeros_like(valid)).mean == 0


def test_no_more_scatter_is_found_than_the_darkest_rays_hold():
    # a hundredth of the blocks may hold less: Poisson's 10 photons, at 2.3 deviations 3
    assert 2e-4 < found(*readings(0.0, gain=1.02, darkest=1e-3)).mean < 1.1e-3
    assert found(*readings(0.0, gain=1.02, darkest=0.1)).mean == pytest.approx(0.02, abs=1e-3)


def crossed():
    """A body with a rod, another shadow in each view, and the scatter that the model makes of it: T, S/I0."""
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    sigma = SPREAD * (GEOMETRY.dsd - GEOMETRY.dso) / GEOMETRY.d_detector[0]
    primary, scatter = np.empty((2, VIEWS, SIZE, SIZE))
    for view, angle in enumerate(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)):
        wide, at = 10 + 4 * np.cos(2 * angle), 7 * np.cos(angle)
        depth = np.sqrt(np.maximum(1 - (u / wide) ** 2 - ((v - 5) / 14) ** 2, 0)) * 2.5
        depth[np.hypot(u - at, v - 3) < 3] += 4
        primary[view] = np.exp(-depth)
        source = ndimage.gaussian_filter(depth * np.exp(-depth), sigma, mode="nearest")
        scatter[view] = 0.04 * source + 0.002
    return primary, scatter


def counted(primary, scatter, photons=1e5):
    counts = np.random.default_rng(0).poisson(photons * (primary + scatter))
    return np.asarray(counts, float)


def field_of(counts, valid=None):
    p = -np.log(np.maximum(counts, 1) / 1e5).astype(np.float32)
    scatter = scatter_of(p, np.ones(p.shape, bool) if valid is None else valid, GEOMETRY, 1e5)
    return scatter, np.stack([scatter.of(view, (SIZE, SIZE)) for view in range(VIEWS)])


def test_a_kernel_is_found_again_behind_the_object():
    """Scatter as the model has it: what noise, blocks and the choice of open ones cost."""
    primary, true = crossed()
    scatter, image = field_of(counted(primary, true))
    assert scatter.gain == pytest.approx(0.04, rel=0.05) and scatter.floor == pytest.approx(0.002, rel=0.1)
    assert image == pytest.approx(true, rel=0.05)
    assert np.ptp(true.max((1, 2))) > 0.2 * true.max()  # views differ by more than that


def test_scatter_of_an_object_that_nearly_fills_the_panel_is_the_objects():
    """A body that leaves the panel's corners open: there the source hardly varies."""
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    sigma = SPREAD * (GEOMETRY.dsd - GEOMETRY.dso) / GEOMETRY.d_detector[0]
    depth = 2.5 * np.sqrt(np.maximum(1 - (np.hypot(u, v) / 25) ** 2, 0))
    source = ndimage.gaussian_filter(depth * np.exp(-depth), sigma, mode="nearest")
    scatter, image = field_of(counted(np.broadcast_to(np.exp(-depth), (VIEWS, SIZE, SIZE)), 0.07 * source))
    assert scatter.gain == pytest.approx(0.07, rel=0.05)
    assert image[0] == pytest.approx(0.07 * source, rel=0.05)


def hot(counts, valid):
    counts[:, 2, 40] *= 100


def hits(counts, valid):
    at = np.random.default_rng(1).integers(0, SIZE, (2, VIEWS))
    counts[np.arange(VIEWS), at[0], at[1]] *= 20


def a_dead_strip(counts, valid):
    valid[:, :, :4] = False


def a_lost_view(counts, valid):
    counts[7], valid[7] = 0, False


def first_views_that_lag(counts, valid):
    counts[0] *= 0.96


def flicker(counts, valid):
    counts *= (1 + 0.01 * np.tile([-1, 1], VIEWS // 2))[:, None, None]


@pytest.mark.parametrize("fault", [hot, hits, a_dead_strip, a_lost_view, first_views_that_lag, flicker])
def test_what_a_panel_or_a_tube_does_is_not_taken_for_scatter(fault):
    primary, true = crossed()
    for planted in (true, 0 * true):
        counts = counted(primary, planted)
        valid = np.ones(counts.shape, bool)
        fault(counts, valid)
        scatter, _ = field_of(counts, valid)
        assert scatter.mean == pytest.approx(planted.mean(), rel=0.05, abs=1e-4)


def test_dead_pixels_hide_no_open_ones():
    p, valid = readings(0.011)
    p, valid = np.repeat(np.repeat(p, 3, 1), 3, 2), np.repeat(np.repeat(valid, 3, 1), 3, 2)
    dead = np.random.default_rng(0).random(p.shape[1:]) < 0.02
    p[:, dead], valid[:, dead] = 0, False
    assert found(p, valid).mean == pytest.approx(0.011, rel=0.1)


def test_a_field_reaches_the_pixels_by_straight_lines_between_its_blocks():
    source = np.arange(12, dtype=np.float32).reshape(1, 3, 4)
    scatter = Scatter(floor=1.0, gain=2.0, source=source, step=(2, 3))
    image = scatter.of(0, (5, 11))  # the last row of blocks is one pixel high, the last column two wide
    assert image.shape == (5, 11) and scatter.mean == 1 + 2 * 5.5
    # along v the middles are at 0.5, 2.5 and 4; along u at 1, 4, 7 and 9.5
    assert image[0, 1] == 1 and image[4, 1] == 1 + 2 * 8 and image[2, 4] == pytest.approx(1 + 2 * (1 + 4 * 0.75))
    assert image[0, 10] == 1 + 2 * 3 and image[0, 8] == pytest.approx(1 + 2 * 2.4)


def test_the_simulators_scatter_is_found_in_its_scans(stored):
    p, clamped = line_integrals(stored.scan, slice(None))
    scatter = scatter_of(p.numpy(), ~clamped.numpy(), stored.scan.geometry, stored.scan.i0)
    assert scatter.mean == pytest.approx(0.05, rel=0.02)


@pytest.mark.slow
def test_scatter_by_monte_carlo_is_found_behind_metal(tmp_path):
    """The truth shares nothing with the model: photons are followed through the object. A constant is 35 % too low."""
    (tmp_path / "scene.toml").write_text(FOLLOWED, encoding="utf-8")
    assert make_dataset([str(tmp_path / "scene.toml"), str(tmp_path / "data")]) == 0
    [folder] = list_scans(tmp_path / "data")
    scan = open_scan(folder).scan
    with_it, without = (np.exp(-np.asarray(tifffile.imread(folder / f"{name}.tif"), float)) for name in TRUE)
    p, clamped = line_integrals(scan, slice(None))
    scatter = scatter_of(p.numpy(), ~clamped.numpy(), scan.geometry, scan.i0)
    image = np.stack([scatter.of(view, p.shape[1:]) for view in range(len(p))])
    dark, true = without < 0.02, with_it - without
    assert dark.mean() > 0.01 and image[dark].mean() == pytest.approx(true[dark].mean(), rel=0.15)


@pytest.mark.slow
def test_the_fit_undoes_scatter_that_it_finds_itself(stored):
    truth = truth_of(stored)
    found, blind = (reconstruct(stored.scan, filtration=0.5, **told) for told in ({}, {"scatter": 0.0}))
    assert found.details["scatter"] > 0
    assert blind.details["scatter"] == 0
    tissue, metal = (
        [score(v.values.numpy(), truth).values for v in (found, blind)] for score in (tissue_score, metal_score)
    )
    assert tissue[0]["psnr3d"] > tissue[1]["psnr3d"] + 1
    assert metal[0]["core_ratio"] > metal[1]["core_ratio"] + 0.1


@pytest.mark.parametrize("scatter", [-0.1, float("inf"), float("nan")])
def test_scatter_that_makes_no_sense_is_refused(stored, scatter):
    expected = r"scatter: expected 'found' or a number within 0 to 100 \(of the open field\)"
    with pytest.raises(InputError, match=expected):
        reconstruct(stored.scan, scatter=scatter)


def test_an_open_field_without_noise_has_none_and_warns_of_nothing():
    p = np.zeros((3, SIZE, SIZE), np.float32)
    p[:, 10:20, 10:20] = np.random.default_rng(0).uniform(0, 0.5, (10, 10))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(p, np.ones(p.shape, bool)).mean == 0
