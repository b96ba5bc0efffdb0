"""Readable float64 twin of `shadow_cpu`: what a hull of points reaches within a band of rows, as a linear programme."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]


def reach(u: Array, v: Array, low: float, high: float) -> tuple[float, float] | None:
    """Return the least and greatest u within the hull of the points (u, v) where low ≤ v ≤ high, None if it is empty.

    A point of the hull is a mean of the corners whose weights are not negative and sum to 1.
    """
    limits = {"A_ub": np.stack([v, -v]), "b_ub": [high, -low], "A_eq": np.ones((1, len(u))), "b_eq": [1.0]}
    ends = [linprog(sign * u, **limits) for sign in (1, -1)]
    return None if ends[0].status == 2 else (float(ends[0].fun), -float(ends[1].fun))
