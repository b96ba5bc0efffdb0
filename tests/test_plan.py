"""What a plan says of a scene before it is simulated, against what simulating it takes."""

import dataclasses
import tracemalloc

import msgspec
import numba
import numpy as np
import pytest

from ctsim import plan as planning
from ctsim import simulate
from ctsim.benchmarks.suites import load
from ctsim.montecarlo import series
from ctsim.phantoms.bodies.rods import Validation
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scanners import preset
from ctsim.phantoms.scene import build, parse_suite
from ctsim.plan import make_plan
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views, truth_volumes
from ctsim.types import Scanner


def scene(n: int, metal: str = "Fe"):
    phantom = build_recipe(Validation(n_voxel=(n, n, n), size=60.0, metal=metal), 1)
    return phantom, Scanner(geometry=preset("ideal", 6, (n, n), (n, n, n), 60.0).geometry)


def plan(parts, **simulation):
    return make_plan(*parts, Simulation(**simulation), Truth(), "scene")


def test_the_edge_error_is_found_where_inserts_are_and_falls_with_sub_rays():
    parts = scene(64)
    errors = [plan(parts, subrays=n).edge_error for n in (2, 34, 256)]
    # the error goes with the spacing 1/n of the lattice across an edge, but the largest sits in single pixels that
    # hardly anything passes, where it falls by luck
    assert errors[0] > 3 * errors[1] and errors[1] > errors[2] > 0
    bare = parts[0].without_metal()
    no_solids = type(bare)(labels=np.ones((8, 8, 8), np.uint8), materials=bare.materials, d_voxel=(7.0,) * 3)
    assert plan((no_solids, parts[1])).edge_error == 0
    assert "worst edge pixel" in plan(parts).text() and "edge pixel" not in plan((no_solids, parts[1])).text()


@pytest.mark.slow
@pytest.mark.parametrize("dense", [False, True])
def test_the_memory_that_a_plan_names_is_what_simulating_takes(dense):
    tracemalloc.start()
    try:
        parts = scene(160)
        if dense:  # every voxel has a density of its own, and materials mix
            labels = np.random.default_rng(0).integers(1, len(parts[0].materials), (160,) * 3).astype(np.uint8)
            density = np.random.default_rng(1).random(labels.shape, np.float32)
            parts = (dataclasses.replace(parts[0], labels=labels, density=density, solids=()), parts[1])
        tracemalloc.reset_peak()
        made = plan(parts)
        for _ in simulate_views(made, *parts):
            pass
        for _ in truth_volumes(made, *parts):
            pass
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    within = 1.3 if dense else 1.6  # a plan without the map's share would be 1.4 times too low
    assert made.memory_bytes / within < peak < made.memory_bytes * within


@pytest.mark.parametrize(("metal", "scans"), [("none", 1), ("Fe", 2)])
def test_the_time_for_scatter_goes_with_photons_and_scans(monkeypatch, metal, scans):
    phantom, machine = scene(16, metal)
    monkeypatch.setattr(planning, "HISTORY_SECONDS", 1e3)  # the rest is nothing next to it
    geometries = [msgspec.structs.replace(machine.geometry, n_views=90, arc_deg=arc) for arc in (360.0, 200.0)]
    for geometry, views in zip(geometries, (24, 14), strict=True):  # a view is followed every 15 degrees
        scanner = Scanner(geometry=geometry, scatter=Scatter(level=3))
        for error, photons in ((0.02, 300_000), (0.01, 1_200_000), (0.5, 20_000)):
            planned = plan((phantom, scanner), scatter_error=error).seconds * numba.get_num_threads() / 1e3
            assert planned == pytest.approx(views * photons * scans, rel=1e-3)
    without = plan((phantom, Scanner(geometry=geometries[0])))
    assert without.seconds < 1e3 and not without.runs("scatter") and not without.runs("anti-scatter grid")


HEAD = """
name = "head"
phantom = { recipe = "validation", metal = "none", size = 160.0, n_voxel = [112, 112, 112] }
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lung-Fe", "teeth-Ti", "broccoli-Al", "head", "head, grid"])
def test_as_many_photons_are_followed_as_planned(monkeypatch, name):
    """A photon takes 0.8 µs in the scenes that take most of them, and 1.8 µs in those that take fewest."""
    grid = ", grid_ratio = 10.0" if "grid" in name else ""
    head = HEAD + f'scanner = {{ preset = "c-arm", scatter = {{ level = 3{grid} }} }}'
    (one,) = parse_suite(head) if "head" in name else [s for s in load("quick") if s.name == name]
    phantom, scanner = build(one), one.resolve()
    found = []
    real = series.scatter_series
    monkeypatch.setattr(simulate, "scatter_series", lambda *a, **more: found.append(real(*a, **more)) or found[-1])
    made = make_plan(phantom, scanner, Simulation(scatter_error=0.05), Truth(twin=False), "scene")
    next(simulate_views(made, phantom, scanner))
    (scatter,) = found
    # photons are doubled until they suffice: a factor of √2 either way of the mean; scenes differ by 2 either way
    assert 1 / 3 < scatter.histories / series.expected_histories(scanner.geometry, 0.05) < 3


@pytest.mark.parametrize(
    ("scanner", "beam"),
    [
        ('preset = "dental", tube = { kvp = 110.0 }', "beam    110 kV, 2.5 mm Al; csi of 0.5 mm\n"),
        ('preset = "c-arm"', "beam    100 kV, 2.5 mm Al + 0.1 mm Cu; csi of 0.6 mm\n"),
        ('tube = { model = "mono", kvp = 60.0 }', "beam    60 keV; gos of 0.1 mm\n"),
        (
            'tube = { model = "finkelshtein-pavlova", bowtie = { center = 1.0, edge = 4.0, half_angle_deg = 9.0 } }',
            "beam    90 kV (finkelshtein-pavlova), 0.5 mm Al + bow-tie; gos of 0.1 mm\n",
        ),
        (
            'tube = { filters = [] }, detector = { kind = "counting" }',
            "kV, no filter; counting of 0.1 mm above 15 keV\n",
        ),
    ],
)
def test_a_plan_names_the_beam(scanner, beam):
    (one,) = parse_suite(
        'name = "s"\nphantom = { recipe = "validation", n_voxel = [8, 8, 8] }\n'
        f"scanner = {{ {scanner}, n_views = 2, n_detector = [8, 8], scatter = {{ level = 0 }} }}\n"
    )
    found = make_plan(build(one), one.resolve(), one.simulation, one.truth, "s")
    assert beam in found.text()
