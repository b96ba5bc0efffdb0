"""The published splat methods as wholes: on a small scan without noise of a sphere, and their loss's gradients."""

import dataclasses
import itertools
import math

import msgspec
import numba
import numpy as np
import pytest
import torch

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.beam import detected
from ctsim.reconstruct.settings import parameters_of
from ctsim.reconstruct.splat.descent import adam, densify
from ctsim.reconstruct.splat.descent.learner import LEAST_VALUE, Learner, seed_splats
from ctsim.reconstruct.splat.descent.loss import l1_ssim
from ctsim.reconstruct.splat.descent.objective import Objective
from ctsim.reconstruct.splat.published import fit_published, paper, r2, read_out
from ctsim.reconstruct.splat.published_settings import Baseline, Settings
from ctsim.reconstruct.splat.response import evaluate
from ctsim.reconstruct.splat.volume import voxelise
from ctsim.reconstruct.watch import Progress, listen, watch
from ctsim.types import Scan, Status

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
SCHEDULE = densify.Schedule(first=20_000)
PAPER, R2 = (kind(steps=200, n_splats=400, schedule=SCHEDULE) for kind in (Settings, Baseline))


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
    seen: list[Progress] = []
    with listen(seen.append, every=0.0):
        return fit_published(scan, settings), seen


@pytest.mark.parametrize("settings", [PAPER, R2], ids=["paper", "r2"])
def test_the_loss_falls_and_the_same_seed_gives_the_same_bits(settings):
    volume, seen = course(sphere(), settings)
    losses = [step.loss for step in seen]
    # 20 views a turn; it starts from FDK's volume, blurred by what 400 splats can show. Measured: 0.45 and 0.53
    assert np.mean(losses[-20:]) < 0.6 * np.mean(losses[:5])
    assert volume.status is Status.OK and volume.details["view_updates"] == 200
    assert torch.isfinite(volume.values).all()
    z, y, x = GEOMETRY.voxel_centres()
    distance = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    inside, outside = volume.values.numpy()[distance < 8], volume.values.numpy()[distance > 13]
    assert inside.mean() > 5 * abs(outside.mean())
    often = densify.Schedule(first=5, every=7, last=20_000, most=600)
    short = msgspec.structs.replace(settings, steps=30, schedule=often, schedule_steps=30)
    first, again = (fit_published(sphere(), short) for _ in range(2))
    other = fit_published(sphere(), msgspec.structs.replace(short, seed=1))
    assert torch.equal(first.values, again.values) and not torch.equal(first.values, other.values)
    assert first.details["splats"] > 400


def test_progress_says_where_the_fit_stands():
    _, seen = course(sphere(), msgspec.structs.replace(PAPER, steps=30))
    assert [p.share for p in seen] == [k / 30 for k in range(1, 31)]
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(seen))
    assert seen[9].remaining == pytest.approx(2 * seen[9].seconds) and seen[-1].remaining == 0


def test_the_response_is_learned_only_where_it_is_to_be():
    def theta(method=paper, **changes):
        found = method(sphere(), steps=20, n_splats=200, **changes).details["response"]
        assert changes.get("response", found["name"]) == found["name"] and sum(found["eta"]) == pytest.approx(1)
        return found["theta"]

    learned = theta()
    assert learned != [0.2, 1.0] and learned == pytest.approx([0.2, 1.0], abs=0.021)  # 20 steps of at most 1e-3
    assert theta(theta=(0.5, 0.9), learn_response=False) == [0.5, 0.9]
    assert theta(theta=[0.5, 0.9]) != [0.5, 0.9]
    assert theta(response="flat") == [1.0, 1.0]
    assert theta(basis="constant") == [0.2, 1.0]
    assert theta(r2) == [] == theta(response="known")
    volumes = [paper(sphere(), steps=2, n_splats=200, e_max=e_max).values for e_max in (60.0, None)]
    assert not torch.equal(*volumes)


def test_a_response_matters_only_where_attenuation_depends_on_energy():
    """Shares of the response sum to 1, so that P = La for a constant density, whatever they are."""

    def run(**changes):
        return paper(sphere(), steps=3, n_splats=200, **changes).values

    assert torch.equal(run(basis="constant", response="mono"), run(basis="constant", response="paper"))
    for basis in ("paper", "klein-nishina", "photoelectric"):
        assert not torch.equal(run(basis=basis, response="flat"), run(basis=basis, response="paper")), basis


