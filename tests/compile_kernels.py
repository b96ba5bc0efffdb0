"""Compile what most tests call, so that the processes of pytest load it and do not each compile it at the same time."""

import ctsim

scene = ctsim.new_scene(
    name="small",
    phantom={"recipe": "lung", "metal": "Fe", "n_voxel": (48, 48, 48), "size": 60.0},
    scanner={"preset": "skyscan1273", "n_voxel": (32, 32, 32), "n_detector": (48, 48), "n_views": 12},
    simulation={"scatter_error": 0.5},
)
scan = ctsim.simulate_scene(scene)
ctsim.score_volume(ctsim.reconstruct_scan(scan, "nmar"), scan, protocols=["tissue"])
