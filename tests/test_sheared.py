"""Detectors whose u and v steps are not at right angles: nothing that a ray meets is left out, and chords are exact."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from ctsim.baselines.metal import reach
from ctsim.detector.noise import Noise
from ctsim.geometry import Geometry
from ctsim.phantoms.scene import _shadow
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views
from ctsim.solids import CAPSULE, ELLIPSOID, Primitive, Solid
from ctsim.tracer.kernels import raytrace_reference
from ctsim.tracer.project import Response, Tracer, path_lengths, transmit
from ctsim.types import Phantom, Scanner

ORBIT = Geometry(
    dso=200.0, dsd=400.0, n_voxel=(8, 8, 8), d_voxel=(3.0, 3.0, 3.0), n_detector=(23, 31), d_detector=(2.4, 2.0),
    n_views=3, start_deg=17.0,
)  # fmt: skip
MATERIALS = ("air", "water", "Fe")
ONE = np.ones(1, np.float32)
MU = np.array([[0.0], [0.02], [0.9]])  # 1/mm
MONO = Response(mu=MU.astype(np.float32), w1=ONE, w2=ONE, edge_mu=MU[:, 0])
# degrees that u leans towards v, and v towards u, and by which the detector turns away about u
CASES = [
    (20.0, 0.0, 0.0), (-65.0, 0.0, 0.0), (0.0, 30.0, 0.0), (0.0, -60.0, 0.0), (-35.0, 25.0, 0.0), (40.0, 0.0, 30.0),
    (35.0, 20.0, 40.0),
]  # fmt: skip


def sheared(u=0.0, v=0.0, tilt=0.0, lengths=(1.0, 1.0), of=ORBIT):
    """Return the orbit's poses with steps that lean towards each other, keep their lengths, times `lengths` (v, u)."""
    source, centre, e_u, e_v = of.pose_array().reshape(-1, 4, 3).transpose(1, 0, 2)
    lean = [math.radians(angle) for angle in (u, v, tilt)]
    (d_v, d_u), normal = of.d_detector, np.cross(e_u, e_v) / math.prod(of.d_detector)
    e_v = d_v * (math.cos(lean[2]) * e_v / d_v + math.sin(lean[2]) * normal)
    e_u, e_v = (
        lengths[1] * (math.cos(lean[0]) * e_u + math.sin(lean[0]) * d_u / d_v * e_v),
        lengths[0] * (math.cos(lean[1]) * e_v + math.sin(lean[1]) * d_v / d_u * e_u),
    )
    poses = np.concatenate([source, centre, e_u, e_v], 1)
    return msgspec.structs.replace(of, poses=tuple(tuple(row) for row in poses.tolist()))


def solid(centre, params, kind=ELLIPSOID, axis=(0.0, 0.0, 1.0)):
    piece = Primitive(kind=kind, centre=tuple(centre), params=params, axis=axis)
    return Solid(name="solid", material="Fe", primitives=(piece,), metal=True)


def phantom(*solids, body=False):
    labels = np.zeros((4, 4, 4), np.uint8)
    labels[1:3, 0:3, 1:4] = body
    return Phantom(labels=labels, materials=MATERIALS, d_voxel=(3.0, 2.0, 4.0), solids=solids)


def chords(pose, shape, ball, finer=1):
    """Lengths in a ball (centre, radius) of the rays to `finer`² points of each pixel: [v, u] of all of them."""
    source, centre, e_u, e_v = pose.reshape(4, 3)
    v, u = (((np.arange(n * finer) + 0.5) / finer - n / 2)[:, None] for n in shape)
    ray = centre - source + (v * e_v)[:, None] + u * e_u
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    off = np.asarray(ball[0]) - source
    return 2 * np.sqrt(np.maximum(ball[1] ** 2 - ((off - (ray @ off)[..., None] * ray) ** 2).sum(-1), 0))


