"""Path lengths on which an energy rule is tried: in steps of a factor while they are thin, of P while they are thick.

A signal is a sum of e^(−μL). Against log L each of these has the same shape for every μ, so that steps of one
factor resolve them all. Behind a thick path what differs between energies decides, over steps of P.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ALONE, TOGETHER, CORNERS = 128, 1536, 1024  # trials of each material, of several at once, of thick ones at once
_ABSENT = 0.3  # share of the trials at once that lack a given material
_THICK = 1.6  # P from which steps are even in P
_STARTS, _SWEEPS = 24, 20  # climbs that start from several materials at once, and steps of each
_FACTORS = np.exp([-0.5, -0.2, -0.05, 0.05, 0.2, 0.5])
Error = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """A detected spectrum before materials: weights [n], sum 1, and attenuation (1/mm) [material, n]."""

    weights: NDArray[np.float64]
    mu: NDArray[np.float64]

    def log_signal(self, lengths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return P [c] behind path lengths (mm) [c, material]."""
        low = lengths @ self.mu.min(axis=1)  # keeps the sum from vanishing
        return low - np.log(np.exp(low[:, None] - lengths @ self.mu) @ self.weights)

    def shorten(self, lengths: NDArray[np.float64], p_max: float) -> NDArray[np.float64]:
        """Return path lengths [c, material], those of too large a P shortened in proportion until P is `p_max`."""
        out, over = lengths.copy(), np.arange(len(lengths))
        for _ in range(4):
            depth = out[over] @ self.mu
            low = depth.min(axis=1)
            parts = np.exp(low[:, None] - depth)
            total = parts @ self.weights
            excess = low - np.log(total) - p_max
            # P is concave in the length, so Newton's step from above ends at or below p_max.
            steep = excess > 0
            slope = (parts[steep] * depth[steep]) @ self.weights / total[steep]
            over = over[steep]
            out[over] *= (1 - excess[steep] / slope)[:, None]
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Trials:
    """Path lengths (mm): `alone` [material, step] of each material, `lengths` [c, material] to be tried."""

    alone: NDArray[np.float64]
    lengths: NDArray[np.float64]


def make_trials(beam: Beam, longest: NDArray[np.float64], p_min: float, p_max: float) -> Trials:
    """Return paths with P from `p_min` to `p_max`, of no material more than its `longest` [material] mm."""
    m = longest.size
    one = [Beam(weights=beam.weights, mu=mu[None]) for mu in beam.mu]
    scales = [_scale(one[k], longest[k], p_min, p_max) for k in range(m)]
    alone = np.stack([_length(scale, np.linspace(0, 1, ALONE)) for scale in scales])
    lengths = [np.kron(np.eye(m)[k], alone[k][:, None]) for k in range(m)]
    if m > 1:
        steps = (_spread(TOGETHER, m) - _ABSENT) / (1 - _ABSENT)
        together = [np.where(steps[:, k] < 0, 0.0, _length(scales[k], steps[:, k])) for k in range(m)]
        # none, half or all of each: where many are thick, what little signal is left changes fastest
        corners = np.floor(3 * _spread(CORNERS, m)) / 2
        lengths += [np.stack(together, 1), corners * longest, longest[None]]
    return Trials(alone=alone, lengths=beam.shorten(np.concatenate(lengths), p_max))


def climb(tried: Trials, errors: NDArray[np.float64], error: Error, beam: Beam, p_max: float) -> NDArray[np.float64]:
    """Return paths [path, material] of greater error, reached from the worst trial of every group of trials.

    `errors` [c] are those of the trials, and `error` gives them for other lengths. A step changes the length of one
    material or all in proportion, and keeps to the longest lengths and to P = `p_max` of the beam.
    """
    m = len(tried.alone)
    groups = np.array_split(np.arange(m * ALONE), 4 * m)
    # a thin film and a thick path are wrong in different ways, so each group has its own P
    by_signal = np.argsort(beam.log_signal(tried.lengths[m * ALONE :]), kind="stable") + m * ALONE
    groups += np.array_split(by_signal, _STARTS)
    paths = tried.lengths[[g[errors[g].argmax()] for g in groups if g.size]]
    moving = np.arange(len(paths))
    for sweep in range(_SWEEPS):
        near = _neighbours(paths[moving], tried.alone)
        near = beam.shorten(near.reshape(-1, m), p_max).reshape(near.shape)
        heights = error(near.reshape(-1, m)).reshape(near.shape[:2])
        best, height = heights.argmax(axis=1), heights.max(axis=1)
        paths[moving] = near[np.arange(len(moving)), best]
        # two sweeps tell which climbs are worth going on with
        moving = moving[(best > 0) & ((sweep < 2) | (height > height.max() / 2))]
        if not moving.size:
            break
    return paths


def _neighbours(paths: NDArray[np.float64], alone: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the paths themselves and those a step away, [path, step, material]."""
    longest = alone.max(axis=1)
    steps = [paths[:, None], np.minimum(paths[:, None] * _FACTORS[:, None], longest)]
    for k, lengths in enumerate(alone):
        elsewhere = np.concatenate([[0.0], lengths[15::16]])
        moved = np.repeat(paths[:, None], _FACTORS.size + elsewhere.size, axis=1)
        moved[:, : _FACTORS.size, k] = np.minimum(paths[:, k, None] * _FACTORS, longest[k])
        moved[:, _FACTORS.size :, k] = elsewhere
        steps.append(moved)
    return np.concatenate(steps, axis=1)


def _scale(beam: Beam, longest: float, p_min: float, p_max: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return steps, from 0 to 1, and the logarithm of the length (mm) at each, of the beam's only material."""
    thinnest = min(p_min / float(beam.mu[0] @ beam.weights), longest / 2)
    logs = np.linspace(math.log(thinnest), math.log(longest), 256)
    last = float(np.interp(p_max, beam.log_signal(np.exp(logs)[:, None]), logs))
    logs = np.linspace(logs[0], last, 256)
    depth = beam.log_signal(np.exp(logs)[:, None])
    step = np.log(depth) + depth / _THICK
    return (step - step[0]) / (step[-1] - step[0]), logs


def _length(scale: tuple[NDArray[np.float64], NDArray[np.float64]], step: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.exp(np.interp(step, *scale))


def _spread(n: int, m: int) -> NDArray[np.float64]:
    """Spread n points evenly over the unit cube, [n, m]: multiples of powers of 1/φ with φ^(m+1) = φ + 1."""
    phi = 2.0
    for _ in range(60):
        phi = (1 + phi) ** (1 / (m + 1))
    return (0.5 + np.outer(np.arange(1, n + 1), phi ** -np.arange(1.0, m + 1))) % 1.0
