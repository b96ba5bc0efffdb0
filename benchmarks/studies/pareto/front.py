"""Which settings are worth their time: the Pareto front of (seconds, error), its knee, and what beats a point."""

import math
from collections.abc import Sequence

Pair = tuple[float, float]


def front(pairs: Sequence[Pair]) -> list[int]:
    """Return the indices of the (seconds, error) pairs that no other beats, fastest first.

    A pair is beaten by another that is no worse in both and better in one. Of equal pairs all are on the front.
    """
    found: list[int] = []
    least = math.inf
    for k in sorted(range(len(pairs)), key=lambda k: pairs[k]):
        if pairs[k][1] < least or (found and pairs[k] == pairs[found[-1]]):
            found.append(k)
            least = pairs[k][1]
    return found


def knee(pairs: Sequence[Pair]) -> int | None:
    """Return the index of the point of the front that lies farthest below the chord between its ends, in log-log.

    Scaling either axis moves no point past another, so no normalisation enters. None where no point lies below
    the chord, as for fewer than three. Times and errors must be positive.
    """
    on = front(pairs)
    x, y = ([math.log(pairs[k][axis]) for k in on] for axis in (0, 1))
    # twice the area of the triangle with the chord: distance times the chord's length, positive below it
    below = [(x[-1] - x[0]) * (y[0] - v) - (x[0] - u) * (y[-1] - y[0]) for u, v in zip(x, y, strict=True)]
    most = max(below, default=0.0)
    return on[below.index(most)] if most > ROUNDING else None


ROUNDING = 1e-12  # of products of logarithms, which are below 100


def beaten_by(pairs: Sequence[Pair], k: int) -> tuple[int, float]:
    """Return the fastest point that is no worse than point `k`, and its share of that point's time.

    That is `k` itself, share 1, on the front.
    """
    error = pairs[k][1]
    rivals = [i for i, (_, e) in enumerate(pairs) if e <= error]
    best = min(rivals, key=lambda i: (pairs[i], i != k))
    return best, pairs[best][0] / pairs[k][0]


def faster(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether runs of `a` seconds are faster than those of `b` beyond the spread of both.

    The 95 % intervals of their medians do not meet: between order statistics, for any distribution. Fewer than
    `FEWEST` runs tell nothing.
    """
    return min(len(a), len(b)) >= FEWEST and _interval(a)[1] < _interval(b)[0]


FEWEST = 5
"""Runs of which the range is an interval of 94 %; all of five lie below five others by chance once in 252 times."""


def _interval(runs: Sequence[float]) -> Pair:
    n, at, below = len(runs), 0, 1  # below: of 2ⁿ equally likely cases, those with at most `at` runs under the median
    while below < 0.025 * 2**n:
        at += 1
        below += math.comb(n, at)
    at = max(at - 1, 0)
    ordered = sorted(runs)
    return ordered[at], ordered[-1 - at]
