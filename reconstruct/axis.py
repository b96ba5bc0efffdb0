"""Where the axis of rotation meets the detector, from rays that a full turn measures twice.

In the plane of the orbit the ray (angle a, fan angle g) is also the ray (a + π − 2g, −g). The shift is the one at which
both have the same line integral. This holds for a fan of any width; above and below the plane rays of a cone have no
opposite ray, so only rows count whose opposite rays stay within a pixel inside the field of view.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.log import LineIntegrals
from ctsim.types import Scan

SMOOTH = 1.5  # pixels along u: standard deviation of a filter, so that no shift is smoothed more by interpolation
REACH = 0.42  # of the columns: how far off the middle the axis is sought, so that a half-fan scan is within
COARSE, FINE = 1.0, 0.01  # pixels
UNLIKE = 0.15  # cost: up to 0.11 at the axis, of 300 photons, and 0.21 or more where the axis is beyond reach
UNEVEN = 1.5  # ratio of the largest to the smallest step of views above which a turn has a gap
MOST_ROWS = 32


def axis_shift(scan: Scan) -> float:
    """Return how many columns the axis lies to the right of the detector's middle (−off_detector[1] / d_detector[1]).

    The squared differences of opposite rays are weighted with the transmission, so that rays through metal, whose
    logarithm is all noise, count little. Raises InputError for a scan that is no full turn on a circle, and where
    opposite rays agree nowhere: without an object in view, or with an axis beyond `REACH`.
    """
    geometry = scan.geometry
    order, angles = _turn(geometry)
    p, weight = _middle(scan, order)
    model = _Opposite(geometry, angles, p, weight)
    reach = REACH * geometry.n_detector[1]
    shifts = np.arange(-math.floor(reach), math.floor(reach) + 1) * COARSE
    costs = np.array([model.cost(float(shift)) for shift in shifts])
    least = int(np.argmin(costs))
    if not costs[least] < UNLIKE or least in (0, len(shifts) - 1):
        raise InputError(
            f"--center auto finds no axis within {reach:.4g} columns of the detector's middle where opposite rays "
            "agree; expected --center PIXELS"
        )
    best = float(shifts[least])
    found: Any = optimize.minimize_scalar(
        model.cost, bounds=(best - COARSE, best + COARSE), method="bounded", options={"xatol": FINE}
    )
    return float(found.x)


def _turn(geometry: Geometry) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the views of a turn in the order of their angles, each angle once, and these in radians."""
    if geometry.poses is not None:
        raise InputError("--center auto needs a circular orbit, the views of this scan are poses")
    angles = np.round(np.mod(geometry.angles, 2 * np.pi), 9).astype(np.float64)
    angles[angles >= round(2 * np.pi, 9)] = 0.0
    distinct, order = np.unique(angles, return_index=True)
    gaps = np.diff(distinct, append=distinct[0] + 2 * np.pi)
    if len(distinct) < 4 or gaps.max() > UNEVEN * gaps.min():
        raise InputError("--center auto needs even views over a full turn; expected --center PIXELS for this scan")
    return order, np.asarray(distinct, np.float64)


def _middle(scan: Scan, order: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean line integral of the rows around the plane of the orbit, and its transmission: [view, u]."""
    geometry = scan.geometry
    n_v, d_v = geometry.n_detector[0], geometry.d_detector[0]
    v = (np.arange(n_v) - (n_v - 1) / 2) * d_v + geometry.off_detector[0]
    fan = max(geometry.s_detector[1] / 2 / geometry.dsd, 1e-6)
    near = np.flatnonzero(np.abs(v) <= d_v / (2 * fan))
    near = (
        near[np.argsort(np.abs(v[near]), kind="stable")][:MOST_ROWS] if near.size else np.array([np.argmin(np.abs(v))])
    )
    logarithm = LineIntegrals(scan)
    p = np.stack([logarithm.of(int(view))[0][near].mean(0, dtype=np.float64) for view in order])
    smooth = ndimage.gaussian_filter1d(p, SMOOTH, axis=1, mode="nearest")
    return smooth, np.exp(-np.clip(smooth, 0.0, None))


class _Opposite:
    """The disagreement of opposite rays as a function of the shift in pixels."""

    def __init__(
        self,
        geometry: Geometry,
        angles: NDArray[np.float64],
        p: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> None:
        self.n_u, self.step, self.dsd = geometry.n_detector[1], geometry.d_detector[1], geometry.dsd
        self.angles, self.n = angles, len(angles)
        # the spline's coefficients along a turn that closes, then along u
        self.p = ndimage.spline_filter1d(ndimage.spline_filter1d(p, 3, 0, mode="grid-wrap"), 3, 1, mode="mirror")
        self.weight = weight
        self._places = np.concatenate([angles, [angles[0] + 2 * np.pi]])

    def cost(self, shift: float) -> float:
        """Return how unlike opposite rays are with the axis at this shift: 0 where they agree, 1 if they are unrelated.

        It is the mean square of their differences over that of what they differ by from their common mean, so that
        where only air is compared it is not small.
        """
        middle = (self.n_u - 1) / 2 + shift
        half = int(min(middle, self.n_u - 1 - middle))
        t = np.arange(1, half + 1, dtype=np.float64)
        gamma = np.arctan(t * self.step / self.dsd)
        right, left = middle + t, middle - t
        there = np.mod(self.angles[:, None] + np.pi - 2 * gamma[None, :] - self.angles[0], 2 * np.pi) + self.angles[0]
        rows = np.interp(there, self._places, np.arange(self.n + 1))
        own = np.broadcast_to(np.arange(self.n, dtype=np.float64)[:, None], there.shape)
        one, w_one = self._at(own, np.broadcast_to(right, there.shape))
        other, w_other = self._at(rows, np.broadcast_to(left, there.shape))
        w = w_one * w_other / (w_one + w_other)
        mean = (w * (one + other)).sum() / (2 * w.sum())
        spread = (w * ((one - mean) ** 2 + (other - mean) ** 2)).sum()
        return float((w * (one - other) ** 2).sum() / spread) if spread > 0 else 1.0

    def _at(self, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        at = np.stack([rows, columns])
        p = ndimage.map_coordinates(self.p, at, order=3, mode="grid-wrap", prefilter=False)
        return p, ndimage.map_coordinates(self.weight, at, order=1, mode="grid-wrap")
