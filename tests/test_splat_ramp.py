"""The ramp filter of the splats' steps, against Fourier transforms, and its kernel against NumPy."""

import math

import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.kernels.product_cpu import padded_rows, products
from ctsim.reconstruct.splat.ramp import ROOM, STEEPEST, ramp

U = 2.0**-24  # of float32


def normal(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


# one row, rows up to the next four, columns of less than a register, of whole panels, and beyond
@pytest.mark.parametrize(("m", "n", "columns"), [(1, 1, 1), (4, 9, 3), (5, 30, 8 * WIDTH), (7, 3, 17 * WIDTH + 5)])
@pytest.mark.parametrize("scale", [0.0, -0.75])
def test_products_are_those_of_matrices(threads, m, n, columns, scale):
    matrix, stack, out = normal(m, n), normal(3, n, columns, seed=1), normal(3, m, columns, seed=2)
    wanted = matrix.astype(np.float64) @ stack + scale * out.astype(np.float64)
    terms = np.abs(matrix).astype(np.float64) @ np.abs(stack) + abs(scale) * np.abs(out)
    if scale == 0:
        out[...] = np.nan  # not read
    products(padded_rows(matrix), stack, out, scale)
    assert np.all(np.abs(out - wanted) <= (n + 3) * U * terms)


def test_any_number_of_threads_gives_the_same_bits():
    volume = normal(40, 33, 70)

    def filtered():
        found = volume.copy()
        ramp((40, 33), (64, 48), 10).apply(found)
        return found

    one, several = one_and_several(filtered)
    assert np.array_equal(one, several) and not np.array_equal(one, volume)


def by_fourier(volume, across, n_views):
    """Multiply the spectrum of slices with room for a quarter of them besides."""
    size = [n + n // ROOM for n in volume.shape[:2]]
    spectrum = np.fft.fft2(volume.astype(np.float64), size, axes=(0, 1))
    f_y, f_x = (np.fft.fftfreq(p) * whole for p, whole in zip(size, across, strict=True))  # cycles a field of view
    gain = np.clip(math.pi * np.hypot(f_y[:, None], f_x) / n_views, 1, max(STEEPEST * n_views, 1))
    found = np.fft.ifft2(spectrum * gain[..., None], axes=(0, 1)).real
    return found[: volume.shape[0], : volume.shape[1]], gain


# a box in the field of view, all of it; odd and even periods; frequencies up to the highest, and few of them
@pytest.mark.parametrize(
    ("shape", "across", "n_views"),
    [
        ((40, 33, 5), (64, 48), 10),
        ((96, 96, 3), (96, 96), 10),
        ((91, 120, 3), (130, 120), 4),
        ((20, 30, 4), (24, 30), 2),
        ((16, 16, 2), (16, 16), 1),
        ((1, 5, 2), (8, 8), 8),
    ],
)
def test_the_ramp_is_that_of_fourier_transforms(threads, shape, across, n_views):
    volume = normal(*shape)
    wanted, gain = by_fourier(volume, across, n_views)
    found = volume.copy()
    ramp(shape[:2], across, n_views).apply(found)
    # each of four products adds up to 120 numbers of about 1, whose roundings grow by the root, and none gains more
    np.testing.assert_allclose(found, wanted, rtol=0, atol=4 * math.sqrt(120) * U * gain.max())
    assert n_views == 1 or np.abs(found - volume).max() > 0.3  # and it is not the identity


def test_a_level_beyond_some_frequencies_takes_few_waves():
    one = ramp((384, 384), (384, 384), 10)
    assert max(len(waves) for waves in one._there) < 384 // 4
