"""The ray tracer against its float64 twin, closed forms, and itself with every skip turned off."""

import dataclasses
import math

import msgspec
import numba
import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.beam.quadrature import energy_rule
from ctsim.beam.spectrum import Tube, spectrum
from ctsim.detector.response import Detector
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid
from ctsim.tracer import project
from ctsim.tracer.columns import Columns, DensityColumns
from ctsim.tracer.kernels import raytrace_cpu, raytrace_reference
from ctsim.tracer.kernels.exp_cpu import exp_minus
from ctsim.tracer.project import Response, Tracer, path_lengths, transmit, work_order
from ctsim.types import Phantom

MATERIALS = ("air", "water", "cortical_bone", "Fe", "Ti")


def solid(kind, params, centre=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), material="Fe", metal=True):
    piece = Primitive(kind=kind, centre=centre, params=params, axis=axis)
    return Solid(name="solid", material=material, primitives=(piece,), metal=metal)


def geometry(n_detector=(9, 13), n_views=5, pixel=5.0, **kw):
    return Geometry(
        dso=200.0, dsd=400.0, n_voxel=(8, 8, 8), d_voxel=(1.0,) * 3, n_detector=n_detector,
        d_detector=(pixel, pixel), n_views=n_views, **kw,
    )  # fmt: skip


