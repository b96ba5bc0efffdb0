"""The published methods' optimiser, losses and densification against torch, scikit-image and finite differences."""

import dataclasses

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from test_splat_project import SMALL, splats, with_

from ctsim import rng
from ctsim.errors import InputError
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.descent import adam, densify, loss
from ctsim.reconstruct.splat.kernels.splat_reference import covariances
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Gradient, Projector
from ctsim.reconstruct.splat.volume import voxelise

RNG = np.random.default_rng(4)
ACTIVATION = adam.activation(SMALL)
KEY = rng.stream_key("test", "split", 0)


def test_what_is_learned_stands_for_the_splats_and_within_the_bounds():
    given = splats(50, "ellipsoids", low=0.05, high=8.0)
    back = ACTIVATION.splats(ACTIVATION.parameters(given))
    assert adam.unit_length(SMALL) == 12 and ACTIVATION.bounds == (0.012, 12)
    for name in ("positions", "scales", "rotations", "densities"):
        # float32 parameters of up to 10 are rounded to 5e-7, and so is the logarithm of what they stand for
        np.testing.assert_allclose(getattr(back, name), getattr(given, name), rtol=2e-6)
    extreme = dataclasses.replace(given, scales=np.full((50, 3), 100, np.float32))
    parameters = ACTIVATION.parameters(extreme)
    assert np.all(ACTIVATION.splats(parameters).scales < 12)
    parameters["scales"], parameters["densities"] = parameters["scales"] * 0 - 1e30, parameters["densities"] * 0 - 1e30
    least = ACTIVATION.splats(parameters)
    assert np.all(least.scales == np.float32(0.012)) and np.all(least.densities == 0)
    with pytest.raises(InputError, match="must be positive"):
        ACTIVATION.parameters(dataclasses.replace(given, densities=-given.densities))
    with pytest.raises(InputError, match="some"):
        ACTIVATION.parameters(splats(2, "round"))


def test_gradients_pass_through_the_activation():
    given = splats(5, "ellipsoids")
    parameters, direction = ACTIVATION.parameters(given), RNG.standard_normal((5, 3)).astype(np.float32)
    given = ACTIVATION.splats(parameters)
    two = RNG.standard_normal((5, 2)).astype(np.float32)
    by_splats = Gradient(
        densities=two, positions=direction, log_scales=direction, rotations=parameters["rotations"], centres=two[:, 0]
    )
    got = ACTIVATION.gradient(parameters, given, by_splats)

    def value(name, h):
        wide = {key: array.astype(np.float64) for key, array in parameters.items()}
        wide[name] = wide[name] + h
        low, high = ACTIVATION.bounds
        scales = low + (high - low) / (1 + np.exp(-wide["scales"]))
        return np.log(scales) * direction if name == "scales" else np.logaddexp(0, wide["densities"]) * two

    for name in ("scales", "densities"):
        numeric = (value(name, 1e-4) - value(name, -1e-4)) / 2e-4
        np.testing.assert_allclose(got[name], numeric, rtol=1e-5, atol=1e-6)
    assert np.array_equal(got["positions"], direction) and np.array_equal(got["rotations"], parameters["rotations"])


def test_a_step_is_that_of_torch():
    values = {"positions": RNG.standard_normal((6, 3)), "densities": RNG.standard_normal((6, 2))}
    values = {name: value.astype(np.float32) for name, value in values.items()}
    rates = {"positions": 2e-3, "densities": np.array([0.01, 0.1], np.float32)}
    tensors = [torch.tensor(values["positions"])] + [torch.tensor(values["densities"][:, c].copy()) for c in (0, 1)]
    groups = [{"params": [t], "lr": r} for t, r in zip(tensors, (2e-3, 0.01, 0.1), strict=True)]
    other, moments = torch.optim.Adam(groups, eps=1e-15), adam.no_moments(values)
    for _ in range(20):
        gradient = {name: RNG.standard_normal(value.shape).astype(np.float32) for name, value in values.items()}
        moments = adam.step(values, gradient, moments, rates)
        tensors[0].grad = torch.tensor(gradient["positions"])
        for c in (0, 1):
            tensors[1 + c].grad = torch.tensor(gradient["densities"][:, c].copy())
        other.step()
    assert moments.steps == 20 and values["positions"].dtype == np.float32
    expected = np.concatenate([tensors[0].numpy(), np.stack([t.numpy() for t in tensors[1:]], 1)], 1)
    got = np.concatenate([values["positions"], values["densities"]], 1)
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-6)  # float32, 20 steps of up to 0.1


def test_a_parameter_without_gradient_stays_and_rates_fall_to_a_tenth():
    zero, values = {"positions": np.zeros((2, 3), np.float32)}, {"positions": np.ones((2, 3), np.float32)}
    adam.step(values, zero, adam.no_moments(zero), adam.RATES)
    assert np.array_equal(values["positions"], np.ones((2, 3)))
    assert adam.rate(0.1, 0, 100) == 0.1
    assert adam.rate(0.1, 50, 100) == pytest.approx(0.1 * 10**-0.5)
    assert adam.rate(0.1, 100, 100) == adam.rate(0.1, 150, 100) == pytest.approx(0.01)


