"""Beam-hardening correction of metal without a spectrum: a polynomial in the lengths of metal and tissue.

Projections [view, v, u], volumes [z, y, x] in 1/mm, lengths in mm.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.baselines.inpaint import Filled
from ctsim.baselines.limar import finished, mended, uncorrected
from ctsim.baselines.metal import Insert, Mask, Trace, check_mask, find_metal, reinsert
from ctsim.baselines.morphology import dilate
from ctsim.baselines.prior import NO_BODY, RING, Prior, choose_prior
from ctsim.geometry import few_views
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.projector import forward_columns
from ctsim.reconstruct.settings import keywords
from ctsim.types import Scan, Status, Volume

TERMS = ("l", "l^2", "l^3", "l t", "l^2 t", "l t^2")  # l: mm of metal, t: mm of water that weigh as the tissue
RIDGE = 2e-3  # on columns of norm 1
FAINT = 1e-9  # keeps the fit of tissue solvable where there is none
FIT_VIEWS = 64  # six numbers need no more
Array = NDArray[np.float32]


class Settings(Filter, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As those of the same names in `ctsim.baselines.nmar.Settings`."""

    mask: Mask = "oracle"
    prior: Prior = "auto"
    insert: Insert = "fdk"

    def __post_init__(self) -> None:
        check_mask(self.mask)


