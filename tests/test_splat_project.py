"""Projections of splats against quadrature, float64, closed forms and their own transpose."""

import dataclasses

import msgspec
import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat import project
from ctsim.reconstruct.splat.kernels import splat_reference as reference
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector

SMALL = Geometry(
    dso=100.0,
    dsd=160.0,
    n_voxel=(8, 8, 8),
    d_voxel=(3.0, 3.0, 3.0),
    n_detector=(23, 30),
    d_detector=(1.3, 1.1),
    n_views=3,
    start_deg=7.0,
)


def with_(geometry=SMALL, **changes):
    return msgspec.structs.replace(geometry, **changes)


def tilted():
    """Poses that stand askew, whose pixels are no rectangles and whose rays come in at a slant."""
    poses = with_(off_detector=(3.0, -4.0)).pose_array().reshape(-1, 4, 3)
    turn = np.linalg.qr(np.array([[9.0, 1, -2], [-1, 8, 3], [2, -3, 9]]))[0]
    source, centre, e_u, e_v = poses.transpose(1, 0, 2)
    poses = np.stack([source, centre, e_u + 0.2 * e_v + 0.02 * source / 100, e_v - 0.1 * e_u], 1) @ turn.T
    return with_(poses=tuple(map(tuple, poses.reshape(-1, 12).tolist())))


GEOMETRIES = {
    "centred": SMALL,
    "detector offset": with_(off_detector=(5.0, -8.0)),
    "5 by 7": with_(n_detector=(5, 7), d_detector=(4.0, 5.0)),
    "7 by 5": with_(n_detector=(7, 5), d_detector=(4.0, 5.0)),
    "tilted": tilted(),
}
KINDS = ["round", "ellipsoids"]


def splats(n, kind, *, low=0.3, high=3.0, within=10.0, seed=1):
    """Splats with scales between `low` and `high` mm, in a cube of half-width `within` mm."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(np.log(low), np.log(high), (n, 1 if kind == "round" else 3)))
    return Splats(
        positions=rng.uniform(-within, within, (n, 3)).astype(np.float32),
        scales=scales.astype(np.float32),
        densities=rng.uniform(0.1, 1, (n, 2)).astype(np.float32),
        rotations=None if kind == "round" else rng.standard_normal((n, 4)).astype(np.float32),
    )


def one(position, scales, rotation=(1, 0, 0, 0)):
    arrays = (np.array([v], np.float32) for v in (position, scales, rotation))
    names = ("positions", "scales", "rotations")
    return Splats(**dict(zip(names, arrays, strict=True)), densities=np.ones((1, 1), np.float32))


def alone(projector, shapes):
    """Project every splat by itself with density 1: [splat, view, v, u]."""
    density = np.ones((1, 1), np.float32)
    columns = (np.ascontiguousarray(shapes[:, i : i + 1]) for i in range(shapes.shape[1]))
    return np.stack([projector.forward(column, density)[:, 0, :, :-WIDTH] for column in columns])


def expected(projector, shapes, cutoff=np.inf):
    """The reference's weights, [splat, view, v, u], and the peaks [splat, view, 1, 1]."""
    cameras = projector.cameras.copy()
    cameras[:, 12] = cutoff
    w = np.stack([reference.weights(shapes, c, *projector.geometry.n_detector) for c in cameras], 1)
    return w, np.stack([reference.peaks(shapes, c) for c in cameras], 1)[:, :, None, None]


def check(projector, shapes, share):
    """Hold the kernel within `share` of a splat's peak; what is beyond the cutoff may be there or be zero."""
    got, (w, peak) = alone(projector, shapes), expected(projector, shapes)
    error, inside = np.abs(got - w) / peak, expected(projector, shapes, projector.cutoff)[0] > 0
    assert inside.sum() >= 5
    assert error[inside].max() < share
    assert np.minimum(error, np.abs(got) / peak)[~inside].max(initial=0.0) < share


def integrals(shapes, camera, n_v, n_u):
    """Line integrals of the Gaussians by the trapezoidal rule over ±9 of their standard deviations on the ray."""
    source, across, e_u, e_v = camera[:12].reshape(4, 3)
    v, u = np.meshgrid(np.arange(n_v), np.arange(n_u), indexing="ij")
    ray = across + u[..., None] * e_u + v[..., None] * e_v
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    precision = np.linalg.inv(reference.covariances(shapes)[0])
    c = np.asarray(shapes[:3], np.float64).T - source
    a = np.einsum("vua,iab,vub->ivu", ray, precision, ray)
    nearest = np.einsum("vua,iab,ib->ivu", ray, precision, c) / a
    t, total = np.linspace(-9, 9, 73), 0.0  # the rule errs by exp(−2π²/step²)
    for step in t:
        x = (nearest + step / np.sqrt(a))[..., None] * ray - c[:, None, None]
        total = total + np.exp(-0.5 * np.einsum("ivua,iab,ivub->ivu", x, precision, x))
    return total * (t[1] - t[0]) / np.sqrt(a)


