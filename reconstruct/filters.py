"""The ramp filter of filtered backprojection, in its band-limited spatial form, and its windows."""

from typing import Annotated, Any, Literal, cast

import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ctsim.reconstruct.primary import Readings
from ctsim.reconstruct.settings import about, names_of, value_of

Window = Annotated[Literal["ram-lak", "shepp-logan", "cosine", "hamming", "hann"], about("window of the ramp filter")]
WINDOWS = names_of(Window)
Cutoff = Annotated[float, about("frequency where the filter ends", "of the Nyquist frequency", gt=0, le=1)]


class Filter(Readings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The filter of a method that ends in filtered backprojection.

    The defaults were chosen on the suite `tune` by `ctsim.benchmarks.tools.tune_filter`.
    """

    window: Window = "cosine"
    cutoff: Cutoff = 0.9


RAMP = Filter(window="ram-lak", cutoff=1.0)
"""The ramp up to the Nyquist frequency, without a window: the exact inverse, which oracles compare with."""


def padded_length(n: int) -> int:
    """Return the FFT length for rows of `n` samples: at least 2 n, so that the convolution does not wrap."""
    return cast(int, scipy.fft.next_fast_len(2 * n, real=True))


def ramp_kernel(n: int, spacing: float) -> NDArray[np.float64]:
    """Return the ramp's impulse response at lags 0 … n/2 and, wrapped, −(n−1)/2 … −1: [n], 1/mm².

    Sampled in space rather than as |f|, whose discrete form loses the mean value (Kak and Slaney,
    Principles of Computerized Tomographic Imaging, 1988, eq. 3-61).
    """
    lag = np.arange(n)
    lag = np.minimum(lag, n - lag)
    odd = lag % 2 == 1
    kernel = np.zeros(n)
    kernel[0] = 1 / (4 * spacing**2)
    kernel[odd] = -1 / (np.pi * lag[odd] * spacing) ** 2
    return kernel


def window_gain(frequency: NDArray[np.float64], window: str = "ram-lak", cutoff: float = 1.0) -> NDArray[np.float64]:
    """Return the window's gain at `frequency` in units of the Nyquist frequency, zero beyond `cutoff`.

    Raises InputError for an unknown window or a cutoff outside (0, 1].
    """
    window, cutoff = value_of("window", window, Window), value_of("cutoff", cutoff, Cutoff)
    x = np.abs(frequency) / cutoff
    gains = {
        "ram-lak": np.ones_like(x),
        "shepp-logan": np.sinc(x / 2),
        "cosine": np.cos(np.pi * x / 2),
        "hamming": 0.54 + 0.46 * np.cos(np.pi * x),
        "hann": 0.5 + 0.5 * np.cos(np.pi * x),
    }
    return np.where(x <= 1 + 1e-12, gains[window], 0.0)


def ramp_response(n: int, spacing: float, window: str = "ram-lak", cutoff: float = 1.0) -> NDArray[np.float32]:
    """Return the gain for the real FFT of rows of `n` samples `spacing` mm from each other: [n//2 + 1], 1/mm.

    The sampling step of the convolution integral is included.
    """
    response = np.fft.rfft(ramp_kernel(n, spacing)).real * spacing
    frequency = np.arange(n // 2 + 1) / (n / 2)
    return (response * window_gain(frequency, window, cutoff)).astype(np.float32)


def filter_rows(rows: NDArray[np.float32], response: NDArray[np.float32], n_fft: int) -> NDArray[np.float32]:
    """Convolve the last axis of `rows` with the filter of the given `response`; same shape and type."""
    workers = numba.get_num_threads()
    # SciPy's types for these calls are those of its backend dispatch.
    spectrum: Any = scipy.fft.rfft(rows, n_fft, axis=-1, workers=workers)
    spectrum *= response
    filtered: Any = scipy.fft.irfft(spectrum, n_fft, axis=-1, workers=workers, overwrite_x=True)
    return filtered[..., : rows.shape[-1]]
