import numpy as np
import pytest

from ctsim.errors import InputError
from ctsim.reconstruct.filters import WINDOWS, filter_rows, padded_length, ramp_kernel, ramp_response, window_gain


def test_kernel_has_the_band_limited_values():
    kernel = ramp_kernel(16, 0.5)
    assert kernel[0] == pytest.approx(1 / (4 * 0.25))
    assert kernel[2] == 0
    assert kernel[3] == pytest.approx(-1 / (np.pi * 3 * 0.5) ** 2)
    assert np.array_equal(kernel[1:], kernel[1:][::-1])


def test_response_follows_the_ramp():
    n, spacing = 1024, 0.7
    frequency = np.fft.rfftfreq(n, spacing)
    # The truncated kernel leaves 2/(π² n) of the peak at zero frequency and less elsewhere.
    np.testing.assert_allclose(ramp_response(n, spacing), frequency, atol=1 / (2 * spacing) * 5 / (np.pi**2 * n))
    assert ramp_response(n, spacing)[0] > 0


@pytest.mark.parametrize("n", [1, 7, 11, 64])
def test_filtering_is_the_linear_convolution(n):
    rows = np.random.default_rng(1).standard_normal((3, n)).astype(np.float32)
    n_fft = padded_length(n)
    assert n_fft >= 2 * n
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    matrix = np.where(lag % 2 == 1, -1 / (np.pi * np.maximum(lag, 1) * 2.0) ** 2, 0.0)
    np.fill_diagonal(matrix, 1 / 16)
    # float32: about 1e-7 of the largest term, times the growth of an FFT of 128 points.
    expected = 2.0 * rows.astype(np.float64) @ matrix
    np.testing.assert_allclose(filter_rows(rows, ramp_response(n_fft, 2.0), n_fft), expected, atol=1e-6)


@pytest.mark.parametrize("window", WINDOWS)
def test_windows_start_at_one_and_stop_at_the_cutoff(window):
    gain = window_gain(np.linspace(0, 1, 101), window, 0.5)
    assert gain[0] == pytest.approx(1)
    assert not gain[52:].any()
    assert np.all(np.diff(gain) <= 0)


def test_windows_have_their_published_values_at_half_the_cutoff():
    values = {w: float(window_gain(np.array([0.5]), w)[0]) for w in WINDOWS}
    expected = {"ram-lak": 1, "shepp-logan": np.sin(np.pi / 4) / (np.pi / 4), "cosine": np.cos(np.pi / 4)}
    assert values == pytest.approx(expected | {"hamming": 0.54, "hann": 0.5})


def test_bad_filters_are_refused_by_name():
    with pytest.raises(InputError, match="ram-lak"):
        ramp_response(8, 1.0, "hanning")
    with pytest.raises(InputError, match="cutoff"):
        ramp_response(8, 1.0, "hann", 0.0)
