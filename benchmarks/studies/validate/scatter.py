"""Scatter of levels 1 and 3 against long Monte Carlo runs of another stream, in cells of the detector."""

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import spectrum
from ctsim.benchmarks.studies.validate.finding import Check, Curves, check
from ctsim.benchmarks.suites import load, select
from ctsim.montecarlo.series import ScatterSeries, scatter_series
from ctsim.montecarlo.transport import Source, scatter_image
from ctsim.montecarlo.world import World
from ctsim.phantoms.scene import Scene, build, parse_suite
from ctsim.scatter import constant_fraction
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.types import Phantom, Scanner

CELLS = 32  # along a side: 3 pixels each
BEHIND = 2.0  # mm of metal
NORMAL_MEAN, NORMAL_95 = math.sqrt(2 / math.pi), 1.959964  # mean and 95th percentile of |x|, x normal
CHEBYSHEV_95 = math.sqrt(20)  # times the RMS: no distribution has more than 5 % beyond
HEAD = """
name = "head"
phantom = { recipe = "validation", size = 200.0, metal = "none", n_voxel = [32, 32, 32] }
[scanner]
tube = { kvp = 100.0 }
detector = { kind = "csi", thickness = 0.5 }
[scanner.geometry]
dso = 700.0
dsd = 1000.0
n_voxel = [64, 64, 64]
d_voxel = [3.125, 3.125, 3.125]
n_detector = [96, 96]
d_detector = [3.6, 3.6]
n_views = 60
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Long:
    """Scatter over the open field of a few views, [view, v, u] in cells: the reference and its standard error.

    `metal` is the mean metal path of the cell in mm.
    """

    views: tuple[int, ...]
    scatter: NDArray[np.float64]
    error: NDArray[np.float64]
    metal: NDArray[np.float64]


def lung(short: bool) -> list[Check]:
    """Compare on the thorax with iron of the suite `quick`."""
    return compared(select(load("quick"), ("lung-Fe",), ())[0], short)


def teeth(short: bool) -> list[Check]:
    """Compare on the jaw with titanium of the suite `quick`."""
    return compared(select(load("quick"), ("teeth-Ti",), ())[0], short)


def head(short: bool) -> list[Check]:
    """Compare on a water cylinder of the size of a head."""
    return compared(parse_suite(HEAD)[0], short)


def compared(scene: Scene, short: bool) -> list[Check]:
    """Return the checks of a scene."""
    phantom, scanner = build(scene), scene.resolve()
    histories, tolerance = (300_000, 0.05) if short else (8_000_000, 0.02)
    long = long_run(phantom, scanner, views=(0, 17) if short else (0, 17, 38), histories=histories)
    source = source_of(scanner)
    series = scatter_series(phantom, source, scanner.geometry, tolerance=tolerance, stream="validate")
    levels = {1: np.full(long.scatter.shape, constant_fraction(scanner.geometry)), 3: in_cells(series, long.views)}
    metal = long.metal > BEHIND
    found = []
    for level, images in levels.items():
        stated = series.error if level == 3 else None
        found += _rows(f"level {level}", images, long, np.ones_like(metal), stated)
        if metal.sum() > 10:
            found += _rows(f"level {level}, behind > {BEHIND:g} mm of metal", images, long, metal, None)
    return _with_profile(found, scene.name, levels, long)


def source_of(scanner: Scanner) -> Source:
    """Return the photons of a scanner without heel and bow-tie."""
    return Source(spectrum=spectrum(scanner.tube), detector=scanner.detector, n_detector=scanner.geometry.n_detector)


def long_run(phantom: Phantom, scanner: Scanner, *, views: tuple[int, ...], histories: int) -> Long:
    """Follow many photons in a few views."""
    source, geometry, tracer = source_of(scanner), scanner.geometry, Tracer.of(phantom)
    world = World.of(phantom, source.spectrum.e_max)
    images = [
        scatter_image(world, source, geometry.pose(k), cells=(CELLS, CELLS), histories=histories, stream=f"long {k}")
        for k in views
    ]
    of_metal = [k for k, m in enumerate(phantom.materials) if any(s.metal and s.material == m for s in phantom.solids)]
    paths = [_cells(path_lengths(tracer, geometry, k)[of_metal].sum(0)) for k in views]
    scatter, error = np.stack([i.scatter for i in images]), np.stack([i.error for i in images])
    return Long(views=views, scatter=scatter, error=error, metal=np.stack(paths))


def in_cells(series: ScatterSeries, views: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the mean signal of views of a series, averaged over cells."""
    return np.stack([_cells(series.view(k)[0].astype(np.float64)) for k in views])


def _cells(image: NDArray) -> NDArray[np.float64]:
    """Average an image [v, u] over cells."""
    n_v, n_u = image.shape
    return image.reshape(CELLS, n_v // CELLS, CELLS, n_u // CELLS).mean((1, 3), dtype=np.float64)


def _rows(
    what: str, images: NDArray[np.float64], long: Long, where: NDArray[np.bool_], stated: float | None
) -> list[Check]:
    """Return mean and 95th percentile of |ΔS|/S, both without the reference's own noise.

    `stated` is the RMS error over the mean that a series states for itself.
    """
    truth, sigma = long.scatter[where], long.error[where] / long.scatter[where]
    off = np.abs(images[where] - truth) / truth
    own = NORMAL_MEAN * float(sigma.mean()), float(NORMAL_95 * np.sqrt((sigma**2).mean()))
    measured = float(off.mean()), float(np.percentile(off, 95))
    # Cauchy and Schwarz: the mean of |ΔS|/S is at most the RMS of ΔS times that of 1/S; the RMS of ΔS/S is as much
    # where ΔS does not depend on S
    spread = float(long.scatter.mean() * np.sqrt((1 / long.scatter**2).mean()))
    limits = (None, None) if stated is None else (stated * spread, CHEBYSHEV_95 * stated * spread)
    bias = float(images[where].mean() / truth.mean() - 1)
    found = []
    for name, value, noise, limit in zip(("mean", "95 %"), measured, own, limits, strict=True):
        found.append(
            check(f"{name} of |ΔS|/S, {what}", math.sqrt(max(value**2 - noise**2, 0.0)), 0.0, relative=False,
                  tolerance=limit, why="" if limit is None else f"stated error, {stated:.2g} of the mean",
                  source=f"{truth.size} cells; {value:.3f} with its noise {noise:.3f}; bias {100 * bias:+.1f} %")
        )  # fmt: skip
    return found


def _with_profile(found: list[Check], name: str, levels: dict[int, NDArray[np.float64]], long: Long) -> list[Check]:
    """Return the checks, the first of them with profiles through the middle of the first view."""
    lines = {"long run": long.scatter} | {f"level {level}": images for level, images in levels.items()}
    middle = slice(CELLS // 2 - 2, CELLS // 2 + 2)
    curves = Curves(
        title=f"{name}, four rows in the middle", across="cell", up="S/I0", x=tuple(range(CELLS)),
        lines={key: tuple(images[0, middle].mean(0).tolist()) for key, images in lines.items()},
    )  # fmt: skip
    return [msgspec.structs.replace(found[0], curves=(curves,)), *found[1:]]