def blobs(shape=(5, 7, 11), seed=0, **kw):
    """A body of unequal axis lengths in which uniform and mixed bricks alternate."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 3, [-(-s // 3) for s in shape])
    labels = np.kron(coarse, np.ones((3, 3, 3))).astype(np.uint8)[: shape[0], : shape[1], : shape[2]]
    return Phantom(labels=labels, materials=MATERIALS, d_voxel=(3.1, 2.3, 1.7), off_origin=(0.4, -1.1, 0.7), **kw)


INSERTS = (
    solid(ELLIPSOID, (4.0, 2.0, 3.0), (1.0, 2.0, 0.5), (1.0, 1.0, 0.3)),
    solid(FRUSTUM, (5.0, 2.0, 1.0), (-3.0, -1.0, 0.0), (0.2, 0.1, 1.0), "Ti"),
    solid(CAPSULE, (4.0, 1.0), (3.0, -4.0, 1.0), (1.0, 0.0, 0.2)),
    solid(BOX, (1.0, 2.0, 3.0), (2.1, 2.2, -1.0), (0.3, 0.0, 1.0), "air"),
    solid(TORUS, (4.0, 0.7), (-2.0, 3.0, 0.0), (0.1, 1.0, 0.4)),
)


def reference_lengths(tracer, geometry, view):
    lengths = np.zeros((len(tracer.materials), *geometry.n_detector))
    raytrace_reference.trace_view(tracer.bricks, tracer.prims, geometry.pose_array()[view], lengths)
    return lengths


@pytest.mark.slow
@pytest.mark.parametrize("solids", [(), INSERTS], ids=["body", "body and solids"])
@pytest.mark.parametrize("dense", [False, True])
def test_path_lengths_equal_the_reference(solids, dense):
    density = np.random.default_rng(1).uniform(0.5, 1.5, (5, 7, 11)).astype(np.float32) if dense else None
    tracer = Tracer.of(blobs(solids=solids, density=density))
    g = geometry(off_detector=(1.3, -2.0), start_deg=11.0)
    for view in range(g.n_views):
        # float32 output of lengths up to 30 mm: half an ulp is 1e-6 mm, the density map is float32 too
        got, want = path_lengths(tracer, g, view), reference_lengths(tracer, g, view)
        np.testing.assert_allclose(got, want, atol=4e-6)
        assert want[1].max() > 1


def heights(g, *z):
    """Return the geometry with source and detector of view k lifted by z[k], as on a helix."""
    poses = g.pose_array()
    poses[:, [2, 5]] += np.array(z)[:, None]
    return msgspec.structs.replace(g, poses=tuple(tuple(map(float, row)) for row in poses))


def with_density(labels, d_voxel, **kw):
    """A phantom of the labels in which every voxel, of air too, has a density of its own."""
    density = np.random.default_rng(8).uniform(0.2, 1.8, labels.shape).astype(np.float32)
    return Phantom(labels=labels, materials=MATERIALS, d_voxel=d_voxel, density=density, **kw)


NEAR = geometry(n_detector=(10, 6), n_views=2, pixel=6.0, start_deg=20.0)
DENSE = {
    "helix": (heights(geometry(n_views=3, start_deg=5.0), -31.0, 2.2, 40.0), (3.1, 2.3, 1.7), (0.4, -1.1, 0.7)),
    "along z-faces": (geometry(n_detector=(7, 3), n_views=2, pixel=4.0), (2.0, 3.0, 4.0), (-5.0, 0.0, 0.0)),
    "thin slices": (geometry(n_detector=(12, 3), n_views=2, pixel=2.0), (0.02, 9.0, 8.0), (0.5, 0.0, 0.0)),
    "source near": (msgspec.structs.replace(NEAR, dso=14.0, dsd=30.0), (3.1, 2.3, 1.7), (0.4, -1.1, 0.7)),
    "source inside": (msgspec.structs.replace(NEAR, dso=5.0, dsd=12.0), (3.1, 2.3, 1.7), (0.4, -1.1, 0.7)),
    "detector inside": (msgspec.structs.replace(NEAR, dsd=203.0, d_detector=(2.0, 2.0)), (3.1, 2.3, 1.7), (0.0,) * 3),
    "one row": (geometry(n_detector=(1, 9), n_views=3, start_deg=1.0), (3.1, 2.3, 1.7), (0.4, -1.1, 0.7)),
    "missed": (geometry(n_views=2, off_detector=(4000.0, 900.0)), (3.1, 2.3, 1.7), (0.0,) * 3),
    "far off": (geometry(n_views=1, off_detector=(4.0, -7.0)), (3.1, 2.3, 1.7), (0.0, 3.0, -9000.0)),
    "turned away": (geometry(n_views=1, off_detector=(-170.0, 0.0)), (3.1, 2.3, 1.7), (-90.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("case", DENSE)
def test_a_density_map_is_crossed_as_in_the_reference(case):
    g, d_voxel, off_origin = DENSE[case]
    labels = np.random.default_rng(4).integers(0, 4, (5, 7, 11)).astype(np.uint8)
    tracer = Tracer.of(with_density(labels, d_voxel, off_origin=off_origin))
    assert isinstance(tracer.columns, DensityColumns)
    met = 0.0
    for view in range(g.n_views):
        got, want = path_lengths(tracer, g, view), reference_lengths(tracer, g, view)
        # float32 output of lengths up to 60 mm times a density of float32
        np.testing.assert_allclose(got, want, atol=4e-6)
        assert got.min() == 0
        met = max(met, want.max())
    assert (met > 1) == (case not in ("missed", "far off"))


def test_rays_in_the_faces_of_voxels_meet_the_density_on_both_sides():
    labels = np.random.default_rng(4).integers(0, 4, (3, 4, 6)).astype(np.uint8)
    density = np.random.default_rng(8).uniform(0.2, 1.8, labels.shape).astype(np.float32)
    pairs = [a.repeat(2, 0).repeat(2, 1).repeat(2, 2) for a in (labels, density)]  # equal on both sides of the faces
    tracer = Tracer.of(
        Phantom(labels=pairs[0], materials=MATERIALS, d_voxel=(2.0,) * 3, off_origin=(0.0, 2.0, 2.0), density=pairs[1])
    )
    g = geometry(n_detector=(5, 5), n_views=4)
    for view in range(4):  # the middle row and column run in faces
        got, want = path_lengths(tracer, g, view), reference_lengths(tracer, g, view)
        np.testing.assert_allclose(got, want, atol=4e-6)
        assert want[1:, 2, 2].sum() > 1


def test_runs_that_lie_apart_and_solids_on_them_are_crossed_as_in_the_reference():
    labels = np.zeros((61, 5, 7), np.uint8)
    labels[2:9], labels[26:30], labels[33:], labels[40:55:2, 1:4] = 1, 1, 2, 1  # gaps above and below MERGED
    labels[-1], labels[0, 2, 3] = 3, 2
    tracer = Tracer.of(with_density(labels, (0.5, 3.0, 2.0), solids=INSERTS))
    g = geometry(n_detector=(17, 7), n_views=2, pixel=4.0, start_deg=31.0)
    for view in range(g.n_views):
        got, want = path_lengths(tracer, g, view), reference_lengths(tracer, g, view)
        np.testing.assert_allclose(got, want, atol=4e-6)
        assert want[1].max() > 1 and want[3].max() > 1


def test_a_density_map_without_material_has_no_length():
    labels = np.zeros((5, 7, 11), np.uint8)
    assert not path_lengths(Tracer.of(with_density(labels, (1.0, 1.0, 1.0))), geometry(), 1).any()


def tilted(g, degrees):
    """Return the geometry with every detector turned in its plane, which no longer stands upright."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    poses = g.pose_array().reshape(-1, 4, 3)
    e_u, e_v = poses[:, 2].copy(), poses[:, 3].copy()
    poses[:, 2], poses[:, 3] = cos * e_u + sin * e_v, cos * e_v - sin * e_u
    rows = tuple(tuple(float(x) for x in row) for row in poses.reshape(-1, 12))
    return msgspec.structs.replace(g, poses=rows)


