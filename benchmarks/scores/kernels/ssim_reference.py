"""Readable float64 twin of `ssim_cpu`: SSIM pixel by pixel from the definition."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def ssim_map(x: Array, y: Array, weights: Array, constants: tuple[float, float], padding: str) -> NDArray[np.float64]:
    """Return the SSIM of every pixel of two slices [v, u]; `weights` are those of the window along one axis.

    `padding` is the mode of `numpy.pad`: "symmetric" repeats the edge sample, "constant" is 0 outside.
    """
    n, window = len(weights), np.outer(weights, weights)
    padded = [np.pad(a.astype(np.float64), n // 2, mode=padding) for a in (x, y)]  # type: ignore[call-overload]
    a, b = (np.lib.stride_tricks.sliding_window_view(p, (n, n)) for p in padded)

    def mean(values: Array) -> NDArray[np.float64]:
        return np.einsum("vuij,ij->vu", values, window)

    mean_a, mean_b, (c1, c2) = mean(a), mean(b), constants
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
