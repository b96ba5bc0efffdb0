"""One run of a field method: what all of them do before and after the fit."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.beyond import seen_beyond
from ctsim.reconstruct.field.data import Data, mean_attenuation, support_of
from ctsim.reconstruct.field.fit import Common, Fit, checkpoint_in
from ctsim.reconstruct.field.grid import Grid
from ctsim.reconstruct.field.physics import Physics
from ctsim.reconstruct.log import NO_SIGNAL, finite_or_not, is_blind, line_integrals
from ctsim.reconstruct.splat.checkpoint import identity_of
from ctsim.reconstruct.splat.fast import finer
from ctsim.reconstruct.watch import Stopwatch
from ctsim.reconstruct.weights import photon_weights
from ctsim.types import Scan, Status, Volume

Image = NDArray[np.float32]
S = TypeVar("S", bound=Common)


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """A scan as a field sees it: its line integrals [view, v, u], which of them were clamped, and the field's grid.

    `unit` is the mean attenuation in the hull of the shadows, 1/mm.
    """

    scan: Scan
    data: Data
    grid: Grid
    unit: float
    clamped: int
    scatter: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """The physics of a method, how its outputs [point, output] become a volume's values [point], and remarks.

    `at_energy(values, energy)` reads them at an energy in keV, None where a method does not know how.
    """

    physics: Physics
    read: Callable[[torch.Tensor], tuple[Image, str]]
    details: dict[str, Any]
    at_energy: Callable[[torch.Tensor, float], Image] | None = None


def truncated(scan: Scan) -> str | None:
    """Return why a field cannot be fitted to a scan whose object leaves the field of view, None if it can be."""
    p, clamped = line_integrals(scan, slice(None))
    if is_blind(scan, int(clamped.sum())):
        return None
    beyond = seen_beyond(p.numpy(), scan.geometry, scan.i0).sentence
    return f"a field explains all attenuation within the grid: {beyond}" if beyond else None


def on_cpu(function: Callable[[Scan, S], Volume]) -> Callable[[Scan, S], Volume]:
    """Refuse scans on another device, before anything looks at their counts.

    Raises InputError for counts on another device than the CPU.
    """

    @functools.wraps(function)
    def method(scan: Scan, settings: S) -> Volume:
        if scan.counts.device.type != "cpu":
            raise InputError(f"fields are fitted on the CPU only, expected the counts there, got {scan.counts.device}")
        return function(scan, settings)

    return method


def run(scan: Scan, settings: Common, make: Callable[[Given], Model], see: "See | None" = None) -> Volume:
    """Fit the field of a model to a scan that has none of its scatter, or whose `see` knows it.

    Raises InputError for a scan whose object leaves the field of view.
    """
    stopwatch = Stopwatch(limit=settings.seconds)
    if reason := truncated(scan):
        raise InputError(reason)
    seen = (see or plain)(scan, settings)
    geometry = scan.geometry
    if is_blind(scan, seen.clamped):
        details = {"clamped_pixels": seen.clamped, "view_updates": 0}
        return Volume(values=torch.zeros(geometry.n_voxel), status=Status.ERROR, reason=NO_SIGNAL, details=details)
    given = _given(seen, scan, settings)
    if given is None:
        details = {"clamped_pixels": seen.clamped, "limitation": "no ray met anything: the volume is empty"}
        return Volume(values=torch.zeros(geometry.n_voxel), details=details | {"view_updates": 0})
    model = make(given)
    fit = Fit(model.physics, given.grid, given.data, settings, given.unit)
    told = msgspec.structs.replace(settings, seconds=math.inf, checkpoints="")
    identity = identity_of(scan, told, type(settings).__qualname__, type(settings).__module__)
    if (checkpoint := checkpoint_in(settings.checkpoints, identity)) is not None:
        fit.resume(checkpoint, stopwatch)
    fit.go(stopwatch, lambda values: given.grid.volume(model.read(values)[0], geometry), checkpoint)
    volume = _volume(fit, model, given)
    volume.details.update(stopwatch.details())
    return volume


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """Line integrals and what of them counts: see `Data`; `scatter`, over the open field, is in them still."""

    data: Data
    clamped: int
    scatter: float = 0.0


See = Callable[[Scan, Any], Seen]


def plain(scan: Scan, settings: Common) -> Seen:
    """Take the logarithm; all pixels that have one count alike."""
    p, clamped = line_integrals(scan, slice(None))
    weights = (~clamped).numpy().astype(np.float32)
    return Seen(data=Data(p=p.numpy(), weights=weights), clamped=int(clamped.sum()))


def _given(seen: Seen, scan: Scan, settings: Common) -> Given | None:
    """Find the points and the mean attenuation; None where nothing casts a shadow."""
    data, geometry = seen.data, finer(scan.geometry, settings.fineness)
    weights = photon_weights(data.p, data.weights > 0)
    support = support_of(geometry, data.p, np.where(data.weights < 0, -1, weights), scan.i0, seen.scatter)
    if not support.any():
        return None
    grid = Grid.of(geometry, support)
    with torch.no_grad():
        lengths = grid.project(torch.ones(len(grid)), np.arange(geometry.n_views)).numpy()
    unit = mean_attenuation(data.p, data.weights, lengths)
    if unit == 0:
        return None
    return Given(scan=scan, data=data, grid=grid, unit=unit, clamped=seen.clamped, scatter=seen.scatter)


def _volume(fit: Fit, model: Model, given: Given) -> Volume:
    found, geometry = fit.found(), given.scan.geometry
    values, how = model.read(found)
    volume = given.grid.volume(values, geometry)
    sound = fit.adam.steps == 0 or bool(fit.best) or math.isfinite(fit.loss)
    status, reason = finite_or_not(volume) if sound else (Status.NONFINITE, "the last loss is not finite")
    at_energy = None
    if model.at_energy is not None:
        at_energy = functools.partial(_at_energy, model.at_energy, found, given.grid, geometry)
    edges = seen_beyond(given.data.p, geometry, given.scan.i0).details()
    return Volume(
        values=torch.from_numpy(volume),
        status=status,
        reason=reason,
        details={"clamped_pixels": given.clamped, "read-out": how, **fit.details(), **edges, **model.details},
        at_energy=at_energy,
    )


def _at_energy(
    read: Callable[[torch.Tensor, float], Image], found: torch.Tensor, grid: Grid, geometry: Geometry, kev: float
) -> torch.Tensor:
    """Return the attenuation in 1/mm at an energy; a function of the module, so that volumes can be pickled."""
    if not (isinstance(kev, int | float | np.floating) and math.isfinite(kev) and kev > 0):
        raise InputError(f"at_energy must be asked for a positive energy in keV, got {kev!r}")
    return torch.from_numpy(grid.volume(read(found, float(kev)), geometry))