@pytest.mark.parametrize("dense", [False, True])
def test_a_tilted_detector_is_traced_through_bricks_to_the_same_accuracy(dense):
    body = blobs(solids=INSERTS)
    tracer = Tracer.of(with_density(body.labels, body.d_voxel, solids=INSERTS) if dense else body)
    g = tilted(geometry(off_detector=(1.3, -2.0), start_deg=11.0), 7.0)
    for view in range(g.n_views):
        got, want = path_lengths(tracer, g, view), reference_lengths(tracer, g, view)
        np.testing.assert_allclose(got, want, atol=4e-6)


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("inside", [False, True])
def test_columns_and_bricks_cross_the_same_lengths(inside, dense):
    rng = np.random.default_rng(5)
    labels = rng.integers(0, 3, (37, 29, 33)).astype(np.uint8)
    where = {"d_voxel": (1.1, 0.9, 1.3), "off_origin": (3.0, 0.0, -1.0)}
    plain = Phantom(labels=labels, materials=MATERIALS, **where)
    tracer = Tracer.of(with_density(labels, **where) if dense else plain)
    assert isinstance(tracer.columns, DensityColumns if dense else Columns)
    g = geometry(n_detector=(45, 51), pixel=2.1, start_deg=1.0, off_detector=(7.0, 3.0))
    if inside:  # a source in the volume, a detector that cuts it, the steepest cone
        g = msgspec.structs.replace(g, dso=9.0, dsd=21.0)
    through_bricks = dataclasses.replace(tracer, columns=None)
    for view in range(g.n_views):
        got, want = tracer.background(g, view), through_bricks.background(g, view)
        # float32 output of lengths up to 50 mm
        np.testing.assert_allclose(got, want, atol=8e-6)
        assert np.array_equal(got == 0, want == 0) and want[1].max() > 10


def test_a_large_uniform_region_is_crossed_exactly():
    labels = np.zeros((40, 44, 52), np.uint8)
    labels[3:37, 5:41, 2:50] = 1
    labels[10:20, 12:30, 20:33] = 2
    tracer = Tracer.of(Phantom(labels=labels, materials=MATERIALS, d_voxel=(1.0, 1.1, 0.9)))
    g = geometry(n_detector=(11, 17), pixel=7.0, start_deg=3.0)
    for view in range(g.n_views):
        np.testing.assert_allclose(path_lengths(tracer, g, view), reference_lengths(tracer, g, view), atol=8e-6)


def test_rays_along_planes_edges_and_corners_keep_their_length():
    labels = np.ones((8, 8, 8), np.uint8)
    tracer = Tracer.of(Phantom(labels=labels, materials=MATERIALS, d_voxel=(2.0,) * 3))
    g = geometry(n_detector=(1, 1), n_views=8)
    for view in range(8):
        # the central ray runs in the plane z = 0 between voxels, along y = 0, x = 0 or the diagonals
        want = 16.0 * (1 if view % 2 == 0 else math.sqrt(2))
        assert path_lengths(tracer, g, view)[1, 0, 0] == pytest.approx(want, rel=1e-6)