def test_a_known_spectrum_is_the_one_that_is_told():
    def run(**changes):
        return paper(sphere(), steps=3, n_splats=200, response="known", **changes).values

    copper = {"filters": [{"material": "Cu", "thickness": 2.0}]}
    assert not torch.equal(run(), run(tube=copper)) and not torch.equal(run(), run(detector={"kind": "csi"}))
    energies, shares = detected(copper, None, 90.0)
    told = Settings(response="known", tube=copper).make_response(90.0)
    length = 40.0
    exact = -np.log(shares @ np.exp(-0.02 * length * (energies / 50.0) ** -3) / shares.sum())
    found, _, _ = evaluate(told, np.zeros((1, 1), np.float32), np.full((1, 1), 0.02 * length, np.float32))
    assert found.item() == pytest.approx(exact, abs=1e-4)  # to which a spectrum is reduced


def test_a_detector_that_is_told_sees_the_assumed_tube():
    told, assumed = (
        Settings(response="tube", detector=kind).make_response(90.0) for kind in ({"kind": "counting"}, None)
    )
    assert told.energies_kev @ told.eta < assumed.energies_kev @ assumed.eta - 1  # a photon counts whatever its energy


def test_nothing_seen_and_no_time_give_what_there_is():
    for method in (paper, r2):
        empty = method(sphere(mu=0.0), steps=5)
        assert empty.status is Status.OK and not empty.reason
        assert not empty.values.any() and "no voxel" in empty.details["limitation"]
    volume = paper(sphere(), seconds=0.0)
    assert volume.details["view_updates"] == 0 and volume.values.any()


def test_densities_are_handed_over_and_read_at_any_energy():
    def run(method=paper, **changes):
        return method(sphere(), steps=20, n_splats=400, **changes)

    at_centre = run()
    a, b = (at_centre.details["densities"][name] for name in ("rho_a", "rho_b"))
    assert a.shape == b.shape == GEOMETRY.n_voxel and a.any() and b.any()
    np.testing.assert_allclose(at_centre.values, a + b, rtol=1e-5, atol=1e-9)
    # 90 keV are 1.8 of the range's centre
    np.testing.assert_allclose(run(readout=90.0).values, a + b / 1.8**3, rtol=1e-5, atol=1e-9)
    hardened = run(readout="hardened")
    weight = ((hardened.values.numpy() - a).sum() / b.sum()).item()
    np.testing.assert_allclose(hardened.values, a + weight * b, rtol=1e-4, atol=1e-7)
    assert 1.8**-3 < weight < 0.2**-3 and hardened.details["read-out"].startswith("hardened")
    assert list(run(r2).details["densities"]) == ["rho_a"]
    assert list(run(basis="photoelectric").details["densities"]) == ["rho_b"]


def test_the_hardened_read_out_knows_no_gauge():
    """κ → c·κ with ρb → ρb/c changes no projection; the densities' sum, attenuation at Ē = 1, falls."""
    objective, parameters, response = problem(sphere())
    splats, c = objective.activation.splats(parameters), 2.5
    moved = dataclasses.replace(splats, densities=splats.densities / np.array([1, c], np.float32))
    other = dataclasses.replace(response, b=response.b * c)
    p, q = (objective.line_integrals(objective.paths(s, 0), r)[0] for s, r in ((splats, response), (moved, other)))
    np.testing.assert_allclose(p, q, rtol=1e-4, atol=1e-6)  # both in float32

    def read(objective, splats, response):
        weights, _ = read_out(splats, response, objective)
        return voxelise(splats, GEOMETRY, splats.densities @ weights[:, None])

    hard = dataclasses.replace(objective, settings=msgspec.structs.replace(PAPER, readout="hardened"))
    first, second = read(hard, splats, response), read(hard, moved, other)
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-7)
    assert np.abs(read(objective, moved, other) - read(objective, splats, response)).max() > 0.01 * first.max()


class Interrupted(Exception):
    pass


@pytest.mark.parametrize("held_out", [0, 3])
def test_an_interrupted_fit_goes_on_to_the_same_bits(held_out, tmp_path, monkeypatch):
    monkeypatch.setattr("ctsim.reconstruct.splat.checkpoint.EVERY", 0.0)
    often = densify.Schedule(first=5, every=7, last=20_000, most=600)
    whole = msgspec.structs.replace(PAPER, steps=40, schedule=often, schedule_steps=40, held_out=held_out)
    kept = msgspec.structs.replace(whole, checkpoints=str(tmp_path))
    steps: list[int] = []

    def interrupt(progress: Progress) -> None:
        steps.append(round(40 * progress.share))
        if steps == list(range(1, 28)):
            raise Interrupted

    with listen(interrupt, every=0.0):
        with pytest.raises(Interrupted):
            fit_published(sphere(), kept)
        assert len(list(tmp_path.iterdir())) == 1
        found = fit_published(sphere(), kept)
    assert steps == [*range(1, 28), *range(27, 41)]  # the step that was cut off had been taken, but not written
    assert torch.equal(found.values, fit_published(sphere(), whole).values)
    assert not list(tmp_path.iterdir())


