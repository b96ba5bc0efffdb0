"""The filtration behind the assumed tube, found from the scan alone.

Line integrals of a wrong response are those of no object: views contradict each other wherever dense and thin paths
cross, and no fit explains them all. What a coarse fit leaves unexplained is averaged over neighbouring rays, whose
noise and missed edges cancel, while the error of the response does not: it changes slowly. Of that, what is the same in
all views is left out: on a circle, a body that is round about the axis would explain it, so that it tells of an
unfinished fit and nothing of the beam. A water bottle, which looks the same from all sides, therefore hardly shows its
beam. Rays through metal are left out, since what its shape leaves is larger; they are the same rays for all
filtrations.

A beam may be softer than the assumed tube's without a filter. Such beams are imitated by a thinner screen: filtrations
below 0 mean none, and a screen that is thinner than the assumed one by as many mm.

Consistency of the data is what other calibrations of a beam without a phantom use, too (Würfl et al., Epipolar
consistency beam hardening, Med. Phys. 44, 2017).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.interpolate import Akima1DInterpolator

from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.response import SCINTILLATOR

USUAL = 0.5  # mm of aluminium, from which the search starts
TRIED = (0.0, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 14.0, 20.0)
SOFTER = (-0.15, -0.1, -0.05)  # thinner screens, tried where there may be no filter
THIN = 0.1  # mm of aluminium, below which filtrations differ by their difference, not by their ratio
PLAUSIBLE = 1.05  # times the least misfit, at two standard deviations: materials, scatter and spectra are assumed
UNTOLD, SOFT = 8.0, 1.0
"""A plausible range from SOFT mm or less to UNTOLD times its lower end or more says that a scan hides its beam.