def test_rods_in_a_cylinder_equal_the_closed_form():
    rods = [(12.0, 0.3), (10.0, 2.4), (13.0, 4.6)]
    water = solid(FRUSTUM, (30.0, 27.0, 27.0), material="water", metal=False)
    metal = [solid(FRUSTUM, (25.0, 3.0, 3.0), (r * math.cos(a), r * math.sin(a), 0.0)) for r, a in rods]
    phantom = Phantom(
        labels=np.zeros((4, 4, 4), np.uint8), materials=MATERIALS, d_voxel=(15.0,) * 3, solids=(water, *metal)
    )
    g = geometry(n_detector=(1, 301), n_views=7, pixel=0.5)
    for view, angle in enumerate(g.angles):
        u = (np.arange(301) - 150) * 0.5
        source = 200 * np.array([math.cos(angle), math.sin(angle)])
        pixel = (
            -200 * np.array([math.cos(angle), math.sin(angle)])[:, None]
            + np.array([-math.sin(angle), math.cos(angle)])[:, None] * u
        )
        d = pixel - source[:, None]
        d /= np.linalg.norm(d, axis=0)

        def chord(x, y, r, d=d, source=source):
            offset = np.array([x, y]) - source
            miss = offset[0] * d[1] - offset[1] * d[0]
            return 2 * np.sqrt(np.maximum(r * r - miss**2, 0))

        fe = sum(chord(r * math.cos(a), r * math.sin(a), 3.0) for r, a in rods)
        got = path_lengths(Tracer.of(phantom), g, view)
        # float32 lengths up to 54 mm: half an ulp is 2e-6 mm
        np.testing.assert_allclose(got[3, 0], fe, atol=3e-6)
        np.testing.assert_allclose(got[1, 0], chord(0, 0, 27.0) - fe, atol=5e-6)


def response(materials=MATERIALS):
    rule = energy_rule(spectrum(Tube()), Detector(), materials[1:], [40.0, 10.0, 5.0, 5.0], 1e-4)
    return Response.of(rule, materials)


@pytest.mark.slow
@pytest.mark.parametrize(("tolerance", "view", "dense"), [(math.inf, 1, False), (0.2, 0, False), (math.inf, 0, True)])
def test_intensities_equal_the_reference(tolerance, view, dense):
    density = np.random.default_rng(1).uniform(0.5, 1.5, (5, 7, 11)).astype(np.float32) if dense else None
    tracer, g = Tracer.of(blobs(solids=INSERTS, density=density)), geometry(n_detector=(5, 7), n_views=2, pixel=7.5)
    r = response()
    shape = g.n_detector
    everywhere = np.tile(np.array([0, shape[1]]), (shape[0], 1))
    extra = np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32)
    pose, background = g.pose_array()[view], tracer.background(g, view)
    background[-1] += extra
    arguments = (
        tracer.bricks[:5], tracer.solids(g, view), pose, work_order(1), everywhere,
        background, (r.mu, r.w1, r.w2),
        (r.edge_mu, project.EDGE_THRESHOLD, project.STEP_THRESHOLD, 21, tolerance), True,
    )  # fmt: skip
    got, want = np.zeros((2, *shape), np.float32), np.zeros((2, *shape))
    raytrace_cpu.transmit_view(*arguments, got[0], got[1])
    raytrace_reference.transmit_view(*arguments, want[0], want[1])
    # float32 optical thickness up to 40 has an error of 4e-6 absolute, the exponential 4e-7 relative
    np.testing.assert_allclose(got, want, rtol=1e-5)
    assert want[0].min() < 0.1 < 0.5 < want[0].max()


