"""Linear interpolation across the metal trace (LIMAR), in cone beam.

Kalender, Hebel and Ebersberger, Radiology 164, 1987, doi:10.1148/radiology.164.2.3602406: the metal's shadow is
cut out of the projections and bridged, the rest is reconstructed, the metal is put back.
"""

from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.inpaint import Filled, Interpolation, fill
from ctsim.baselines.metal import Insert, Mask, Metal, Trace, check_mask, find_metal, reinsert
from ctsim.reconstruct.fdk import add_fdk
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.log import finite_or_not
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import about, keywords
from ctsim.types import Scan, Status, Volume

Pixels = Annotated[int, msgspec.Meta(ge=0, le=1000)]


class Bridging(Filter, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The filter, where the metal is, how its trace is bridged, and how it comes back.

    See `ctsim.baselines.metal.find_metal`, `ctsim.baselines.inpaint.fill`, `ctsim.baselines.metal.reinsert` and, for
    `dilation`, `ctsim.baselines.metal.Trace`.
    """

    mask: Mask = "oracle"
    interpolation: Interpolation = "rows"
    insert: Insert = "fdk"
    dilation: Annotated[
        Pixels | None, about("widens the trace; null: by the dark pixels at the mask's edge", "pixels")
    ] = None

    def __post_init__(self) -> None:
        check_mask(self.mask)


@keywords(Bridging)
@primary
def reconstruct(scan: Scan, settings: Bridging) -> Volume:
    """Reconstruct `scan` with the metal trace interpolated; keywords are those of `Bridging`.

    Without metal, or where the mask is not to be relied on, the result is FDK's to the last bit and nothing is
    projected. Raises InputError as `find_metal` and FDK do, and for settings that are not there.
    """
    first = fdk(scan, window=settings.window, cutoff=settings.cutoff)
    metal = find_metal(scan, first.values.numpy(), settings.mask)
    if first.status is not Status.OK or not metal.found:
        return uncorrected(first, metal)
    trace = Trace(metal, scan, settings.dilation)
    values, filled = interpolated(trace, first.values, settings.interpolation, settings)
    reinsert(values, first.values.numpy(), metal, settings.insert)
    details: dict[str, object] = {"view_updates": 2 * scan.geometry.n_views, "dilation": settings.dilation}
    details["intermediates"] = filled.intermediates(trace.view(filled.shown))
    return finished(values, first, metal, details | filled.details())


def interpolated(trace: Trace, first: torch.Tensor, how: str, by: Filter) -> tuple[torch.Tensor, Filled]:
    """Return FDK of the projections with the trace interpolated, and what was filled.

    `first` is FDK without, and `by` the filter that it was made with.
    """

    def bridge(p: NDArray[np.float32], views: slice, filled: Filled) -> None:
        for k, view in enumerate(range(views.start, views.stop)):
            fill(p[k], trace.view(view), how, filled)

    return mended(trace, first, bridge, by)


def mended(
    trace: Trace,
    first: torch.Tensor,
    bridge: Callable[[NDArray[np.float32], slice, Filled], None],
    by: Filter,
) -> tuple[torch.Tensor, Filled]:
    """Return FDK of the projections with the trace filled, and what was filled.

    `first` [z, y, x] is FDK of the projections as they are; `bridge` changes those of some views [view, v, u], only in
    the trace. What it changes is reconstructed with the filter of `first`, `by`, and added.
    """
    filled = Filled(shown=trace.geometry.n_views // 4)

    def change(views: slice) -> NDArray[np.float32]:
        p = trace.logarithm.of(views)[0]
        before = p.copy()
        bridge(p, views, filled)
        filled.keep(p, views)
        p -= before
        return p

    values = first.clone()
    add_fdk(change, trace.geometry, trace.rows(), values, by)
    return values, filled


def uncorrected(first: Volume, metal: Metal, why: str = "") -> Volume:
    """Return FDK's volume as it is; the details say why: that there is no metal, a doubt of the mask, or `why`."""
    why = why or metal.doubt or ("" if metal.mask.any() else "no metal in the mask")
    said = {"uncorrected_reason": f"{why}: the volume is FDK's"} if first.status is Status.OK else {}
    return Volume(
        values=first.values,
        status=first.status,
        reason=first.reason,
        details=first.details | metal.details() | {"corrected": False} | said,
    )


def finished(values: torch.Tensor, first: Volume, metal: Metal, details: dict[str, object]) -> Volume:
    """Wrap a corrected volume."""
    status, reason = finite_or_not(values.numpy())
    return Volume(
        values=values,
        status=status,
        reason=reason,
        details=first.details | metal.details() | {"corrected": True} | details,
    )
