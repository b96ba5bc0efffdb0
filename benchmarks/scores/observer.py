"""A channelised Hotelling observer: how often it tells volumes with a lesion from volumes without.

The observer is trained and tested on different scans (cross-fitting): scan n belongs to fold n mod FOLDS, and each fold
is scored by templates trained on the others. AUC is the share of pairs (one scan with, one without the lesion) that the
scores put in the right order, a tie counting one half (Mann–Whitney), within folds.

- Background known exactly: a template for each location, trained there. Only noise hides the lesion; a streak that is
  the same in every scan does not.
- Background varying: one template for all locations, trained at the other ones, and scores of all locations compared
  with each other. What artefacts make differ from place to place hides the lesion, too.

Volumes are float32. A direction in which responses vary by less than that rounding has the rounding's variance instead,
and counts only if the classes differ by more: where one value fills a volume, four of five directions hold nothing but
rounding, and a template must not follow them.

Intervals: scans are drawn again with replacement, with and without lesion apart and within folds, and the observer is
trained anew. A scan brings all its locations along. The same draws serve all methods, so that differences are paired.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri
from scipy.stats import ncf

FOLDS = 5
LEAST = 2 * FOLDS  # scans of a class
DRAWS = 500
Z95 = float(ndtri(0.975))
ROUNDING = 1e-7  # of the largest response: the least deviation in any direction, for volumes are float32
CERTAIN = 1e4  # squared detectability: the AUC is 1 in float64, and the noncentral F distribution fails beyond 1e8
_CHUNK = 2**22  # comparisons at once

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Responses:
    """Responses of the channels [scan, location, channel] in scans with and without the lesions.

    Scan k of both belongs to fold `pairs[k]` mod FOLDS. `scale` is the largest response to a volume, of which rounding
    is a share; 0 where that is the largest of these, as it is unless something was taken off.
    """

    present: Array
    absent: Array
    pairs: NDArray[np.int64]
    scale: float = 0.0

    @property
    def rounding(self) -> float:
        """Return the variance that rounding alone has, in units of the responses squared."""
        return _rounding(self.scale or _largest(self.present, self.absent))

    def at(self, locations: NDArray[np.int64]) -> "Responses":
        """Return the responses at some of the locations."""
        return replace(self, present=self.present[:, locations], absent=self.absent[:, locations])

    def only(self, pairs: NDArray[np.int64]) -> "Responses":
        """Return the responses of some of the scans."""
        kept = np.isin(self.pairs, pairs)
        return replace(self, present=self.present[kept], absent=self.absent[kept], pairs=self.pairs[kept])


@dataclass(frozen=True, slots=True, kw_only=True)
class Area:
    """An AUC with its 95 % interval; `draws` are those of the bootstrap, in an order that all methods share."""

    auc: float
    low: float
    high: float
    draws: Array


def auc(present: Array, absent: Array, w1: Array | None = None, w0: Array | None = None) -> Array:
    """Return the share of pairs in the right order, of scores [..., m] and [..., n] with weights of the same shapes."""
    w1 = np.ones_like(present) if w1 is None else w1
    w0 = np.ones_like(absent) if w0 is None else w0
    above = (present[..., :, None] > absent[..., None, :]) + 0.5 * (present[..., :, None] == absent[..., None, :])
    won = np.einsum("...m,...mn,...n->...", w1, above, w0)
    return won / (w1.sum(-1) * w0.sum(-1))


def known_background(found: Responses, draws: int = DRAWS) -> Area:
    """Return the AUC of an observer with a template for each location, the mean over the locations."""
    return _area(found, draws, _at_each)


def varying_background(found: Responses, draws: int = DRAWS) -> Area:
    """Return the AUC of an observer with one template, trained at the other locations; needs two or more."""
    return _area(found, draws, _at_all)


def difference(one: Area, other: Area) -> tuple[float, float, float]:
    """Return one AUC minus another with its 95 % interval, of areas on the same scans.

    It is the value ± 1.96 standard deviations of the paired draws. Where one AUC is the same in all draws, as at 1, the
    two intervals are combined instead (Zou and Donner 2008, doi:10.1002/sim.3095), which need not be symmetric.
    """
    value = one.auc - other.auc
    if one is other or (one.draws.std() > 0 and other.draws.std() > 0):
        half = Z95 * float((one.draws - other.draws).std())
        return value, value - half, value + half
    down, up = (
        math.hypot(one.auc - one.low, other.high - other.auc),
        math.hypot(one.high - one.auc, other.auc - other.low),
    )
    return value, value - down, value + up


def normal_theory(present: Array, absent: Array) -> tuple[float, float, float]:
    """Return AUC and its exact 95 % interval for normal responses [scan, channel] of one covariance.

    No scans are set apart: the bias of training on the tested scans is known and taken off, and the interval follows
    from the noncentral F distribution (Wunderlich et al. 2015, doi:10.1109/TMI.2014.2360496). It is that of an observer
    trained on infinitely many scans. Directions in which responses vary by rounding alone are left out.
    """
    n1, n0 = len(present), len(absent)
    n, share = n1 + n0, n1 * n0 / (n1 + n0)
    signal = present.mean(0) - absent.mean(0)
    pooled = (_scatter(present) + _scatter(absent)) / (n - 2)
    values, vectors = np.linalg.eigh(pooled)
    rounding = _rounding(_largest(present, absent))
    varies = values > rounding
    if ((signal @ vectors[:, ~varies]) ** 2 > rounding).any():  # nothing hides that difference
        return 1.0, 1.0, 1.0
    if not varies.any():
        return 0.5, 0.5, 0.5
    p = int(varies.sum())
    squared = float(((signal @ vectors[:, varies]) ** 2 / values[varies]).sum())
    best = max((n - p - 3) / (n - 2) * squared - p / share, 0.0)
    value = (n - p - 1) / (p * (n - 2)) * share * squared
    if best > CERTAIN:
        return 1.0, 1.0, 1.0

    def limit(level: float) -> float:
        def excess(squared_d: float) -> float:
            return float(ncf.cdf(value, p, n - p - 1, share * squared_d)) - level

        if excess(0.0) <= 0:
            return 0.0
        top = max(best, 1.0)
        while excess(top) > 0:
            top *= 2
        return brentq(excess, 0.0, top)  # pyright: ignore[reportReturnType]  a tuple only with full_output

    low, high = limit(0.975), limit(0.025)
    return _auc_of(best), _auc_of(low), _auc_of(high)


def wilson(share: float, error: float, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share whose standard error is `error`, or that of n trials if this is 0."""
    trials = n if error == 0 or share in (0.0, 1.0) else share * (1 - share) / error**2
    middle = (share + Z95**2 / (2 * trials)) / (1 + Z95**2 / trials)
    half = Z95 / (1 + Z95**2 / trials) * math.sqrt(share * (1 - share) / trials + Z95**2 / (4 * trials**2))
    return middle - half, middle + half


