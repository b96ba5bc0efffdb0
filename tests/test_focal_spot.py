"""The focal spot: penumbras against closed forms and against rays from hundreds of sources, twins, errors stated."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from scipy.integrate import quad

from ctsim.beam.spectrum import Tube
from ctsim.beam.spot import FWHM, FocalSpot, OffFocal, sub_sources
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views
from ctsim.solids import BOX, ELLIPSOID, Primitive, Solid
from ctsim.types import Phantom, Scanner

QUIET = Noise(model="none")
FINE = Simulation(subrays=128, edge_tolerance=0.01, spot_error=0.01)
GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(8, 8, 8), d_voxel=(2.0,) * 3, n_detector=(14, 18), d_detector=(0.5, 0.6), n_views=1
)


def solids_only(*solids):
    labels, names = np.zeros((1, 1, 1), np.uint8), ("air", "water", "Fe")
    return Phantom(labels=labels, materials=names, d_voxel=(1.0,) * 3, solids=solids)


def piece(kind, centre, params, metal=True, material="Fe"):
    made = Primitive(kind=kind, centre=centre, params=params)
    return Solid(name="piece", material=material, primitives=(made,), metal=metal)


def machine_of(spot, geometry=GEOMETRY, noise=QUIET):
    tube = Tube(model="mono", kvp=60.0, filters=(), focal_spot=spot)
    return Scanner(geometry=geometry, noise=noise, tube=tube, detector=Detector(kind="ideal"))


def scan(body, spot, settings=FINE, geometry=GEOMETRY, noise=QUIET):
    machine = machine_of(spot, geometry, noise)
    plan = make_plan(body, machine, settings, Truth(noise_free=True), "scene")
    return plan, [out for _, out in simulate_views(plan, body, machine)]


def edge_of(spot, axis):
    """Return the density of a spot's light along an axis, in 1/mm; at the detector it is magnified by 1."""
    size = spot.size[axis]
    if spot.shape == "gaussian":
        return lambda s: math.exp(-4 * math.log(2) * (s / size) ** 2) * 2 * math.sqrt(math.log(2) / math.pi) / size
    return lambda s: (abs(s) <= size / 2) / size


@pytest.mark.parametrize("shape", ["gaussian", "uniform"])
@pytest.mark.parametrize("axis", [0, 1])
def test_an_edge_is_blurred_as_the_spot_says(shape, axis):
    spot = FocalSpot(size=(0.5, 1.1), shape=shape)
    half = [10.0, 10.0]  # y, z of a plate in the plane of the axis, seen from +x
    centre = [0.03, 0.04]  # of the edge: in no special place of a pixel
    middle = [centre[0] - half[0], 0.0] if axis == 1 else [0.0, centre[1] - half[1]]
    thickness = 0.2
    plate = piece(BOX, (0.0, *middle), (thickness / 2, *half))
    _, (out,) = scan(solids_only(plate), spot)
    image = out["counts"] / 1e5
    line = image[7] if axis == 1 else image[:, 9]
    passed = math.exp(-attenuation("Fe", np.array([60.0]))[0] * thickness)
    d, edge = GEOMETRY.d_detector[axis], 2 * centre[1 - axis]  # the plate is magnified twice, the spot once
    places = (np.arange(line.size) - (line.size - 1) / 2) * d
    density, reach = edge_of(spot, axis), 4 * max(spot.size)

    def lit(place):
        """Return the share of the spot's light that the edge lets through to a pixel."""

        def inside(s):
            return min(max((place + d / 2 - (edge + s)) / d, 0.0), 1.0) * density(s)

        cuts = sorted({-spot.size[axis] / 2, spot.size[axis] / 2, place + d / 2 - edge, place - d / 2 - edge})
        return quad(inside, -reach, reach, points=cuts, limit=200)[0]

    expected = np.array([passed + (1 - passed) * lit(x) for x in places])
    # of the step: 0.01 for the points, 1/128 for the sub-rays, 0.002 for the plate's thickness, seen at slants to 0.004
    np.testing.assert_allclose(line, expected, atol=(1 - passed) * (0.01 + 1 / 128 + 0.002), rtol=0)
    assert (np.abs(expected - (passed + 1) / 2) < 0.499 * (1 - passed)).sum() >= 2


