"""How well the scatter of a scan is found, and what it is worth to know it.

    python -m ctsim.benchmarks.tools.scatter docs/measured

Each scene of the suite `scatter` is simulated with its scatter stored, and reconstructed by splats, FDK, LIMAR and NMAR
four times: with scatter left in the readings, less one constant, less what is found, and less the true scatter. Lag and
glare of the panel are found and taken off for all of them. Controls stand in a table of their own. The page is written
to the folder, or printed without one.
"""

import dataclasses
import sys
from collections.abc import Sequence

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim import score_volume, simulate_scene
from ctsim.baselines.control import hull, zero
from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.table import simple
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.records import METAL
from ctsim.benchmarks.tools.page import headed, of_suite, rows_of
from ctsim.dataset.truth import ScanWithTruth
from ctsim.phantoms.scene import Scene
from ctsim.reconstruct.panel import panel_of, without_panel
from ctsim.reconstruct.primary import Readings, primary, scatter_in, without_scatter
from ctsim.reconstruct.scatter import Scatter
from ctsim.types import Scan, Volume

Image = NDArray[np.float32]
NAME = "scatter.md"
TITLE = "Scatter found in scans"
SUITE = "scatter"
BANDS = (("dark", 0.0, 0.05), ("medium", 0.05, 0.3), ("bright", 0.3, 0.95), ("open", 0.999, np.inf))
"""Names of bands of the primary over the open field, and their ends."""
METHODS = ("splat", "fdk", "limar", "nmar")
LEFT, CONSTANT, FOUND, TRUE = TOLD = ("0", "constant", "found", "true")
CAPTION = (
    "True: the mean scatter of all readings over the open field, by Monte Carlo unless the scene's name says constant. "
    "Found: what `scatter_of` finds in the counts alone, and by how much it is off where the primary is below 0.05 of "
    "the open field (dark), up to 0.3 (medium), up to 0.95 (bright), and where nothing is in the way (open). Constant: "
    "the mean of what is found where nothing is in the way, taken for all pixels. The width of the kernel was chosen "
    "on these scenes."
)
FARED = (
    "By what is taken off the readings: nothing (0), the constant, what is found, and the true mean scatter. Noise "
    "stays. Splats model what is left of a reading; for the others at least a tenth of each reading is kept."
)
CONTROL = (
    "PSNR3D of tissue (dB) of what is no method: zeros (zero), one value within the object's shadows (hull), and FDK "
    "of the same scan without the metal (twin-fdk). As for the methods, lag and glare are taken off the readings of "
    "hull and twin-fdk, and of scatter nothing (0) or what is found."
)
CORE = "Attenuation in the metal's core over the true one, for the methods that do not copy it from FDK."
HEAD = ("scene", "true (1e-3)", "found (1e-3)", "constant (1e-3)", *(name for name, *_ in BANDS))
PSNR = ("scene", *(f"{method}: {told}" for method in METHODS for told in TOLD))
CONTROLS = ("scene", "zero", "hull: 0", "hull: found", "twin-fdk: 0", "twin-fdk: found")
CORES = PSNR[: 1 + 2 * len(TOLD)]


def main(arguments: list[str]) -> int:
    """Write or print the page; return 0."""
    return of_suite(arguments, SUITE, NAME, page)


def page(scenes: Sequence[Scene]) -> str:
    """Return the page: how it was made, how well scatter is found, and how methods fare, a row for each scene."""
    rows = rows_of(scenes, row)
    text, start = [], 1
    for head, above in (
        (HEAD, ""),
        (PSNR, f"## PSNR3D of tissue (dB)\n\n{FARED}\n\n"),
        (CONTROLS, f"## Controls\n\n{CONTROL}\n\n"),
        (CORES, f"## Core\n\n{CORE}\n\n"),
    ):
        end = start + len(head) - 1
        cells = [[cells[0], *cells[start:end]] for cells in rows]
        text.append(above + simple(head, cells, numbers=head[1:]).markdown())
        start = end
    return headed(TITLE, __doc__, CAPTION, "\n".join(text))


