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
# by `scatter_error`, the largest mean and 95th percentile of |ΔS|/S behind metal, as docs/explanation/physics.md says
PROMISED = {0.02: (0.03, 0.08), 0.05: (0.10, 0.20)}
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
    histories, tolerances = (300_000, (0.05,)) if short else (8_000_000, (0.05, 0.02))
    long = long_run(phantom, scanner, views=(0, 17) if short else (0, 17, 38), histories=histories)
    source, metal = source_of(scanner), long.metal > BEHIND
    levels = {"level 1": np.full(long.scatter.shape, constant_fraction(scanner.geometry))}
    found = _both("level 1", levels["level 1"], long, metal, None, (None, None))
    for tolerance in tolerances:
        series = scatter_series(phantom, source, scanner.geometry, tolerance=tolerance, stream="validate")
        name = f"level 3 to {tolerance:.0%}"
        levels[name] = in_cells(series, long.views)
        found += _both(name, levels[name], long, metal, series.error, PROMISED[tolerance])
    return _with_profile(found, scene.name, levels, long)


def _both(
    what: str, images: NDArray[np.float64], long: Long, metal: NDArray[np.bool_], stated: float | None,
    promised: tuple[float | None, float | None],
) -> list[Check]:  # fmt: skip
    """Return the rows of the whole image, and of the cells behind metal if there are some.

    `stated` is the RMS error over the mean that a series states for itself.
    """
    truth = long.scatter
    # Cauchy and Schwarz: the mean of |ΔS|/S is at most the RMS of ΔS times that of 1/S; the RMS of ΔS/S is as much
    # where ΔS does not depend on S
    spread = float(truth.mean() * np.sqrt((1 / truth**2).mean()))
    limits = (None, None) if stated is None else (stated * spread, CHEBYSHEV_95 * stated * spread)
    why = "" if stated is None else f"stated error, {stated:.2g} of the mean"
    found = _rows(what, images, long, np.ones_like(metal), limits, why)
    if metal.sum() > 10:
        why = "" if stated is None else "promised in physics.md"
        found += _rows(f"{what}, behind > {BEHIND:g} mm of metal", images, long, metal, promised, why)
    return found


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
    what: str, images: NDArray[np.float64], long: Long, where: NDArray[np.bool_],
    limits: tuple[float | None, float | None], why: str,
) -> list[Check]:  # fmt: skip
    """Return mean and 95th percentile of |ΔS|/S in the cells `where`, both without the reference's own noise."""
    truth, sigma = long.scatter[where], long.error[where] / long.scatter[where]
    off = np.abs(images[where] - truth) / truth
    own = NORMAL_MEAN * float(sigma.mean()), float(NORMAL_95 * np.sqrt((sigma**2).mean()))
    measured = float(off.mean()), float(np.percentile(off, 95))
    bias = float(images[where].mean() / truth.mean() - 1)
    return [
        check(f"{name} of |ΔS|/S, {what}", math.sqrt(max(value**2 - noise**2, 0.0)), 0.0, relative=False,
              tolerance=limit, why=why,
              source=f"{truth.size} cells; {value:.3f} with its noise {noise:.3f}; bias {100 * bias:+.1f} %")
        for name, value, noise, limit in zip(("mean", "95 %"), measured, own, limits, strict=True)
    ]  # fmt: skip


def _with_profile(found: list[Check], name: str, levels: dict[str, NDArray[np.float64]], long: Long) -> list[Check]:
    """Return the checks, the first of them with profiles through the middle of the first view."""
    lines = {"long run": long.scatter} | levels
    middle = slice(CELLS // 2 - 2, CELLS // 2 + 2)
    curves = Curves(
        title=f"{name}, four rows in the middle", across="cell", up="S/I0", x=tuple(range(CELLS)),
        lines={key: tuple(images[0, middle].mean(0).tolist()) for key, images in lines.items()},
    )  # fmt: skip
    return [msgspec.structs.replace(found[0], curves=(curves,)), *found[1:]]
