"""Volumes of splats against float64, closed forms, their transpose and the ray-caster."""

import msgspec
import numpy as np
import pytest
import torch
from by_threads import one_and_several

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.projector import forward
from ctsim.reconstruct.splat.kernels import splat_reference as reference
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.volume import voxelise, voxelise_adjoint

SMALL = Geometry(
    dso=100.0,
    dsd=160.0,
    n_voxel=(5, 7, 11),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(20, 24),
    d_detector=(1.0, 1.1),
    n_views=4,
)


def with_(geometry=SMALL, **changes):
    return msgspec.structs.replace(geometry, **changes)


GRIDS = {
    "5 by 7 by 11": SMALL,
    "11 by 5 by 7": with_(n_voxel=(11, 5, 7)),
    "flat voxels, moved": with_(d_voxel=(0.4, 1.3, 0.9), off_origin=(1.0, -2.0, 0.7)),
    "wide rows": with_(n_voxel=(4, 3, 41)),
    "one voxel": with_(n_voxel=(1, 1, 1), d_voxel=(3.0, 2.0, 4.0)),
}
KINDS = ["round", "ellipsoids"]


def splats(n, kind, *, low=0.2, high=2.0, within=4.0, seed=1):
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(np.log(low), np.log(high), (n, 1 if kind == "round" else 3)))
    return Splats(
        positions=rng.uniform(-within, within, (n, 3)).astype(np.float32),
        scales=scales.astype(np.float32),
        densities=rng.uniform(0.1, 1, (n, 2)).astype(np.float32),
        rotations=None if kind == "round" else rng.standard_normal((n, 4)).astype(np.float32),
    )


def exact(given, geometry, mean, cutoff):
    first = [axis[0] for axis in geometry.voxel_centres()]
    grid = np.array([*geometry.d_voxel, *first, cutoff, 1 / 12 if mean else 0.0])
    return reference.voxelise(given.shapes(), given.densities, grid, geometry.n_voxel)


@pytest.mark.parametrize("mean", [True, False])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GRIDS)
def test_the_kernel_agrees_with_float64(name, kind, mean):
    given, geometry = splats(20, kind), GRIDS[name]
    got, wide = voxelise(given, geometry, mean=mean, cutoff=6.0), exact(given, geometry, mean, np.inf)
    assert got.dtype == np.float32 and wide.max() > 0.02
    # exponents of up to 18 and offsets of ξ are rounded to 6e-8 a few times; 20 splats of at most 1; exp(−18) beyond
    np.testing.assert_allclose(got, wide, rtol=0, atol=2e-6 * given.densities.max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_splat_ends_at_the_cutoff(kind):
    geometry = with_(n_voxel=(15, 17, 23), d_voxel=(0.7, 0.6, 0.5))
    for seed in range(5):
        given = splats(1, kind, high=1.0, within=1.0, seed=seed)
        got = voxelise(given, geometry)
        inside, wide = exact(given, geometry, True, 3.5), exact(given, geometry, True, np.inf)
        peak = wide.max()
        assert np.abs(got - inside)[inside > 0].max() < 1e-6 * peak
        # up to WIDTH − 1 voxels of a row may be there that lie beyond
        assert np.minimum(np.abs(got - wide), got)[inside == 0].max() < 1e-6 * peak
        assert (got[inside == 0] == 0).any()


def test_the_mean_over_a_voxel_is_right_to_second_order():
    """Against the mean of 12³ values in a voxel; what is left is of fourth order, exp(−k²/24) for sinc(k/2)."""
    worst = []
    for d in (0.5, 1.0):
        geometry = with_(n_voxel=(9, 9, 9), d_voxel=(d, d, d))
        fine = with_(n_voxel=(108, 108, 108), d_voxel=(d / 12, d / 12, d / 12))
        given = splats(1, "ellipsoids", low=0.99, high=1.5, within=0.4)
        parts = voxelise(given, fine, mean=False, cutoff=8.0).reshape(2, 9, 12, 9, 12, 9, 12)
        true, peak = parts.mean((2, 4, 6), dtype=float), given.densities.max()
        worst.append(np.abs(voxelise(given, geometry, cutoff=8.0) - true).max() / peak)
        # log sinc(k/2) + k²/24 = −k⁴/2880 in each axis, and the fourth derivative of a Gaussian is at most 3/σ⁴
        assert worst[-1] < 1.1 * 3 * 3 * (d / 0.99) ** 4 / 2880
        assert worst[-1] < 0.2 * np.abs(voxelise(given, geometry, mean=False, cutoff=8.0) - true).max() / peak
    assert worst[0] < worst[1] / 8


@pytest.mark.parametrize("scale", [0.01, 0.3, 1.0])
def test_the_mean_over_voxels_keeps_the_mass(scale):
    geometry, masses = with_(n_voxel=(16, 16, 16)), []
    shifts = np.arange(4) / 4
    for z in shifts:
        for y in shifts:
            for x in shifts:
                given = Splats(
                    positions=np.array([[x, y, z]], np.float32),
                    scales=np.array([[scale, scale / 2, scale]], np.float32),
                    densities=np.ones((1, 1), np.float32),
                    rotations=np.array([[1, 2, 3, 4]], np.float32),
                )
                masses.append(voxelise(given, geometry, cutoff=6.0).sum(dtype=float))
    # over all places in a voxel only the fourth harmonic is left, exp(−2π²·16/12) = 4e-12; exp(−18) beyond the cutoff
    assert np.mean(masses) == pytest.approx((2 * np.pi) ** 1.5 * scale**3 / 2, rel=2e-6)


@pytest.mark.parametrize("mean", [True, False])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GRIDS)
def test_adjoint_is_the_transpose(name, kind, mean):
    given, geometry, rng = splats(30, kind), GRIDS[name], np.random.default_rng(3)
    values = rng.standard_normal((30, 3)).astype(np.float32)
    there = voxelise(given, geometry, values, mean=mean)
    volume = rng.standard_normal(there.shape).astype(np.float32)
    back = voxelise_adjoint(given, geometry, volume, mean=mean)
    left, right = (there.astype(float) * volume).sum(), (values.astype(float) * back).sum()
    # the same float32 weights both ways
    assert abs(left - right) < 1e-6 * np.linalg.norm(there.astype(float)) * np.linalg.norm(volume.astype(float))


