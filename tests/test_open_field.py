"""Scatter found in the open field, and what the splat fit makes of it."""

import warnings

import numpy as np
import pytest

from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.scores.protocol import metal_score, tissue_score, truth_of
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.scatter import open_excess
from ctsim.reconstruct.splat.fast import reconstruct

SCENE = """
name = "scattering"
seed = 7
phantom = { recipe = "lung", metal = "Fe", n_voxel = [56, 56, 56] }
scanner = { n_voxel = [40, 40, 40], n_detector = [64, 64], n_views = 60, scatter = { level = 1, fraction = 0.05 } }
"""
VIEWS, SIZE, I0 = 40, 48, 1e4


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


@pytest.mark.parametrize("scatter", [0.003, 0.011, 0.3, 2.0])
def test_scatter_is_found_within_five_deviations_of_what_it_is_read_from(scatter):
    # either the median over open pixels, safer than a mean over 25 of them, or the darkest means over 25 pixels
    open_noise = np.sqrt((1 + scatter) / (I0 * VIEWS) + (1 + scatter) ** 2 / (10 * I0)) / 5
    dark_noise = np.sqrt(scatter / I0 + scatter**2 / (10 * I0)) / 5
    assert open_excess(*readings(scatter)) == pytest.approx(scatter, abs=5 * max(open_noise, dark_noise))


def test_noise_and_the_flats_pattern_pass_for_no_scatter():
    assert open_excess(*readings(0.0)) == 0


def test_without_a_pixel_that_stays_open_no_scatter_is_found():
    assert open_excess(*readings(0.011, half_width=SIZE // 2)) == 0
    p, valid = readings(0.011)
    assert open_excess(p, np.zeros_like(valid)) == 0
    valid[0] = False
    assert open_excess(p, valid) == 0


def test_no_more_scatter_is_found_than_the_darkest_ray_holds():
    assert open_excess(*readings(0.0, gain=1.02, darkest=1e-3)) < 1.1e-3
    assert open_excess(*readings(0.0, gain=1.02, darkest=0.1)) == pytest.approx(0.02, abs=1e-3)


def test_the_simulators_scatter_is_found_in_its_scans(stored):
    p, clamped = line_integrals(stored.scan, slice(None))
    assert open_excess(p.numpy(), ~clamped.numpy()) == pytest.approx(0.05, rel=0.02)


@pytest.mark.slow
def test_the_fit_undoes_scatter_that_it_finds_itself(stored):
    truth = truth_of(stored)
    found, blind = (reconstruct(stored.scan, **told) for told in ({}, {"scatter": 0.0}))
    assert found.details["scatter"] > 0
    assert blind.details["scatter"] == 0
    tissue, metal = (
        [score(v.values.numpy(), truth).values for v in (found, blind)] for score in (tissue_score, metal_score)
    )
    assert tissue[0]["psnr3d"] > tissue[1]["psnr3d"] + 1
    assert metal[0]["core_ratio"] > metal[1]["core_ratio"] + 0.1


@pytest.mark.parametrize("scatter", [-0.1, float("inf"), float("nan")])
def test_scatter_that_makes_no_sense_is_refused(stored, scatter):
    with pytest.raises(InputError, match=r"scatter: expected a number within 0 to 100 \(of the open field\)"):
        reconstruct(stored.scan, scatter=scatter)


def test_an_open_field_without_noise_has_none_and_warns_of_nothing():
    readings = np.zeros((3, 40, 37), np.float32)
    readings[:, 10:20, 10:20] = np.random.default_rng(0).uniform(0, 0.5, (10, 10))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_excess(readings, np.ones(readings.shape, bool)) == 0