def test_ssim_is_that_of_scikit_image_within_the_image():
    x, y = RNG.random((40, 51)) * 3, RNG.random((40, 51)) * 3
    y = 0.7 * x + 0.3 * y
    result = structural_similarity(
        x, y, data_range=5.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5
    )
    expected = np.asarray(result[1])
    similarity = 1 - 4 * (loss.l1_ssim(x, y, 5.0)[0] - np.abs(x - y).mean())
    assert 0 < similarity < 1
    assert ssim_map(x, y, 5.0)[10:-10, 10:-10] == pytest.approx(expected[10:-10, 10:-10], abs=1e-9)
    assert similarity == pytest.approx(ssim_map(x, y, 5.0).mean(), abs=1e-12)


def ssim_map(x, y, data_range):
    """SSIM pixel by pixel from the definition, the window zero outside the image."""
    g = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(g, g) / g.sum() ** 2
    parts = [np.lib.stride_tricks.sliding_window_view(np.pad(a, 5), (11, 11)) for a in (x, y, x * x, y * y, x * y)]
    mx, my, xx, yy, xy = (np.einsum("vuab,ab->vu", part, window) for part in parts)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    top = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    return top / ((mx**2 + my**2 + c1) * (xx - mx**2 + yy - my**2 + c2))


def test_the_loss_has_its_finite_differences():
    x, y = RNG.random((13, 17)) * 3, RNG.random((13, 17)) * 3
    value, gradient = loss.l1_ssim(x, y, 3.0)
    assert value == pytest.approx(np.abs(x - y).mean() + 0.25 * (1 - ssim_map(x, y, 3.0).mean()), abs=1e-12)
    assert loss.l1_ssim(x, x, 3.0)[0] == pytest.approx(0, abs=1e-12)
    for index in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[index] = 1e-5
        numeric = (loss.l1_ssim(x + step, y, 3.0)[0] - loss.l1_ssim(x - step, y, 3.0)[0]) / 2e-5
        assert abs(numeric - gradient[index]) < 1e-6 * np.abs(gradient).max()
    narrow, by_narrow = loss.l1_ssim(x.astype(np.float32), y.astype(np.float32), 3.0)
    assert narrow == pytest.approx(value, abs=1e-5) and by_narrow.dtype == np.float32
    np.testing.assert_allclose(by_narrow, gradient, rtol=0, atol=1e-4 * np.abs(gradient).max())


def test_total_variation_has_its_finite_differences():
    volume = RNG.random((4, 5, 6))
    value, gradient = loss.total_variation(volume)
    differences = [np.abs(np.diff(volume, axis=k)).ravel() for k in range(3)]
    assert value == pytest.approx(np.concatenate(differences).mean())  # as R²-Gaussian: over all differences
    for index in np.ndindex(volume.shape):
        step = np.zeros_like(volume)
        step[index] = 1e-7
        numeric = (loss.total_variation(volume + step)[0] - loss.total_variation(volume - step)[0]) / 2e-7
        assert numeric == pytest.approx(gradient[index], abs=1e-6)
    assert not loss.total_variation(np.ones((3, 3, 3)))[1].any()


def test_a_brick_is_a_part_of_the_grid():
    geometry = with_(n_voxel=(9, 7, 12), d_voxel=(1.0, 1.5, 0.8), off_origin=(1.0, 2.0, -3.0))
    given, places = splats(20, "ellipsoids"), set()
    whole = voxelise(given, geometry, cutoff=6.0)
    for number in range(20):
        part = loss.brick(geometry, "scene", number, edge=8)
        assert part == loss.brick(geometry, "scene", number, edge=8) and part.n_voxel == (8, 7, 8)
        at = []
        for inner, outer in zip(part.voxel_centres(), geometry.voxel_centres(), strict=True):
            k = int(np.abs(outer - inner[0]).argmin())
            np.testing.assert_allclose(inner, outer[k : k + len(inner)], atol=1e-9)
            at.append(slice(k, k + len(inner)))
        places.add((at[0].start, at[2].start))
        # rows begin elsewhere, and exponents of up to 18 are rounded
        np.testing.assert_allclose(voxelise(given, part, cutoff=6.0), whole[:, *at], rtol=0, atol=1e-5)
    assert len(places) > 5


