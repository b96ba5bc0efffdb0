"""The published splat methods as wholes: on a small scan without noise of a sphere, and their loss's gradients."""

import dataclasses
import math

import numba
import numpy as np
import pytest
import torch

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.types import Scan, Status
from reconstruct.log import line_integrals
from reconstruct.splat import adam, densify, published
from reconstruct.splat.published import PRESETS, Objective, Settings, fit_published, seed_splats
from reconstruct.splat.response import make_response

GEOMETRY = Geometry(
    dso=200.0,
    dsd=300.0,
    n_voxel=(32, 32, 32),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(36, 40),
    d_detector=(1.6, 1.6),
    n_views=20,
)
RADIUS, MU = 10.0, 0.03  # mm, 1/mm
SCHEDULE = densify.Schedule(every=2000, most=600)
PAPER, R2 = (dataclasses.replace(PRESETS[name], steps=200, n_splats=400, schedule=SCHEDULE) for name in ("paper", "r2"))


@pytest.fixture(autouse=True)
def one_thread():
    """Scans as small as these spend more on waiting for threads than on work; no bit depends on their number."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


def sphere(mu=MU, i0=1e6) -> Scan:
    """A scan without noise of a sphere in the middle, from its chords."""
    pose, (n_v, n_u) = GEOMETRY.pose_array()[:, None, None], GEOMETRY.n_detector
    v = (np.arange(n_v) - (n_v - 1) / 2)[None, :, None, None]
    u = (np.arange(n_u) - (n_u - 1) / 2)[None, None, :, None]
    ray = pose[..., 3:6] + u * pose[..., 6:9] + v * pose[..., 9:12] - pose[..., :3]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    miss = (pose[..., :3] ** 2).sum(-1) - (pose[..., :3] * ray).sum(-1) ** 2
    p = torch.from_numpy(mu * 2 * np.sqrt(np.maximum(RADIUS**2 - miss, 0)))
    return Scan(geometry=GEOMETRY, counts=(i0 * torch.exp(-p)).float(), flat=torch.full((36, 40), i0), i0=i0)


def course(scan: Scan, settings: Settings):
    seen: list[tuple[int, float, float, int]] = []
    return fit_published(scan, settings, on_step=lambda *step: seen.append(step)), seen


@pytest.mark.parametrize("settings", [PAPER, R2], ids=["paper", "r2"])
def test_the_loss_falls_and_the_same_seed_gives_the_same_bits(settings):
    volume, seen = course(sphere(), settings)
    losses = [loss for _, loss, _, _ in seen]
    # 20 views a turn; it starts from 1/6 of the sum of densities that neighbours overlap to
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:5])
    assert volume.status is Status.OK and volume.details["view_updates"] == 200
    assert [k for k, *_ in seen] == list(range(1, 201)) and seen[-1][3] == volume.details["splats"]
    assert all(b >= a for a, b in zip([s for *_, s, _ in seen], [s for *_, s, _ in seen[1:]], strict=False))
    assert torch.isfinite(volume.values).all()
    z, y, x = GEOMETRY.voxel_centres()
    distance = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    inside, outside = volume.values.numpy()[distance < 8], volume.values.numpy()[distance > 13]
    assert inside.mean() > 5 * abs(outside.mean())
    short = dataclasses.replace(settings, steps=30, schedule=densify.Schedule(every=7000, most=600))
    first, again = (fit_published(sphere(), short) for _ in range(2))
    other = fit_published(sphere(), dataclasses.replace(short, seed=1))
    assert torch.equal(first.values, again.values) and not torch.equal(first.values, other.values)
    assert first.details["splats"] > 400


def test_the_response_is_learned_only_where_it_is_to_be():
    short = dataclasses.replace(PAPER, steps=20)
    assert fit_published(sphere(), short).details["response"]["theta"] != [0.2, 1.0]
    held = dataclasses.replace(short, theta=(1.0, 1.0), learn_response=False)
    assert fit_published(sphere(), held).details["response"]["theta"] == [1.0, 1.0]
    volume = published.paper(sphere(), steps=2, e_max=60.0)
    assert volume.details["view_updates"] == 2
    assert not torch.equal(volume.values, published.paper(sphere(), steps=2).values)
    assert published.r2(sphere(), steps=2).details["response"] == {"name": "mono", "theta": []}


def test_nothing_seen_and_no_time_give_what_there_is():
    for reconstruct in (published.paper, published.r2):
        empty = reconstruct(sphere(mu=0.0), steps=5)
        assert empty.status is Status.OK and not empty.values.any() and "no voxel" in empty.reason
    volume = published.paper(sphere(), seconds=0.0)
    assert volume.details["view_updates"] == 0 and volume.values.any()


def test_counts_that_are_not_finite_say_nothing():
    scan = sphere()
    counts = scan.counts.clone()
    counts[:, 17:19, 17:19], counts[3, :4, :4] = torch.nan, torch.inf
    volume, seen = course(dataclasses.replace(scan, counts=counts), dataclasses.replace(PAPER, steps=40))
    assert volume.details["clamped_pixels"] == 20 * 4 + 16
    assert volume.status is Status.OK and torch.isfinite(volume.values).all()
    assert all(math.isfinite(loss) for _, loss, _, _ in seen)
    objective, parameters, response = problem(dataclasses.replace(scan, counts=counts))
    before = objective(parameters, response, 0, 0).loss
    objective.p[0, 17:19, 17:19] += 1.0
    assert objective(parameters, response, 0, 0).loss == before
    objective.p[0, 20, 20] += 1.0
    assert objective(parameters, response, 0, 0).loss != before


def problem(scan, settings=PAPER):
    """The loss, what is learned and the response at the start."""
    objective = Objective.of(scan, settings)
    given = seed_splats(objective.p, GEOMETRY, settings)
    # half of what is seen, so that no pixel's difference changes its sign, and no needle is at a bound
    response = make_response(settings.response, e_max=90.0)
    return objective, objective.activation.parameters(given), response


def test_the_response_has_the_whole_loss_s_finite_differences():
    objective, parameters, response = problem(sphere())
    terms = objective(parameters, response, 3, 0)
    assert np.abs(terms.theta).min() > 1e-4
    theta, step = np.array(response.trainable), 0.002
    for k in (0, 1):
        shift = np.eye(2)[k] * step
        ends = [objective(parameters, response.with_theta(theta + s * shift), 3, 0).loss for s in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        # halving the step quarters its own error, 5 % at 0.02, so 0.05 % here; the rest is P in float32
        assert terms.theta[k] == pytest.approx(numeric, rel=0.01)


@pytest.mark.parametrize("channels", ["ab", "b"])
def test_densities_have_the_whole_loss_s_finite_differences(channels):
    n = len(channels)
    settings = dataclasses.replace(PAPER, channels=channels, start=(0.075,) * n, density_rates=(0.01,) * n)
    scan = sphere()
    scan.counts[:, 10:20, 15:25] = torch.nan  # what does not count pulls at nothing
    objective, parameters, response = problem(scan, settings)
    terms, step = objective(parameters, response, 3, 0), 0.02
    for channel in range(len(channels)):
        moved = []
        for sign in (1, -1):
            shifted = parameters["densities"].copy()
            shifted[:, channel] += np.float32(sign * step)
            moved.append(objective({**parameters, "densities": shifted}, response, 3, 0).loss)
        expected = (moved[0] - moved[1]) / (2 * step)
        assert terms.parameters["densities"][:, channel].sum() == pytest.approx(expected, rel=0.01)


def test_tv_pulls_at_densities_as_its_finite_difference_says():
    settings = dataclasses.replace(R2, tv_share=50.0)
    objective, parameters, response = problem(sphere(), settings)
    plain = dataclasses.replace(objective, settings=dataclasses.replace(settings, tv_share=0.0))
    step = 0.01

    def tv(shift):
        moved = {**parameters, "densities": parameters["densities"] + np.float32(shift)}
        return objective(moved, response, 0, 7).loss - plain(moved, response, 0, 7).loss

    by_tv = objective(parameters, response, 0, 7).parameters["densities"]
    by_tv = by_tv - plain(parameters, response, 0, 7).parameters["densities"]
    assert tv(0) > 0.1
    assert by_tv.sum() == pytest.approx((tv(step) - tv(-step)) / (2 * step), rel=0.01)


def test_splats_are_seeded_as_published():
    scan = sphere()
    p, _ = line_integrals(scan, slice(None))
    given, unit = seed_splats(p.numpy(), GEOMETRY, PAPER), adam.unit_length(GEOMETRY)
    assert len(given) == 400 and unit == 16 and np.all(np.diff(given.positions[:, 2]) >= 0)
    assert len(np.unique(given.positions, axis=0)) == 400 and np.all(given.densities > 0)
    np.testing.assert_allclose(given.densities[:, 0], 10 * given.densities[:, 1], rtol=1e-6)
    assert given.densities[:, 0].min() * unit > 0.075 * 0.005
    apart = np.linalg.norm(given.positions[:, None] - given.positions, axis=2)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    np.testing.assert_allclose(given.scales[:, 1], np.sqrt((nearest**2).mean(1)), rtol=1e-5)
    few = seed_splats(p.numpy(), GEOMETRY, dataclasses.replace(PAPER, n_splats=2))
    assert len(few) == 2 and np.all(few.scales == 1.0)


def test_a_short_run_is_a_shortened_long_one():
    long, short = PRESETS["paper"].times(), dataclasses.replace(PRESETS["paper"], steps=2000).times()
    assert (long.first, long.last, long.every) == (500, 15000, 100)
    assert (short.first, short.last, short.every) == (50, 1500, 10) and short.pull == long.pull
    assert dataclasses.replace(PRESETS["r2"], steps=60).times().every == 1


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="steps"):
        Settings(steps=0)
    with pytest.raises(InputError, match="seconds"):
        Settings(seconds=-1.0)
    with pytest.raises(InputError, match="as many"):
        Settings(channels="a")
    with pytest.raises(InputError, match="positive"):
        Settings(start=(0.1, 0.0))
    with pytest.raises(InputError, match="device"):
        published.r2(sphere(), device="cuda")