def test_time_that_ran_out_can_be_given_later(tmp_path):
    settings = msgspec.structs.replace(PAPER, steps=30, checkpoints=str(tmp_path))
    early = fit_published(sphere(), msgspec.structs.replace(settings, seconds=1e-9))
    assert early.details["view_updates"] == 0 and len(list(tmp_path.iterdir())) == 1
    late = fit_published(sphere(), settings)
    assert late.details["earlier_seconds"] > 0 and "earlier_seconds" not in early.details
    assert late.details["view_updates"] == 30 and not list(tmp_path.iterdir())


def test_a_damaged_checkpoint_is_refused_and_another_scan_s_not_taken(tmp_path):
    settings = msgspec.structs.replace(PAPER, steps=30, checkpoints=str(tmp_path), seconds=0.0)
    fit_published(sphere(), settings)
    fit_published(sphere(mu=0.02), settings)
    fit_published(sphere(), msgspec.structs.replace(settings, seed=1))
    files = sorted(tmp_path.iterdir())
    assert len(files) == 3
    for file in files:
        file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match="delete it"):
        fit_published(sphere(), settings)
    with pytest.raises(InputError, match="cannot be read"):
        fit_published(sphere(), msgspec.structs.replace(settings, checkpoints=str(files[0])))


def test_a_fit_ends_when_views_it_does_not_see_gain_no_more():
    settings = msgspec.structs.replace(PAPER, steps=2000, held_out=4, patience=2)
    scan, passes = sphere(i0=30.0), {}
    noisy = torch.from_numpy(np.random.default_rng(5).poisson(scan.counts.numpy())).float()  # to be fitted in vain
    with watch(lambda updates, seconds, values: passes.update({updates: values})):
        volume = fit_published(dataclasses.replace(scan, counts=noisy), settings)
    about, done = volume.details["held_out"], volume.details["view_updates"]
    assert about["views"] == [4, 8, 11, 15]
    assert done < 2000 and about["step"] in passes and len(passes) == done // 16
    np.testing.assert_allclose(passes[about["step"]], volume.values, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("falls", [False, True])
def test_a_tube_that_starts_thin_is_learned_to_the_end(falls, monkeypatch):
    """The best state may have less filtration than the last one, and the least, rounded to float32, is below itself."""
    learn = Learner._learn_response
    if falls:
        monkeypatch.setattr(Learner, "_learn_response", lambda self, slope, done: learn(self, np.abs(slope) + 1, done))
    settings = msgspec.structs.replace(PAPER, response="tube", theta=(0.03,), steps=400, held_out=4, patience=2)
    noisy = torch.from_numpy(np.random.default_rng(5).poisson(sphere(i0=30.0).counts.numpy())).float()
    volume = fit_published(dataclasses.replace(sphere(i0=30.0), counts=noisy), settings)
    (found,) = volume.details["response"]["theta"]
    assert volume.status is Status.OK and (found == 0.03 if falls else 0.03 < found < 0.5)


def test_a_loss_that_is_not_finite_ends_the_fit_and_says_so(monkeypatch):
    steps = []
    monkeypatch.setattr(Learner, "step", lambda self, done: steps.append(done) or (math.nan if done == 25 else 0.5))
    lost = fit_published(sphere(), PAPER)
    assert steps == list(range(26)) and lost.status is Status.NONFINITE and "not finite" in lost.reason
    # what met the views that were held out best was kept before
    kept = fit_published(sphere(), msgspec.structs.replace(PAPER, held_out=2))
    assert kept.status is Status.OK and kept.details["held_out"]["step"] == 18


def test_a_fit_can_be_watched():
    seen = []
    with watch(lambda updates, seconds, volume: seen.append((updates, volume))):
        volume = fit_published(sphere(), msgspec.structs.replace(PAPER, steps=40))
    assert [updates for updates, _ in seen] == [20, 40]
    np.testing.assert_allclose(seen[-1][1], volume.values, rtol=1e-4, atol=1e-8)


def test_counts_that_are_not_finite_say_nothing():
    scan = sphere()
    counts = scan.counts.clone()
    counts[:, 17:19, 17:19], counts[3, :4, :4] = torch.nan, torch.inf
    volume, seen = course(dataclasses.replace(scan, counts=counts), msgspec.structs.replace(PAPER, steps=40))
    assert volume.details["clamped_pixels"] == 20 * 4 + 16
    assert volume.status is Status.OK and torch.isfinite(volume.values).all()
    assert all(math.isfinite(step.loss) for step in seen)
    objective, parameters, response = problem(dataclasses.replace(scan, counts=counts))
    assert not objective.p[~objective.valid].any() and not objective.valid[:, 17:19, 17:19].any()
    before = objective(parameters, response, 0, 0).loss
    objective.valid[0, 17:19, 17:19] = True  # 0 seen where the sphere is
    assert objective(parameters, response, 0, 0).loss > before + 1e-3


def problem(scan, settings=PAPER):
    """The loss, what is learned and the response at the start."""
    objective, response = Objective.of(scan, settings), settings.make_response(90.0)
    given = seed_splats(objective.p, GEOMETRY, settings, response)
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


@pytest.mark.parametrize("basis", ["paper", "klein-nishina", "constant", "photoelectric"])
def test_densities_have_the_whole_loss_s_finite_differences(basis):
    settings = msgspec.structs.replace(PAPER, basis=basis)
    scan = sphere()
    scan.counts[:, 10:20, 15:25] = torch.nan  # what does not count pulls at nothing
    objective, parameters, response = problem(scan, settings)
    terms, step = objective(parameters, response, 3, 0), 0.004  # few pixels' differences change their sign
    for channel in range(len(settings.channels)):
        moved = []
        for sign in (1, -1):
            shifted = parameters["densities"].copy()
            shifted[:, channel] += np.float32(sign * step)
            moved.append(objective({**parameters, "densities": shifted}, response, 3, 0).loss)
        expected = (moved[0] - moved[1]) / (2 * step)
        assert terms.parameters["densities"][:, channel].sum() == pytest.approx(expected, rel=0.01)


def test_tv_pulls_at_densities_as_its_finite_difference_says():
    settings = msgspec.structs.replace(R2, tv_share=50.0)
    objective, parameters, response = problem(sphere(), settings)
    plain = dataclasses.replace(objective, settings=msgspec.structs.replace(settings, tv_share=0.0))
    step = 0.01

    def tv(shift):
        moved = {**parameters, "densities": parameters["densities"] + np.float32(shift)}
        return objective(moved, response, 0, 7).loss - plain(moved, response, 0, 7).loss

    by_tv = objective(parameters, response, 0, 7).parameters["densities"]
    by_tv = by_tv - plain(parameters, response, 0, 7).parameters["densities"]
    assert tv(0) > 0.03
    assert by_tv.sum() == pytest.approx((tv(step) - tv(-step)) / (2 * step), rel=0.01)


def test_a_step_is_that_of_the_scene_scaled_to_its_unit_cube():
    """R2-Gaussian divides lengths and P by half the widest side, so densities, losses and steps are the same there."""
    settings, unit = msgspec.structs.replace(R2, tv_share=5.0), 16.0
    small = msgspec.structs.replace(
        GEOMETRY,
        **{name: getattr(GEOMETRY, name) / unit for name in ("dso", "dsd")},
        **{name: tuple(x / unit for x in getattr(GEOMETRY, name)) for name in ("d_voxel", "d_detector")},
    )
    scan = sphere()
    here, parameters, response = problem(scan, settings)
    assert here.unit == unit and adam.unit_length(small) == 1
    scaled = dataclasses.replace(scan, geometry=small, counts=scan.i0 * (scan.counts / scan.i0) ** (1 / unit))
    there = Objective.of(scaled, settings)
    moved = {**parameters, "positions": parameters["positions"] / np.float32(unit)}
    a, b = here(parameters, response, 3, 0), there(moved, response, 3, 0)
    values = there.paths(there.activation.splats(moved), 3)[0]
    published = l1_ssim(np.where(there.valid[3], values[:, :40], np.float32(0)), there.p[3], 1.0)[0]
    plain = dataclasses.replace(there, settings=msgspec.structs.replace(settings, tv_share=0.0))
    assert plain(moved, response, 3, 0).loss == published < b.loss
    pairs = [(a.parameters[name], b.parameters[name]) for name in ("scales", "densities")]
    pairs += [(a.parameters["positions"] * unit, b.parameters["positions"]), (a.centres, b.centres)]
    assert a.loss == pytest.approx(b.loss, abs=1e-6)  # P of float32 counts
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-3 * np.abs(other).max())


