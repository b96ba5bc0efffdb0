"""Normalised metal artefact reduction (NMAR), in cone beam.

Meyer, Raupach, Lell, Schmidt and Kachelriess, Med. Phys. 37, 2010, doi:10.1118/1.3484090: projections are divided
by those of a prior, an image of tissue classes, before the metal trace is interpolated, and multiplied again.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.inpaint import Filled, fill
from ctsim.baselines.limar import Bridging, finished, mended, uncorrected
from ctsim.baselines.metal import Trace, find_metal, reinsert
from ctsim.baselines.prior import FITTED, NO_BODY, choose_prior, fitted_prior
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.projector import forward_columns
from ctsim.reconstruct.settings import about, keywords
from ctsim.types import Scan, Status, Volume

Normalisation = Annotated[
    Literal["offset", "additive", "ratio"],
    about("how the prior's projections flatten the measured ones before bridging"),
]
Prior = Annotated[
    Literal["auto", "fdk", "limar", "splat", "field"],
    about("volume that the prior is made from; auto: limar if it fits the projections better, else fdk"),
]
Floor = Annotated[float, msgspec.Meta(gt=0, le=1e6)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalise:
    """How measured projections P are made flat by the prior's q before they are interpolated (LI), and back.

    "offset": (q + c)·LI[(P + c)/(q + c)] − c with c = `floor`·max q (default 0.2). "additive", its limit c → ∞:
    q + LI[P − q]. "ratio": Q·LI[P/Q], Q = max(q, `floor`·max q) (default 0.05); with a tiny floor it diverges where the
    metal's shadow leaves the prior's.
    """

    kind: str = "offset"
    floor: float | None = None

    def fill(
        self,
        p: NDArray[np.float32],
        q: NDArray[np.float32],
        trace: NDArray[np.bool_],
        filled: Filled,
        largest: float,
        how: str,
    ) -> NDArray[np.float32]:
        """Return `p` [v, u] with its trace filled; `largest` is the greatest projection of the prior."""
        floor = self.floor if self.floor is not None else 0.2 if self.kind == "offset" else 0.05
        if self.kind == "additive" or largest <= 0:  # a prior of air has nothing to divide by
            scale, shift = np.ones_like(q), -q
        elif self.kind == "offset":
            c = np.float32(floor * largest)
            scale, shift = q + c, np.full_like(q, c)
        else:
            scale, shift = np.maximum(q, np.float32(floor * largest)), np.zeros_like(q)
        flat = (p + shift) / scale
        fill(flat, trace, how, filled)
        return np.where(trace, scale * flat - shift, p).astype(np.float32)


class Settings(Bridging, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Those of `ctsim.baselines.limar.Bridging`; `normalisation` and `floor` as in `Normalise`; and which prior.

    With `prior` "auto" it is LIMAR's where its projections fit the measured ones better by a twentieth around the
    trace (`ctsim.baselines.prior.choose_prior`), else FDK's. "splat" and "field" are those methods' volumes, by their
    defaults, with water for metal (`ctsim.baselines.prior.fitted_prior`).
    """

    prior: Prior = "auto"
    normalisation: Normalisation = "offset"
    floor: Annotated[
        Floor | None, about("added to the divisor, or its least value; null: 0.2, or 0.05 for ratio", "of max q")
    ] = None


@keywords(Settings)
@primary
def reconstruct(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan` with the metal trace interpolated after normalisation by a prior; keywords as `Settings`.

    Without metal, or where the mask is not to be relied on, the result is FDK's to the last bit and nothing is
    projected. Raises InputError as LIMAR does.
    """
    first = fdk(scan, window=settings.window, cutoff=settings.cutoff)
    x_0 = first.values.numpy()
    metal = find_metal(scan, x_0, settings.mask)
    if first.status is not Status.OK or not metal.found:
        return uncorrected(first, metal)
    trace = Trace(metal, scan, settings.dilation)
    if settings.prior in FITTED:
        choice = fitted_prior(trace, metal, scan, settings.prior)
    else:
        choice = choose_prior(trace, metal, first.values, settings, settings.prior, settings.interpolation) or NO_BODY
    if isinstance(choice, str):
        return uncorrected(first, metal, choice)
    rule = Normalise(kind=settings.normalisation, floor=settings.floor)
    bridge = functools.partial(rule.fill, largest=choice.largest, how=settings.interpolation)
    values, filled = normalised(trace, first.values, choice.columns, bridge, settings)
    reinsert(values, x_0, metal, settings.insert)
    details: dict[str, object] = {"dilation": settings.dilation, "largest_prior": choice.largest}
    shown = filled.intermediates(trace.view(filled.shown))
    details["intermediates"] = shown | {"prior": choice.columns.transpose(2, 0, 1)}
    details |= {"view_updates": (2 + choice.view_updates) * scan.geometry.n_views + choice.fitted}
    return finished(values, first, metal, details | choice.details() | filled.details())


Bridge = Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], Filled], NDArray[np.float32]]


def normalised(
    trace: Trace, first: torch.Tensor, columns: NDArray[np.float32], bridge: Bridge, by: Filter
) -> tuple[torch.Tensor, Filled]:
    """Return FDK of the projections, their trace bridged with those of a prior, and what was filled.

    `first` [z, y, x] is FDK without, made with the filter `by`; the prior is stored as `columns` [y, x, z].
    `bridge(p, q, trace, filled)` gets the rows [v, u] of a view that hold metal; only those are projected.
    """

    def through_prior(p: NDArray[np.float32], views: slice, filled: Filled) -> None:
        traces = np.stack([trace.view(view) for view in range(views.start, views.stop)])
        held: NDArray[np.bool_] = np.any(traces, axis=2)
        wanted = held.copy()  # rows without any pixel left are filled from their neighbours
        wanted[:, 1:] |= held[:, :-1]
        wanted[:, :-1] |= held[:, 1:]
        q = forward_columns(columns, trace.geometry, views, rows=wanted)
        for k in np.flatnonzero(held.any(1)):
            at = np.flatnonzero(wanted[k])
            rows = slice(at[0], at[-1] + 1)
            p[k, rows] = bridge(p[k, rows], q[k, rows], traces[k, rows], filled)

    return mended(trace, first, through_prior, by)