def test_a_small_scene_is_the_mean_of_very_many_sources():
    spot = FocalSpot(size=(1.4, 0.8), shape="uniform")
    centre, radius = np.array([6.0, 0.7, 0.4]), 1.2
    _, (out,) = scan(solids_only(piece(ELLIPSOID, tuple(centre), (radius,) * 3)), spot)
    n = 24
    steps = (np.arange(n) + 0.5) / n - 0.5
    z, y = np.meshgrid(steps * spot.size[0], steps * spot.size[1], indexing="ij")
    source = np.stack([np.full(z.shape, 250.0), y, z], -1).reshape(-1, 1, 3)
    fine = (np.arange(6) + 0.5) / 6 - 0.5
    mu, image = attenuation("Fe", np.array([60.0]))[0], np.empty(GEOMETRY.n_detector)
    for i, j in np.ndindex(image.shape):
        b, a = np.meshgrid((i - 6.5 + fine) * 0.5, (j - 8.5 + fine) * 0.6, indexing="ij")
        pixel = np.stack([np.full(a.shape, -250.0), a, b], -1).reshape(1, -1, 3)
        way = (pixel - source) / np.linalg.norm(pixel - source, axis=-1, keepdims=True)
        off = np.linalg.norm(np.cross(centre - source, way), axis=-1)
        image[i, j] = np.exp(-2 * mu * np.sqrt(np.maximum(radius**2 - off**2, 0))).mean()
    # 0.01 for the points, 1/128 for the sub-rays, 0.003 for the oracle's 144 places across a step
    np.testing.assert_allclose(out["counts"] / 1e5, image, atol=0.021, rtol=0)
    _, (point,) = scan(solids_only(piece(ELLIPSOID, tuple(centre), (radius,) * 3)), None)
    assert np.abs(point["counts"] / 1e5 - image).max() > 0.1


def test_where_there_is_no_edge_nothing_changes():
    wide = solids_only(piece(BOX, (0.0, 0.0, 0.0), (2.0, 60.0, 60.0), material="water", metal=False))
    spot = FocalSpot(size=(0.6, 1.0))
    (_, (blurred,)), (_, (sharp,)) = scan(wide, spot), scan(wide, None)
    # a point of the spot is at most 1.2 mm off the centre: rays slant by 2.4e-3 more at most, from 0.012 on
    np.testing.assert_allclose(blurred["noise_free"], sharp["noise_free"], rtol=0.02 * 2.4e-3)
    small = solids_only(piece(ELLIPSOID, (0.0, -1.5, 0.0), (0.5, 0.5, 0.5)))
    _, (out,) = scan(small, spot)
    assert (out["counts"][:, 12:] == 1e5).all()


def test_measured_weights_are_a_mean_of_scans_from_each_cell():
    body = solids_only(piece(ELLIPSOID, (5.0, 0.3, -0.2), (1.0, 0.8, 0.9)))
    weights = ((1.0, 3.0, 0.0), (2.0, 0.0, 4.0))
    spot = FocalSpot(size=(0.4, 0.9), shape="measured", weights=weights)
    plan, (out,) = scan(body, spot, msgspec.structs.replace(FINE, spot_error=0.5))
    assert plan.spot.grid == (2, 3) and plan.spot.weights.size == 4
    pose, expected = GEOMETRY.pose(0), 0.0
    for i, j in np.ndindex(2, 3):
        moved = pose.copy()
        moved[1] += (j - 1) * 0.3
        moved[2] += (i - 0.5) * 0.2
        geometry = msgspec.structs.replace(GEOMETRY, poses=(tuple(moved.tolist()),))
        expected = expected + weights[i][j] / 10 * scan(body, None, geometry=geometry)[1][0]["counts"].astype(float)
    np.testing.assert_allclose(out["counts"], expected, rtol=3e-7)  # float32


def test_off_focal_radiation_lifts_a_shadow_by_its_share_and_far_away():
    share, wide = 0.08, 6.0
    tube = Tube(model="mono", kvp=60.0, filters=(), off_focal=OffFocal(share=share, fwhm=wide))
    geometry = msgspec.structs.replace(GEOMETRY, n_detector=(5, 60))
    machine = Scanner(geometry=geometry, noise=QUIET, tube=tube, detector=Detector(kind="ideal"))
    plate = solids_only(piece(BOX, (0.0, -20.0, 0.0), (1.0, 20.0, 20.0)))  # 2 mm of iron where y < 0
    settings = msgspec.structs.replace(FINE, spot_error=2e-3)
    plan = make_plan(plate, machine, settings, Truth(), "scene")
    ((_, out),) = simulate_views(plan, plate, machine)
    passed = math.exp(-attenuation("Fe", np.array([60.0]))[0] * 2.0)
    places = (np.arange(60) - 29.5) * 0.6
    # the plate's two edges are seen at 2.008 and 1.992 times their place, 0; a pixel is small against the Gaussian
    normal = np.array([0.5 * math.erfc(-x / (wide / FWHM * 2**0.5)) for x in places])
    sharp = np.where(places > 0, 1.0, passed)
    expected = (1 - share) * sharp + share * (passed + (1 - passed) * normal)
    # 2e-3 for the points, 6e-4 for the plate's faces, seen 0.8 % apart, and 1e-4 for the Gaussian's bend over a pixel
    np.testing.assert_allclose(out["counts"][2] / 1e5, expected, atol=3e-3)
    assert plan.spot.weights[0] == pytest.approx(1 - share) and plan.spot.error <= 2e-3
    assert "off-focal (" in plan.text() and not plan.runs("focal spot")
    whole = sub_sources(FocalSpot(size=(0.4, 0.4)), (1.0, 1.0), 0.02, tube.off_focal)
    assert whole.weights.sum() == pytest.approx(1) and whole.error <= 0.02
    assert whole.weights[: math.prod(whole.grid)].sum() == pytest.approx(1 - share)
    for wrong in ({"share": 0.6, "fwhm": 5.0}, {"share": 0.1, "fwhm": 0.0}):
        with pytest.raises(InputError, match=r"off_focal: (share|fwhm) must be within \("):
            OffFocal(**wrong)