def test_thread_count_changes_no_bit():
    given, geometry = splats(200, "ellipsoids", within=8.0), with_(n_voxel=(37, 20, 33), d_voxel=(0.5, 0.5, 0.5))

    def volumes():
        volume = voxelise(given, geometry)
        return volume, voxelise_adjoint(given, geometry, volume)

    one, several = one_and_several(volumes)
    assert all(np.array_equal(a, b) for a, b in zip(one, several, strict=True))


@pytest.mark.parametrize("mean", [True, False])
@pytest.mark.parametrize("value", [0.0, 1e-30, np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("what", ["positions", "scales", "rotations", "densities"])
def test_odd_splats_are_finite_and_spoil_no_other(what, value, mean):
    given = splats(2, "ellipsoids", low=0.5)
    arrays = {name: getattr(given, name).copy() for name in ("positions", "scales", "rotations", "densities")}
    arrays[what][0] = value
    volume = voxelise(Splats(**arrays), SMALL, mean=mean)
    other = voxelise(Splats(**{name: array[1:] for name, array in arrays.items()}), SMALL, mean=mean)
    assert np.all(np.isfinite(volume)) and other.max() > 0 and np.all(volume >= other * np.float32(1 - 1e-6))
    assert np.all(np.isfinite(voxelise_adjoint(Splats(**arrays), SMALL, np.ones_like(volume), mean=mean)))


def test_no_splats_give_zeros_and_wrong_input_is_refused():
    none = splats(0, "round")
    assert not voxelise(none, SMALL).any() and voxelise(none, SMALL).shape == (2, 5, 7, 11)
    assert voxelise_adjoint(none, SMALL, np.ones((2, 5, 7, 11), np.float32)).shape == (0, 2)
    with pytest.raises(InputError, match="values must be float32"):
        voxelise(none, SMALL, np.ones((1, 1), np.float32))
    with pytest.raises(InputError, match="the volume must be float32"):
        voxelise_adjoint(none, SMALL, np.ones((2, 7, 5, 11), np.float32))


@pytest.mark.parametrize("kind", KINDS)
def test_the_ray_caster_sees_in_the_volume_what_the_projector_sees_in_the_splats(kind):
    worst = []
    for d in (0.5, 0.25):
        n = round(28 / d)
        geometry = with_(n_voxel=(n, n, n), d_voxel=(d, d, d), off_detector=(2.0, -3.0))
        given = splats(6, kind, low=1.2, high=1.8, within=3.0)
        seen = Projector(geometry=geometry, tolerance=0.0, box=False, cutoff=6.0)
        images = seen.forward(given.shapes(), given.densities)[..., :-WIDTH]
        volume = voxelise(given, geometry, mean=False, cutoff=6.0)
        for c in range(2):
            rays = forward(torch.from_numpy(volume[c]), geometry).numpy()
            worst.append(np.abs(rays - images[:, c]).max() / images[:, c].max())
            # bilinear interpolation errs by at most h²/8 (|f_aa| + |f_bb|), and ∫|f_aa| ≤ max P/σ²
            assert worst[-1] < d**2 / (4 * 1.2**2)
            assert worst[-1] > d**2 / (400 * 1.2**2)
    assert max(worst[2:]) < max(worst[:2]) / 3  # second order
