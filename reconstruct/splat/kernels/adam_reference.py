"""Readable float64 twin of `adam_cpu`."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Wide = NDArray[np.float64]


def step(values: Array, gradient: Array, first: Array, second: Array, rates: Array, count: int) -> tuple[Wide, ...]:
    """Return values and moments after step number `count`: Kingma and Ba 2015, algorithm 1."""
    g = gradient.astype(np.float64)
    m, v = 0.9 * first.astype(np.float64) + 0.1 * g, 0.999 * second.astype(np.float64) + 0.001 * g**2
    mean, square = m / (1 - 0.9**count), v / (1 - 0.999**count)
    return values.astype(np.float64) - rates * mean / (np.sqrt(square) + 1e-15), m, v


def activate(x_scales: Array, x_densities: Array, low: float, span: float) -> tuple[Wide, Wide]:
    """Return scales low + span·sigmoid(x) and densities softplus(x)."""
    return low + span * _sigmoid(x_scales), np.logaddexp(0, x_densities.astype(np.float64))


def by_scales(x: Array, by_log_scales: Array, low: float, span: float) -> Wide:
    """Take gradients by log scales to those by what is learned: d log s/dx = span·σ(1 − σ)/s."""
    share = _sigmoid(x)
    return by_log_scales * span * share * (1 - share) / (low + span * share)


def by_densities(x: Array, gradient: Array) -> Wide:
    """Take gradients by densities to those by what is learned: dρ/dx = σ."""
    return gradient * _sigmoid(x)


def _sigmoid(x: Array) -> Wide:
    return 1 / (1 + np.exp(-x.astype(np.float64)))
