"""Time and error of ways to project splats, in one process: `python -m ctsim.benchmarks.tools.splat_kernels OUT`.

Writes OUT/splat_kernels.md. Contenders take turns, seconds are medians over the rounds; errors are against the exact
form on the same splats. Two cases: a view of the published methods (50 000 splats of σ = 2.5 pixels, 512²), and a
lattice of the preset "fast" in a water cylinder on `core`'s scanner.
"""

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.host import commit, in_turns, machine
from ctsim.benchmarks.engine.table import simple
from ctsim.errors import InputError
from ctsim.kernels.lanes import WIDTH
from ctsim.phantoms.scanners import preset
from ctsim.reconstruct.splat.columns import LatticeProjector
from ctsim.reconstruct.splat.fast import finer
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector

ROUNDS = 7
CORE = preset("ideal", 240, (224, 224), (128, 128, 128), 60.0).geometry
VIEW = preset("ideal", 1, (512, 512), (256, 256, 256), 60.0).geometry
N_SPLATS, SIGMA = 50_000, 2.5  # of a published view; σ in pixels
NUMBERS = ("ms", "ns a splat and view", "relative RMS off the exact form")


def main(arguments: list[str]) -> int:
    """Measure and write the table; return 0."""
    if len(arguments) != 1:
        raise InputError("expected OUT, the folder for splat_kernels.md")
    out = Path(arguments[0])
    out.mkdir(parents=True, exist_ok=True)
    table = simple(("case", "what", *NUMBERS), [*published(), *lattice()], numbers=NUMBERS)
    text = f"{commit()}, {machine()}; medians of {ROUNDS} interleaved rounds.\n\n{table.markdown()}"
    (out / "splat_kernels.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)
    return 0


def published() -> list[list[str]]:
    """Measure one view of the published methods."""
    rng = np.random.default_rng(0)
    within = rng.normal(size=(N_SPLATS, 3))
    within *= (25 * rng.uniform(size=(N_SPLATS, 1)) ** (1 / 3)) / np.linalg.norm(within, axis=1, keepdims=True)
    scale = SIGMA * VIEW.d_detector[0] * VIEW.dso / VIEW.dsd
    splats = Splats(
        positions=within.astype(np.float32),
        scales=(scale * rng.uniform(0.7, 1.4, (N_SPLATS, 3))).astype(np.float32),
        rotations=rng.normal(size=(N_SPLATS, 4)).astype(np.float32),
        densities=rng.uniform(0, 0.1, (N_SPLATS, 2)).astype(np.float32),
    )
    ewa, exact = (Projector(geometry=VIEW, tolerance=tolerance) for tolerance in (np.inf, 0))
    shapes = splats.shapes()
    n_v, n_u = VIEW.n_detector
    back = np.zeros((2, n_v, n_u + WIDTH), np.float32)
    back[..., :n_u] = rng.normal(size=(2, n_v, n_u))
    found = _rounds(
        {
            "exact forward": lambda: exact.forward(shapes, splats.densities),
            "EWA forward": lambda: ewa.forward(shapes, splats.densities),
            "EWA gradient": lambda: ewa.gradient(splats, back, 0),
        }
    )
    reference = found["exact forward"][1]
    errors = {name: _error(found[name][1], reference) for name in ("exact forward", "EWA forward")}
    case = f"{N_SPLATS} splats, σ = {SIGMA:g} pixels, {n_v} × {n_u}, 1 view"
    return [_row(case, name, s, N_SPLATS, errors.get(name)) for name, (s, _) in found.items()]


def lattice() -> list[list[str]]:
    """Measure a lattice, by columns and splat by splat."""
    geometry = finer(CORE, 1.5)
    z, y, x = geometry.voxel_centres()
    support = (np.abs(z) < 25)[:, None, None] & (x**2 + y[:, None] ** 2 < 20**2)
    grid, views = Lattice(geometry=geometry, support=support), np.arange(0, geometry.n_views, 24)
    values = np.random.default_rng(0).uniform(0, 0.1, (len(grid), 2)).astype(np.float32)
    columns, ewa = LatticeProjector(geometry, grid), Projector(geometry=geometry, tolerance=np.inf)
    shapes = grid.splats(values).shapes()
    exact = Projector(geometry=geometry, tolerance=0).forward(shapes, values, views)
    pictures = exact[..., : geometry.n_detector[1]]
    laid = columns.arranged(pictures)
    found = _rounds(
        {
            "by columns, forward": lambda: columns.pictures(columns.forward(values, views)),
            "splat by splat, forward": lambda: ewa.forward(shapes, values, views)[..., : geometry.n_detector[1]],
            "by columns, adjoint": lambda: columns.adjoint(laid, views),
            "splat by splat, adjoint": lambda: ewa.adjoint(shapes, exact, views),
        }
    )
    back = Projector(geometry=geometry, tolerance=0).adjoint(shapes, exact, views)
    case = f"lattice of {len(grid)} splats, {geometry.n_detector[0]} × {geometry.n_detector[1]}, {len(views)} views"
    return [
        _row(case, name, s, len(grid) * len(views), _error(result, back if "adjoint" in name else pictures))
        for name, (s, result) in found.items()
    ]


def _rounds(contenders: dict[str, Callable[[], Any]]) -> dict[str, tuple[float, Any]]:
    """Run each once to compile, then in turns; return median seconds and the last result."""
    results: dict[str, Any] = {}
    runs = {name: lambda name=name, run=run: results.update({name: run()}) for name, run in contenders.items()}
    return {name: (statistics.median(seconds), results[name]) for name, (_, seconds) in in_turns(runs, ROUNDS).items()}


def _error(found: np.ndarray, reference: np.ndarray) -> float:
    difference = found.astype(np.float64) - reference
    return float(np.sqrt((difference**2).mean() / (reference.astype(np.float64) ** 2).mean()))


def _row(case: str, name: str, seconds: float, count: int, error: float | None) -> list[str]:
    off = "–" if error is None else f"{error:.1e}"
    return [case, name, _digits(1e3 * seconds), _digits(1e9 * seconds / count), off]


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    sys.exit(guarded("splat_kernels", "ctsim.benchmarks.tools.splat_kernels", sys.argv[1:], resumes=False))
