"""Metal matters in the scenes of the main table: it is what they are for."""

import pytest
from msgspec.structs import replace

from ctsim import reconstruct_scan, score_volume, simulate_scene
from ctsim.benchmarks.suites import load
from ctsim.phantoms.scene import Scene

LEAST = 2.0  # dB that metal costs FDK with its window; at full size 2.6 or more, as the README says


def halved(scene: Scene) -> Scene:
    """Return a scene with half the voxels, pixels and views along each axis, and coarser scatter and focal spot."""
    phantom = replace(scene.phantom, n_voxel=(113, 113, 113))
    scanner = replace(scene.scanner, n_voxel=(64, 64, 64), n_detector=(112, 112), n_views=120)
    return replace(
        scene,
        phantom=phantom,
        scanner=scanner,
        simulation=replace(scene.simulation, scatter_error=0.3, spot_error=0.3),
    )


@pytest.mark.slow
@pytest.mark.parametrize("scene", load("headline"), ids=lambda scene: scene.name)
def test_metal_costs_fdk_two_decibels_in_every_headline_scene(scene: Scene) -> None:
    scan = simulate_scene(halved(scene))
    assert scan.metal_free is not None
    volume, twin = reconstruct_scan(scan), reconstruct_scan(scan.metal_free)
    with_metal = score_volume(volume, scan, protocols="tissue")["tissue"].values["psnr3d"]
    without = score_volume(twin, scan, variant="metal_free", protocols="tissue")["tissue"].values["psnr3d"]
    assert with_metal is not None
    assert without is not None
    assert without - with_metal >= LEAST