@keywords(Settings)
@primary
def bhc_poly(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan` less a polynomial in metal and tissue length that is fitted to what metal adds to it.

    q are the projections of a tissue prior (`ctsim.baselines.prior.tissue_prior`) that has water in place of the metal;
    how P of tissue alone bends with q is fitted on a ring around the trace. What P exceeds that by in the trace is
    regressed on `TERMS`, leaving out clamped pixels, and the fit, where it is positive, is subtracted from P.
    Keywords are those of `Settings`. Without metal, where the mask is not to be relied on, and where nothing can be
    fitted, the result is FDK's to the last bit. Raises InputError as LIMAR does.
    """
    first = fdk(scan, window=settings.window, cutoff=settings.cutoff)
    x_0 = first.values.numpy()
    metal = find_metal(scan, x_0, settings.mask)
    if first.status is not Status.OK or not metal.found:
        return uncorrected(first, metal)
    trace = Trace(metal, scan)
    choice = choose_prior(trace, metal, first.values, settings, settings.prior)
    if choice is None:
        return uncorrected(first, metal, NO_BODY)
    fit = _fit(scan, trace, choice.columns, choice.water)
    if not fit.pixels:
        return uncorrected(first, metal, "no pixel of the trace has a signal")
    negative = 0

    def correct(p: Array, views: slice, _: Filled) -> None:
        nonlocal negative
        for k, held, metal_length, tissue in _along(
            choice.columns, choice.water, trace, range(views.start, views.stop)
        ):
            added = _terms(metal_length[held], tissue[held]) @ fit.coefficients
            negative += int((added < 0).sum())
            whole = np.maximum(p[k - views.start][held], 0)  # metal adds no more than there is
            p[k - views.start][held] -= np.clip(added, 0, whole).astype(np.float32)

    values, shown = mended(trace, first.values, correct, settings)
    reinsert(values, x_0, metal, settings.insert)
    counted = {
        "negative_pixels": negative,
        "view_updates": (2 + choice.view_updates) * scan.geometry.n_views,
    }
    held = trace.lengths(shown.shown) > trace.thinnest
    pictured = {"intermediates": shown.intermediates(held) | {"prior": choice.columns.transpose(2, 0, 1)}}
    return finished(values, first, metal, fit.details() | choice.details() | counted | pictured)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """What metal adds to P.

    `coefficients` are those of `TERMS`; `tissue` those of t and t²; `before` and `after` the RMS of
    what metal adds and of what the fit leaves of it.
    """

    coefficients: NDArray[np.float64]
    tissue: NDArray[np.float64]
    pixels: int
    before: float
    after: float

    def details(self) -> dict[str, object]:
        """Return what a result says of its fit."""
        return {
            "coefficients": dict(zip(TERMS, self.coefficients.tolist(), strict=True)),
            "tissue_coefficients": self.tissue.tolist(),
            "fitted_pixels": self.pixels,
            "residual_before": self.before,
            "residual_after": self.after,
        }


def _fit(scan: Scan, trace: Trace, columns: Array, water: float) -> Fit:
    """Fit what metal adds over the trace in some views; what tissue alone gives is fitted on a ring around it."""
    views = few_views(scan.geometry.n_views, FIT_VIEWS).tolist()
    around, within = Normal(2), Normal(len(TERMS) + 2)
    for k, held, metal, tissue in _along(columns, water, trace, views):
        p, clamped = (image.numpy() for image in line_integrals(scan, k))
        rows: NDArray[np.bool_] = np.any(held, axis=1)
        ring = dilate(held, RING) & rows[:, None] & ~dilate(held, 1) & ~clamped
        around.add(_bent(tissue[ring]), p[ring])
        seen = held & ~clamped
        bent = _bent(tissue[seen])
        within.add(np.concatenate([_terms(metal[seen], tissue[seen]), bent], 1), p[seen])
    alone = around.solve(FAINT) if around.n else np.array([water, 0.0])
    off = within.less(alone)
    c = off.solve(RIDGE)
    zero = np.zeros(len(TERMS))
    return Fit(
        coefficients=c, tissue=alone, pixels=off.n,
        before=off.misfit(zero), after=off.misfit(c),
    )  # fmt: skip


class Normal:
    """The normal equations of a linear fit, gathered a view at a time."""

    def __init__(self, n_terms: int) -> None:
        self.n, self.square = 0, 0.0
        self.gram, self.right = np.zeros((n_terms, n_terms)), np.zeros(n_terms)

    def add(self, terms: NDArray[np.float64], values: Array) -> None:
        """Add equations, `terms` [n, term] and `values` [n]."""
        values_64 = values.astype(np.float64)
        self.n, self.square = self.n + values.size, self.square + float(values_64 @ values_64)
        self.gram += terms.T @ terms
        self.right += terms.T @ values_64

    def less(self, known: NDArray[np.float64]) -> "Normal":
        """Return the equations of all but the last terms, with those subtracted by their coefficients."""
        m = self.right.size - known.size
        rest = Normal(m)
        rest.n, rest.gram = self.n, self.gram[:m, :m]
        rest.right = self.right[:m] - self.gram[:m, m:] @ known
        rest.square = self.square - 2 * float(known @ self.right[m:]) + float(known @ self.gram[m:, m:] @ known)
        return rest

    def solve(self, ridge: float) -> NDArray[np.float64]:
        """Return the coefficients, with a ridge on columns of norm 1."""
        norm = np.sqrt(np.diag(self.gram))
        norm[norm == 0] = 1  # such as no tissue anywhere: the ridge makes its coefficients 0
        scaled = self.gram / np.outer(norm, norm) + ridge * np.eye(norm.size)
        return np.linalg.solve(scaled, self.right / norm) / norm

    def misfit(self, c: NDArray[np.float64]) -> float:
        """Return the RMS of what coefficients leave."""
        left = self.square - 2 * float(c @ self.right) + float(c @ self.gram @ c)
        return math.sqrt(max(left, 0.0) / max(self.n, 1))


def _along(
    columns: Array, water: float, trace: Trace, views: list[int] | range
) -> Iterator[tuple[int, NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield each view that has a trace, the trace, and the lengths in metal and in tissue (mm), [v, u].

    Tissue is projected in the rows that hold some of the trace.
    """
    for k in views:
        lengths = trace.lengths(k)
        held = lengths > trace.thinnest
        if held.any():
            q = forward_columns(columns, trace.geometry, [k], rows=held.any(1)[None])[0]
            yield k, held, lengths.astype(np.float64), q.astype(np.float64) / water


def _bent(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms of tissue alone, [n, 2]."""
    return np.stack([t, t**2], 1)


def _terms(metal: NDArray[np.float64], tissue: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `TERMS` of lengths in metal and tissue, [n, 6]; all are 0 where there is no metal."""
    m, t = metal, tissue
    return np.stack([m, m**2, m**3, m * t, m**2 * t, m * t**2], 1)
