import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.reconstruct.kernels import backproject_cpu, backproject_reference

RNG = np.random.default_rng(3)
VIEWS = RNG.standard_normal((9, 7, 11)).astype(np.float32)
ANGLES = np.sort(RNG.uniform(0, 2 * np.pi, 9))
CASES = {
    "centred": ((50.0, 90.0, 1.0, 1.0, 0.0, 0.0), (0.7, 0.7, 0.7, 0, 0, 0, 4.0)),
    "detector offset": ((50.0, 90.0, 1.3, 0.9, 0.8, -1.7), (0.7, 0.5, 0.6, 0, 0, 0, 4.0)),
    "origin offset": ((50.0, 90.0, 1.3, 0.9, 0.0, 0.0), (0.7, 0.5, 0.6, 1.1, -0.9, 0.4, 4.0)),
    "anisotropic, off the detector": ((9.0, 20.0, 1.3, 0.9, 0.2, 0.1), (5.0, 0.1, 0.9, 0, 0, 0, 7.0)),
    "fine voxels": ((50.0, 90.0, 1.3, 0.9, 0.2, 0.1), (0.02, 0.3, 0.2, 0.0, 0, 0, 7.0)),
}


def run(kernel, views, case, shape=(5, 7, 11), dtype: type = np.float32):
    volume = np.zeros(shape, dtype)
    orbit, grid = (np.array(values, float) for values in CASES[case])
    kernel.backproject(views, ANGLES, orbit, grid, volume)
    return volume


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("shape", [(5, 7, 11), (33, 18, 37), (1, 18, 37), (1, 1, 1)])
def test_fast_kernel_equals_its_reference(case, shape):
    fast = run(backproject_cpu, VIEWS, case, shape)
    slow = run(backproject_reference, VIEWS, case, shape, np.float64)
    # Places are rounded to 2⁻²⁴ · 8 rows, samples of size ~3 differ by that times their slope; nine views.
    np.testing.assert_allclose(fast, slow, rtol=0, atol=9 * 3 * 8 * 2**-22)
    assert shape == (1, 1, 1) or np.count_nonzero(slow) > 10


def test_one_row_and_one_column_detectors():
    for views in (VIEWS[:, :1], VIEWS[:, :, :1], VIEWS[:, :1, :1]):
        for shape in ((5, 7, 11), (1, 7, 11)):
            fast = run(backproject_cpu, views, "centred", shape)
            slow = run(backproject_reference, views, "centred", shape, np.float64)
            np.testing.assert_allclose(fast, slow, atol=1e-5)


@pytest.mark.parametrize("off_v", [0.0, 0.4, 0.6])
def test_a_slice_from_one_long_row(off_v):
    """The kernel of one row rounds places to float32; half a pixel beside the row it sees nothing."""
    views = RNG.standard_normal((9, 1, 641)).astype(np.float32)
    orbit, grid = (
        np.array([300.0, 600.0, 0.2, 0.2, 0.2 * off_v, 3.3]),
        np.array([0.1, 0.21, 0.19, 0.0, 4.0, -2.0, 60.0]),
    )
    fast, slow = np.zeros((1, 150, 301), np.float32), np.zeros((1, 150, 301))
    backproject_cpu.backproject(views, ANGLES, orbit, grid, fast)
    backproject_reference.backproject(views, ANGLES, orbit, grid, slow)
    # A place, up to 641, comes of eight roundings by up to 2⁻²⁴ of it, samples differ by sqrt(2) from one to the next
    # (RMS), and there are nine views: all of them independent.
    assert np.sqrt(np.mean((fast - slow) ** 2)) <= 641 * 2**-24 * (8 * 2 * 9) ** 0.5
    assert (np.count_nonzero(slow) == 0) if off_v > 0.5 else slow.std() > 1


def test_thread_count_changes_no_bit():
    shapes = ((40, 41, 43), (1, 41, 43))
    one, several = one_and_several(lambda: [run(backproject_cpu, VIEWS, "detector offset", shape) for shape in shapes])
    assert all(np.array_equal(a, b) for a, b in zip(one, several, strict=True))


def test_one_tile_and_many_share_one_compilation():
    # A second one costs seconds, and would be spent where a run is timed after a warm-up on a small grid.
    for shape in ((2, 1, 1), (5, 40, 41)):
        run(backproject_cpu, VIEWS, "centred", shape)
    assert len(backproject_cpu._add_tiles.signatures) == 1


def test_columns_outside_the_field_of_view_stay_untouched():
    orbit, grid = np.array(CASES["centred"][0]), np.array([0.7, 0.7, 0.7, 0, 0, 0, 2.0])
    volume = np.full((5, 7, 11), 5.0, np.float32)
    backproject_cpu.backproject(VIEWS, ANGLES, orbit, grid, volume)
    y, x = (np.arange(7) - 3) * 0.7, (np.arange(11) - 5) * 0.7
    outside = np.add.outer(y**2, x**2) > 4.0
    assert (volume[:, outside] == 5).all()
    assert not (volume[:, ~outside] == 5).all()
