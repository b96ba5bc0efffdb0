"""The simulator from plan to counts: what it promises about accuracy, skipping, twins and noise."""

import dataclasses

import msgspec
import numba
import numpy as np
import pytest
import torch

from ctsim.beam.spectrum import Bowtie, Filter, Tube, heel_factor
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.look import present_materials
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.reconstruct.fdk import fdk
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.simulate import Simulator, compact, flat_image, scan_info, simulate_views, truth_volumes
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.tracer import voxelise
from ctsim.types import Phantom, Scanner

GEOMETRY = Geometry(
    dso=250.0,
    dsd=500.0,
    n_voxel=(12, 14, 16),
    d_voxel=(3.0,) * 3,
    n_detector=(24, 30),
    d_detector=(3.5, 3.5),
    n_views=4,
)
QUIET = Noise(model="none")


def rod(material="Fe", x=8.0, radius=3.0, metal=True, height=15.0):
    piece = Primitive(kind=FRUSTUM, centre=(x, 2.0, 0.0), params=(height, radius, radius))
    return Solid(name="rod", material=material, primitives=(piece,), metal=metal)


def phantom(solids=None):
    z, y, x = np.meshgrid(*(np.arange(20) - 9.5,) * 3, indexing="ij")
    labels = np.where((x**2 + y**2 < 64) & (abs(z) < 8), 1, 0).astype(np.uint8)
    labels[x**2 + (y - 3) ** 2 + z**2 < 6] = 3
    names = ("air", "water", "Ti", "cortical_bone", "Fe")
    return Phantom(labels=labels, materials=names, d_voxel=(2.0,) * 3, solids=(rod(),) if solids is None else solids)


def scanner(**changes):
    return Scanner(**{"geometry": GEOMETRY, "noise": QUIET, **changes})


def run(body, machine, simulation=None, truth=None, first_view=0):
    plan = make_plan(body, machine, simulation or Simulation(), truth or Truth(), "scene")
    views = [out for _, out in simulate_views(plan, body, machine, first_view)]
    return plan, {name: np.stack([v[name] for v in views]) for name in views[0]}


EVERYTHING = Truth(noise_free=True, scatter_free=True, mono_kev=(60.0, 80.0), trace=True, metal_path=True, paths=True)


def test_only_materials_that_occur_are_planned_and_renumbering_keeps_them():
    body = phantom()
    names = present_materials(body)
    assert names == ("air", "water", "cortical_bone", "Fe")
    small = compact(body, names)
    before = np.array(body.materials)[body.labels]
    assert np.array_equal(np.array(small.materials)[small.labels], before)


def test_skipping_stays_within_the_stated_tolerance():
    body, tolerance = phantom(), 1e-4
    for tube in (Tube(), Tube(kvp=120.0, filters=(Filter(material="Cu", thickness=0.3),))):
        machine = scanner(tube=tube)
        plan, fast = run(body, machine, Simulation(tolerance=tolerance), EVERYTHING)
        full, slow = run(body, machine, Simulation(skip=False), EVERYTHING)
        assert len(full.rule.energies) > 5 * len(plan.rule.energies)
        for name in ("noise_free", "metal_free/noise_free"):
            # the quadrature's bound, plus float32 over some 150 nodes: 150·6e-8 relative in the signal
            assert np.abs(fast[name] - slow[name]).max() < tolerance + 1e-5, name
            assert fast[name].max() > 1
        np.testing.assert_array_equal(fast["trace"], slow["trace"])
        np.testing.assert_allclose(fast["mono_60kev"], slow["mono_60kev"], rtol=1e-6, atol=1e-7)


def test_a_single_energy_is_beer_lambert():
    machine = scanner(tube=Tube(model="mono", kvp=60.0, filters=()), detector=Detector(kind="ideal"))
    plan, out = run(phantom(solids=()), machine, truth=EVERYTHING)
    assert len(plan.rule.energies) == 1
    # float32 lengths and thicknesses of at most 2
    np.testing.assert_allclose(out["noise_free"], out["mono_60kev"], atol=2e-6)
    mu = [attenuation(m, np.array([60.0]))[0] for m in plan.materials[1:]]
    np.testing.assert_allclose(np.tensordot(out["paths"], mu, (1, 0)), out["mono_60kev"], rtol=1e-5, atol=1e-6)


