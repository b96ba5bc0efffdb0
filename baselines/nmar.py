"""Normalised metal artefact reduction (NMAR), in cone beam.

Meyer, Raupach, Lell, Schmidt and Kachelriess, Med. Phys. 37, 2010, doi:10.1118/1.3484090: projections are divided
by those of a prior, an image of tissue classes, before the metal trace is interpolated, and multiplied again.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray

from baselines.inpaint import Filled, fill
from baselines.limar import check, finished, interpolated, uncorrected
from baselines.metal import Metal, Trace, find_metal, reinsert, water_value
from baselines.morphology import dilate, opened
from ctsim.errors import InputError
from ctsim.types import Scan, Status, Volume
from reconstruct.fdk import fdk_stream
from reconstruct.fdk import reconstruct as fdk
from reconstruct.log import line_integrals
from reconstruct.projector import forward_columns

AIR, LUNG, BONE = 0.5, 0.15, 1.5  # bounds of the classes in multiples of water
LUNG_SHARE = 0.03  # of the body; with less there is no lung class
CHOICE_VIEWS = 32  # views that decide between the priors
RING = 4  # width in pixels of the ring around the trace that the priors are judged on
PRIORS, NORMALISATIONS = ("auto", "fdk", "limar"), ("offset", "additive", "ratio")


def reconstruct(
    scan: Scan,
    *,
    device: str = "cpu",
    mask: str = "oracle",
    prior: str = "auto",
    margin: float = 0.9,
    normalisation: str = "offset",
    floor: float | None = None,
    interpolation: str = "rows",
    insert: str = "fdk",
    dilation: int = 0,
) -> Volume:
    """Reconstruct `scan` with the metal trace interpolated after normalisation by a prior.

    `mask`, `interpolation`, `insert` and `dilation` are those of `baselines.limar.reconstruct`. `prior` is segmented
    from the "fdk" or the "limar" volume, or "auto": from the latter where its projections fit the measured ones
    around the trace better by `margin` (ratio of standard deviations). `normalisation` and `floor` are those of
    `Normalise`. Without metal, or where the mask is not to be relied on, the result is FDK's to the last bit and
    nothing is projected. Raises InputError as these do, and as FDK does.
    """
    check(interpolation, insert, dilation)
    if prior not in PRIORS:
        raise InputError(f"prior must be one of {', '.join(PRIORS)}, got {prior!r}")
    if not 0 < margin < np.inf:
        raise InputError(f"margin must be positive, got {margin}")
    rule = Normalise(kind=normalisation, floor=floor)
    first = fdk(scan, device=device)
    x_0 = first.values.numpy()
    metal = find_metal(scan, x_0, mask)
    if first.status is not Status.OK or not metal.found:
        return uncorrected(first, metal)
    trace = Trace(metal, scan.geometry, dilation)
    x_li, _ = interpolated(scan, trace, interpolation)
    water = water_value(x_0)
    if water <= 0:
        return uncorrected(first, metal)
    candidates = {k: tissue_prior(x, metal, water) for k, x in (("fdk", x_0), ("limar", x_li.numpy()))}
    chosen, misfit, largest = choose_prior(scan, trace, candidates, prior, margin)
    bridge = functools.partial(rule.fill, largest=largest, how=interpolation)
    values, filled = normalised(scan, trace, candidates[chosen], bridge)
    reinsert(values, x_0, metal, insert)
    details: dict[str, object] = {"prior": chosen, "water_per_mm": water, "prior_misfit": misfit}
    details |= {"largest_prior": largest, "view_updates": 3 * scan.geometry.n_views}
    return finished(values, first, metal, details | filled.details())


Bridge = Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], Filled], NDArray[np.float32]]


def normalised(scan: Scan, trace: Trace, prior: NDArray[np.float32], bridge: Bridge) -> tuple[torch.Tensor, Filled]:
    """Return FDK of the projections, their trace bridged with the projections of `prior`, and what was filled.

    `bridge(p, q, trace, filled)` gets the rows [v, u] of a view that hold metal; only those are projected.
    """
    columns, filled = np.ascontiguousarray(prior.transpose(1, 2, 0)), Filled()

    def read(views: slice) -> NDArray[np.float32]:
        p = line_integrals(scan, views)[0].numpy()
        traces = np.stack([trace.view(view) for view in range(views.start, views.stop)])
        held: NDArray[np.bool_] = np.any(traces, axis=2)
        wanted = held.copy()  # rows without any pixel left are filled from their neighbours
        wanted[:, 1:] |= held[:, :-1]
        wanted[:, :-1] |= held[:, 1:]
        q = forward_columns(columns, scan.geometry, views, rows=wanted)
        for k in np.flatnonzero(held.any(1)):
            at = np.flatnonzero(wanted[k])
            rows = slice(at[0], at[-1] + 1)
            p[k, rows] = bridge(p[k, rows], q[k, rows], traces[k, rows], filled)
        return p

    return fdk_stream(read, scan.geometry), filled


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalise:
    """How measured projections P are made flat by the prior's q before they are interpolated (LI), and back.

    "offset": (q + c)·LI[(P + c)/(q + c)] − c with c = `floor`·max q (default 0.2). "additive", its limit c → ∞:
    q + LI[P − q]. "ratio": Q·LI[P/Q], Q = max(q, `floor`·max q) (default 0.05); with a tiny floor it diverges where the
    metal's shadow leaves the prior's.
    """

    kind: str = "offset"
    floor: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in NORMALISATIONS:
            raise InputError(f"normalisation must be one of {', '.join(NORMALISATIONS)}, got {self.kind!r}")
        if self.floor is not None and not 0 < self.floor < np.inf:
            raise InputError(f"floor must be positive, got {self.floor}")

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


def tissue_prior(volume: NDArray[np.float32], metal: Metal, water: float) -> NDArray[np.float32]:
    """Segment a reconstruction [z, y, x] in 1/mm into air, lung, soft tissue and bone, with soft tissue in the metal.

    The volume smoothed by a voxel decides: below half of water (0.15 of it where the body has lungs) air is 0, lungs
    take their own mean, up to 1.5 times water all is water. Bone keeps its own, unsmoothed values: blurred, they cost
    5 to 35 % of the error on jaw and thorax.
    """
    smooth = scipy.ndimage.gaussian_filter(volume, 1.0)
    smooth[metal.mask] = water
    thin = (smooth >= LUNG * water) & (smooth < AIR * water)
    # what partial volume leaves at the body's surface is no lung
    lung = opened(thin)
    out = np.where((smooth >= BONE * water) & ~metal.mask, volume, np.float32(water)).astype(np.float32)
    out[smooth < AIR * water] = 0
    if lung.sum() > LUNG_SHARE * (smooth >= AIR * water).sum():
        out[thin] = smooth[lung].mean()
    return out


def choose_prior(
    scan: Scan, trace: Trace, candidates: dict[str, NDArray[np.float32]], prior: str, margin: float
) -> tuple[str, dict[str, float], float]:
    """Return the prior to use, the misfit of each around the trace, and its greatest projection, in some views."""
    geometry = scan.geometry
    views = np.unique(np.linspace(0, geometry.n_views - 1, min(CHOICE_VIEWS, geometry.n_views)).round().astype(int))
    traces = {int(view): trace.view(int(view)) for view in views}
    misfit, largest = {}, {}
    for name in candidates if prior == "auto" else (prior,):
        q = forward_columns(np.ascontiguousarray(candidates[name].transpose(1, 2, 0)), geometry, views)
        largest[name] = float(q.max())
        off = [_around(scan, view, t, q[k]) for k, (view, t) in enumerate(traces.items()) if t.any()]
        ring = np.concatenate([np.zeros(0, np.float32), *off])
        misfit[name] = float(np.std(ring)) if ring.size else 0.0  # nothing was seen around the metal
    chosen = prior
    if prior == "auto":
        chosen = "limar" if misfit["limar"] < margin * misfit["fdk"] else "fdk"
    return chosen, misfit, largest[chosen]


def _around(scan: Scan, view: int, trace: NDArray[np.bool_], q: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return P − q on a ring around the trace of one view."""
    p, clamped = line_integrals(scan, view)
    inner = dilate(trace, 1)  # half a voxel of metal that the mask leaves out still darkens the nearest pixel
    ring = dilate(inner, RING) & ~inner & ~clamped.numpy()
    return (p.numpy() - q)[ring]