def mean_intensity(lengths, finer):
    n_v, n_u = (n // finer for n in lengths.shape)
    return np.exp(-MU[2, 0] * lengths).reshape(n_v, finer, n_u, finer).mean((1, 3))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("lengths", [(1.0, 1.0), (0.4, 1.7)])
def test_central_rays_have_a_balls_chord_with_and_without_skipping(case, lengths):
    g, ball = sheared(*case, lengths=lengths), ((4.0, -3.0, 5.0), 7.0)
    body = phantom(solid(ball[0], (ball[1],) * 3))
    for view in range(g.n_views):
        # float32 lengths and attenuation, their product, and the exponential, below 4e-7·max(1, τ/4)
        tau = MU[2, 0] * chords(g.pose(view), g.n_detector, ball)
        # the chord's own float64 root turns 1e-16 of r² = 49 mm² at grazing rays to 1e-7 mm
        limit = 3 * 2.0**-24 * tau + 4e-7 * np.maximum(1, tau / 4) + 1e-6
        for skip in (True, False):
            p = -np.log(transmit(Tracer.of(body, skip=skip), g, view, MONO, subrays=1)[0].astype(np.float64))
            assert np.all(np.abs(p - tau) <= limit)
        assert np.count_nonzero(tau) > 5


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("body", [False, True])
def test_skipping_changes_nothing(case, body):
    wires = [solid((x, -x, 0.0), (9.0, 0.1), CAPSULE, (0.2, x, 1.0)) for x in (-6.0, 4.0)]
    there, g = phantom(solid((5.0, 5.0, -3.0), (4.0, 2.0, 3.0)), *wires, body=body), sheared(*case)
    for view in range(g.n_views):
        fast, slow = (transmit(Tracer.of(there, skip=skip), g, view, MONO) for skip in (True, False))
        # thicknesses below 60: products and sums of two materials, each rounded by 60·2⁻²⁴ = 3.6e-6 at most, in which
        # the compiler may order vectors' ends otherwise
        np.testing.assert_allclose(fast[0], slow[0], rtol=2 * 3 * 3.6e-6)
        lengths = [path_lengths(Tracer.of(there, skip=skip), g, view) for skip in (True, False)]
        assert np.array_equal(lengths[0], lengths[1]) and lengths[0][2].max() > 3
        want = np.zeros_like(lengths[0])
        raytrace_reference.trace_view(Tracer.of(there).bricks, Tracer.of(there).prims, g.pose(view), want)
        np.testing.assert_allclose(lengths[0], want, atol=4e-6)  # float32 of lengths below 30 mm


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_pixels_hold_a_balls_mean_intensity(case):
    g, ball, finer = sheared(*case), ((4.0, -3.0, 5.0), 7.0), 64
    tracer = Tracer.of(phantom(solid(ball[0], (ball[1],) * 3)))
    exact = mean_intensity(chords(g.pose(0), g.n_detector, ball, finer), finer)
    got = transmit(tracer, g, 0, MONO, subrays=256, edge_tolerance=1e-3)[0]
    # the estimate, half the range over n, holds 1e-3 from n = 500 on; the mean of so many lattice points at an edge
    # is off by about n^(-3/4) = 9.5e-3, and that of the closed form's 64² by 2e-3
    np.testing.assert_allclose(got, exact, rtol=0, atol=1.15e-2)
    assert got.min() < 1e-4


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("corner", [(0.35, 0.35), (0.35, -0.35), (-0.35, 0.35), (-0.35, -0.35)])
def test_a_ball_in_the_corner_of_a_pixel_is_seen(case, corner):
    """Its shadow meets neither the pixel's centre nor its corners."""
    g, (row, column) = sheared(*case), (13, 9)
    pose, shape, radius, finer = g.pose(1), g.n_detector, 0.06, 201
    source, centre, e_u, e_v = pose.reshape(4, 3)
    v, u = row + corner[0] - (shape[0] - 1) / 2, column + corner[1] - (shape[1] - 1) / 2
    at = source + 0.5 * (centre + u * e_u + v * e_v - source)
    tracers = [Tracer.of(phantom(solid(at, (radius,) * 3)), skip=skip) for skip in (True, False)]
    signal = [transmit(tracer, g, 1, MONO, subrays=256)[0] for tracer in tracers]
    np.testing.assert_array_equal(signal[0], signal[1])
    one = np.concatenate([source, centre + (row - 11) * e_v + (column - 15) * e_u, e_u, e_v])
    exact = 1 - mean_intensity(chords(one, (1, 1), (at, radius), finer), finer).item()
    lost = 1 - signal[0].astype(np.float64)
    assert exact > 1e-5
    # of 4096 rays 40 to 90 meet the ball, by which its edge of 20 to 30 spacings moves the sum by a few at most
    assert lost[row, column] == pytest.approx(exact, rel=0.15)
    lost[row, column] = 0
    assert not lost.any()  # sums of ones are exact


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_scan_is_the_same_with_and_without_skipping(case):
    there = phantom(solid((4.0, -3.0, 5.0), (7.0, 3.0, 5.0)), body=True)
    machine = Scanner(geometry=sheared(*case), noise=Noise(model="none"))
    plan = make_plan(there, machine, Simulation(), Truth(noise_free=True), "scene")
    whole = dataclasses.replace(plan, settings=msgspec.structs.replace(plan.settings, skip=False))
    for (_, fast), (_, slow) in zip(*(simulate_views(p, there, machine) for p in (plan, whole)), strict=True):
        for name in ("noise_free", "metal_free/noise_free"):
            np.testing.assert_allclose(fast[name], slow[name], atol=2e-5)
        assert fast["noise_free"].max() > 2


@pytest.mark.parametrize("case", CASES)
def test_an_object_is_within_the_cone_where_its_shadow_is_on_the_detector(case):
    g, size, tall = sheared(*case), 40.0, 0.6
    u, v = _shadow(g.pose_array(), size, tall)
    for view, pose in enumerate(g.pose_array()):
        source, centre, e_u, e_v = pose.reshape(4, 3)
        hit = centre + u[view, :, None] * e_u + v[view, :, None] * e_v - source
        # the rays to these pixels pass the circles that bound the object
        heights = np.where(np.arange(hit.shape[0]) < 48, -1, 1) * tall * size / 2
        share = (heights - source[2]) / hit[:, 2]
        radius = np.hypot(*(source + share[:, None] * hit)[:, :2].T)
        assert np.ptp(radius) < 1e-6 * size


def test_the_reach_of_metal_is_counted_along_the_pixels_steps():
    flat = msgspec.structs.replace(ORBIT, d_voxel=(6.0, 6.0, 6.0))
    as_poses = sheared(of=flat)
    assert reach(as_poses) == reach(flat)
    # half of 6 mm is 6 mm on the detector, of z 2.5 pixels of 2.4 mm; views turn x and y by 13° at least
    assert reach(flat) == (3, 3)
    # between columns 60° off there are 1 mm, not 2: 6·cos 13° = 5.8 pixels; between rows 1.2 mm, at 30° to the horizon:
    # 5·cos 30°·cos 13° = 4.2; half a pixel more, rounded
    assert reach(sheared(60.0, of=flat)) == (5, 6)
    halved = sheared(lengths=(0.5, 0.5), of=flat)
    assert reach(halved) == reach(msgspec.structs.replace(flat, d_detector=(1.2, 1.0))) == (6, 6)
