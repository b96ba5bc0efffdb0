"""A prior for the projections behind metal: tissue classes from a reconstruction, and which reconstruction.

Volumes [z, y, x] in 1/mm, projections [view, v, u].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray

from ctsim.baselines.limar import interpolated
from ctsim.baselines.metal import Metal, Trace, around, reach, water_value
from ctsim.baselines.morphology import dilate, opened, spread
from ctsim.reconstruct.field.methods import field
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.projector import forward_columns
from ctsim.reconstruct.settings import about, names_of
from ctsim.reconstruct.splat.fast import reconstruct as splat
from ctsim.types import Scan, Status, Volume

AIR, LUNG, BONE = 0.5, 0.15, 1.5  # bounds of the classes in multiples of water
LUNG_SHARE = 0.03  # of the body; with less there is no lung class
SKIN = 1  # voxels around the mask that hold blurred metal
CHOICE_VIEWS = 32  # views that decide between the priors
MARGIN = 0.95  # LIMAR's prior must fit better by this
RING = 4  # width in pixels of the ring around the trace that the priors are judged on
Prior = Annotated[
    Literal["auto", "fdk", "limar"],
    about("volume that the tissue prior is made from; auto: limar if it fits the projections better"),
]
PRIORS = names_of(Prior)
FITTED: dict[str, Callable[[Scan], Volume]] = {"splat": splat, "field": field}
"""Methods whose volume is a prior as it is."""
NO_BODY = "nothing stands out from air"
Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The prior chosen, `columns` [y, x, z], and its name; `largest` is its greatest projection in some views.

    `misfit` holds by prior the standard deviation of P − q on the ring around the trace, 0 where nothing was seen.
    `fitted` is how often views were used to fit it.
    """

    name: str
    columns: Array
    misfit: dict[str, float]
    largest: float
    water: float
    fitted: int = 0

    def details(self) -> dict[str, object]:
        """Return what a result says of its prior."""
        return {"prior": self.name, "prior_misfit": self.misfit, "water_per_mm": self.water}

    @property
    def view_updates(self) -> int:
        """How often each view was backprojected for it, in addition to FDK."""
        return int("limar" in self.misfit)


def choose_prior(
    trace: Trace, metal: Metal, first: torch.Tensor, by: Filter, prior: str, how: str = "rows"
) -> Choice | None:
    """Return the prior from FDK's volume `first`, from LIMAR's, or ("auto") the better of both; None where all is air.

    The better one is LIMAR's where its projections fit the measured ones on a ring around the trace better by a
    twentieth: at a draw FDK's has the finer detail. `by` is the filter of `first`, `how` LIMAR's interpolation.
    """
    water = water_value(first.numpy())
    if water <= 0:
        return None
    names = PRIORS[1:] if prior == "auto" else (prior,)
    found: dict[str, tuple[Array, float]] = {}
    misfit: dict[str, float] = {}
    for name in names:
        volume = (first if name == "fdk" else interpolated(trace, first, how, by)[0]).numpy()
        columns = np.ascontiguousarray(tissue_prior(volume, metal, water).transpose(1, 2, 0))
        misfit[name], largest = _misfit(trace, columns)
        found[name] = columns, largest
    name = better(misfit) if prior == "auto" else prior
    columns, largest = found[name]
    return Choice(name=name, columns=columns, misfit=misfit, largest=largest, water=water)


def fitted_prior(trace: Trace, metal: Metal, scan: Scan, name: str) -> Choice | str:
    """Return a fitted volume with water in place of the metal and of what lies next to it, or why there is none.

    No tissue classes are made of it. Lee et al., Med. Phys. 52, 2025, doi:10.1002/mp.17859, take a neural field so.
    """
    volume = FITTED[name](scan)
    if volume.status is not Status.OK:
        return f"the prior, {name}, ended as {volume.status}: {volume.reason}"
    values, inside = volume.values.numpy().copy(), dilate(metal.mask, SKIN, corners=True)
    values[inside] = 0
    if (water := water_value(values)) <= 0:
        return NO_BODY
    values[inside] = water
    columns = np.ascontiguousarray(np.maximum(values, 0).transpose(1, 2, 0))
    misfit, largest = _misfit(trace, columns)
    updates = int(volume.details.get("view_updates", 0))
    return Choice(name=name, columns=columns, misfit={name: misfit}, largest=largest, water=water, fitted=updates)


def better(misfit: dict[str, float]) -> str:
    """Return which of both priors "auto" takes."""
    return "limar" if misfit["limar"] < MARGIN * misfit["fdk"] else "fdk"


def tissue_prior(volume: Array, metal: Metal, water: float) -> Array:
    """Segment a reconstruction [z, y, x] in 1/mm into air, lung, soft tissue and bone, with soft tissue for the metal.

    The volume smoothed by a voxel decides: below half of water (0.15 of it where the body has lungs) air is 0, lungs
    take their own mean, up to 1.5 times water all is water. Bone keeps its own, unsmoothed values: blurred, they cost
    5 to 35 % of the error on jaw and thorax. The voxels next to the mask are partly metal and would pass for bone:
    they are soft tissue, too.
    """
    inside = dilate(metal.mask, SKIN, corners=True)
    smooth = scipy.ndimage.gaussian_filter(volume, 1.0)
    smooth[inside] = water
    thin = (smooth >= LUNG * water) & (smooth < AIR * water)
    # what partial volume leaves at the body's surface is no lung
    lung = opened(thin)
    out = np.where((smooth >= BONE * water) & ~inside, volume, np.float32(water)).astype(np.float32)
    out[smooth < AIR * water] = 0
    if lung.sum() > LUNG_SHARE * (smooth >= AIR * water).sum():
        out[thin] = smooth[lung].mean()
    return out


def choice_views(n: int) -> list[int]:
    """Return which of `n` views decide: the middle ones of equal shares, the same where every view is given twice."""
    shares = min(CHOICE_VIEWS, n)
    return [(2 * k + 1) * n // (2 * shares) for k in range(shares)]


def _misfit(trace: Trace, columns: Array) -> tuple[float, float]:
    """Return the standard deviation of P − q on the ring and the greatest q, in some views."""
    views = choice_views(trace.geometry.n_views)
    projections = forward_columns(columns, trace.geometry, views)
    off = [_beside(trace, view, q) for view, q in zip(views, projections, strict=True)]
    ring = np.concatenate(off)
    return float(np.std(ring)) if ring.size else 0.0, float(projections.max())


def _beside(trace: Trace, view: int, q: Array) -> Array:
    """Return P − q on a ring around the trace of one view; nothing where there is no trace."""
    shadow = trace.view(view)
    if not shadow.any():
        return q[shadow]
    v, u = reach(trace.geometry)
    window = around(shadow, (v + RING, u + RING))
    p, clamped = trace.logarithm.of(view)
    inner = spread(shadow[window], (v, u))  # what little metal is left there would count against both
    ring = dilate(inner, RING) & ~inner & ~clamped[window]
    return (p - q)[window][ring]
