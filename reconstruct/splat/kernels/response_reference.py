"""The polychromatic response in float64, written to be read; the oracle of `response_cpu`."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def evaluate(a: Array, b: Array, eta: Array, la: Array, lb: Array) -> tuple[Array, Array, Array]:
    """Return P = −log Σ η_k exp(−a_k·la − b_k·lb) and its derivatives in la and lb, each [pixel].

    `a`, `b`, `eta` [node] with Σ η = 1; `la`, `lb` [pixel].
    """
    p, q = _shares(a, b, eta, la, lb)
    return p, q @ a, q @ b


def theta_sums(a: Array, b: Array, eta: Array, la: Array, lb: Array, g: Array) -> Array:
    """Return Σ over pixels of g·dP/dη_k [node], η not renormalised; 0 where η_k is 0. `g` [pixel]."""
    _, q = _shares(a, b, eta, la, lb)
    return np.divide(-(g @ q), eta, out=np.zeros(eta.size), where=eta > 0)


def _shares(a: Array, b: Array, eta: Array, la: Array, lb: Array) -> tuple[Array, Array]:
    """Return P [pixel] and q_k = η_k exp(−x_k)/Σ [pixel, node], the share of the signal that a node carries."""
    a, b, eta, la, lb = (np.asarray(v, np.float64) for v in (a, b, eta, la, lb))
    x = la[:, None] * a + lb[:, None] * b
    # the smallest exponent among nodes that count: their sum cannot underflow
    low = x[:, eta > 0].min(axis=1)
    parts = eta * np.exp(np.where(eta > 0, low[:, None] - x, 0.0))
    total = parts.sum(axis=1)
    return low - np.log(total), parts / total[:, None]
