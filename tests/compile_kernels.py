"""Compile what most tests call, so that the processes of pytest load it and do not each compile it at the same time."""

import ctsim

scan = ctsim.simulate_scene(ctsim.find_scene("quick", "lung-Fe"))
ctsim.score_volume(ctsim.reconstruct_scan(scan, "nmar"), scan, protocols=["tissue"])
