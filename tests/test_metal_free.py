"""The metal-free twin of every recipe holds no metal.

The oracle is a scan of the same body whose metal was taken out before planning, with energies, materials and
edge thresholds of its own: it shares no image with the scan that holds metal.
"""

import numpy as np
import pytest

from ctsim.phantoms.recipes import NAMES
from ctsim.phantoms.scene import Scene, build, parse_suite
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views

METALS = {"metal_rods": "Al6061", "teeth": "Ti", "broccoli": "Al", "bell_pepper": "Al"}
SIZES = {"walnut": "size = 40.0", "metal_rods": "size = 60.0"}
RECIPES = [name for name in NAMES if name != "ct_volume"]


def scene(recipe: str, seed: int) -> Scene:
    size = SIZES.get(recipe, "size = 60.0")
    (found,) = parse_suite(
        f"""
        [[scene]]
        name = "body"
        seed = {seed}
        phantom = {{ recipe = "{recipe}", metal = "{METALS.get(recipe, "Fe")}", {size}, n_voxel = [48, 48, 48] }}
        [scene.scanner]
        n_voxel = [32, 32, 32]
        n_detector = [56, 56]
        n_views = 4
        """
    )
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "skip"), [(1, True), (2, False)])
@pytest.mark.parametrize("recipe", RECIPES)
def test_the_twin_of_a_scan_holds_no_metal(recipe, seed, skip):
    given = scene(recipe, seed)
    body, machine = build(given), given.resolve()
    bare = body.without_metal()
    assert any(s.metal for s in body.solids) and not any(s.metal for s in bare.solids)
    settings, truth = Simulation(skip=skip), Truth(noise_free=True)
    plan = make_plan(body, machine, settings, truth, "scene")
    alone = make_plan(bare, machine, settings, truth, "scene")
    shadowed = 0
    for (_, scan), (_, other) in zip(
        simulate_views(plan, body, machine), simulate_views(alone, bare, machine), strict=True
    ):
        apart = np.abs(scan["metal_free/noise_free"] - other["noise_free"])
        # the two plans choose energies and sub-rays by the materials they know; metal left behind is far above that
        assert apart.max() <= 0.05
        shadowed += np.count_nonzero(np.abs(scan["noise_free"] - other["noise_free"]) > 0.05)
    assert shadowed > 0  # metal is seen in the scan itself