def _rounding(largest: float) -> float:
    """Return the variance that rounding alone has where this is the largest response."""
    return (ROUNDING * largest) ** 2


def _largest(*responses: Array) -> float:
    return max(float(np.abs(kind).max()) for kind in responses)


def _auc_of(squared_d: float) -> float:
    return float(ndtr(math.sqrt(squared_d / 2)))


def _scatter(values: Array) -> Array:
    off = values - values.mean(0)
    return off.T @ off


def _area(found: Responses, draws: int, observer: Callable[..., Array]) -> Area:
    folds = [np.flatnonzero(found.pairs % FOLDS == f) for f in range(FOLDS)]
    ones = np.ones((1, len(found.pairs)))
    value = float(observer(found, folds, ones, ones)[0])
    w1, w0 = _drawn(found.pairs, draws, 1), _drawn(found.pairs, draws, 0)
    again = observer(found, folds, w1, w0)
    if np.abs(np.append(again, value) - 0.5).max() < 1e-12:  # all pairs tie in all draws: that is not by chance
        return Area(auc=0.5, low=0.5, high=0.5, draws=again)
    low, high = wilson(value, float(again.std(ddof=1)), len(found.pairs))
    return Area(auc=value, low=low, high=high, draws=again)


def _drawn(pairs: NDArray[np.int64], draws: int, which: int) -> Array:
    """Return how often each scan is drawn [draw, scan], by fold; equal pairs give equal draws."""
    out = np.zeros((draws, len(pairs)))
    for f in range(FOLDS):
        members = np.flatnonzero(pairs % FOLDS == f)
        rng = np.random.Generator(np.random.Philox(key=[which, f]))
        out[:, members] = rng.multinomial(len(members), np.full(len(members), 1 / len(members)), draws)
    return out