def test_the_twin_is_the_scan_of_the_body_without_metal_to_the_last_count():
    body, machine = phantom(), scanner(noise=Noise(), scatter=Scatter(level=1))
    plan, out = run(body, machine)
    bare = body.without_metal()
    # same quadrature for both, or the nodes would differ
    bare_plan = dataclasses.replace(
        make_plan(bare, machine, Simulation(), Truth(), "scene"),
        rule=plan.rule,
        materials=plan.materials,
        tissues=plan.tissues,
    )
    alone = np.stack([v["counts"] for _, v in simulate_views(bare_plan, bare, machine)])
    np.testing.assert_array_equal(out["metal_free/counts"], alone)
    changed = out["counts"] != out["metal_free/counts"]
    assert 0.02 < changed.mean() < 0.6


def test_any_view_can_be_made_alone():
    machine = scanner(noise=Noise(fixed_pattern=0.01))
    _, whole = run(phantom(), machine)
    _, rest = run(phantom(), machine, first_view=2)
    np.testing.assert_array_equal(whole["counts"][2:], rest["counts"])


def test_ground_truth_is_made_only_when_asked_for():
    _, few = run(phantom(), scanner(), truth=Truth(twin=False))
    assert set(few) == {"counts"}
    plan, _ = run(phantom(solids=()), scanner(), truth=EVERYTHING)
    names = {o.name for o in plan.outputs}
    assert not {"trace", "metal_path", "scatter_free", "metal_free/counts"} & names
    assert not plan.runs("metal-free twin") and not plan.runs("Ti") and plan.runs("water")


def test_scatter_lifts_the_signal_by_its_fraction():
    machine = scanner(scatter=Scatter(level=1, fraction=0.05))
    _, out = run(phantom(), machine, truth=EVERYTHING)
    lifted = np.exp(-out["noise_free"].astype(np.float64)) - np.exp(-out["scatter_free"].astype(np.float64))
    np.testing.assert_allclose(lifted, 0.05, rtol=1e-5)