def test_splats_are_seeded_as_published():
    objective, _, response = problem(sphere())
    given = seed_splats(objective.p, GEOMETRY, PAPER, response)
    assert len(given) == 400 and adam.unit_length(GEOMETRY) == 16 and np.all(np.diff(given.positions[:, 2]) >= 0)
    assert len(np.unique(given.positions, axis=0)) == 400 and np.all(given.densities > 0)
    np.testing.assert_allclose(given.densities[:, 0], 10 * given.densities[:, 1], rtol=1e-6)
    assert given.densities[:, 0].min() > 0.075 * LEAST_VALUE
    apart = np.linalg.norm(given.positions[:, None] - given.positions, axis=2)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    np.testing.assert_allclose(given.scales[:, 1], np.sqrt((nearest**2).mean(1)), rtol=1e-5)
    few = seed_splats(objective.p, GEOMETRY, msgspec.structs.replace(PAPER, n_splats=2), response)
    assert len(few) == 2 and np.all(few.scales == 1.0)


def test_one_density_begins_with_the_same_line_integrals_whatever_its_energy():
    def start(basis):
        objective, parameters, response = problem(sphere(mu=1e-4, i0=1e9), msgspec.structs.replace(PAPER, basis=basis))
        return objective.line_integrals(objective.paths(objective.activation.splats(parameters), 0), response)[0]

    assert not start("constant").any()  # nothing is above 0.005 1/mm
    objective, parameters, response = problem(sphere(), msgspec.structs.replace(PAPER, basis="photoelectric"))
    splats = objective.activation.splats(parameters)
    # ρb times its mean b is what the other basis begins with
    constant = problem(sphere(), msgspec.structs.replace(PAPER, basis="constant"))
    other = constant[0].activation.splats(constant[1]).densities
    np.testing.assert_allclose(splats.densities * (response.eta @ response.b), other, rtol=1e-5)


