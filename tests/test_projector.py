import msgspec
import numpy as np
import pytest
import torch
from by_threads import one_and_several

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.kernels import joseph_cpu, joseph_reference
from ctsim.reconstruct.projector import adjoint, forward

RNG = np.random.default_rng(8)
SMALL = Geometry(
    dso=30.0,
    dsd=50.0,
    n_voxel=(5, 7, 11),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(8, 15),
    d_detector=(1.3, 1.5),
    n_views=9,
    start_deg=11.0,
)


def with_(geometry=SMALL, **changes):
    return msgspec.structs.replace(geometry, **changes)


def turned(geometry, degrees, axis):
    """The same scanner with every pose turned about the x, y or z axis of the grid."""
    a, (i, j) = np.radians(degrees), [k for k in range(3) if k != axis]
    turn = np.eye(3)
    turn[[i, i, j, j], [i, j, i, j]] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
    poses = geometry.pose_array().reshape(-1, 4, 3) @ turn.T
    return with_(geometry, poses=tuple(map(tuple, poses.reshape(-1, 12).tolist())))


CASES = {
    "centred": SMALL,
    "along the axes and diagonals": with_(n_views=8, start_deg=0.0),
    "detector offset": with_(off_detector=(1.7, -6.3)),
    "grid moved": with_(off_origin=(0.8, -2.1, 3.3)),
    "anisotropic": with_(d_voxel=(0.7, 1.9, 0.4)),
    "thin slices": with_(d_voxel=(0.15, 1.0, 1.0), off_detector=(0.6, 0.0)),
    "thinner than rays rise": with_(d_voxel=(0.08, 1.0, 1.0), off_detector=(0.6, 0.0)),
    "thick slices": with_(d_voxel=(20.0, 0.5, 0.4)),
    "coarse detector": with_(n_detector=(3, 4), d_detector=(4.0, 5.0)),
    "source within the grid": with_(dso=4.0, dsd=20.0),
    "source next to a plane": with_(dso=3.0 + 1e-7, dsd=20.0, n_views=1, start_deg=0.0, n_voxel=(5, 7, 7)),
    "detector within the grid": with_(dso=30.0, dsd=31.0),
    "slightly tilted": turned(SMALL, 7.0, 0),
    "from above": turned(SMALL, 80.0, 1),
    "tilted, anisotropic, moved": turned(with_(d_voxel=(0.3, 1.9, 0.4), off_origin=(0.8, -0.4, 0.3)), -35.0, 0),
    "rows downwards": with_(
        poses=tuple(map(tuple, (SMALL.pose_array() * np.r_[np.ones(9), -np.ones(3)]).tolist())),
    ),
    "exactly diagonal": with_(
        n_views=2,
        poses=(
            (20.0, 20.25, 0.5, -15.0, -14.75, 0.5, -1.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            (-20.0, 20.25, 0.5, 15.0, -14.75, 0.5, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0),
        ),
    ),
    "one voxel": with_(n_voxel=(1, 1, 1), d_voxel=(3.0, 2.0, 4.0)),
    "one row": with_(n_detector=(1, 15)),
}


def arrays(geometry):
    n_z, n_y, n_x = geometry.n_voxel
    volume = RNG.standard_normal((n_y, n_x, n_z)).astype(np.float32)
    return volume, RNG.standard_normal(geometry.shape).astype(np.float32)


def run(kernel, geometry, volume, projections, dtype: type):
    poses, grid = geometry.pose_array(), np.array([*geometry.d_voxel, *geometry.off_origin])
    rows = np.tile([0, geometry.n_detector[0]], (geometry.n_views, 1))
    there, back = np.empty(geometry.shape, dtype), np.zeros(volume.shape, dtype)
    kernel.project(volume.astype(dtype), poses, grid, rows, there)
    kernel.backproject(projections.astype(dtype), poses, grid, rows, back)
    return there, back


@pytest.mark.parametrize("name", CASES)
def test_fast_kernel_equals_its_reference(name):
    geometry = CASES[name]
    volume, projections = arrays(geometry)
    fast = run(joseph_cpu, geometry, volume, projections, np.float32)
    slow = run(joseph_reference, geometry, volume, projections, np.float64)
    for a, b in zip(fast, slow, strict=True):
        # Places within 16 rows or voxels are rounded to 2⁻²¹, and weights err by as much; so does a sample of size
        # 4σ by 2·4·2⁻²¹ = 4e-6. Several samples make a result, and their errors average out.
        assert np.abs(b).max() > 0.1
        np.testing.assert_allclose(a, b, rtol=0, atol=5e-6 * np.abs(b).max())


@pytest.mark.parametrize("name", CASES)
def test_adjoint_is_the_transpose(name):
    geometry = CASES[name]
    _, projections = arrays(geometry)
    volume = torch.from_numpy(RNG.standard_normal(geometry.n_voxel).astype(np.float32))
    there, back = forward(volume, geometry), adjoint(torch.from_numpy(projections), geometry)
    left = float((there.double() * torch.from_numpy(projections)).sum())
    right = float((volume.double() * back.double()).sum())
    scale = float(there.double().norm()) * float(np.linalg.norm(projections.astype(float)))
    assert abs(left - right) < 1e-6 * scale


def test_adjoint_is_the_transpose_at_a_usual_size():
    geometry = with_(n_voxel=(40, 41, 43), n_detector=(50, 61), d_detector=(1.4, 1.4), dso=90.0, dsd=150.0, n_views=30)
    volume = torch.rand(geometry.n_voxel, generator=torch.Generator().manual_seed(0))
    there = forward(volume, geometry)
    left = float((there.double() ** 2).sum())
    right = float((volume.double() * adjoint(there, geometry).double()).sum())
    assert left == pytest.approx(right, rel=1e-5)


@pytest.mark.parametrize("name", ["centred", "tilted, anisotropic, moved"])
def test_chosen_views_and_rows_equal_the_full_result(name):
    geometry = CASES[name]
    _, projections = arrays(geometry)
    volume = torch.from_numpy(RNG.standard_normal(geometry.n_voxel).astype(np.float32))
    full, views = forward(volume, geometry), [7, 0, 3]
    assert torch.equal(forward(volume, geometry, views), full[views])
    assert torch.equal(forward(volume, geometry, slice(2, 7, 2)), full[2:7:2])
    assert forward(volume, geometry, []).shape == (0, *geometry.n_detector)
    ranges = np.array([[2, 5], [0, 0], [6, 8]])
    wanted = np.zeros((3, geometry.n_detector[0]), bool)
    for row, (first, last) in zip(wanted, ranges, strict=True):
        row[first:last] = True
    expected = torch.where(torch.from_numpy(wanted)[:, :, None], full[views], torch.zeros(()))
    for rows in (ranges, wanted):
        # Places are rounded from another first row: as in the comparison with the reference.
        torch.testing.assert_close(
            forward(volume, geometry, views, rows=rows), expected, rtol=0, atol=5e-6 * float(full.abs().max())
        )
    some = torch.from_numpy(projections)[views]
    kept = torch.where(torch.from_numpy(wanted)[:, :, None], some, torch.full((), 0.0))
    spoiled = torch.where(torch.from_numpy(wanted)[:, :, None], some, torch.full((), float("nan")))
    for rows in (ranges, wanted):
        assert torch.equal(adjoint(spoiled, geometry, views, rows=rows), adjoint(kept, geometry, views))


def test_view_twice_counts_twice():
    _, projections = arrays(SMALL)
    one = torch.from_numpy(projections[4:5])
    torch.testing.assert_close(adjoint(one.repeat(2, 1, 1), SMALL, [4, 4]), 2 * adjoint(one, SMALL, [4]))


@pytest.mark.parametrize("name", ["centred", "thick slices", "tilted, anisotropic, moved"])
def test_thread_count_changes_no_bit(name):
    geometry = with_(CASES[name], n_voxel=(20, 33, 37))
    volume, projections = arrays(geometry)
    one, several = one_and_several(lambda: run(joseph_cpu, geometry, volume, projections, np.float32))
    assert np.array_equal(one[0], several[0]) and np.array_equal(one[1], several[1])


def rays(geometry):
    """Source and unit direction of every ray, [view, v, u, 3]."""
    pose = geometry.pose_array()[:, None, None]
    n_v, n_u = geometry.n_detector
    v = (np.arange(n_v) - (n_v - 1) / 2)[None, :, None, None]
    u = (np.arange(n_u) - (n_u - 1) / 2)[None, None, :, None]
    ray = pose[..., 3:6] + u * pose[..., 6:9] + v * pose[..., 9:12] - pose[..., :3]
    return pose[..., :3], ray / np.linalg.norm(ray, axis=-1, keepdims=True)


VIEWING = Geometry(
    dso=200.0,
    dsd=320.0,
    n_voxel=(44, 48, 52),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(24, 28),
    d_detector=(2.3, 2.1),
    n_views=7,
    off_detector=(1.5, -4.0),
    off_origin=(0.5, -1.0, 2.0),
)
BLOB = np.array([1.5, -2.0, 1.0])  # x, y, z in mm


def blob_error(geometry, sigma):
    """Largest error of the projections of a Gaussian, relative to their largest value."""
    z, y, x = geometry.voxel_centres()
    square = (
        ((z - BLOB[2]) ** 2)[:, None, None] + ((y - BLOB[1]) ** 2)[None, :, None] + ((x - BLOB[0]) ** 2)[None, None, :]
    )
    volume = torch.from_numpy(np.exp(-square / (2 * sigma**2)).astype(np.float32))
    source, ray = rays(geometry)
    to = BLOB - source
    miss = (to**2).sum(-1) - (to * ray).sum(-1) ** 2
    exact = np.sqrt(2 * np.pi) * sigma * np.exp(-miss / (2 * sigma**2))
    return np.abs(forward(volume, geometry).numpy() - exact).max() / exact.max()


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_gaussian_has_its_closed_form_integrals(tilt):
    sigma = 3.8  # the grid holds 5.6 σ to its nearest face
    fine = with_(VIEWING, n_voxel=(88, 96, 104), d_voxel=(0.5, 0.5, 0.5))
    coarse, fine = (turned(g, tilt, 0) if tilt else g for g in (VIEWING, fine))
    # Bilinear interpolation errs by at most h²/8 (|f_aa| + |f_bb|), and ∫|f_aa| ≤ max P/σ²; second order in h.
    bound = 1 / (4 * sigma**2)
    assert blob_error(coarse, sigma) < bound
    assert blob_error(fine, sigma) < bound / 4
    assert blob_error(fine, sigma) > bound / 400  # and no better than it can be: a wrong σ would not show otherwise


@pytest.mark.parametrize("d_voxel", [(1.0, 1.0, 1.0), (2.0, 0.8, 1.3)])
def test_cylinder_has_its_chords(d_voxel):
    n_voxel = tuple(int(np.ceil(60 / d)) for d in d_voxel)
    geometry = with_(VIEWING, n_voxel=n_voxel, d_voxel=d_voxel)
    radius, (x_0, y_0) = 15.0, (1.0, -0.5)
    _, y, x = geometry.voxel_centres()
    part = (np.arange(16) + 0.5) / 16 - 0.5
    inside = (y[:, None] + part * d_voxel[1] - y_0)[:, None, :, None] ** 2
    inside = inside + (x[:, None] + part * d_voxel[2] - x_0)[None, :, None, :] ** 2 < radius**2
    volume = torch.from_numpy(np.broadcast_to(inside.mean((2, 3)), n_voxel).astype(np.float32))
    source, ray = rays(geometry)
    flat = ray[..., :2] / np.linalg.norm(ray[..., :2], axis=-1, keepdims=True)
    to = np.array([x_0, y_0]) - source[..., :2]
    miss = np.abs(to[..., 0] * flat[..., 1] - to[..., 1] * flat[..., 0])
    chord = 2 * np.sqrt(np.maximum(radius**2 - miss**2, 0)) / np.linalg.norm(ray[..., :2], axis=-1)
    error = forward(volume, geometry).numpy() - chord
    # A ray that crosses the wall steeply gains or loses at most half a step (√2 voxels / cos of the cone) at each
    # end; where its planes lie there is chance, so the mean is far smaller.
    step = np.sqrt(2) * max(d_voxel[1:]) * 1.02
    steep = miss < 0.7 * radius
    assert steep.sum() > 1000
    assert np.abs(error[steep]).max() < step
    assert abs(error[steep].mean()) < step / 50
    clear = miss > radius + np.hypot(*d_voxel[1:]) * 2
    assert clear.sum() > 100 and np.abs(error[clear]).max() == 0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: forward(torch.zeros(5, 7, 12), SMALL), r"\(5, 7, 11\)"),
        (lambda: forward(torch.zeros(SMALL.n_voxel, device="meta"), SMALL), "CPU"),
        (lambda: adjoint(torch.zeros(SMALL.shape), SMALL, [0]), r"\(1, 8, 15\)"),
        (lambda: adjoint(torch.zeros(SMALL.shape, device="meta"), SMALL), "CPU"),
        (lambda: forward(torch.zeros(SMALL.n_voxel), SMALL, [9]), "0 … 8"),
        (lambda: forward(torch.zeros(SMALL.n_voxel), SMALL, [-1]), "0 … 8"),
        (lambda: forward(torch.zeros(SMALL.n_voxel), SMALL, [0.5]), "indices"),  # type: ignore[list-item]
        (lambda: forward(torch.zeros(SMALL.n_voxel), SMALL, [0], rows=np.ones((2, 8), bool)), r"\[1, 8\]"),
    ],
)
def test_wrong_input_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