@pytest.mark.parametrize("fraction", [0.0, 0.05])
def test_scatter_does_not_carry_the_heel_of_the_pixel_it_meets(fraction):
    steep = Tube(heel=True, anode_deg=8.0)  # part of the detector lies behind the anode
    tall = msgspec.structs.replace(GEOMETRY, n_detector=(48, 30))
    scatter = Scatter(level=1, fraction=fraction)
    machine = scanner(tube=steep, scatter=scatter, geometry=tall)
    plan, out = run(phantom(), machine, truth=EVERYTHING)
    # the primary alone, from a scan without heel: counts = i0·(heel·primary + S), read against i0·heel
    _, bare = run(phantom(), scanner(tube=Tube(anode_deg=8.0), scatter=Scatter(), geometry=tall), truth=EVERYTHING)
    angles = np.arctan2((np.arange(48) - 23.5) * 3.5, 500.0)
    heel = heel_factor(steep, angles)[:, None]
    for twin in ("", "metal_free/"):
        primary = np.exp(-bare[f"{twin}noise_free"].astype(np.float64))
        expected = heel * primary + fraction
        # float32 through three roundings of numbers of at most 1.5
        np.testing.assert_allclose(out[f"{twin}counts"] / machine.i0, expected, rtol=1e-6, atol=1e-7)
        lit = np.broadcast_to(heel > 0, expected.shape)
        p = -np.log(np.where(lit, expected, primary) / np.where(lit, heel, 1.0))
        np.testing.assert_allclose(out[f"{twin}noise_free"], p, rtol=1e-6, atol=2e-6)
        if fraction:
            np.testing.assert_allclose(out[f"{twin}scatter_free"], bare[f"{twin}noise_free"], rtol=1e-6, atol=1e-6)
    assert (heel == 0).any() and heel.max() > 1.05
    flat = flat_image(plan, machine)
    np.testing.assert_allclose(flat / machine.i0, np.broadcast_to(heel, flat.shape), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("skip", [True, False])
def test_tigre_noise_is_normalised_by_the_largest_p_of_the_whole_scan(skip):
    # seen along its length in one view of two, the rods make P far larger there
    row = tuple(rod(x=x, radius=2.0) for x in (-9.0, 0.0, 9.0))
    geometry = msgspec.structs.replace(GEOMETRY, n_views=2, n_detector=(160, 200), d_detector=(0.6, 0.6), arc_deg=180.0)
    body, truth = phantom(solids=row), Truth(noise_free=True)
    machine = scanner(geometry=geometry, noise=Noise(model="tigre", electronic=0.0), i0=1e4)
    simulation = Simulation(skip=skip)
    _, out = run(body, machine, simulation, truth)
    _, rest = run(body, machine, simulation, truth, first_view=1)
    np.testing.assert_array_equal(out["counts"][1:], rest["counts"])  # gone on with after an interruption
    tops = {}
    for twin in ("", "metal_free/"):
        p = out[f"{twin}noise_free"].astype(np.float64)
        tops[twin] = top = p.max()
        assert p[0].max() < 0.8 * top or p[1].max() < 0.8 * top or twin
        for k in range(2):
            # N = i0·exp(−p/top) photons decide: the spread of P is top/sqrt(N), here near p = 0.7
            near = np.abs(p[k] - 0.7) < 0.1
            noise = (-np.log(out[f"{twin}counts"][k][near] / 1e4) - p[k][near]) / (
                top / np.sqrt(1e4 * np.exp(-p[k][near] / top))
            )
            assert noise.std() == pytest.approx(1.0, rel=5 / np.sqrt(2 * near.sum()) + 0.01), (twin, k)
    assert tops[""] > 2 * tops["metal_free/"]


def test_a_pattern_that_the_flat_leaves_gives_rings():
    body = Phantom(labels=phantom().labels.clip(0, 1), materials=("air", "water"), d_voxel=(2.0,) * 3, solids=())
    geometry = msgspec.structs.replace(
        GEOMETRY, n_views=120, n_detector=(6, 96), d_detector=(1.0, 1.0), n_voxel=(1, 64, 64), d_voxel=(1.0,) * 3
    )
    plain = fdk_of(body, scanner(geometry=geometry))
    inside = np.hypot(*np.meshgrid(np.arange(64) - 31.5, np.arange(64) - 31.5)) < 13  # of the water
    water = float(plain[0][inside].mean())

    def added(noise):
        return (fdk_of(body, scanner(geometry=geometry, noise=noise)) - plain)[0]

    flat_takes_out = added(Noise(model="none", fixed_pattern=0.03, pattern_residual=0.0))
    assert np.abs(flat_takes_out[inside]).max() < 1e-4 * water
    rings = added(Noise(model="none", fixed_pattern=0.03))
    assert rings[inside].std() > 0.003 * water
    # rings look the same from all sides, noise does not; 120 views and the grid are their own quarter turn
    assert np.corrcoef(rings[inside], np.rot90(rings)[inside])[0, 1] > 0.95
    noise = added(Noise(electronic=0.0))
    assert np.corrcoef(noise[inside], np.rot90(noise)[inside])[0, 1] < 0.3


def fdk_of(body, machine):
    plan, out = run(body, machine, truth=Truth(twin=False))
    dark = machine.noise.dark
    p = -np.log((out["counts"] - dark) / (flat_image(plan, machine) - dark)).astype(np.float32)
    return fdk(torch.from_numpy(p), machine.geometry).numpy()


def test_bow_tie_and_heel_cancel_in_the_flat_field():
    tube = Tube(bowtie=Bowtie(material="Al", center=1.0, edge=5.0, half_angle_deg=10.0), heel=True)
    machine = scanner(tube=tube, noise=Noise(model="none"))
    empty_side = Phantom(
        labels=np.zeros((4, 4, 4), np.uint8),
        materials=("air", "Fe"),
        d_voxel=(2.0,) * 3,
        solids=(rod(x=0.0, radius=1.0),),
    )
    plan, out = run(empty_side, machine, truth=Truth(noise_free=True))
    flat = flat_image(plan, machine)
    assert flat.max() > 1.2 * flat.min()
    np.testing.assert_allclose(out["counts"][:, :, 0], np.tile(flat[:, 0], (4, 1)), rtol=1e-5)
    assert np.abs(out["noise_free"][:, :, 0]).max() < 1e-5
    assert out["noise_free"].max() > 1


def test_references_hold_the_attenuation_of_their_materials():
    body, machine = phantom(), scanner()
    plan = make_plan(body, machine, Simulation(), Truth(), "scene")
    volumes = dict(truth_volumes(plan, body, machine))
    assert volumes["reference_50kev"].shape == GEOMETRY.n_voxel
    fe = attenuation("Fe", np.array([50.0]))[0]
    # a 3 mm voxel in the middle of a rod of 3 mm radius is full of iron
    assert volumes["reference_50kev"].max() == pytest.approx(fe, rel=1e-6)
    water = attenuation("water", np.array([50.0]))[0]
    inside = volumes["labels"] == plan.materials.index("water")
    assert np.median(volumes["reference_50kev"][inside]) == pytest.approx(water, rel=1e-6)
    assert volumes["metal"].sum() > 0 and volumes["metal_free/reference_50kev"].max() < 0.2
    info = scan_info(plan, body, machine)
    assert 10 < info["l0"] < 40 and info["metal"] == ["Fe"]


def test_an_empty_scene_is_refused_by_name():
    empty = Phantom(labels=np.zeros((4, 4, 4), np.uint8), materials=("air", "water"), d_voxel=(1.0,) * 3)
    with pytest.raises(InputError, match="empty"):
        make_plan(empty, scanner(), Simulation(), Truth(), "scene")


def test_heel_needs_a_circular_orbit():
    poses = tuple(tuple(float(x) for x in row) for row in GEOMETRY.pose_array())
    with pytest.raises(InputError, match="circular orbit"):
        scanner(geometry=msgspec.structs.replace(GEOMETRY, poses=poses), tube=Tube(heel=True))


@pytest.mark.parametrize("more", [{"heel": True}, {"bowtie": Bowtie(center=1.0, edge=5.0, half_angle_deg=10.0)}])
def test_tigre_noise_is_refused_where_the_open_field_is_not_flat(more):
    with pytest.raises(InputError, match="tigre"):
        scanner(tube=Tube(**more), noise=Noise(model="tigre"))


def test_arbitrary_poses_give_what_the_orbit_gives():
    poses = tuple(tuple(float(x) for x in row) for row in GEOMETRY.pose_array())
    _, orbit = run(phantom(), scanner())
    _, posed = run(phantom(), scanner(geometry=msgspec.structs.replace(GEOMETRY, poses=poses)))
    np.testing.assert_array_equal(orbit["counts"], posed["counts"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        {"i0": 10.0, "noise": Noise()},
        {"tube": Tube(kvp=40.0)},
        {"detector": Detector(kind="counting")},
        {"noise": Noise(model="tigre")},
        {"geometry": msgspec.structs.replace(GEOMETRY, n_views=1, off_detector=(4.0, -9.0))},
    ],
    ids=["ten photons", "40 kVp", "counting", "tigre", "one view, offset"],
)
def test_extreme_scans_stay_finite(case):
    thick = phantom(solids=(rod(x=0.0, radius=14.0), rod("air", x=0.0, radius=2.0, metal=False)))
    _, out = run(thick, scanner(**case), truth=Truth(noise_free=True))
    assert all(np.isfinite(images).all() for images in out.values())
    assert out["noise_free"].max() > 8


def test_volumes_of_scan_and_twin_share_a_body_but_no_metal():
    body, machine = phantom(solids=(rod(), rod("Ti", x=-9.0, metal=False))), scanner()
    plan = make_plan(body, machine, Simulation(), Truth(), "scene")
    volumes = {name: volume.copy() for name, volume in truth_volumes(plan, body, machine)}
    mine = compact(body, plan.materials)
    for prefix, content in (("", mine), ("metal_free/", mine.without_metal())):
        assert np.array_equal(volumes[f"{prefix}labels"], voxelise.label_volume(content, GEOMETRY))
        mu = {m: float(attenuation(m, np.array([50.0]))[0]) for m in plan.materials[1:]}
        alone = voxelise.attenuation_volume(content, GEOMETRY, mu)
        # both are float32 of the same float64 tables, up to the rounding of a sum over one energy
        np.testing.assert_allclose(volumes[f"{prefix}reference_50kev"], alone, rtol=2**-22)
    iron = plan.materials.index("Fe")
    assert (volumes["labels"] == iron).any() and not (volumes["metal_free/labels"] == iron).any()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread")  # pyright: ignore[reportAttributeAccessIssue]
def test_a_view_of_a_few_rows_takes_one_thread_and_gives_the_others_back(monkeypatch):
    seen, before = [], numba.get_num_threads()
    real = Simulator.view
    monkeypatch.setattr(Simulator, "view", lambda self, k: (seen.append(numba.get_num_threads()), real(self, k))[1])
    for rows in (8, 9):
        machine = scanner(geometry=msgspec.structs.replace(GEOMETRY, n_detector=(rows, 30), n_views=1))
        run(phantom(), machine)
        assert numba.get_num_threads() == before
    assert seen == [1, before]