def row(scene: Scene) -> list[str]:
    """Simulate a scene, find its scatter, reconstruct it by all methods, and return the cells of all tables."""
    stored = simulate_scene(scene)
    scan = stored.scan
    unscattered, both = (np.exp(-stored.array(name)) for name in ("scatter_free", "noise_free"))
    true = both - unscattered
    found = image_of(scatter_in(without_panel(scan, panel_of(scan)), "found"), scan)
    is_open = unscattered > BANDS[-1][1]
    constant = float(found[is_open].mean(dtype=np.float64)) if is_open.any() else 0.0
    fared = [fares(stored, name, told, constant, true) for name in METHODS for told in TOLD]
    return [
        scene.name,
        *(f"{1e3 * mean:.2f}" for mean in (true.mean(), found.mean(), constant)),
        *(off(found, true, (unscattered > low) & (unscattered <= high)) for _, low, high in BANDS),
        *(psnr for psnr, _ in fared),
        *controls(stored),
        *(core for _, core in fared[: len(CORES) - 1]),
    ]


def fares(stored: ScanWithTruth, name: str, told: str, constant: float, true: Image) -> tuple[str, str]:
    """Reconstruct a scan by a method that is told this of its scatter; return PSNR3D and the core's ratio."""
    method = find(name, {"panel": "found", "scatter": {CONSTANT: constant, FOUND: "found"}.get(told, 0.0)})
    scan = scan_for(method, stored, METAL)
    if told == TRUE:
        field = Scatter(floor=0, gain=1, source=true)
        scan = unfloored(scan, true) if name == "splat" else without_scatter(scan, field)
    return scored(method.reconstruct(scan), stored)


def controls(stored: ScanWithTruth) -> list[str]:
    """Return the cells of the controls."""
    readings = [Readings(panel="found", scatter=scatter) for scatter in (0.0, FOUND)]
    twins = [find("twin-fdk", msgspec.to_builtins(one)) for one in readings]
    volumes = [
        zero(stored.scan),
        *(primary(lambda scan, _: hull(scan))(stored.scan, one) for one in readings),
        *(twin.reconstruct(scan_for(twin, stored, METAL)) for twin in twins),
    ]
    return [scored(volume, stored)[0] for volume in volumes]


def scored(volume: Volume, stored: ScanWithTruth) -> tuple[str, str]:
    """Return PSNR3D and the core's ratio of a volume as a table shows them."""
    scores = score_volume(volume, stored, protocols=("tissue", "metal"))
    psnr, core = scores["tissue"].values["psnr3d"], scores["metal"].values["core_ratio"]
    return f"{psnr:.2f}", "n/a" if core is None else f"{core:.2f}"


def image_of(scatter: Scatter, scan: Scan) -> Image:
    """Return scatter over the open field, [view, v, u]."""
    return np.stack([scatter.of(view, scan.geometry.n_detector) for view in range(scan.geometry.n_views)])


def off(found: Image, true: Image, where: NDArray[np.bool_]) -> str:
    """Return by how much the mean of what was found differs from the true one, as a table shows it."""
    if not where.any():
        return "n/a"
    mean = float(true[where].mean(dtype=np.float64))
    return f"{100 * (float(found[where].mean(dtype=np.float64)) / mean - 1):+.0f} %"


def unfloored(scan: Scan, scatter: Image) -> Scan:
    """Return the scan with its true mean scatter, over the open field, taken off the counts."""
    open_field = scan.flat.numpy() - scan.dark
    counts = scan.counts.numpy().astype(np.float32) - scatter * open_field
    return dataclasses.replace(scan, counts=torch.from_numpy(counts.astype(np.float32)))


if __name__ == "__main__":
    sys.exit(guarded("scatter", "ctsim.benchmarks.tools.scatter", sys.argv[1:]))
