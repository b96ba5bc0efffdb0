"""How much readings count: fewer photons less, and edges less than a grid can explain."""

import numpy as np
import pytest

from ctsim import new_scene, reconstruct_scan, score_volume, simulate_scene
from ctsim.reconstruct.splat import fast
from ctsim.reconstruct.weights import DARK, doubt_edges, photon_weights

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


def test_a_ramp_keeps_its_weights_and_an_edge_does_not():
    p = np.broadcast_to(np.linspace(0, 2.4, 9, dtype=np.float32), (1, 5, 9)).copy()
    weights = photon_weights(p, np.ones(p.shape, np.bool_))
    before = weights.copy()
    doubt_edges(p, weights, EDGES)
    np.testing.assert_allclose(weights[..., 1:-1], before[..., 1:-1], rtol=1e-5)
    p[..., 4:] += EDGES
    doubt_edges(p, weights := before.copy(), EDGES)
    np.testing.assert_allclose(weights[0, :, 3], before[0, :, 3] / (1 + before[0, :, 3]), rtol=1e-5)


def test_the_finest_level_is_doubted_and_the_coarser_ones_count_photons(monkeypatch):
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
    for level in seen[:-1]:
        read = level.weights > 0
        assert np.array_equal(level.weights[read], photon_weights(level.p, read)[read])


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
