"""What all iterative methods owe: solutions, weights, ends, and the algebraic ones by hand."""

import functools
import itertools

import msgspec
import numpy as np
import pytest
import torch
from by_threads import one_and_several
from iterative_scans import (
    GEOMETRY,
    METHODS,
    MU,
    RADIUS,
    TINY,
    distance,
    matrix,
    one_thread,  # noqa: F401
    scan_of,
    sphere,
    tiny,
)
from scipy.sparse.linalg import lsqr

from ctsim.baselines.iterative import System, visiting_order, watch
from ctsim.baselines.krylov import cgls
from ctsim.baselines.sart import os_sart, sart, sirt
from ctsim.baselines.tv_methods import asd_pocs, awpcsd, fista_tv
from ctsim.errors import InputError
from ctsim.reconstruct.projector import forward
from ctsim.types import Scan, Status

CONVERGED = {"sirt": 100, "cgls": 15, "fista-tv": 50}
"""Iterations of a scan without noise, of the others 10. Defaults are for noise and metal, and stop earlier."""


@functools.cache
def result(name):
    return METHODS[name](sphere(), iterations=CONVERGED.get(name, 10))


@pytest.mark.parametrize("name", METHODS)
def test_sphere_comes_back(name):
    volume = result(name)
    values, r = volume.values.numpy(), distance()
    assert volume.status is Status.OK and not volume.reason
    assert values.dtype == np.float32
    # A sphere of one attenuation is no member of the voxel model: its wall, one voxel wide, keeps a residual of
    # some 2 %. Two voxels from the wall the attenuation itself is measured, and air is empty but for ripples of it.
    # AwPCSD ends on TV steps, whose length is 2 % of the volume's norm each while the residual is what it was: they
    # flatten a small sphere by some tenths of a percent that no later pass makes good.
    assert values[r < RADIUS - 2].mean() == pytest.approx(MU, rel=0.01 if name == "awpcsd" else 0.005)
    assert values[r < RADIUS - 2].std() < 0.05 * MU
    assert abs(values[r > RADIUS + 2].mean()) < 0.005 * MU
    assert volume.details["residual"] < 0.04
    if name != "cgls":
        assert values.min() >= 0
    updates = volume.details["view_updates"]
    assert updates == GEOMETRY.n_views * len(volume.details["step_sizes"])


@pytest.mark.parametrize("name", METHODS)
def test_residual_falls_as_the_theory_says(name):
    residuals = result(name).details["residuals"]
    assert all(b < a for a, b in itertools.pairwise(residuals[:5]))
    assert residuals[-1] < 0.2 * residuals[0] or residuals[0] < 0.1
    if name == "cgls":
        assert all(b < a for a, b in itertools.pairwise(residuals))


def test_sirt_lowers_its_own_norm_in_each_iteration():
    scan = tiny()
    system, norms = System(scan), []
    sums = system.forward(system.support.astype(np.float32))
    share = np.where(sums > 0.5 * min(TINY.d_voxel), 1 / np.maximum(sums, 1e-9), 0)

    def measure(views, seconds, volume):
        lacking = forward(volume, TINY).numpy() - system.data
        norms.append(float((share * lacking.astype(float) ** 2).sum()))

    with watch(measure):
        sirt(scan, iterations=60, relaxation=1.9, positivity=False)
    # ‖r‖ in the norm M is what gradient steps of length 1.9/‖·‖ lower; 1e-6 is float32's rounding of the projections
    assert all(b <= a * (1 + 1e-6) for a, b in itertools.pairwise(norms))
    assert norms[-1] < norms[0]


@pytest.mark.parametrize("weights", ["none", "exp(-l)"])
@pytest.mark.parametrize("iterations", [1, 2, 5, 8])
def test_cgls_equals_lsqr(weights, iterations):
    scan = tiny()
    system = System(scan, weights)
    assert system.support.all()
    root = np.sqrt(system.weights.astype(float)).ravel()
    expected = lsqr(root[:, None] * matrix(TINY), root * system.data.ravel(), iter_lim=iterations, atol=0, btol=0)[0]
    values = cgls(scan, iterations=iterations, weights=weights).values.numpy().ravel()
    # The two agree in exact arithmetic; float32 projections (2⁻²⁴·√60) are amplified as directions lose conjugacy.
    np.testing.assert_allclose(values, expected, rtol=0, atol=2e-4 * np.abs(expected).max())