def test_the_exponential_is_accurate_to_its_bound():
    @numba.njit
    def each(x, out):
        for i in range(x.size):
            out[i] = exp_minus(x[i])

    x = np.concatenate([[0.0], np.geomspace(1e-6, 79.9, 20001), [81.0, 1e9]]).astype(np.float32)
    out = np.empty_like(x)
    each(x, out)
    want = np.exp(-np.minimum(x.astype(np.float64), 80))
    assert np.all(np.abs(out / want - 1) < 4e-7 * np.maximum(1, x / 4))
    # no denormal, which would slow a kernel many times
    assert out[0] == 1.0 and out.min() >= np.finfo(np.float32).tiny


def test_skipping_changes_nothing():
    labels = np.zeros((40, 40, 40), np.uint8)
    labels[12:28, 14:25, 10:30] = 1
    phantom = Phantom(labels=labels, materials=MATERIALS, d_voxel=(1.0,) * 3, solids=INSERTS)
    g, r = geometry(n_detector=(40, 50), n_views=3, pixel=2.5), response()
    for view in range(3):
        fast = transmit(Tracer.of(phantom), g, view, r)
        slow = transmit(Tracer.of(phantom, skip=False), g, view, r)
        assert np.array_equal(fast[0], slow[0]) and np.array_equal(fast[1], slow[1])


@pytest.mark.parametrize("pixel", [(10.0, 1.67), (1.2, 9.0)])
def test_skipping_changes_nothing_that_matters_on_oblong_pixels(pixel):
    wires = [solid(CAPSULE, (12.0, 0.1), (x, 2 * x, 0.0), (0.2, x, 1.0)) for x in (-6.0, 0.5, 5.0)]
    phantom = blobs(solids=(*INSERTS, *wires))
    g, r = msgspec.structs.replace(geometry(n_detector=(12, 60), n_views=3), d_detector=pixel), response()
    for view in range(3):
        fast = transmit(Tracer.of(phantom), g, view, r)
        slow = transmit(Tracer.of(phantom, skip=False), g, view, r)
        # float32 sums of some 12 nodes, in which the compiler may order vectors' ends otherwise
        np.testing.assert_allclose(fast[0], slow[0], rtol=4e-6)


@pytest.mark.parametrize("dense", [False, True])
def test_results_do_not_depend_on_the_number_of_threads(dense):
    body = blobs(solids=INSERTS)
    tracer = Tracer.of(with_density(body.labels, body.d_voxel, solids=INSERTS) if dense else body)
    g, r = geometry(n_detector=(31, 40), pixel=1.5), response()
    one, several = one_and_several(lambda: transmit(tracer, g, 1, r))
    assert np.array_equal(several[0], one[0]) and np.array_equal(several[1], one[1])


def test_sub_rays_bring_an_edge_pixel_to_its_measured_intensity():
    rod = solid(FRUSTUM, (20.0, 4.0, 4.0), (3.0, 1.0, 0.0))
    phantom = Phantom(labels=np.zeros((4,) * 3, np.uint8), materials=MATERIALS, d_voxel=(10.0,) * 3, solids=(rod,))
    g, r = geometry(n_detector=(3, 61), n_views=3, pixel=0.5), response()
    tracer = Tracer.of(phantom)
    fine = geometry(n_detector=(3 * 40, 61 * 40), n_views=3, pixel=0.5 / 40)
    worst = {}
    for view in range(3):
        exact = transmit(tracer, fine, view, r, subrays=1)[0].reshape(3, 40, 61, 40).mean((1, 3), dtype=np.float64)
        for subrays in (1, 8, 34):
            error = np.log(transmit(tracer, g, view, r, subrays=subrays)[0] / exact)
            worst.setdefault(subrays, []).append(np.sqrt(np.mean(error**2)))
    rms = {n: max(w) for n, w in worst.items()}
    # n lattice points have a spacing 1/n across the edge: the error must fall at least like that
    assert rms[8] < rms[1] / 4 and rms[34] < rms[1] / 12