A lower end below THIN counts as THIN: such beams are nearly the same."""
WIDTH = 1 / 16  # σ of the averages, in widths of the panel
MET, DARK = 0.15, 3.0
"""P of rays that count: below they graze the object, above scatter and lacking photons make more than the beam does."""
METAL, FAINT = 8.0, 1e-3
"""Times water, what is metal; what of P it adds at most to a ray that is said not to meet it."""
LEAST = 0.3  # of the neighbours that count: an average over fewer is left out
FEWEST = 1000  # averages less a mean for each pixel, below which there is no misfit

Fits = Callable[[float], Fit | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Filtration:
    """The filtration (mm of aluminium), the least and the greatest that explain the scan nearly as well, and misfits.

    `misfits` are those of `misfit` by the filtration tried on the last grid, empty where the scan shows too little.
    Below 0 there is no filter, and a screen that is thinner than the assumed one by as many mm.
    """

    value: float
    low: float
    high: float
    misfits: dict[float, float]

    def described(self) -> dict[str, Any]:
        """Return all of it in the types of JSON, and the screen (mm of GOS) where it is thinner than assumed."""
        tried = {f"{t:g}": round(value, 6) for t, value in self.misfits.items()}
        screen = {"screen": round(SCINTILLATOR.thickness + self.value, 3)} if self.value < 0 else {}
        return {"value": self.value, **screen, "low": self.low, "high": self.high, "misfits": tried}

    @property
    def sentence(self) -> str:
        """Say that the scan does not tell its beam, or that its beam may lie beyond those tried, or nothing.

        Hard beams differ little, so the hardest are often plausible; a nearly round body may yet be behind a soft one.
        """
        if not self.misfits:
            return ""
        explain = f"{self.low:g} to {self.high:g} mm Al explain it alike"
        if self.low < 0:
            explain += f" (below 0: none, and a screen that much thinner than {SCINTILLATOR.thickness:g} mm of GOS)"
        if self.low <= SOFT and self.high >= UNTOLD * max(self.low, THIN):
            return (
                f"the scan does not tell its beam (round bodies do not): {explain}; "
                '`filtration` or the response "known" tells it'
            )
        if self.high >= TRIED[-1]:
            return (
                f"the scan tells no upper limit of its filtration: {explain}, and no more was tried; a nearly round "
                'body may be behind less; `filtration` or the response "known" tells it'
            )
        if self.low > min(TRIED[0], *self.misfits):
            return ""
        return (
            f"the scan's beam may be softer than any that was tried, for which values are too low: {explain}; "
            '`filtration`, `detector` or the response "known" tells the method more'
        )


def found(
    coarse: Fits, fine: Fits | None = None, soft: Fits | None = None, *, screen_assumed: bool = False
) -> Filtration:
    """Search the filtration that a scan shows, by `coarse` fits and then, if there are any, `fine` ones around it.

    All return the fit at a filtration, None for nothing. Coarse fits take little time next to fine ones: where these
    follow, they are made at all filtrations, since between thick metal their misfit may have more than one valley.
    Where there may be next to no filter, `soft` ones follow, with thinner screens too if the screen is only assumed:
    many photons of such a beam stop in the first voxels, and what a coarse grid misses there looks like a filter of
    0.05 mm.
    """
    misfits = _searched(coarse, USUAL, everywhere=fine is not None)
    if fine is not None:
        finer = _searched(fine, min(misfits, key=lambda t: misfits[t]) if misfits else USUAL)
        misfits = finer if len(finer) > 1 or not misfits else _valley(misfits)
    if not misfits:
        return Filtration(value=USUAL, low=TRIED[0], high=TRIED[-1], misfits={})
    chosen = _chosen(misfits)
    if soft is None or chosen.low >= THIN or chosen.high > SOFT:
        return chosen
    softer = _searched(soft, TRIED[0], (*SOFTER, *TRIED) if screen_assumed else TRIED)
    return _chosen(softer) if len(softer) > 1 else chosen


def _searched(
    fit_of: Fits, start: float, tried: Sequence[float] = TRIED, *, everywhere: bool = False
) -> dict[float, float]:
    """Return the misfits by those filtrations of `tried` from `start` on, both ways while plausible or `everywhere`.

    Empty where `start` has none.
    """
    first = fit_of(start)
    if first is None or not math.isfinite(least := misfit(first, rays := rays_of(first))):
        return {}
    misfits = {start: least}

    def misfit_at(k: int) -> float:
        if (value := tried[k]) not in misfits:
            fit = fit_of(value)
            misfits[value] = math.inf if fit is None else misfit(fit, rays)
        return misfits[value]

    for way in (1, -1):
        k = tried.index(start)
        # a neighbour that is plausible, too, may yet lead to a better one
        while 0 <= k + way < len(tried) and (everywhere or misfit_at(k) <= PLAUSIBLE * min(misfits.values())):
            k += way
            misfit_at(k)
    return {t: value for t, value in sorted(misfits.items()) if math.isfinite(value)}


def _valley(misfits: dict[float, float]) -> dict[float, float]:
    """Return those around the least that are plausible without a gap, and one more on either side."""
    tried, least = sorted(misfits), min(misfits.values())
    first = last = next(k for k, t in enumerate(tried) if misfits[t] == least)
    while first > 0 and misfits[tried[first]] <= PLAUSIBLE * least:
        first -= 1
    while last + 1 < len(tried) and misfits[tried[last]] <= PLAUSIBLE * least:
        last += 1
    return {t: misfits[t] for t in tried[first : last + 1]}


def _chosen(misfits: dict[float, float]) -> Filtration:
    """Return the mean filtration by how likely each is, on a curve through the logarithms of the misfits over `scale`.

    Where all explain the scan alike, that is the middle of what was tried. A cubic spline would dip behind a steep
    slope, where misfits may be flat.
    """
    tried, values = scale(list(misfits)), np.log(list(misfits.values()))
    fine = np.linspace(tried[0], tried[-1], 2001)
    above = Akima1DInterpolator(tried, values, method="makima")(fine) if len(tried) > 1 else np.zeros_like(fine)
    above -= above.min()
    plausible = fine[above <= math.log(PLAUSIBLE)]
    mean = np.average(fine, weights=np.exp(-2 * above / math.log(PLAUSIBLE)))
    value, low, high = (round(float(t), 3) + 0.0 for t in from_scale([mean, plausible[0], plausible[-1]]))
    return Filtration(value=value, low=low, high=high, misfits=misfits)


def scale(filtration: ArrayLike) -> NDArray[np.float64]:
    """Return where filtrations (mm) lie on the scale of their differences: log(t/THIN), below THIN t/THIN − 1."""
    t = np.asarray(filtration, np.float64) / THIN
    return np.where(t < 1, t - 1, np.log(np.maximum(t, 1)))


def from_scale(place: ArrayLike) -> NDArray[np.float64]:
    """Return the filtrations (mm) that lie at places on `scale`."""
    x = np.asarray(place, np.float64)
    return THIN * np.where(x < 0, x + 1, np.exp(np.maximum(x, 0)))


def rays_of(fit: Fit) -> NDArray[np.bool_]:
    """Return which readings [view, v, u] tell the beam: those of rays that meet the object and no metal."""
    views = np.arange(fit.data.geometry.n_views)
    p, least = fit.fitted(views), np.float32(METAL * fit.curve.water)
    metal = fit.integrals(lambda u: np.where(u > least, u, np.float32(0)), views)
    return (fit.data.weights > 0) & (p > MET) & (p < DARK) & (metal < FAINT)


def misfit(fit: Fit, rays: NDArray[np.bool_]) -> float:
    """Return the root mean square of what locally averaged p − P over `rays` [view, v, u] varies by from view to view.

    Infinite for too few rays.
    """
    left = fit.data.p - fit.fitted(np.arange(fit.data.geometry.n_views))
    sigma = (0, *[WIDTH * fit.data.geometry.n_detector[1]] * 2)
    share = ndimage.gaussian_filter(rays.astype(np.float32), sigma)
    total = ndimage.gaussian_filter(np.where(rays, left, np.float32(0)), sigma)
    counts = rays & (share > LEAST)
    averages = np.divide(total, share, where=counts, out=np.zeros_like(total))
    often = counts.sum(0)
    freedom = int(np.maximum(often - 1, 0).sum())
    if freedom < FEWEST:
        return math.inf
    same = averages.sum(0, dtype=np.float64) / np.maximum(often, 1)
    # a view at a time: in float64 all of them would be large
    squares = sum(float(np.square((view - same)[seen]).sum()) for view, seen in zip(averages, counts, strict=True))
    value = math.sqrt(squares / freedom)
    return value if 0 < value < math.inf else math.inf
