"""Total variation of a volume: its proximal map, and a smoothed gradient to descend along.

TV(x) = Σ |D x| with D the forward differences along y, x and z (zero past the last voxel), each multiplied by the
smallest voxel length over that axis' (`ratios`, ≤ 1), so that a slope counts the same along all axes. Volumes
are float32 [y, x, z], dual fields [3, y, x, z]; sums are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ctsim.geometry import Geometry

Array = NDArray[np.float32]


def axis_ratios(geometry: Geometry) -> NDArray[np.float32]:
    """Return the smallest voxel length over that of y, x and z, [3]."""
    d_z, d_y, d_x = geometry.d_voxel
    return (min(geometry.d_voxel) / np.array([d_y, d_x, d_z])).astype(np.float32)


class Denoiser:
    """The proximal map argmin ½‖x − b‖² + τ TV(x) over x zero off `support` and, if asked, not negative.

    Fast gradient projection on the dual, Beck and Teboulle, IEEE Trans. Image Process. 18, 2009,
    doi:10.1109/TIP.2009.2028250. The dual field is kept from call to call, as a start for the next.
    """

    def __init__(self, support: NDArray[np.bool_], ratios: NDArray[np.float32], positivity: bool) -> None:
        self.support, self.ratios, self.positivity = support, ratios, positivity
        self.dual = np.zeros((3, *support.shape), np.float32)
        self._ahead = np.empty_like(self.dual)

    def run(self, b: Array, tau: float, iterations: int) -> Array:
        """Return the minimiser of `b`, [y, x, z], after `iterations` steps."""
        x, ahead = np.empty_like(b), self._ahead
        if tau == 0:
            _primal(b, self.dual, np.float32(0), self.ratios, self.support, self.positivity, x)
            return x
        start, t = self.dual, 1.0
        # ‖D‖² ≤ 4 Σ ratio², Beck and Teboulle's lemma 4.2 with a third axis
        step = np.float32(1 / (4 * float((self.ratios**2).sum()) * tau))
        for _ in range(iterations):
            after = (1 + math.sqrt(1 + 4 * t * t)) / 2
            _primal(b, start, np.float32(tau), self.ratios, self.support, self.positivity, x)
            _ascend(x, start, ahead, self.dual, step, np.float32((t - 1) / after), self.ratios)
            start, t = ahead, after
        _primal(b, self.dual, np.float32(tau), self.ratios, self.support, self.positivity, x)
        return x


def total_variation(x: Array, ratios: NDArray[np.float32]) -> float:
    """Return TV(x), summed in float64."""
    sums = np.zeros(len(x))
    _sum_slopes(x, ratios, sums)
    return float(sums.sum())


def descend(x: Array, length: float, steps: int, ratios: NDArray[np.float32], delta: float = math.inf) -> None:
    """Take `steps` steps of norm `length` down the gradient of TV, in place.

    The root is smoothed at 1e-4 of the largest value, as it has no gradient at zero. With a finite `delta` (1/mm)
    differences D are weighted by exp(−(D/δ)²), held fixed within a step: adaptive-weighted TV, which spares edges
    (Liu, Ma, Fan and Liang, Phys. Med. Biol. 57, 2012, doi:10.1088/0031-9155/57/23/7923).
    """
    field, gradient = np.empty((3, *x.shape), np.float32), np.empty_like(x)
    for _ in range(steps):
        least = np.float32(max(1e-4 * float(np.abs(x).max()), 1e-15))
        _normalised_slopes(x, ratios, np.float32(1 / delta), least, field)
        _transposed(field, ratios, gradient)
        norm = math.sqrt(float(np.einsum("ijk,ijk", gradient, gradient, dtype=np.float64)))
        if norm == 0:
            return
        gradient *= np.float32(length / norm)
        x -= gradient


@njit(inline="always")
def _slope(x, i, j, k, ratios):
    """Forward differences of one voxel along y, x and z."""
    here = x[i, j, k]
    a = (x[i + 1, j, k] - here) * ratios[0] if i + 1 < x.shape[0] else np.float32(0)
    b = (x[i, j + 1, k] - here) * ratios[1] if j + 1 < x.shape[1] else np.float32(0)
    c = (x[i, j, k + 1] - here) * ratios[2] if k + 1 < x.shape[2] else np.float32(0)
    return a, b, c


@njit(inline="always")
def _back(field, i, j, k, ratios):
    """Dᵀ of a field at one voxel; the field's last entries along each axis must be zero."""
    value = -(field[0, i, j, k] * ratios[0] + field[1, i, j, k] * ratios[1] + field[2, i, j, k] * ratios[2])
    if i > 0:
        value += field[0, i - 1, j, k] * ratios[0]
    if j > 0:
        value += field[1, i, j - 1, k] * ratios[1]
    if k > 0:
        value += field[2, i, j, k - 1] * ratios[2]
    return value


@njit(parallel=True, cache=True)
def _primal(b, field, tau, ratios, support, positivity, x):
    for i in prange(b.shape[0]):
        for j in range(b.shape[1]):
            for k in range(b.shape[2]):
                value = b[i, j, k] - tau * _back(field, i, j, k, ratios)
                if not support[i, j, k] or (positivity and value < 0):
                    value = np.float32(0)
                x[i, j, k] = value


@njit(parallel=True, cache=True)
def _ascend(x, start, ahead, dual, step, momentum, ratios):
    """Step the dual field from `start` up the slopes of x, back into the unit balls, and on by its momentum: `ahead`.

    `start` may be one of the two that are written: all of a voxel's values are loaded before any is stored, and no
    other voxel's step reads or writes them.
    """
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                a, b, c = start[0, i, j, k] + step * a, start[1, i, j, k] + step * b, start[2, i, j, k] + step * c
                shrink = np.float32(1) / max(np.float32(1), np.sqrt(a * a + b * b + c * c))
                a, b, c = a * shrink, b * shrink, c * shrink
                ahead[0, i, j, k] = a + momentum * (a - dual[0, i, j, k])
                ahead[1, i, j, k] = b + momentum * (b - dual[1, i, j, k])
                ahead[2, i, j, k] = c + momentum * (c - dual[2, i, j, k])
                dual[0, i, j, k], dual[1, i, j, k], dual[2, i, j, k] = a, b, c


@njit(parallel=True, cache=True)
def _sum_slopes(x, ratios, sums):
    for i in prange(x.shape[0]):
        total = 0.0
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                total += math.sqrt(np.float64(a) * a + np.float64(b) * b + np.float64(c) * c)
        sums[i] = total


@njit(parallel=True, cache=True, error_model="numpy")
def _normalised_slopes(x, ratios, per_delta, least, field):
    """Fill `field` with the weighted slopes over their smoothed root."""
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            for k in range(x.shape[2]):
                a, b, c = _slope(x, i, j, k, ratios)
                u, v = math.exp(-((a * per_delta) ** 2)), math.exp(-((b * per_delta) ** 2))
                w = math.exp(-((c * per_delta) ** 2))
                root = np.sqrt(u * a * a + v * b * b + w * c * c + least * least)
                field[0, i, j, k], field[1, i, j, k], field[2, i, j, k] = u * a / root, v * b / root, w * c / root


@njit(parallel=True, cache=True)
def _transposed(field, ratios, gradient):
    for i in prange(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            for k in range(gradient.shape[2]):
                gradient[i, j, k] = _back(field, i, j, k, ratios)