def test_a_short_run_begins_to_densify_as_late_as_a_long_one_and_small_grids_take_fewer():
    long, short = (Settings(steps=n).densification((256,) * 3) for n in (20_000, 2000))
    assert (long.first, long.last, long.every, long.most) == (500, 15_000, 100, 500_000)
    assert (short.first, short.last, short.every) == (500, 1500, 100) and short.pull == long.pull == 5e-5
    assert Settings().densification((64, 64, 64)).most == 65_536
    assert Settings().densification((32, 32, 32)).most == 50_000


def test_the_baseline_is_the_method_with_other_defaults():
    found = parameters_of(Baseline)
    assert list(found) == list(parameters_of(Settings))
    differ = {name for name, p in parameters_of(Settings).items() if found[name].default != p.default}
    assert differ == {"steps", "schedule_steps", "response", "basis", "tv_share"}
    assert (Baseline().steps, Baseline().channels, Baseline().tv_share) == (30_000, "a", 0.05)
    assert {found[name].expected for name in differ} == {parameters_of(Settings)[name].expected for name in differ}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps"),
        ({"seconds": -1.0}, "seconds"),
        ({"held_out": -1}, "held_out"),
        ({"patience": 0}, "patience"),
        ({"basis": "water"}, "basis: expected one of"),
        ({"response": "tubes"}, "response: expected one of"),
        ({"response": "mono"}, "basis: expected constant"),
        ({"response": "flat", "theta": (1.0, 1.0)}, "theta: expected null"),
        ({"tube": {"kvp": 60.0}}, "for response 'known'"),
        ({"response": "known", "tube": {"kvpp": 60.0}}, "tube: "),
        ({"readout": "soft"}, "hardened"),
        ({"readout": 0.0}, "readout: expected a number above 0"),
        ({"held_out": 20}, "fewer than the 20 views"),
        ({"theta": (2.0, 1.0)}, "theta"),
        ({"stepps": 3}, "stepps: unknown parameter; did you mean steps"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        paper(sphere(), **changes)


def test_poses_are_refused_in_a_sentence():
    poses = tuple(tuple(row) for row in GEOMETRY.pose_array().tolist())
    scan = dataclasses.replace(sphere(), geometry=msgspec.structs.replace(GEOMETRY, poses=poses))
    with pytest.raises(InputError, match="FDK"):
        paper(scan, steps=1)