def test_small_splats_are_doubled_and_large_ones_split():
    given = splats(6, "ellipsoids", low=0.5, high=1.0)
    scales = given.scales.copy()
    scales[[1, 4], 2] = 2.5  # a tenth of the volume is 2.4 mm
    given = dataclasses.replace(given, scales=scales)
    pull = np.array([1, 1, 0, 0, 1, 0]) * 6e-5
    after, origin = densify.densify(given, pull, SMALL, densify.Schedule(), KEY)
    # 0 is doubled, 1 and 4 give way to two each
    assert origin.tolist() == [0, 2, 3, 5, -1, -1, -1, -1, -1]
    stay = origin[:4]
    assert np.array_equal(after.positions[:5], given.positions[[*stay, 0]])
    halved = np.array([0.5, 1, 1, 1, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)[:, None]
    assert np.array_equal(after.densities, given.densities[[*stay, 0, 1, 4, 1, 4]] * halved)
    np.testing.assert_allclose(after.scales[5:], given.scales[[1, 4, 1, 4]] / 1.6, rtol=1e-6)
    again, _ = densify.densify(given, pull, SMALL, densify.Schedule(), KEY)
    other, _ = densify.densify(given, pull, SMALL, densify.Schedule(), rng.stream_key("test", "split", 1))
    assert np.array_equal(after.positions, again.positions)
    assert not np.array_equal(after.positions[5:], other.positions[5:])
    moments = adam.Moments(first={"x": np.arange(6, dtype=np.float32)[:, None]}, second={}, steps=3)
    moved = densify.carried(moments, origin)
    assert moved.first["x"][:, 0].tolist() == [0, 2, 3, 5, 0, 0, 0, 0, 0] and moved.steps == 3


def test_halves_of_a_split_are_drawn_from_it():
    one = splats(1, "ellipsoids", low=2.5, within=0.0)  # the volume ends at 4 σ and beyond
    many = Splats(**{field.name: np.repeat(getattr(one, field.name), 4000, 0) for field in dataclasses.fields(one)})
    after, _ = densify.densify(many, np.ones(4000), SMALL, densify.Schedule(), KEY)
    expected = covariances(one.shapes())[0][0]
    spread = np.cov((after.positions - one.positions).T.astype(float))
    # 8000 draws: variances within √(2/8000) = 1.6 %, four times that
    assert np.abs(spread - expected).max() < 0.065 * np.diag(expected).max()


def test_faint_and_broken_splats_go_and_the_cap_holds():
    given, schedule = splats(8, "ellipsoids", low=0.5, high=1.0), densify.Schedule(most=10)
    densities = given.densities.copy()
    densities[0], densities[1, 0], densities[2, 1] = 1e-7, 0, np.nan
    given = dataclasses.replace(given, densities=densities)
    after, origin = densify.densify(given, np.zeros(8), SMALL, schedule, KEY)
    assert origin.tolist() == [1, 3, 4, 5, 6, 7]
    pull = np.array([0, 0, 0, 1, 5, 2, 4, 3.0])
    after, origin = densify.densify(given, pull, SMALL, schedule, KEY)
    assert len(after) == 8 and np.array_equal(after.positions[6:], given.positions[[4, 6]])
    positions = given.positions.copy()
    positions[3, 0], positions[4, 2], positions[5, 1] = 12.1, -12.1, 11.9
    left, origin = densify.densify(dataclasses.replace(given, positions=positions), np.zeros(8), SMALL, schedule, KEY)
    assert origin.tolist() == [1, 5, 6, 7] and len(left) == 4
    none, origin = densify.densify(splats(0, "ellipsoids"), np.zeros(0), SMALL, schedule, KEY)
    assert len(none) == 0 and origin.size == 0
    assert [s for s in range(0, 16000, 50) if schedule.is_due(s)] == list(range(600, 15000, 100))
    assert densify.screen_pull(np.array([2e-7]), 512) == pytest.approx(5.12e-5)


def test_a_few_steps_bring_splats_to_what_was_seen():
    geometry = with_(n_views=6)
    projector = Projector(geometry=geometry, tolerance=np.inf)
    true, start = splats(20, "ellipsoids", low=2.0), splats(20, "ellipsoids", low=2.0, seed=2)
    images = projector.forward(true.shapes(), true.densities[:, :1].copy())[:, 0]
    parameters = ACTIVATION.parameters(dataclasses.replace(start, densities=start.densities[:, :1].copy()))
    moments, losses = adam.no_moments(parameters), []
    unit, rates = adam.unit_length(SMALL), {"positions": 0.02, "scales": 0.03, "rotations": 0.02, "densities": 0.05}
    for k in range(90):
        given, view = ACTIVATION.splats(parameters), k % 6
        there = projector.forward(given.shapes(), given.densities, [view])[0, 0]
        value, by_p = loss.l1_ssim(
            np.ascontiguousarray(there[:, :-WIDTH]),
            np.ascontiguousarray(images[view, :, :-WIDTH]),
            float(images.max()),
        )
        image = np.zeros((1, *there.shape), np.float32)
        image[0, :, :-WIDTH] = by_p
        gradient = ACTIVATION.gradient(parameters, given, projector.gradient(given, image, view))
        scaled = {**rates, "positions": rates["positions"] * unit / 4}
        moments = adam.step(parameters, gradient, moments, scaled)
        losses.append(value)
    assert np.mean(losses[-6:]) < 0.2 * np.mean(losses[:6])
