"""The method "splat": polychromatic splats from counts, geometry and the greatest energy alone.

Coarse to fine: the object is carved from its shadows, fitted on a coarse grid from a start of plain water, and refined
to a grid finer than the volume's, as fine as the detector sees. No mask, no spectrum (unless one is given) and no FDK
enter.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry, few_views
from ctsim.reconstruct.beam import detected, known_detector, refuse_beam, refuse_filtration
from ctsim.reconstruct.beyond import seen_beyond
from ctsim.reconstruct.log import how_it_ended, line_integrals
from ctsim.reconstruct.panel import without_panel
from ctsim.reconstruct.primary import PanelLight, Scattered, panel_in, scatter_in
from ctsim.reconstruct.scatter import Scatter
from ctsim.reconstruct.settings import about, keywords
from ctsim.reconstruct.splat.checkpoint import Checkpoint, identity_of
from ctsim.reconstruct.splat.common import Common, Energy
from ctsim.reconstruct.splat.course import PASSES, Course, levels_of, passes_over
from ctsim.reconstruct.splat.curve import DENSEST, MaterialCurve
from ctsim.reconstruct.splat.filtration import USUAL, Filtration, found
from ctsim.reconstruct.splat.level import (
    VIEWS,
    Data,
    by_photons,
    doubted,
    edges_doubted,
    evening_error,
    least_met,
    some_readings,
    thinned,
)
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.response import (
    FILTER,
    SCINTILLATOR,
    Response,
    basis_functions,
    evaluate,
    make_response,
    tangent,
)
from ctsim.reconstruct.splat.verdict import bounded, dark_misfit, flat, metal_unread, uneven, unexplained, verdict
from ctsim.reconstruct.starved import Below, weights_and_bounds
from ctsim.reconstruct.watch import Stopwatch
from ctsim.reconstruct.weights import doubt_edges, even_out
from ctsim.types import Scan, Status, Volume

SHORTEST = 0.5  # path in voxels that counts as one
ROUND = 1.25
"""Greatest ratio of a voxel's sides on the finest grid, where pixels are as fine: a sum of round splats then varies by
10 % from one to the next, by 4 % on cubes."""
ENOUGH, VIEWED = 32, 4  # voxels along an axis, and views, on which the filtration is found
TRIAL, LONE_TRIAL = (8, 4), (0, 6)
"""Passes of a trial, and of one over a grid that is alone. With 2 over coarser grids, thick aluminium that few photons
pass is still so faint that the misfit has valleys where there is no beam."""
Image = NDArray[np.float32]


Passes = Annotated[int, msgspec.Meta(ge=0, le=1000)]
Filter = Annotated[float, msgspec.Meta(ge=0, le=FILTER[2])]


class Settings(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a fit goes, what beam it assumes, and how its volume is read.

    `passes` null makes them 20 and 9, or 12 over a grid that is alone, and fewer, at least one, where the passes over a
    level times its views times its voxels would be more than 9e10, minutes of two cores, or over a coarser grid more
    than a quarter of that over the finest (of two passes at least). `tv` is stronger in the first
    passes and on coarser levels. Weights are the share of photons that came through. On coarser grids those of dark
    rays are raised as by an error of P of 0.005 besides noise. Where a body is thick they are raised on the finest
    grid, too, to half of the usual weight, but by no more than an error of `model_error` would; 0 leaves them there.
    `edges` then lowers some.
    The finest grid is at most as fine as the detector's pixels at the isocentre. With `fine_metal` the splats within
    two voxels of the surface of metal are half as far apart in the second half of the passes over each grid.
    `response` "tube" is a tube behind `filtration`, seen by `detector`, null for 0.2 mm of GOS; `filtration` null has
    it found, on grids of at least 32 voxels along x and y, and a thinner screen where there is next to none.
    `readout` "hardened" is by the object's own water; `Volume.at_energy` gives the volume at any energy. `scatter`
    "found" is what the pixels tell that no shadow reaches (`scatter_of`), with its course over the panel; a number is
    the same everywhere, and 0 is for scans whose open pixels are brighter than their open field for another reason.
    """

    passes: Annotated[tuple[Passes, Passes] | None, about("over the views: on each coarser level, on the finest")] = (
        None
    )
    tv: Annotated[float, about("denoising threshold per 100 views", "of water", ge=0, le=1000)] = 0.025
    edges: Annotated[
        float, about("second difference of P between pixels that halves an open ray's weight", ge=1e-3, le=1e6)
    ] = 0.5
    model_error: Annotated[
        float, about("error of P besides noise by which weights behind thick bodies may be evened out", ge=0, le=10)
    ] = 0.02
    fineness: Annotated[float, about("how much finer the finest grid is than the volume's", ge=1, le=16)] = 1.5
    fine_metal: Annotated[bool, about("finer splats at the surface of metal, seen by sub-pixels")] = True
    exact: Annotated[bool, about("project splats by their exact line integrals, not by EWA")] = False
    response: Annotated[Literal["tube", "known"], about("beam: assumed, or known from tube and detector")] = "tube"
    filtration: Annotated[Filter | None, about("filtration behind the assumed tube; null: found", "mm Al")] = None
    readout: Annotated[Energy | Literal["hardened"], about("energy at which the volume is read")] = "hardened"
    panel: PanelLight = "found"
    scatter: Scattered = "found"

    def __post_init__(self) -> None:
        Common.__post_init__(self)
        if self.passes == (0, 0):
            raise InputError("passes: expected two counts that are not both 0, got (0, 0)")
        refuse_beam(self.response, self.tube, self.detector)
        refuse_filtration(self.response, self.filtration)

    @property
    def assumed(self) -> float:
        """The filtration (mm Al) where none is found."""
        return USUAL if self.filtration is None else self.filtration

    def make_response(self, e_max: float, filtration: float) -> Response:
        """Build the response for a scan of greatest energy `e_max` (keV), of the tube behind a `filtration` (mm Al).

        Below 0 it is none, and the assumed screen is thinner by as many mm.
        """
        if self.response == "tube":
            sees = SCINTILLATOR if self.detector is None else known_detector(self.detector)
            if filtration < 0:
                sees = msgspec.structs.replace(sees, thickness=sees.thickness + filtration)
            theta = (max(filtration, 0.0),)
            return make_response("tube", e_max=e_max, basis="klein-nishina", theta=theta, detector=sees)
        seen = detected(self.tube, self.detector, e_max)
        return make_response("known", e_max=e_max, basis="klein-nishina", spectrum=seen)


