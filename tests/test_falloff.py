"""The field falls off towards the panel's corners: in the scan, the flat and the photons that scatter."""

import msgspec
import numpy as np
import pytest

from ctsim import simulate
from ctsim.beam.spectrum import Tube, heel_factor
from ctsim.detector.noise import Noise
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.plan import make_plan
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views
from ctsim.solids import ELLIPSOID, Primitive, Solid
from ctsim.types import Phantom, Scanner

GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(8, 8, 8), d_voxel=(2.0,) * 3, n_detector=(15, 19), d_detector=(16.0, 12.0),
    n_views=1, off_detector=(9.0, -7.0),
)  # fmt: skip
BALL = Solid(
    name="b", material="Fe", primitives=(Primitive(kind=ELLIPSOID, centre=(0.0, 9.0, 4.0), params=(30.0,) * 3),)
)
BODY = Phantom(labels=np.zeros((1, 1, 1), np.uint8), materials=("air", "Fe"), d_voxel=(1.0,) * 3, solids=(BALL,))


def scanner(**changes):
    return Scanner(**({"geometry": GEOMETRY, "noise": Noise(model="none"), "tube": Tube(falloff=True)} | changes))


def run(machine, truth=None):
    plan = make_plan(BODY, machine, Simulation(), truth or Truth(noise_free=True, scatter_free=True), "scene")
    return plan, next(iter(simulate_views(plan, BODY, machine)))[1]


def solid_angles():
    """Return the solid angle of each pixel's middle over that at the foot of the perpendicular, by vectors."""
    source, centre, e_u, e_v = GEOMETRY.pose(0).reshape(4, 3)
    normal = np.cross(e_u, e_v) / np.linalg.norm(np.cross(e_u, e_v))
    n_v, n_u = GEOMETRY.n_detector
    v, u = np.meshgrid(np.arange(n_v) - (n_v - 1) / 2, np.arange(n_u) - (n_u - 1) / 2, indexing="ij")
    way = centre + v[..., None] * e_v + u[..., None] * e_u - source
    far = np.linalg.norm(way, axis=-1)
    return abs(way @ normal) / far**3 * GEOMETRY.dsd**2


def test_a_corner_of_a_wide_panel_gets_86_percent():
    geometry = msgspec.structs.replace(GEOMETRY, n_detector=(3, 3), d_detector=(114.0, 114.0), off_detector=(0.0, 0.0))
    machine = scanner(geometry=geometry)
    plan, _ = run(machine)
    flat = flat_image(plan, machine) / machine.i0
    assert flat[1, 1] == 1.0 and flat[0, 0] == flat[2, 2] == pytest.approx(0.862, abs=5e-4)


def test_scan_and_flat_fall_off_alike_and_the_line_integrals_stay():
    machine, even = scanner(), scanner(tube=Tube())
    (plan, out), (_, plain) = run(machine), run(even)
    gain = solid_angles()
    np.testing.assert_allclose(flat_image(plan, machine) / machine.i0, gain, rtol=1e-6)
    np.testing.assert_allclose(out["counts"] / machine.i0, gain * plain["counts"] / machine.i0, rtol=1e-6)
    np.testing.assert_allclose(out["noise_free"], plain["noise_free"], atol=2e-6)
    np.testing.assert_allclose(flat_image(make_plan(BODY, even, Simulation(), Truth(), "s"), even), even.i0)
    assert gain.min() < 0.9
    assert plan.runs("falloff") and "falloff" in plan.text().partition("skips")[0]


def test_it_multiplies_the_heel():
    machine = scanner(tube=Tube(falloff=True, heel=True, anode_deg=30.0))
    plan, _ = run(machine)
    heights = (np.arange(15) - 7) * 16.0 + 9.0
    heel = heel_factor(machine.tube, np.arctan2(heights, 500.0))[:, None]
    np.testing.assert_allclose(flat_image(plan, machine) / machine.i0, solid_angles() * heel, rtol=1e-6)


def test_photons_that_scatter_start_as_many_as_reach_the_pixel(monkeypatch):
    seen = []

    def follow(body, source, geometry, **more):
        seen.append(source.gain)
        raise InterruptedError

    monkeypatch.setattr(simulate, "scatter_series", follow)
    with pytest.raises(InterruptedError):
        run(scanner(scatter=Scatter(level=3)))
    np.testing.assert_allclose(seen[0], solid_angles(), rtol=1e-6)


def test_constant_scatter_comes_from_all_of_the_object():
    _, out = run(scanner(scatter=Scatter(level=1, fraction=0.05)))
    _, bare = run(scanner())
    np.testing.assert_allclose((out["counts"] - bare["counts"]) / 1e5, 0.05, rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise": Noise(model="tigre")}, "tube.bowtie nor tube.falloff"),
        ({"geometry": msgspec.structs.replace(GEOMETRY, poses=(tuple(GEOMETRY.pose(0).tolist()),))}, "circular orbit"),
    ],
)
def test_where_it_cannot_be_it_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        scanner(**changes)
