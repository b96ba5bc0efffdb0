"""Fast kernels against their float64 references, on unequal axis lengths."""

import itertools

import numpy as np
import pytest

from ctsim.baselines.kernels import (
    dot_cpu,
    dot_reference,
    excess_cpu,
    excess_reference,
    fill_cpu,
    fill_reference,
    sart_cpu,
    sart_reference,
)
from ctsim.benchmarks.scores.kernels import ssim_cpu, ssim_reference
from ctsim.benchmarks.scores.metrics import border, window
from ctsim.geometry import Geometry
from ctsim.reconstruct.kernels import log_cpu, log_reference, tv_cpu, tv_reference
from ctsim.reconstruct.splat.kernels import adam_cpu, adam_reference, carve_cpu, carve_reference
from ctsim.tracer.columns import make_density_columns
from ctsim.tracer.kernels import (
    bricks_cpu,
    bricks_reference,
    columns_cpu,
    columns_reference,
    density_cpu,
    shadow_cpu,
    shadow_reference,
)
from ctsim.tracer.kernels.gather_cpu import PAD
from ctsim.types import Phantom

SHAPE = (5, 7, 11)
U = 2.0**-24  # of float32
RATIOS = np.array([0.5, 1.0, 0.8], np.float32)


def normal(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("n_kinds", [1, 2, 3])
def test_reach_is_the_largest_cube_ahead(n_kinds):
    rng = np.random.default_rng(n_kinds)
    kind = rng.integers(0, n_kinds, SHAPE).astype(np.uint16)
    kind[1:4, 2:6, 3:9] = 0  # with cubes of up to three in it
    code = bricks_cpu.reach(kind)
    assert np.array_equal(code & 255, np.broadcast_to(kind, code.shape))
    if n_kinds == 1:
        assert (code >> 8 == 255).all()  # nothing differs beyond the grid
        return
    assert np.array_equal(code >> 8, bricks_reference.reach(kind))
    assert (code >> 8 == 3).any()


def test_boundaries_are_the_changes_of_label_along_z():
    labels = np.random.default_rng(1).integers(0, 3, SHAPE).astype(np.uint8)
    count = np.zeros(SHAPE[1:], np.int64)
    columns_cpu.count_boundaries(labels, count)
    expected = columns_reference.boundaries(labels)
    assert count.tolist() == [[len(column) for column in row] for row in expected]
    at = np.cumsum(count.ravel()).reshape(count.shape) - count
    change, ends = np.empty(count.sum(), np.uint32), at + count
    columns_cpu.list_boundaries(labels, at, change)
    assert np.array_equal(at, ends)
    flat = [boundary for row in expected for column in row for boundary in column]
    assert [(c & 0xFFFF, c >> 16 & 0xFF, c >> 24) for c in change.tolist()] == flat


def test_runs_hold_the_density_of_one_material_each_and_zeros_around(threads):
    r = np.random.default_rng(1)
    labels = r.integers(0, 3, (67, 7, 11)).astype(np.uint8)
    labels[r.random(labels.shape) < 0.9] = 0  # gaps of all lengths
    density = r.uniform(0.5, 1.5, labels.shape).astype(np.float32)
    phantom = Phantom(labels=labels, materials=("air", "water", "Fe"), d_voxel=(1.0,) * 3, density=density)
    columns = make_density_columns(phantom)
    assert columns is not None
    first, run, values = columns
    told, used = np.zeros((2, *labels.shape), np.float32), np.zeros(values.size, bool)
    for y, x in np.ndindex(labels.shape[1:]):
        within = run[first[y, x] : first[y, x + 1]]
        for bottom, after, label, place in within:
            assert not told[label - 1, bottom:after, y, x].any()
            told[label - 1, bottom:after, y, x] = values[place : place + after - bottom]
            used[place : place + after - bottom] = True
            for edge in (place, place + after - bottom):  # PAD zeros beyond, the ends themselves are none
                assert not values[edge - PAD : edge].any() or edge > place
                assert not values[edge : edge + PAD].any() or edge == place
            assert values[place] > 0 and values[place + after - bottom - 1] > 0
        for a, b in itertools.pairwise(within):
            assert a[2] < b[2] or b[0] - a[1] >= density_cpu.MERGED
    assert np.array_equal(told, np.stack([np.where(labels == m, density, 0) for m in (1, 2)]))
    assert not values[~used].any() and len(run) > labels[0].size


def test_a_shadow_is_what_its_hull_reaches_in_a_row():
    rng, margin_v, margin_u, n_v, n_u = np.random.default_rng(2), 1.3, 2, 11, 40
    us, vs = rng.uniform(2, 38, (7, 8)), rng.uniform(-3, 14, (7, 1)) + rng.uniform(-2.5, 2.5, (7, 8))
    found = np.empty((n_v, 7, 2), np.int64)
    shadow_cpu.cast_hulls(us, vs, np.array([False] * 6 + [True]), margin_v, margin_u, n_u, found)
    assert (found[:, 6] == [-1, n_u]).all()  # behind the source
    met = 0
    for v, part in np.ndindex(n_v, 6):
        low, high = found[v, part]
        inner = shadow_reference.reach(us[part], vs[part], v - margin_v, v + margin_v)
        # rows are rounded outwards: up to one more below the lowest corner
        outer = shadow_reference.reach(us[part], vs[part], v - margin_v, v + margin_v + 1)
        if outer is None:
            assert low > high
        if inner is not None:
            met += 1
            assert low <= np.floor(inner[0] + 1e-6) - margin_u or low == -1
            assert high >= np.ceil(inner[1] - 1e-6) + margin_u or high == n_u
        if outer is not None and low <= high:
            assert low >= max(np.floor(outer[0] - 1e-6) - margin_u, -1)
            assert high <= min(np.ceil(outer[1] + 1e-6) + margin_u, n_u)
    assert 20 < met < 60


def test_line_integrals_are_the_logarithm_of_the_signal(threads):
    rng, dark, floor = np.random.default_rng(3), 100.0, 0.5
    counts = rng.integers(90, 4000, SHAPE).astype(np.uint16)
    open_field = rng.uniform(3000, 60000, SHAPE[1:]).astype(np.float32)
    open_field[2, 3], open_field[4, 1] = np.nan, 50
    usable = np.isfinite(open_field) & (open_field - dark > floor)
    log_open = np.log(np.where(usable, open_field - np.float32(dark), floor)).astype(np.float32)
    signal = np.arange(65536) - dark
    table = np.log(np.maximum(signal, floor)).astype(np.float32)
    p, clamped = np.empty(SHAPE, np.float32), np.empty(SHAPE, bool)
    log_cpu.look_up(counts, table, signal <= floor, log_open, ~usable, p, clamped)
    expected, where = log_reference.line_integrals(counts, open_field, dark, floor)
    assert np.array_equal(clamped, where) and 0 < where.sum() < where.size
    # two logarithms of up to 12 rounded to float32, the open signal before them, and their difference
    np.testing.assert_allclose(p, expected, rtol=0, atol=4 * 12 * U)
    real = counts + rng.random(SHAPE).astype(np.float32)
    real[0, 0, :3] = np.nan, np.inf, -np.inf
    log_cpu.take_log(real, np.float32(dark), np.float32(floor), log_open, ~usable, p, clamped)
    expected, where = log_reference.line_integrals(real, open_field, dark, floor)
    assert np.array_equal(clamped, where) and where[0, 0, :3].all()
    # as above, and the signal is rounded as well
    np.testing.assert_allclose(p, expected, rtol=0, atol=5 * 12 * U)


def tv_fields():
    """Return b [y, x, z] and three dual fields that are 0 past the last voxel, as the transpose asks for."""
    fields = normal(3, 3, *SHAPE, seed=4)
    fields[:, 0, -1], fields[:, 1, :, -1], fields[:, 2, :, :, -1] = 0, 0, 0
    return normal(*SHAPE), *fields


@pytest.mark.parametrize("positivity", [False, True])
def test_tv_volumes_and_sums_are_those_of_the_definition(threads, positivity):
    x, field, *_ = tv_fields()
    out, support = np.empty_like(x), np.random.default_rng(5).random(SHAPE) < 0.8
    # a dozen roundings of sums of seven terms, each up to 4
    bound = {"rtol": 0, "atol": 12 * 4 * U}
    tv_cpu.primal(x, field, np.float32(0.3), RATIOS, support, positivity, out)
    np.testing.assert_allclose(
        out, tv_reference.primal(x, field, np.float32(0.3), RATIOS, support, positivity), **bound
    )
    tv_cpu.transposed(field, RATIOS, out)
    np.testing.assert_allclose(out, tv_reference.transposed(field, RATIOS), **bound)
    sums = np.empty(SHAPE[0])
    tv_cpu.sum_slopes(x, RATIOS, sums)
    expected = np.sqrt((tv_reference.slopes(x, RATIOS) ** 2).sum(0)).sum((1, 2))
    np.testing.assert_allclose(sums, expected, rtol=4 * U)  # differences are float32, their sums are not


@pytest.mark.parametrize("same", ["", "ahead", "dual"])
def test_a_step_of_the_dual_field_is_that_of_the_definition(threads, same):
    """The field that is stepped from may be one of those written."""
    x, start, dual, ahead = tv_fields()
    start = {"ahead": ahead, "dual": dual}.get(same, start)
    expected = tv_reference.ascend(x, start, dual, 0.25, 0.4, RATIOS)
    tv_cpu.ascend(x, start, ahead, dual, np.float32(0.25), np.float32(0.4), RATIOS)
    for found, wanted in zip((ahead, dual), expected, strict=True):
        # 0.4 is rounded; values up to 4 and about ten roundings
        np.testing.assert_allclose(found, wanted, rtol=0, atol=12 * 4 * U)


@pytest.mark.parametrize("delta", [0.7, np.inf])
def test_slopes_are_normalised_by_the_smoothed_root(threads, delta):
    x, field = normal(*SHAPE), np.empty((3, *SHAPE), np.float32)
    tv_cpu.normalised_slopes(x, RATIOS, np.float32(1 / delta), np.float32(1e-3), field)
    expected = tv_reference.normalised_slopes(x, RATIOS, delta, 1e-3)
    # values are at most 1; a difference, a product, three for the exponent z, whose error exp multiplies by z, where
    # z·exp(−z) is at most 1/e, and some ten for the root and the quotient
    np.testing.assert_allclose(field, expected, rtol=0, atol=20 * U)


def test_smoothed_slopes_are_those_of_the_reference_and_their_roots(threads):
    x, field, sums = normal(*SHAPE), np.empty((3, *SHAPE), np.float32), np.empty(SHAPE[0])
    tv_cpu.smoothed_slopes(x, RATIOS, 1e-3, field, sums)
    np.testing.assert_allclose(field, tv_reference.normalised_slopes(x, RATIOS, np.inf, 1e-3), rtol=0, atol=20 * U)
    roots = np.sqrt((tv_reference.slopes(x, RATIOS) ** 2).sum(0) + 1e-6)
    np.testing.assert_allclose(sums, roots.sum((1, 2)), rtol=10 * U)


def test_carving_marks_the_pixel_that_a_voxel_falls_on(threads):
    geometry = Geometry(
        dso=60.0, dsd=110.0, n_voxel=SHAPE, d_voxel=(2.0, 1.5, 1.2), n_detector=(4, 6), d_detector=(2.1, 2.3),
        n_views=5, off_detector=(1.3, -2.2), off_origin=(0.4, -0.3, 0.2), start_deg=11.0,
    )  # fmt: skip
    poses, (z, y, x) = geometry.pose_array(), geometry.voxel_centres()
    blocked = np.random.default_rng(6).random(geometry.shape) < 0.8
    state = np.zeros(SHAPE, np.int8)
    carve_cpu.carve(poses, blocked, z, y, x, state)
    assert np.array_equal(state, carve_reference.carve(poses, blocked, z, y, x))
    assert {*np.unique(state)} == {-1, 0, 1}
    again = np.where(np.random.default_rng(7).random(SHAPE) < 0.5, 5, 0).astype(np.int8)  # half of them done
    expected = np.where(again == 0, state, again)
    carve_cpu.carve(poses, blocked, z, y, x, again)
    assert np.array_equal(again, expected)
    # as far behind the first view's source as the middle lies before it: its pixels say nothing there
    behind = y + 2 * poses[0, 1], x + 2 * poses[0, 0]
    state[:] = 0
    carve_cpu.carve(poses[:1], blocked, z, *behind, state)
    assert not state.any() and not carve_reference.carve(poses[:1], blocked[:1], z, *behind).any()


def test_the_excess_is_that_of_the_three_materials(threads):
    lengths = np.random.default_rng(7).uniform(0, 40, (3, 77)).astype(np.float32)
    lengths[:, ::5], lengths[1:, 1::5] = 0, 0
    lengths[:, 2] = 4000  # behind which exp(−depth) is 0 in float64
    mu = np.random.default_rng(8).uniform(0.02, 0.4, (3, 11))
    weights = np.full(11, 1 / 11)
    mono, p = mu @ weights, normal(77)
    before = p.astype(np.float64)
    excess_cpu.add_excess(p, lengths, mu, weights, mono)
    expected = before + excess_reference.excess(lengths, mu, weights, mono)
    # the excess is rounded to float32, and so is its sum with p
    np.testing.assert_allclose(p, expected, rtol=2 * U, atol=2 * 64 * U)
    assert np.array_equal(p[::5], before[::5]) and expected.max() > 1


def test_gaps_are_bridged_along_rows():
    image, trace = normal(7, 11), np.random.default_rng(9).random((7, 11)) < 0.5
    trace[3], trace[5] = True, False
    expected = fill_reference.fill_rows(image, trace)
    fill_cpu.fill_rows(image, trace, np.flatnonzero(trace.any(1)))
    # a share, a difference, a product and a sum in float32 of values up to 4
    np.testing.assert_allclose(image, expected, rtol=0, atol=4 * 8 * U)


def test_weighted_sums_are_those_of_float64(threads):
    a, b, weights = (normal(7, 1001, seed=k) for k in range(3))
    sums = np.empty(7)
    dot_cpu.dot_by_row(a, b, weights, sums)
    # 1001 terms in whatever order, in float64
    bound = 1001 * 2.0**-53 * np.abs(a.astype(float) * b * weights).sum(1).max()
    np.testing.assert_allclose(sums, dot_reference.dot_by_row(a, b, weights), rtol=0, atol=bound)


@pytest.mark.parametrize("positivity", [False, True])
def test_an_update_of_sart_is_that_of_the_definition(threads, positivity):
    x, change, sums = (normal(*SHAPE, seed=k) for k in range(3))
    sums = np.where(sums < 0, 0, sums + np.float32(0.1)).astype(np.float32)
    expected = sart_reference.move(x, change, sums, np.float32(0.7), positivity)
    sart_cpu.move(x, change, sums, np.float32(0.7), positivity)
    # a product, a quotient and a sum
    np.testing.assert_allclose(x, expected, rtol=4 * U, atol=4 * U * np.abs(expected).max())
    assert (x[sums == 0] < 0).any()  # is left alone


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "padding"), [("mirror", "symmetric"), ("zero", "constant")])
def test_ssim_of_slices_is_that_of_the_definition(threads, mode, padding):
    x, y = normal(*SHAPE), normal(*SHAPE, seed=1)
    region = np.random.default_rng(10).random(SHAPE) < 0.6
    region[2] = False
    constants = (1e-4, 9e-4)
    borders = border(SHAPE[1], mode), border(SHAPE[2], mode)
    found = ssim_cpu.slice_sums(x, y, region, window(), borders, constants)
    maps = [ssim_reference.ssim_map(a, b, window(), constants, padding) for a, b in zip(x, y, strict=True)]
    expected = (np.stack(maps) * region).sum((1, 2))
    # float64 throughout; variances are differences of means of squares, some 1, that c2 keeps above 9e-4
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    assert found[2] == 0


