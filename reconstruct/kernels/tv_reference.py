"""Readable float64 twin of `tv_cpu`: forward differences of a volume [y, x, z], their transpose, and what uses them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def slopes(x: Array, ratios: Array) -> Array:
    """Return D x [3, y, x, z]: forward differences times `ratios`, 0 past the last voxel."""
    x = x.astype(np.float64)
    return np.stack([np.diff(x, axis=k, append=np.take(x, [-1], k)) * float(ratios[k]) for k in range(3)])


def transposed(field: Array, ratios: Array) -> Array:
    """Return Dᵀ field, written out from the definition ⟨D x, field⟩ = ⟨x, Dᵀ field⟩."""
    found = np.zeros(field.shape[1:])
    for axis in range(3):
        scaled = np.moveaxis(field[axis].astype(np.float64) * float(ratios[axis]), axis, 0)
        out = np.moveaxis(found, axis, 0)
        for k in range(len(scaled) - 1):
            out[k] -= scaled[k]
            out[k + 1] += scaled[k]
    return found


def primal(b: Array, field: Array, tau: float, ratios: Array, support: NDArray[np.bool_], positivity: bool) -> Array:
    """Return b − τ Dᵀ field, zero off `support` and, if asked, where negative."""
    inner = b.astype(np.float64) - tau * transposed(field, ratios)
    return np.where(support, np.maximum(inner, 0) if positivity else inner, 0)


def ascend(x: Array, start: Array, dual: Array, step: float, momentum: float, ratios: Array) -> tuple[Array, Array]:
    """Return the field that is ahead by its momentum, and the dual field, projected onto the unit balls."""
    field = start.astype(np.float64) + step * slopes(x, ratios)
    field = field / np.maximum(np.sqrt((field**2).sum(0)), 1)
    return field + momentum * (field - dual.astype(np.float64)), field


def normalised_slopes(x: Array, ratios: Array, delta: float, least: float) -> Array:
    """Return w·D x / √(Σ w (D x)² + least²) with weights w = exp(−(D x/δ)²)."""
    d = slopes(x, ratios)
    weights = np.exp(-((d / delta) ** 2))
    return weights * d / np.sqrt((weights * d**2).sum(0) + least**2)