@keywords(Settings)
def reconstruct(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan`, attenuation in 1/mm; keywords are those of `Settings`.

    Details hold the volumes "rho_a" and "rho_b" under "densities", and under "grid" how many voxels the finest
    lattice has over the volume, be it that of metal alone.
    """
    stopwatch = Stopwatch(limit=settings.seconds)
    as_read, panel = Below.of(scan), panel_in(scan, settings.panel)
    scan = without_panel(scan, panel)
    scatter = scatter_in(scan, settings.scatter)  # first: it takes line integrals of its own, which are then gone
    finest = finer(scan.geometry, settings.fineness)
    data, clamped = _weighted(scan, settings, finest, scatter, (Below.of(scan) if panel else as_read).noise)
    levels = levels_of(data, coarse=(settings.passes or PASSES)[0] > 0)
    filtration = None if clamped.all() else find_filtration(levels, scan, settings)
    response = settings.make_response(scan.e_max, filtration.value if filtration else settings.assumed)

    levels = doubted(levels, scan.i0, settings.edges)
    fit = None if clamped.all() else _fitted(_course(levels, response, settings), scan, settings, stopwatch)
    details: dict[str, Any] = {
        "response": response.described(),
        **({} if filtration is None else {"filtration": filtration.described()}),
        **(panel.details() if settings.panel == "found" else {}),
        **scatter.details(),
        "clamped_pixels": int(clamped.sum()),
        "evened_out": data.error,
        "grid": list(finest.n_voxel) if fit is None else [n * fit.finer for n in fit.data.geometry.n_voxel],
        "splats": 0 if fit is None else fit.n_splats,
    }
    if fit is None:
        nothing, empty = np.zeros((2, *scan.geometry.n_voxel), np.float32), torch.zeros(scan.geometry.n_voxel)
        at_energy = functools.partial(_at_energy, nothing, response)
        status, reason = how_it_ended(empty, scan, int(clamped.sum()))
        if status is Status.OK:
            details["limitation"] = "no ray met anything: the volume is empty"
        return Volume(values=empty, status=status, reason=reason, details=details, at_energy=at_energy)
    values, rho, how = _read(fit, settings, scan.geometry)
    status, reason = verdict(fit, values)
    missed, unread = dark_misfit(fit), metal_unread(fit, _summed(fit.curve.tangent, rho), scan.geometry)
    beyond = seen_beyond(data.p, scan.geometry, scan.i0)
    found_at = "" if filtration is None else filtration.sentence
    of_metal = unexplained(fit, missed), bounded(unread)
    limits = as_read.sentence, panel.sentence, *of_metal, beyond.sentence, found_at, flat(finest), uneven(data)
    details |= {
        "read-out": how,
        "dark_misfit": missed,
        "metal_unread": unread,
        **({"limitation": "; ".join(filter(None, limits))} if any(limits) else {}),
        "misfit": fit.misfit if math.isfinite(fit.misfit) else None,
        "view_updates": fit.view_updates,
        **stopwatch.details(),
        "densities": {"rho_a": rho[0], "rho_b": rho[1]},
    }
    return Volume(
        values=torch.from_numpy(values),
        status=status,
        reason=reason,
        details=details,
        at_energy=functools.partial(_at_energy, rho, response),
    )


def _weighted(
    scan: Scan, settings: Settings, geometry: Geometry, scatter: Scatter, noise: float
) -> tuple[Data, NDArray[np.bool_]]:
    """Return the scan as the finest grid sees it, and which readings [view, v, u] are clamped."""
    readings, clamped = line_integrals(scan, slice(None))
    p = readings.numpy()
    weights = weights_and_bounds(scan, p, ~clamped.numpy(), scatter, noise)
    data = Data(geometry=geometry, p=p, weights=weights, scatter=scatter.mean)
    data = dataclasses.replace(data, error=evening_error(data, settings.model_error**2 * scan.i0))
    even_out(weights, data.error)
    doubt_edges(p, weights, settings.edges, scatter.mean)
    return data, clamped.numpy()


def find_filtration(levels: list[Data], scan: Scan, settings: Settings) -> Filtration | None:
    """Find the filtration by trial fits; None where it is given, the beam is known, or grids or views are too few.

    All are made on the grid of 32 to 63 voxels along the shortest axis and the next one, if there is a finer one still.
    Those of soft beams are made on the next one, if there is one, the fit's own or not.

    Edges that no grid holds are the misfit on a coarse one: on 18 voxels 12 mm of aluminium are found where 0.5 are
    right. Two views contradict each other before no beam: 19 mm are found.
    """
    given = settings.response != "tube" or settings.filtration is not None
    if given or min(levels[-1].geometry.n_voxel[1:]) < ENOUGH:
        return None
    levels = levels if len(levels) > 1 else levels_of(levels[-1], coarse=True)
    k = next(k for k, level in enumerate(levels) if min(level.geometry.n_voxel[1:]) >= ENOUGH)
    if levels[k].geometry.n_views < VIEWED:
        return None
    coarse, more = levels[: k + 1], k + 2 < len(levels)
    if k + 1 == len(levels) and levels[k].error:  # the finest grid, of a flat or a small scan
        coarse = [*levels[:k], by_photons(levels[k])]
    some = [*levels[: k + 1], thinned(levels[k + 1])] if more else levels

    def fits_on(few: list[Data]) -> Callable[[float], Fit | None]:
        brief = msgspec.structs.replace(settings, passes=TRIAL if len(few) > 1 else LONE_TRIAL)

        def fit_of(value: float) -> Fit | None:
            course = _course(few, settings.make_response(scan.e_max, value), brief, trial=True)
            return course.go(lambda fit, whole, share: True)

        return fit_of

    @functools.cache
    def off_edges() -> Callable[[float], Fit | None]:  # where errors are most of a soft beam's misfit
        last = some[-1] if more else by_photons(some[-1])
        return fits_on([*some[:-1], edges_doubted(last, settings.edges)])

    # on the finest grid, trials take as long as the fit: soft beams alone are worth it
    fine = fits_on(some) if more else None
    return found(fits_on(coarse), fine, lambda value: off_edges()(value), screen_assumed=settings.detector is None)


def _fitted(course: Course, scan: Scan, settings: Settings, stopwatch: Stopwatch) -> Fit | None:
    """Fit until the end or that of the time; keep what is unfinished, if that is asked for."""
    kept = _checkpoint(course, scan, settings) if settings.checkpoints else None
    begun, over = None, False
    if kept is not None and (state := kept.read()) is not None:
        try:
            begun, earlier = course.restored(state), float(state["seconds"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise kept.damaged(error) from None
        stopwatch.resume(earlier)

    def proceed(fit: Fit, whole: bool, share: float) -> bool:
        nonlocal over
        stopwatch.tell(share, fit.loss)
        stopwatch.show(fit.view_updates, lambda: _read(fit, settings, scan.geometry)[0], whole=whole)
        over = stopwatch.over
        if kept is not None and (over or kept.due()):
            kept.write({**course.state(fit), "seconds": np.array(stopwatch.seconds)})
        return not over

    fit = course.go(proceed, begun)
    if kept is not None and not over:
        kept.remove()
    return fit


def _checkpoint(course: Course, scan: Scan, settings: Settings) -> Checkpoint:
    """Return where a fit is kept, named by what its state depends on: not by its end, its read-out, or the folder."""
    told = msgspec.structs.replace(settings, seconds=math.inf, readout="hardened", checkpoints="")
    return Checkpoint(
        folder=Path(settings.checkpoints), identity=identity_of(scan, (told, course.passes), "splat", __name__)
    )


def finer(geometry: Geometry, fineness: float) -> Geometry:
    """Return the geometry with up to `fineness` times as many voxels along each axis, none smaller than a pixel.

    Voxels are made no more than `ROUND` times as long as wide, since splats are round. A volume's sharp edges lie
    beyond the frequencies of its own grid. Fitted on that grid they ring; on one half as fine again the error in the
    tissue fell by about 2 dB.
    """
    pixel, least = min(geometry.d_detector) * geometry.dso / geometry.dsd, min(geometry.d_voxel)
    finest = [min(fineness * max(1.0, d / (ROUND * least)), d / pixel) for d in geometry.d_voxel]
    n = [max(k, round(k * more)) for k, more in zip(geometry.n_voxel, finest, strict=True)]
    d_voxel = tuple(d * k / m for d, k, m in zip(geometry.d_voxel, geometry.n_voxel, n, strict=True))
    return msgspec.structs.replace(geometry, n_voxel=tuple(n), d_voxel=d_voxel)


def _read(fit: Fit, settings: Settings, geometry: Geometry) -> tuple[Image, Image, str]:
    """Return the volume as settings want it read, [z, y, x], ρa and ρb [2, z, y, x], and in words how it was read."""
    if settings.readout == "hardened":
        length = typical_length(fit)
        weights, how = tangent(fit.response, fit.curve.of_water, length), f"hardened by {length:.1f} mm of water"
    else:
        weights, how = _at(settings.readout, fit.response), f"at {settings.readout:g} keV"
    rho = fit.densities(geometry)
    return _summed(weights, rho), rho, how


def _at_energy(rho: Image, response: Response, kev: float) -> torch.Tensor:
    """Return the attenuation in 1/mm at an energy; a function of the module, so that volumes can be pickled."""
    _refuse_unless_energy(kev, "at_energy must be asked for a positive energy in keV")
    return torch.from_numpy(_summed(_at(kev, response), rho))


def _refuse_unless_energy(kev: Any, expected: str) -> None:
    if not (isinstance(kev, int | float | np.floating) and math.isfinite(kev) and kev > 0):
        raise InputError(f"{expected}, got {kev!r}")


def _at(kev: float, response: Response) -> tuple[float, float]:
    """Return what ρa and ρb count at an energy."""
    a, b = basis_functions(np.array([kev]), response.basis, response.e_max)
    return float(a[0]), float(b[0])


def _summed(weights: tuple[float, float], rho: Image) -> Image:
    return np.float32(weights[0]) * rho[0] + np.float32(weights[1]) * rho[1]


def _course(levels: list[Data], response: Response, settings: Settings, trial: bool = False) -> Course:
    data = levels[-1]
    met = least_met(data)
    return Course(
        levels=levels,
        passes=passes_over(levels, settings.passes),
        response=response,
        curve=MaterialCurve.of(response, rough_length(data, response, met)),
        met=met,
        tv=settings.tv,
        exact=settings.exact,
        fine_metal=settings.fine_metal and not trial,
        trial=trial,
    )


def rough_length(data: Data, response: Response, met: float) -> float:
    """Return the water path (mm) behind which p is the median of the rays that met something."""
    p = some_readings(data)
    seen = p[p > met + data.open]
    if not seen.size:
        return 0.0
    lengths = np.linspace(0, 500, 2001)
    la, lb = ((lengths * density).astype(np.float32) for density in MaterialCurve.of(response, 0.0).of_water)
    found, _, _ = evaluate(response, la, lb)
    return float(np.interp(np.median(seen), -np.log(np.exp(-found) + data.scatter), lengths))


def typical_length(fit: Fit) -> float:
    """Return the median water-equivalent path (mm) through what is no metal, of the rays that meet it."""
    geometry, water = fit.data.geometry, fit.curve.water

    def of_water(u: Image) -> Image:
        return np.where(u < DENSEST * water, u / water, 0).astype(np.float32)

    paths = fit.integrals(of_water, few_views(geometry.n_views, VIEWS))
    met = paths[paths > SHORTEST * max(geometry.d_voxel)]
    return float(np.median(met)) if met.size else 0.0