def test_a_step_of_adam_is_that_of_the_publication(threads):
    """Pieces of 30 values, the last one shorter."""
    values, gradient, first = (normal(77, 3, seed=k) for k in range(3))
    second = np.random.default_rng(11).uniform(0.5, 2, (77, 3)).astype(np.float32)
    rates = np.array([0.01, 0.1, 0.001], np.float32)
    corrections = np.float32(1 / (1 - 0.9**7)), np.float32(1 / (1 - 0.999**7))
    expected = adam_reference.step(values, gradient, first, second, rates, 7)
    found = [a.reshape(-1).copy() for a in (values, first, second)]
    adam_cpu.step(found[0], gradient.reshape(-1), *found[1:], np.tile(rates, 10), corrections)
    # three roundings of terms up to 4 for the moments; a step is at most 0.1·2·4/√(0.5/0.007) and has ten roundings
    for got, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(got.reshape(77, 3), wanted, rtol=0, atol=4 * 4 * U)


def test_activations_and_their_gradients_are_those_of_the_definition(threads):
    scales, by_scales = 3 * normal(7, 3), normal(7, 3, seed=1)
    densities, by_densities = 5 * normal(7, 2, seed=2), normal(7, 2, seed=3)
    low, span = numbers = np.float32(0.1), np.float32(12)
    found = np.empty_like(scales), np.empty_like(densities)
    adam_cpu.activate(scales, densities, numbers, *found)
    expected = adam_reference.activate(scales, densities, low, span)
    for got, wanted in zip(found, expected, strict=True):
        # exp has an ulp or two, and there are five roundings
        np.testing.assert_allclose(got, wanted, rtol=10 * U)
    given = found[0].copy(), densities, by_scales, by_densities
    adam_cpu.through(given, numbers, *found)
    expected = (
        adam_reference.by_scales(scales, by_scales, low, span),
        adam_reference.by_densities(densities, by_densities),
    )
    # a share has some six roundings, and so has the rest; the gradient is at most 4 times the share
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=12 * 4 * U)
    np.testing.assert_allclose(found[1], expected[1], rtol=10 * U)