@pytest.mark.slow
@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_exact_form_is_the_integral_along_the_ray(name, kind):
    projector = Projector(geometry=GEOMETRIES[name], tolerance=0.0, box=False)
    shapes = splats(7, kind).shapes()
    w, peak = expected(projector, shapes)
    n = projector.geometry.n_detector
    exact = np.stack([integrals(shapes, camera, *n) for camera in projector.cameras], 1)
    # float64 twice; the shadow's place and conic lose a few digits to differences of coordinates of 100 mm
    assert np.abs(w - exact).max() < 1e-9 * peak.max()
    # the kernel itself: float32 offsets and coefficients in exponents of up to cutoff²/2, rounded to 6e-8 a few times
    inside = expected(projector, shapes, projector.cutoff)[0] > 0
    error = np.abs(alone(projector, shapes) - exact) / peak
    assert error[inside].max() < 1e-5


@pytest.mark.parametrize("box", [True, False])
@pytest.mark.parametrize("tolerance", [0.0, np.inf])
@pytest.mark.parametrize("name, kind", [("centred", "round"), ("tilted", "ellipsoids"), ("5 by 7", "ellipsoids")])
def test_the_kernel_agrees_with_float64(name, kind, tolerance, box):
    # 16 rows by multiplication: 120 factors exp(−C_vv), each within 3e-8 when rounded, are 4e-6 of a value
    projector = Projector(geometry=GEOMETRIES[name], tolerance=tolerance, box=box)
    check(projector, splats(20, kind).shapes(), 1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_splats_take_the_cheap_form_where_that_is_within_the_tolerance(kind):
    shapes = splats(30, kind, low=0.1, high=6.0).shapes()
    exact = Projector(geometry=SMALL, tolerance=0.0)
    w, peak = expected(exact, shapes)
    inside = expected(exact, shapes, exact.cutoff)[0] > 0
    for tolerance in (1e-3, 1e-2, 0.1):
        error = np.abs(alone(Projector(geometry=SMALL, tolerance=tolerance), shapes) - w) / peak
        assert np.where(inside, error, 0).max() < tolerance
    assert np.where(inside, error, 0).max() > 1e-4  # and some did


def test_ewa_errs_in_proportion_to_the_scale_and_no_more_than_known():
    """R2-Gaussian's scanner: the source is 2.5 widths of the volume away. Splats are half as thick in two axes."""
    width, camera = SMALL.dso / 2.5, Projector(geometry=SMALL, box=False).cameras[0]
    worst = {}
    for share in (0.0025, 0.005, 0.01, 0.05, 0.1):
        errors = []
        for seed in range(12):
            given = splats(1, "ellipsoids", within=0.4 * width, seed=seed)
            scales = np.array([[1, 0.5, 0.5]], np.float32) * np.float32(share * width)
            shapes = dataclasses.replace(given, scales=scales).shapes()
            near = camera.copy()  # 41² pixels of half a σ around the shadow
            near[6:12] *= np.repeat(0.5 * share * width * SMALL.dsd / SMALL.dso / np.array([1.1, 1.3]), 3)
            near[3:6] = reference.shadow(shapes, camera)[2][0] - 20 * near[6:9] - 20 * near[9:12]
            exact, ewa = near.copy(), near.copy()
            exact[12:14], ewa[12:14] = (np.inf, 0.0), (np.inf, np.inf)
            difference = reference.weights(shapes, ewa, 41, 41) - reference.weights(shapes, exact, 41, 41)
            errors.append(np.abs(difference).max() / reference.peaks(shapes, near)[0])
        worst[share] = max(errors)
    assert worst[0.01] < 0.003 and worst[0.05] < 0.017 and worst[0.1] < 0.04
    # first order: half the scale, half the error, up to the second order's share
    assert worst[0.0025] == pytest.approx(worst[0.005] / 2, rel=0.1)
    assert worst[0.0025] > 1e-5


@pytest.mark.parametrize("scale", [0.01, 0.1, 0.3, 1.0, 4.0])
def test_a_box_keeps_the_mass(scale):
    """The sum over pixels is the Gaussian's mass, (2π)^1.5 det Σ^½ |v_c|/(τ²V), up to sampling."""
    geometry = with_(n_detector=(90, 90), d_detector=(1.0, 1.0), n_views=1)
    projector = Projector(geometry=geometry, tolerance=np.inf, cutoff=6.0)
    shift = np.arange(8) / 8 * SMALL.dso / SMALL.dsd  # over one pixel in u and v, in mm at the isocentre
    masses, bounds = [], []
    camera = projector.cameras[0]
    e_r, e_u = camera[:3] / SMALL.dso, camera[6:9]
    for a in shift:
        for b in shift:
            shapes = one(a * e_u + b * np.array([0, 0, 1]), [scale, scale / 2, scale / 3], (1, 2, 3, 4)).shapes()
            ray = reference.shadow(shapes, camera)[2][0]
            volume = (2 * np.pi) ** 1.5 * np.prod(shapes[3:6].astype(float))
            depth = (SMALL.dso / SMALL.dsd) ** 2 * (camera[3:6] @ -e_r)
            mass = volume * np.linalg.norm(ray) / depth
            masses.append(projector.forward(shapes, np.ones((1, 1), np.float32)).sum(dtype=float) / mass)
            variances = np.linalg.eigvalsh(reference.spreads(shapes, camera)[1])[0]
            # Poisson's sum formula: the frequencies 1, 0 and beyond in both axes, each exp(−2π²σ²k²)
            bounds.append((1 + 2 * np.exp(-2 * np.pi**2 * variances[0]) * 1.01) ** 2 - 1)
    assert np.all(np.abs(np.array(masses) - 1) < np.array(bounds) + 1e-5)
    # over all places within a pixel they average out, but for the shadow's change over that pixel, 1/160 of its size
    assert np.mean(masses) == pytest.approx(1, abs=2e-4)


ODD = {
    "needle": ([0, 0, 0], [20, 1e-3, 1e-3], (1, 0.3, 0.2, 0.1)),
    "needle towards the source": ([0, 0, 0], [20, 1e-3, 1e-3], (1, 0, 0, 0.06)),
    "disc": ([0, 0, 0], [8, 8, 1e-4], (1, 0.3, 0.2, 0.1)),
    "point": ([1, 1, 1], [1e-6, 1e-6, 1e-6], (1, 0, 0, 0)),
    "vanishing": ([1, 1, 1], [1e-30, 1e-30, 1e-30], (1, 0, 0, 0)),
    "huge": ([1, 1, 1], [1e6, 1e6, 1e6], (1, 0, 0, 0)),
    "immense": ([1, 1, 1], [1e30, 1e30, 1e30], (1, 0, 0, 0)),
    "behind the source": ([300, 40, 0], [2, 2, 2], (1, 0, 0, 0)),
    "at the source": (SMALL.pose(0)[:3], [2, 2, 2], (1, 0, 0, 0)),
    "beside the source": (SMALL.pose(0)[:3] + np.array([0, 0, 5]), [2, 2, 2], (1, 0, 0, 0)),
    "outside the field": ([0, 0, 500], [2, 2, 2], (1, 0, 0, 0)),
    "far away": ([1e30, -1e30, 1e30], [2, 2, 2], (1, 0, 0, 0)),
    "no extent": ([1, 1, 1], [0, 0, 0], (1, 0, 0, 0)),
    "no thickness": ([1, 1, 1], [3, 2, 0], (1, 0.3, 0.2, 0.1)),
    "NaN scale": ([1, 1, 1], [np.nan, 1, 1], (1, 0, 0, 0)),
    "infinite scale": ([1, 1, 1], [np.inf, 1, 1], (1, 0, 0, 0)),
    "NaN position": ([np.nan, 1, 1], [1, 1, 1], (1, 0, 0, 0)),
    "infinite position": ([1, -np.inf, 1], [1, 1, 1], (1, 0, 0, 0)),
    "no rotation": ([1, 1, 1], [1, 1, 1], (0, 0, 0, 0)),
    "NaN rotation": ([1, 1, 1], [1, 1, 1], (np.nan, 0, 0, 0)),
}
SHADOWLESS = list(ODD)[4:5] + list(ODD)[7:9] + list(ODD)[10:]


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("tolerance", [0.0, 1e-3, np.inf])
@pytest.mark.parametrize("box", [True, False])
def test_odd_splats_are_finite_and_spoil_no_other(name, tolerance, box):
    projector = Projector(geometry=with_(n_views=1), tolerance=tolerance, box=box)
    odd, fair = one(*ODD[name]).shapes(), one([1, 2, -1], [1, 2, 1.5], (1, 2, 3, 4)).shapes()
    density = np.ones((2, 1), np.float32)
    image = projector.forward(np.concatenate([odd, fair], 1), density)
    other = projector.forward(fair, density[:1])
    assert np.all(np.isfinite(image)) and other.max() > 0
    # the odd one comes first, and what comes after it in the same chunk is all there
    assert np.all(image >= other * np.float32(1 - 1e-6))
    if name in SHADOWLESS:
        assert np.array_equal(image, other)
    sums = projector.adjoint(np.concatenate([odd, fair], 1), np.ones_like(image))
    assert np.all(np.isfinite(sums)) and sums[1] == projector.adjoint(fair, np.ones_like(image))[0]
    assert sums[0] >= 0 and (name not in SHADOWLESS or sums[0] == 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_density_that_is_not_finite_is_left_out(value):
    projector, shapes = Projector(geometry=SMALL), splats(2, "round").shapes()
    values = np.array([[value, 1], [1, 2]], np.float32)
    assert np.array_equal(projector.forward(shapes, values), projector.forward(shapes[:, 1:].copy(), values[1:]))


@pytest.mark.parametrize("kind", KINDS)
def test_no_splats_and_no_views_give_zeros(kind):
    projector, shapes = Projector(geometry=SMALL), splats(0, kind).shapes()
    assert not projector.forward(shapes, np.zeros((0, 2), np.float32)).any()
    assert projector.adjoint(shapes, np.ones((3, 2, 23, 30 + WIDTH), np.float32)).shape == (0, 2)
    some = splats(3, kind)
    assert projector.forward(some.shapes(), some.densities, []).shape == (0, 2, 23, 30 + WIDTH)
    assert not projector.adjoint(some.shapes(), np.ones((0, 2, 23, 30 + WIDTH), np.float32), []).any()


@pytest.mark.parametrize(
    "name, kind", [("detector offset", "round"), ("7 by 5", "ellipsoids"), ("tilted", "ellipsoids")]
)
def test_sums_over_many_splats_and_over_pixels_agree_with_float64(name, kind):
    projector, given = Projector(geometry=GEOMETRIES[name], tolerance=np.inf, cutoff=6.0), splats(40, kind)
    there = projector.forward(given.shapes(), given.densities)
    stack = np.zeros((3, 2 * there.shape[2], there.shape[3]))
    reference.forward_views(given.shapes(), given.densities, projector.cameras, stack)
    peak = max(reference.peaks(given.shapes(), camera).max() for camera in projector.cameras)
    # one splat's error is 1e-5 of its peak at worst, and no more than a few of them meet in a pixel
    np.testing.assert_allclose(there, stack.reshape(there.shape), rtol=0, atol=3e-5 * peak)
    back, sums = projector.adjoint(given.shapes(), there), np.zeros((40, 2))
    reference.backward_views(given.shapes(), projector.cameras, stack, sums)
    np.testing.assert_allclose(back, sums, rtol=0, atol=1e-5 * sums.max())


@pytest.mark.parametrize("tolerance", [0.0, np.inf])
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("name, kind", [("centred", "round"), ("5 by 7", "round"), ("7 by 5", "ellipsoids")])
def test_adjoint_is_the_transpose(name, kind, channels, tolerance):
    projector, given = Projector(geometry=GEOMETRIES[name], tolerance=tolerance), splats(40, kind, within=25.0)
    rng = np.random.default_rng(5)
    values = rng.standard_normal((40, channels)).astype(np.float32)
    there = projector.forward(given.shapes(), values)
    images = rng.standard_normal(there.shape).astype(np.float32)
    back = projector.adjoint(given.shapes(), images)
    left, right = (there.astype(float) * images).sum(), (values.astype(float) * back).sum()
    # both take the same float32 weights; only the products and sums are rounded apart
    assert abs(left - right) < 1e-5 * np.linalg.norm(there.astype(float)) * np.linalg.norm(images.astype(float))


def test_the_transpose_at_a_slant_and_with_four_channels():
    projector, given = Projector(geometry=tilted()), splats(40, "ellipsoids")
    there = projector.forward(given.shapes(), given.densities)
    both = np.concatenate([there, there[:, ::-1] * 2], 1)
    back = projector.adjoint(given.shapes(), both)
    left, right = (there.astype(float) ** 2).sum(), (given.densities.astype(float) * back[:, :2]).sum()
    assert left == pytest.approx(right, rel=1e-5)
    assert np.array_equal(back[:, :2], projector.adjoint(given.shapes(), there))
    assert np.array_equal(back[:, 2:], 2 * back[:, 1::-1])


def test_columns_beyond_the_detector_are_zero_and_not_read():
    projector, given = Projector(geometry=with_(d_detector=(0.5, 0.5))), splats(40, "ellipsoids")
    images = projector.forward(given.shapes(), given.densities)
    assert not images[..., -WIDTH:].any() and images[..., -WIDTH - 1].any()
    spoiled = images.copy()
    spoiled[..., -WIDTH:] = 1e3
    assert np.array_equal(projector.adjoint(given.shapes(), spoiled), projector.adjoint(given.shapes(), images))


def test_thread_count_changes_no_bit():
    geometry = with_(n_detector=(150, 40), d_detector=(0.3, 1.0), n_views=17)
    projector, given = Projector(geometry=geometry), splats(300, "ellipsoids")

    def images():
        many = projector.forward(given.shapes(), given.densities)
        single = projector.forward(given.shapes(), given.densities, [3])
        return many, single, projector.adjoint(given.shapes(), many)

    one, several = one_and_several(images)
    assert all(np.array_equal(a, b) for a, b in zip(one, several, strict=True))
    many, single, _ = one
    assert np.array_equal(single[0], many[3])


def test_bands_of_rows_change_no_bit(monkeypatch):
    geometry = with_(n_detector=(150, 40), d_detector=(0.3, 1.0), n_views=1)
    projector, given = Projector(geometry=geometry), splats(300, "ellipsoids")
    results = []
    for tasks in (1, 3, 50):
        monkeypatch.setattr(project, "TASKS", tasks)
        results.append(projector.forward(given.shapes(), given.densities))
    assert np.array_equal(results[0], results[1]) and np.array_equal(results[0], results[2])


def test_a_long_thin_splat_across_the_pixels_keeps_its_ridge():
    """Its values rise by a hundred decades within a block, from which multiplication alone would not come back."""
    geometry = with_(n_detector=(60, 60), d_detector=(1.6, 1.6), n_views=1, start_deg=0.0)
    for turn in (0.39, -0.39, 0.2):
        shapes = one([0, 0, 0], [0.02, 0.02, 15], (np.cos(turn), np.sin(turn), 0, 0)).shapes()
        for box in (True, False):
            check(Projector(geometry=geometry, tolerance=np.inf, box=box), shapes, 1e-5)


def test_a_needle_loses_no_digits():
    """The determinant of its shadow is 10⁻¹⁴ of the products that it is the difference of."""
    geometry = with_(n_detector=(23, 31), n_views=1, start_deg=0.0)
    shapes = one([0, 0, 0], [1e-6, 1e-6, 20], (np.cos(0.39), np.sin(0.39), 0, 0)).shapes()
    for tolerance in (0.0, np.inf):
        image = Projector(geometry=geometry, tolerance=tolerance, box=False).forward(
            shapes, np.ones((1, 1), np.float32)
        )
        assert image[0, 0, 11, 15] == pytest.approx(np.sqrt(2 * np.pi) * 1e-6, rel=1e-5)  # across the needle


def test_a_tall_splat_is_as_exact_as_others():
    """Rows by multiplication err with the square of their number, so they start anew now and then."""
    geometry = with_(n_detector=(400, 12), d_detector=(0.2, 1.6), n_views=1, start_deg=0.0)
    shapes = one([0, 0, 0], [1, 1, 8]).shapes()
    check(Projector(geometry=geometry, tolerance=np.inf), shapes, 1e-5)


def test_wrong_input_is_refused():
    projector, given = Projector(geometry=SMALL), splats(3, "round")
    shapes, images = given.shapes(), np.zeros((3, 2, 23, 38), np.float32)
    with pytest.raises(InputError, match="values must be float32 of shape"):
        projector.forward(shapes, np.ones((3, 3), np.float32))
    with pytest.raises(InputError, match="values must be float32"):
        projector.forward(shapes, given.densities.astype(float))
    with pytest.raises(InputError, match="shapes must be float32"):
        projector.forward(shapes.astype(float), given.densities)
    with pytest.raises(InputError, match="images must be float32"):
        projector.adjoint(shapes, images[..., :30])
    with pytest.raises(InputError, match="images must be float32"):
        projector.adjoint(shapes, np.zeros((3, 3, 23, 38), np.float32))
    with pytest.raises(InputError, match="scales of splats"):
        Splats(positions=given.positions, scales=np.ones((3, 3), np.float32), densities=given.densities)