def test_sart_by_hand():
    # One view, one update from zero: x = λ Aᵀ(p/A1)/Aᵀ1, in numbers of an explicit matrix.
    geometry = msgspec.structs.replace(TINY, n_views=1)
    scan, a = tiny(geometry), matrix(geometry)
    p = System(scan).data.ravel().astype(float)
    sums = a.sum(1)
    met = sums > 0.5 * min(TINY.d_voxel)
    lacking = np.divide(p, sums, out=np.zeros_like(p), where=met)
    moved = a.T @ lacking / np.maximum(a[met].sum(0), 1e-12)
    values = sart(scan, iterations=1, relaxation=0.7).values.numpy().ravel()
    np.testing.assert_allclose(values, 0.7 * moved, rtol=0, atol=2e-6)


def test_weightless_rays_change_nothing():
    scan = tiny()
    weights = torch.ones(TINY.shape)
    weights[3:7, 2:4, 2:6] = 0
    counts = torch.where(weights == 0, scan.counts * 0.3, scan.counts)
    spoiled = Scan(geometry=TINY, counts=counts, flat=scan.flat, i0=scan.i0)
    for method in METHODS.values():
        clean, other = (method(s, iterations=3, weights=weights).values for s in (scan, spoiled))
        # asd-pocs and awpcsd set their aim by the noise of the weighted rays, so this holds for them as well
        torch.testing.assert_close(clean, other, rtol=0, atol=1e-9)
        assert not torch.equal(method(spoiled, iterations=3).values, clean)


def test_named_weights():
    scan = tiny()
    data = torch.from_numpy(System(scan).data)
    by_name, by_hand = (os_sart(scan, weights=w).values for w in ("exp(-l)", torch.exp(-data.clamp(min=0))))
    torch.testing.assert_close(by_name, by_hand, rtol=0, atol=2e-6)  # two exponentials, values up to 1


@pytest.mark.parametrize("method", [sart, os_sart, sirt])
def test_too_long_steps_are_called_divergence(method):
    volume = method(tiny(), iterations=200, relaxation=4.0, positivity=False)
    assert volume.status is Status.DIVERGED
    assert "residual" in volume.reason
    assert bool(torch.isfinite(volume.values).all())
    assert len(volume.details["residuals"]) < 200


@pytest.mark.parametrize("name", METHODS)
def test_nothing_is_invented_outside_the_field_of_view(name):
    # Wider than the fan at the corners and higher than the cone
    geometry = msgspec.structs.replace(GEOMETRY, n_voxel=(60, 45, 47), n_views=12)
    volume = METHODS[name](sphere(geometry), iterations=3).values
    _, y, x = geometry.voxel_centres()
    outside = np.add.outer(y**2, x**2) > geometry.fov_radius**2
    assert outside.sum() > 100
    assert (volume.numpy()[:, outside] == 0).all()
    assert (volume[[0, -1]] == 0).all()
    assert (volume > 0.5 * MU).any()


@pytest.mark.parametrize("name", METHODS)
def test_empty_scan_gives_an_empty_volume(name):
    volume = METHODS[name](scan_of(torch.zeros(TINY.shape), TINY))
    assert volume.status is Status.OK
    assert (volume.values == 0).all()


@pytest.mark.parametrize("name", METHODS)
def test_watcher_sees_each_iteration(name):
    seen = []
    with watch(lambda views, seconds, volume: seen.append((views, seconds, volume))):
        volume = METHODS[name](tiny(), iterations=4)
    METHODS[name](tiny(), iterations=1)  # no longer watched
    assert [views for views, *_ in seen] == [12 * (k + 1) for k in range(len(seen))] and 1 <= len(seen) <= 4
    assert all(0 < a[1] < b[1] for a, b in itertools.pairwise(seen))
    # asd-pocs cuts at zero once more at the end
    assert torch.equal(seen[-1][2].clamp(min=0 if name == "asd-pocs" else -np.inf), volume.values)
    assert volume.details["view_updates"] == seen[-1][0]


@pytest.mark.parametrize("name", ["os-sart", "fista-tv", "awpcsd", "cgls"])
def test_thread_count_changes_no_bit(name):
    one, several = one_and_several(lambda: METHODS[name](sphere(), iterations=2).values)
    assert torch.equal(one, several)


