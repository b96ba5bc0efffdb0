"""Readable float64 twin of `log_cpu`: one formula for counts of any kind."""

import numpy as np
from numpy.typing import NDArray


def line_integrals(
    counts: NDArray[np.number], open_field: NDArray[np.number], dark: float, floor: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return −ln(signal / open signal) [view, v, u] and which pixels are clamped.

    A signal is what exceeds `dark`, and at least `floor`; where it is clamped or not finite it is `floor`.
    """
    signal, lit = counts.astype(np.float64) - dark, open_field.astype(np.float64) - dark
    seen, usable = np.isfinite(signal) & (signal > floor), np.isfinite(lit) & (lit > floor)
    return np.log(np.where(usable, lit, floor)) - np.log(np.where(seen, signal, floor)), ~(seen & usable)