def _moments(x: Array, w: Array) -> tuple[Array, Array]:
    """Return mean [draw, channel] and covariance [draw, channel, channel] of x [scan, location, channel].

    Weights are those of scans, w [draw, scan]; all locations of a scan count alike.
    """
    total = w.sum(1) * x.shape[1]
    mean = (w @ x.sum(1)) / total[:, None]
    squares = np.einsum("kpc,kpd->kcd", x, x).reshape(len(x), -1)
    squared = (w @ squares).reshape(len(w), x.shape[2], x.shape[2]) / total[:, None, None]
    return mean, squared - mean[:, :, None] * mean[:, None, :]


def _template(x1: Array, x0: Array, w1: Array, w0: Array, rounding: float) -> tuple[Array, Array]:
    """Return Hotelling's template [draw, channel] and the score halfway between the classes [draw].

    `rounding` is the least variance in any direction; where that is 0, all responses are 0, and the template is, too.
    """
    (m1, s1), (m0, s0) = _moments(x1, w1), _moments(x0, w0)
    values, vectors = np.linalg.eigh((s1 + s0) / 2)
    along = np.einsum("bcd,bc->bd", vectors, m1 - m0)
    along[(values < rounding) & (along**2 < rounding)] = 0
    template = np.einsum("bcd,bd->bc", vectors, along / np.maximum(values, rounding or 1.0))
    return template, ((m1 + m0) / 2 * template).sum(1)


def _at_each(found: Responses, folds: list[NDArray[np.int64]], w1: Array, w0: Array) -> Array:
    total, n = np.zeros(len(w1)), found.present.shape[1]
    for p in range(n):
        total += _cross_fitted(found, folds, w1, w0, [p], [p])
    return total / n


def _at_all(found: Responses, folds: list[NDArray[np.int64]], w1: Array, w0: Array) -> Array:
    every = list(range(found.present.shape[1]))
    return _cross_fitted(found, folds, w1, w0, every, None)


def _cross_fitted(
    found: Responses, folds: list[NDArray[np.int64]], w1: Array, w0: Array, tested: list[int], trained: list[int] | None
) -> Array:
    """Return the AUC [draw] over the locations `tested`; `trained` are those of the template, None for the others."""
    everyone, total = np.arange(len(found.pairs)), np.zeros(len(w1))
    for test in folds:
        train = np.setdiff1d(everyone, test)
        scores: tuple[list[Array], list[Array]] = [], []
        for p in tested:
            where = np.array(trained if trained is not None else [q for q in tested if q != p])
            x1, x0 = (kind[np.ix_(train, where)] for kind in (found.present, found.absent))
            template, middle = _template(x1, x0, w1[:, train], w0[:, train], found.rounding)
            for kind, x in zip(scores, (found.present, found.absent), strict=True):
                kind.append(template @ x[test, p].T - middle[:, None])
        total += _compared(scores, np.tile(w1[:, test], len(tested)), np.tile(w0[:, test], len(tested)))
    return total / len(folds)


def _compared(scores: tuple[list[Array], list[Array]], w1: Array, w0: Array) -> Array:
    """Return the AUC [draw] of the scores of all locations."""
    present, absent = (np.concatenate(kind, 1) for kind in scores)
    step = max(1, _CHUNK // (present.shape[1] * absent.shape[1]))
    parts = [slice(k, k + step) for k in range(0, len(w1), step)]
    return np.concatenate([auc(present[part], absent[part], w1[part], w0[part]) for part in parts])
