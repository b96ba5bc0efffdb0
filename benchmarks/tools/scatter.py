"""How well splats find the scatter of a scan, and what it is worth to know it.

    python -m ctsim.benchmarks.tools.scatter docs/measured

Each scene of the suite `scatter` is simulated with its scatter stored, and reconstructed three times: with scatter left
in the readings, with what is found, and with the true scatter taken off. The page is written to the folder, or printed
without one.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim import score_volume, simulate_scene
from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.tools.page import headed, of_suite, rows_of
from ctsim.phantoms.scene import Scene
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.scatter import scatter_of
from ctsim.reconstruct.splat.fast import Settings, reconstruct
from ctsim.types import Scan

NAME = "scatter.md"
TITLE = "Scatter that splats find"
SUITE = "scatter"
BANDS = (("dark", 0.0, 0.05), ("medium", 0.05, 0.3), ("bright", 0.3, 0.95), ("open", 0.999, np.inf))
"""Names of bands of the primary over the open field, and their ends."""
CAPTION = (
    "True: the mean scatter of all readings over the open field, by Monte Carlo unless the scene's name says constant. "
    "Found: what `scatter_of` finds in the counts alone, and by how much it is off where the primary is below 0.05 of "
    "the open field (dark), up to 0.3 (medium), up to 0.95 (bright), and where nothing is in the way (open). PSNR3D of "
    "tissue (dB) and the attenuation in the metal's core over the true one: with scatter left in the readings (0), "
    "with what is found, and with the true mean scatter taken off the counts, whose noise stays. The width of the "
    "kernel was chosen on these scenes."
)
HEAD = (
    *("scene", "true (1e-3)", "found (1e-3)", *(name for name, *_ in BANDS)),
    *("0: PSNR3D", "core", "found: PSNR3D", "core", "true: PSNR3D", "core"),
)


def main(arguments: list[str]) -> int:
    """Write or print the page; return 0."""
    return of_suite(arguments, SUITE, NAME, page)


def page(scenes: Sequence[Scene]) -> str:
    """Return the page: how it was made, and a row for each scene."""
    return headed(TITLE, __doc__, CAPTION, table(rows_of(scenes, row)).markdown())


def table(rows: Sequence[Sequence[str]]) -> Table:
    """Return the table of rows of cells."""
    return simple(HEAD, [list(cells) for cells in rows], numbers=HEAD[1:])


def row(scene: Scene) -> list[str]:
    """Simulate a scene, find its scatter, reconstruct it three times, and return its cells."""
    stored = simulate_scene(scene)
    scan = stored.scan
    primary, both = (np.exp(-stored.array(name)) for name in ("scatter_free", "noise_free"))
    true, found = both - primary, found_in(scan)

    def fared(of: Scan, **settings: Any) -> list[str]:
        scores = score_volume(reconstruct(of, Settings(**settings)), stored)
        psnr, core = scores["tissue"].values["psnr3d"], scores["metal"].values["core_ratio"]
        return [f"{psnr:.2f}", "n/a" if core is None else f"{core:.2f}"]

    return [
        scene.name,
        f"{1e3 * true.mean():.2f}",
        f"{1e3 * found.mean():.2f}",
        *(off(found, true, (primary > low) & (primary <= high)) for _, low, high in BANDS),
        *fared(scan, scatter=0.0),
        *fared(scan),
        *fared(without(scan, true), scatter=0.0),
    ]


def found_in(scan: Scan) -> NDArray[np.float32]:
    """Return the scatter over the open field that is found in a scan, [view, v, u]."""
    p, clamped = line_integrals(scan, slice(None))
    scatter = scatter_of(p.numpy(), ~clamped.numpy(), scan.geometry, scan.i0)
    return np.stack([scatter.of(view, scan.geometry.n_detector) for view in range(scan.geometry.n_views)])


def off(found: NDArray[np.float32], true: NDArray[np.float32], where: NDArray[np.bool_]) -> str:
    """Return by how much the mean of what was found differs from the true one, as a table shows it."""
    if not where.any():
        return "n/a"
    mean = float(true[where].mean(dtype=np.float64))
    return f"{100 * (float(found[where].mean(dtype=np.float64)) / mean - 1):+.0f} %"


def without(scan: Scan, scatter: NDArray[np.float32]) -> Scan:
    """Return the scan with its true mean scatter, over the open field, taken off the counts."""
    open_field = scan.flat.numpy() - scan.dark
    counts = scan.counts.numpy().astype(np.float32) - scatter * open_field
    return dataclasses.replace(scan, counts=torch.from_numpy(counts.astype(np.float32)))


if __name__ == "__main__":
    sys.exit(guarded("scatter", "ctsim.benchmarks.tools.scatter", sys.argv[1:]))