def rods_in_air(rods, mu, g, view, finer):
    """P [v, u] of rods (centre, axis, radius, half height) of one attenuation, from `finer`² closed chords a pixel."""
    angle, (n_v, n_u) = g.angles[view], g.n_detector
    source = 200 * np.array([math.cos(angle), math.sin(angle), 0.0])
    at = [((np.arange(n * finer) + 0.5) / finer - n / 2) * d for n, d in zip((n_v, n_u), g.d_detector, strict=True)]
    v, u = np.meshgrid(*at, indexing="ij")
    d = -2 * source + u[..., None] * [-math.sin(angle), math.cos(angle), 0.0] + v[..., None] * [0.0, 0.0, 1.0]
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    tau = np.zeros(u.shape)
    for centre, axis, radius, half in rods:
        axis, out = np.array(axis) / np.linalg.norm(axis), source - centre
        along, start = d @ axis, out @ axis
        across, off = d - along[..., None] * axis, out - start * axis
        a, b, c = (across**2).sum(-1), across @ off, off @ off - radius**2
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        ends = np.sort([(-half - start) / along, (half - start) / along], axis=0)
        chord = np.minimum((root - b) / a, ends[1]) - np.maximum((-root - b) / a, ends[0])
        tau += mu * np.where(root > 0, np.maximum(chord, 0), 0)
    return -np.log(np.exp(-tau).reshape(n_v, finer, n_u, finer).mean((1, 3)))


@pytest.mark.slow
def test_pixels_that_a_bright_sliver_decides_are_refined():
    rods = [
        ((-4.0, -3.0, 2.0), (0.1, 0.25, 1.0), 3.0, 10.0),
        ((8.0, 7.0, -4.0), (0.3, -0.2, 1.0), 4.0, 9.0),
        ((-2.0, 9.0, 3.0), (1.0, 0.3, 0.2), 0.6, 6.0),
    ]
    solids = tuple(solid(FRUSTUM, (half, radius, radius), centre, axis) for centre, axis, radius, half in rods)
    phantom = Phantom(labels=np.zeros((4,) * 3, np.uint8), materials=MATERIALS, d_voxel=(10.0,) * 3, solids=solids)
    g, r = geometry(n_detector=(60, 72), n_views=5, pixel=1.0), response()
    at_60 = int(np.argmin(np.abs(r.mu[3] - attenuation("Fe", np.array([60.0]))[0])))
    one = np.ones(1, np.float32)
    r = Response(mu=r.mu[:, at_60 : at_60 + 1], w1=one, w2=one, edge_mu=r.mu[:, at_60].astype(np.float64))
    tracer, few, more = Tracer.of(phantom), [], []
    for view in range(g.n_views):
        exact = rods_in_air(rods, float(r.mu[3, 0]), g, view, 32)
        usual, plain = (-np.log(transmit(tracer, g, view, r, edge_tolerance=x)[0]) for x in (0.03, math.inf))
        few.append(np.abs(plain - exact))
        more.append(np.abs(usual - exact))
    few, more = np.stack(few), np.stack(more)
    # 34 lattice points leave single pixels far off; the estimate is no bound, but errors beyond three of it are rare
    assert few.max() > 0.15 and np.count_nonzero(few > 0.09) > 10
    assert more.max() < 0.09 and np.sqrt(np.mean(more**2)) < np.sqrt(np.mean(few**2)) / 1.5


def test_a_wire_thinner_than_a_pixel_is_not_missed():
    wire = solid(CAPSULE, (15.0, 0.05), (0.33, 0.61, 0.0), (0.0, 0.3, 1.0))
    phantom = Phantom(labels=np.zeros((4,) * 3, np.uint8), materials=MATERIALS, d_voxel=(10.0,) * 3, solids=(wire,))
    g, r = geometry(n_detector=(21, 21), n_views=1, pixel=3.0), response()
    m1, _ = transmit(Tracer.of(phantom), g, 0, r)
    darkened = m1 < 1 - 1e-4
    assert darkened.any(axis=1).sum() >= 16  # 30 mm, magnified twice, over 3 mm rows, tilted


def test_the_energy_mean_ray_outside_the_shadow_is_open():
    tracer, g, r = Tracer.of(blobs()), geometry(n_detector=(40, 60), pixel=3.0), response()
    m1, m2 = transmit(tracer, g, 0, r)
    assert m1[0, 0] == pytest.approx(1.0, abs=1e-6) and m2[0, 0] == pytest.approx(r.w2.sum(), rel=1e-6)
    assert m1.min() < 0.9