def bone_and_rod():
    z, y, x = np.meshgrid(*(np.arange(20) - 9.5,) * 3, indexing="ij")
    labels = np.where(x**2 + y**2 + z**2 < 36, 1, 0).astype(np.uint8)
    rods = (piece(ELLIPSOID, (1.0, 0.5, 0.0), (0.8, 0.8, 3.0)), piece(BOX, (0.0, 5.0, 1.0), (0.3, 0.3, 0.3)))
    return Phantom(labels=labels, materials=("air", "water", "Fe"), d_voxel=(0.5,) * 3, solids=rods)


@pytest.mark.parametrize("skip", [True, False])
def test_the_twin_is_the_scan_of_the_body_without_metal_to_the_last_count(skip):
    body, geometry = bone_and_rod(), msgspec.structs.replace(GEOMETRY, n_views=3, n_detector=(30, 40))
    given = {"spot": FocalSpot(size=(0.8, 1.2)), "settings": Simulation(skip=skip), "geometry": geometry}
    plan, views = scan(body, **given, noise=Noise())
    bare = body.without_metal()
    machine = machine_of(given["spot"], geometry, Noise())
    alone = dataclasses.replace(
        make_plan(bare, machine, given["settings"], Truth(), "scene"),
        rule=plan.rule, materials=plan.materials, tissues=plan.tissues, spot=plan.spot,
    )  # fmt: skip
    for out, (_, other) in zip(views, simulate_views(alone, bare, machine), strict=True):
        np.testing.assert_array_equal(out["metal_free/counts"], other["counts"])
        assert 0.005 < (out["counts"] != other["counts"]).mean() < 0.5


@pytest.mark.parametrize("shape", ["gaussian", "uniform"])
@pytest.mark.parametrize("width", [0.05, 0.4, 1.7, 6.0])
def test_the_points_are_the_fewest_within_the_stated_error(shape, width):
    spot = FocalSpot(size=(0.0, 1.0), shape=shape)
    found = sub_sources(spot, (width, width), 0.01)
    x = np.linspace(-3 * width - 1, 3 * width + 1, 1601)
    # a fine sum over the spot in place of the closed form
    s = (np.arange(4000) + 0.5) / 4000 * 8 * width - 4 * width
    dense = np.exp(-((s / width * FWHM) ** 2) / 2) if shape == "gaussian" else 1.0 * (abs(s) <= width / 2)
    exact = np.clip(x[:, None] - s + 0.5, 0, 1) @ (dense / dense.sum())
    points = np.clip(x[:, None] - found.offsets[:, 1] * width + 0.5, 0, 1) @ found.weights
    assert np.abs(points - exact).max() <= found.error + 1e-3 <= 0.011  # 1e-3: the sum's own step
    assert found.grid[0] == 1 and abs(found.weights.sum() - 1) < 1e-12
    with pytest.raises(InputError, match=r"tube.focal_spot: along u it blurs edges over .* expected a smaller spot"):
        sub_sources(spot, (width, 1000.0), 0.01)


def test_the_plan_says_whether_there_is_a_spot():
    body = bone_and_rod()
    plan, _ = scan(body, None)
    assert plan.spot is None and not plan.runs("focal spot") and "off: " in plan.text() and "focal spot" in plan.text()
    assert "sub_sources" not in plan.to_dict()
    plan, _ = scan(body, FocalSpot(size=(0.3, 1.2)))
    n_v, n_u = plan.spot.grid
    assert f"focal spot ({n_v} x {n_u} sub-sources)" in plan.text() and n_v < n_u
    assert plan.to_dict()["sub_sources"] == n_v * n_u and plan.to_dict()["spot_error"] <= FINE.spot_error


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"size": (0.0, 0.0)}, "not both 0"),
        ({"size": (-1.0, 1.0)}, "0 to 20 mm"),
        ({"size": (1.0, math.inf)}, "0 to 20 mm"),
        ({"size": (1.0, 1.0), "shape": "round"}, "shape must be"),
        ({"size": (1.0, 1.0), "shape": "measured"}, "weights belong to"),
        ({"size": (1.0, 1.0), "weights": ((1.0,),)}, "weights belong to"),
        ({"size": (1.0, 1.0), "shape": "measured", "weights": ((1.0,), (1.0, 2.0))}, "rows of equal length"),
        ({"size": (1.0, 1.0), "shape": "measured", "weights": ((0.0, 0.0),)}, "not all 0"),
    ],
)
def test_what_is_no_spot_is_refused_in_one_sentence(given, words):
    with pytest.raises(InputError, match=words):
        FocalSpot(**given)
