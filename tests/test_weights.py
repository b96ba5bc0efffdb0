"""How much readings count: fewer photons less, and edges less than a grid can explain."""

import numpy as np
import pytest

from ctsim import new_scene, reconstruct_scan, score_volume, simulate_scene
from ctsim.reconstruct.weights import doubt_edges, photon_weights

EDGES = 0.5


def doubted(p, weights, edges=EDGES):
    """Compute the weights pixel by pixel in float64, as the docstring defines them."""
    out = weights.astype(np.float64)
    for view, v, u in zip(*np.nonzero(weights > 0), strict=True):
        near = np.s_[view, max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        others = p[near][weights[near] != 0].astype(np.float64)
        out[view, v, u] = 1 / (1 / out[view, v, u] + (np.ptp(others) / edges) ** 2)
    return out


def test_edges_count_less_and_what_says_nothing_makes_none():
    draws = np.random.default_rng(3)
    p = draws.uniform(0, 7, (3, 9, 11)).astype(np.float32)
    weights = photon_weights(p, np.ones(p.shape, np.bool_))
    kind = draws.random(p.shape)
    weights[kind < 0.2], p[kind < 0.1] = 0, np.nan
    weights[kind > 0.9] = -0.002
    weights[1, 3:8, 3:8] = 0
    weights[1, 5, 5] = 0.3  # alone among dead pixels
    expected = doubted(p, weights)
    doubt_edges(p, weights, EDGES)
    np.testing.assert_allclose(weights, expected, rtol=1e-5)
    assert weights[1, 5, 5] == np.float32(0.3)


@pytest.mark.parametrize("edges", [1e-3, 1.0, 1e9])
def test_a_flat_view_keeps_its_weights(edges):
    p = np.full((1, 5, 1), 2.0, np.float32)  # a panel of one column, too
    weights = photon_weights(p, np.ones(p.shape, np.bool_))
    before = weights.copy()
    doubt_edges(p, weights, edges)
    assert np.array_equal(weights, before)


@pytest.mark.slow
def test_a_wire_is_no_disc():
    """Of a drumstick with eight turns of iron wire a fit that trusts every bright pixel beside them makes discs."""
    scene = new_scene(
        name="wire",
        phantom={"recipe": "chicken", "turns": 8.0, "n_voxel": [77] * 3, "size": 60.0},
        scanner={"preset": "skyscan1273", "n_voxel": [44] * 3, "n_detector": [88, 88], "n_views": 100, "i0": 1e5},
    )
    scan = simulate_scene(scene)
    found = [reconstruct_scan(scan, "splat", edges=edges, filtration=0.5) for edges in (EDGES, 1e6)]
    scores = [score_volume(volume, scan, protocols=["tissue", "metal"]) for volume in found]
    psnr, dice = ([score[a].values[b] for score in scores] for a, b in (("tissue", "psnr3d"), ("metal", "dice")))
    assert psnr[0] > psnr[1] + 2 and dice[0] > 2 * dice[1]  # 21.1 and 17.6 dB, 0.29 and 0.11