@pytest.mark.slow
def test_tilted_poses_and_shifted_detectors():
    turn = np.array([[1, 0, 0], [0, np.cos(0.2), -np.sin(0.2)], [0, np.sin(0.2), np.cos(0.2)]])
    poses = (GEOMETRY.pose_array().reshape(-1, 4, 3) @ turn.T).reshape(-1, 12)
    tilted = msgspec.structs.replace(GEOMETRY, poses=tuple(map(tuple, poses.tolist())))
    shifted = msgspec.structs.replace(GEOMETRY, off_detector=(3.0, -14.0))
    for geometry in (tilted, shifted):
        values = os_sart(sphere(geometry), iterations=8).values.numpy()
        assert values[distance() < RADIUS - 2].mean() == pytest.approx(MU, rel=0.005)


def cut(**changes):
    """Limitation and details of a method on the sphere, with another grid or detector."""
    volume = os_sart(sphere(msgspec.structs.replace(GEOMETRY, **changes)), iterations=1, subsets=4)
    assert volume.status is Status.OK and not volume.reason
    return volume.details.get("limitation", ""), volume.details


def test_what_goes_on_beyond_the_grid_or_the_detector_is_said():
    limitation, details = cut()
    assert not limitation and details["attenuated_rays_beyond"] == 0 and details["attenuated_edges"] == {}
    # the sphere's centre lies at (1, −2, 0.5) mm and its radius is 10: 14 mm wide, the grid cuts it on all sides
    limitation, details = cut(n_voxel=(28, 14, 14))
    assert "rays miss the reconstruction grid" in limitation and details["attenuated_rays_beyond"] > 100
    # 16 pixels of 2 mm at magnification 2 hold 8 mm to either side of the axis, in u and then in v
    limitation, details = cut(n_detector=(36, 16))
    assert "wrong towards the border" in limitation
    assert set(details["attenuated_edges"]) == {"first column", "last column"}
    _, details = cut(n_detector=(16, 38), n_voxel=(12, 29, 31))
    assert set(details["attenuated_edges"]) == {"first row", "last row"}
    # the same detector with a grid that no ray leaves upwards: what is measured is explained where it arose
    assert cut(n_detector=(16, 38))[1]["attenuated_edges"] == {}


def test_weights_by_trace_leave_out_the_shadow_of_metal():
    """A ball of metal in the sphere: only its shadow has no weight."""
    inner, r = 3.0, distance()
    truth = np.where(r < inner, 40 * MU, np.where(r < RADIUS, MU, 0)).astype(np.float32)
    scan = scan_of(forward(torch.from_numpy(truth), GEOMETRY), GEOMETRY)
    system = System(scan, "trace")
    shadow = forward(torch.from_numpy((r < inner).astype(np.float32)), GEOMETRY).numpy()
    assert system.about_weights["mask_status"] == "ok"
    assert set(np.unique(system.weights)) == {0, 1}
    assert (system.weights[shadow > 1] == 0).all()
    # the trace is wider than the ball by a pixel for its edge, and by what half of FDK's peak adds
    wide = forward(torch.from_numpy((r < inner + 2.5).astype(np.float32)), GEOMETRY).numpy()
    assert (system.weights[wide == 0] == 1).all()
    volume = cgls(sphere(), iterations=1, weights="trace")  # nothing but water: no trace, and it is said
    assert volume.status is Status.OK and not volume.reason
    assert "times water" in volume.details["mask_reason"] and volume.details["mask_status"] == "mask_unreliable"


def test_visiting_order_visits_all_once_and_jumps():
    for n in (1, 2, 3, 12, 20, 60, 97):
        order = visiting_order(n)
        assert sorted(order) == list(range(n))
    assert min(abs(a - b) for a, b in itertools.pairwise(visiting_order(60))) > 10


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda scan: sart(scan, iterations=0), "iterations"),
        (lambda scan: sart(scan, iterations=1.5), "iterations"),
        (lambda scan: os_sart(scan, subsets=0), "subsets"),
        (lambda scan: sirt(scan, relaxation=-1), "relaxation"),
        (lambda scan: cgls(scan, weights="exp(-p)"), "exp"),
        (lambda scan: cgls(scan, weights=torch.ones(2, 2)), "weights"),
        (lambda scan: fista_tv(scan, tv=-1), "tv"),
        (lambda scan: asd_pocs(scan, alpha=float("nan")), "alpha"),
        (lambda scan: asd_pocs(scan, epsilon=0), "epsilon"),
        (lambda scan: awpcsd(scan, delta=0), "delta"),
    ],
)
def test_wrong_parameters_are_named(call, words):
    with pytest.raises(InputError, match=words):
        call(tiny())
