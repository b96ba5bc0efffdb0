"""What a plan says of a scene before it is simulated, against what simulating it takes."""

import tracemalloc

import numpy as np
import pytest

from ctsim.phantoms.bodies import Validation
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scanners import preset
from ctsim.plan import make_plan
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
    errors = [plan(parts, subrays=n).edge_error for n in (4, 34, 256)]
    # the error goes with the spacing 1/n of the lattice across an edge, but the largest sits in single pixels that
    # hardly anything passes, where it falls by luck
    assert errors[0] > 3 * errors[1] and errors[1] > errors[2] > 0
    bare = parts[0].without_metal()
    no_solids = type(bare)(labels=np.ones((8, 8, 8), np.uint8), materials=bare.materials, d_voxel=(7.0,) * 3)
    assert plan((no_solids, parts[1])).edge_error == 0
    assert "worst edge pixel" in plan(parts).text() and "edge pixel" not in plan((no_solids, parts[1])).text()


@pytest.mark.slow
def test_the_memory_that_a_plan_names_is_what_simulating_takes():
    tracemalloc.start()
    try:
        parts = scene(160)
        tracemalloc.reset_peak()
        made = plan(parts)
        for _ in simulate_views(made, *parts):
            pass
        for _ in truth_volumes(made, *parts):
            pass
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert made.memory_bytes / 1.6 < peak < made.memory_bytes * 1.6
