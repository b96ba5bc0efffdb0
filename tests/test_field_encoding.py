"""The field at the voxels of a grid: hash encoding and network, against a direct evaluation of every point."""

import itertools

import msgspec
import numpy as np
import pytest
import torch
from by_threads import one_and_several
from test_field import GEOMETRY, points_of

from ctsim.reconstruct.field.encoding import PRIMES, Encoding, resolutions_of
from ctsim.reconstruct.field.grid import Grid
from ctsim.reconstruct.field.kernels import network_reference
from ctsim.reconstruct.field.network import first_parameters

TABLE = 7  # 128 entries: 4 cubes a side have 125 corners and fit, 9 do not
U = 2.0**-24  # of float32


def grid_of(n_voxel, seed, d_voxel=(1.0, 1.0, 1.0)):
    """Take half of the voxels inside a margin, so that columns have holes and the box is not the grid."""
    chosen = np.zeros(n_voxel, bool)
    inner = tuple(slice(1, n - 2) for n in n_voxel)
    chosen[inner] = np.random.default_rng(seed).random(chosen[inner].shape) < 0.5
    chosen[:, n_voxel[1] // 2, 2:4] = False  # columns without a point
    return Grid.of(msgspec.structs.replace(GEOMETRY, n_voxel=n_voxel, d_voxel=d_voxel, off_origin=(0, 0, 0)), chosen)


def directly(points, resolution, rows, lookup):
    """Interpolate as Müller et al. do, point by point; `lookup` finds the row of a corner."""
    found = np.zeros((len(points), rows.shape[1]))
    for n, point in enumerate(points):
        cube = np.floor(point * resolution).astype(int)
        share = point * resolution - cube
        for step in itertools.product((0, 1), repeat=3):
            weight = np.prod([s if t else 1 - s for s, t in zip(share, step, strict=True)])
            found[n] += weight * rows[lookup(cube + step)]
    return found


def test_the_reference_interpolates_the_corners_of_every_level():
    points = np.random.default_rng(3).random((77, 3))
    rows, weights, entries = network_reference.encode(points, (4, 9), TABLE)
    random = np.random.default_rng(5)
    dense = {c: random.random(2) for c in itertools.product(range(5), repeat=3)}
    hashed = random.random((1 << TABLE, 2))

    def slot(corner):
        return int((corner[0] * PRIMES[0]) ^ (corner[1] * PRIMES[1]) ^ (corner[2] * PRIMES[2])) % (1 << TABLE)

    # the encoding keeps only the rows that some point needs, in the order of their keys
    around = [np.floor(points * r).astype(int) for r in (4, 9)]
    steps = list(itertools.product((0, 1), repeat=3))
    keys = sorted({tuple((c + s).tolist()) for c in around[0] for s in steps})
    slots = sorted({slot((c + s).tolist()) for c in around[1] for s in steps})
    table = np.stack([dense[k] for k in keys] + [hashed[s] for s in slots])
    assert len(table) == entries
    expected = np.concatenate(
        [
            directly(points, 4, np.stack(list(dense.values())), lambda c: list(dense).index(tuple(c.tolist()))),
            directly(points, 9, hashed, lambda c: slot(c.tolist())),
        ],
        axis=1,
    )
    found = (table[rows.numpy()] * weights.numpy()[..., None]).sum(2).reshape(len(points), -1)
    assert np.allclose(found, expected, rtol=1e-12)


CASES = [
    # n_voxel, voxel lengths (z, y, x), resolutions, log2 of the table, features, neurons, outputs
    ((150, 9, 8), (1, 1, 1), (8, 30, 150), 9, 4, 32, 1),  # columns of several blocks
    ((7, 12, 30), (2, 1.5, 1), (3, 8, 30), TABLE, 3, 5, 3),
    ((11, 6, 5), (3, 1, 1), (2,), 19, 1, 1, 2),
    ((5, 40, 6), (1, 1, 1), (8, 15, 25, 40), 19, 2, 16, 8),
    ((5, 5, 60), (1, 5, 0.25), (4, 60), 19, 4, 8, 1),  # twenty cubes a voxel: most corners are beside none
]


@pytest.mark.parametrize("n_voxel, d_voxel, levels, table, features, width, outputs", CASES)
def test_the_field_and_its_gradients_are_those_of_the_reference(
    n_voxel, d_voxel, levels, table, features, width, outputs
):
    """Within rounding: sums of n terms are off by at most n·u times the sum of what they add, in absolute value.

    A network whose parameters, and gradient, are those absolute values has these sums for its values and gradients.
    """
    grid = grid_of(n_voxel, 1, d_voxel)
    encoding = Encoding.of(grid, levels, table)
    rows, weights, entries = network_reference.encode(points_of(grid), levels, table)
    assert encoding.entries == entries and encoding.points == len(grid)
    assert encoding.dense == tuple(network_reference.corners(points_of(grid), r, table)[2] for r in levels)
    given = first_parameters(encoding, features, width, outputs, 7)
    generator = torch.Generator().manual_seed(3)
    given["table"] = torch.randn(given["table"].shape, generator=generator)
    given["b2"] = torch.randn(outputs, generator=generator)
    scale = torch.linspace(0.5, 2, outputs)
    upstream = torch.randn((len(grid), outputs), generator=generator)

    def values_and_gradients(function, kind, change):
        parameters = {name: change(p.to(kind)).requires_grad_() for name, p in given.items()}
        values = function(parameters, scale.to(kind))
        gradients = torch.autograd.grad((values * change(upstream.to(kind))).sum(), list(parameters.values()))
        return [values.detach(), *gradients]

    def reference(parameters, scale):
        return network_reference.evaluate(rows, weights, parameters, scale)

    found = values_and_gradients(encoding, torch.float32, lambda p: p.clone())
    expected = values_and_gradients(reference, torch.float64, lambda p: p.clone())
    sums = values_and_gradients(reference, torch.float64, torch.abs)
    terms = features * len(levels) + width + 20  # of the longest sum of a value, and what a term is a product of
    for number, (one, other, total) in enumerate(zip(found, expected, sums, strict=True)):
        assert one.shape == other.shape
        roundings = terms + len(grid) * (number > 0)  # gradients are sums over points
        assert bool(((one - other).abs() <= roundings * U * 2 * total).all())  # 2: squareplus' slope is ½ at 0, not 1


def test_no_bit_depends_on_the_number_of_threads():
    grid = grid_of((70, 20, 24), 2)
    encoding = Encoding.of(grid, (8, 24, 70), 10)
    one, several = one_and_several(lambda: _passes(encoding, first_parameters(encoding, 4, 32, 2, 1)))
    assert all(torch.equal(a, b) for a, b in zip(one, several, strict=True))


def _passes(encoding, given):
    parameters = {n: p.clone().requires_grad_() for n, p in given.items()}
    values = encoding(parameters, torch.linspace(1, 2, given["b2"].numel()))
    return [values.detach(), *torch.autograd.grad((values * values.detach()).sum(), list(parameters.values()))]


def test_buffers_pass_nothing_on():
    """Between the halves of a pass another may come, and what a buffer held does not matter."""
    encoding = Encoding.of(grid_of((9, 12, 10), 4), (3, 12), TABLE)
    one, other = (first_parameters(encoding, 4, 8, 1, seed) for seed in (1, 2))
    expected = _passes(encoding, one)
    for name in ("copies", "corners"):
        encoding.lattice.buffers[name].fill(np.nan)
    parameters = {n: p.clone().requires_grad_() for n, p in one.items()}
    values = encoding(parameters, torch.ones(1))
    _passes(encoding, other)
    found = torch.autograd.grad((values * values.detach()).sum(), list(parameters.values()))
    assert all(torch.equal(a, b) and bool(a.any()) for a, b in zip(found, expected[1:], strict=True))


@pytest.mark.parametrize("chosen", [(3, 2, 1), (slice(0, 150, 149), 2, 2), (slice(None), 1, 3), (4, slice(None), 2)])
def test_few_points_are_enough(chosen):
    """One voxel, two with a gap of several blocks between, a column, a row: fewer than tasks."""
    inside = np.zeros((150, 7, 5), bool)
    inside[chosen] = True
    grid = Grid.of(msgspec.structs.replace(GEOMETRY, n_voxel=inside.shape), inside)
    encoding = Encoding.of(grid, (2, 7), TABLE)
    rows, weights, _ = network_reference.encode(points_of(grid), (2, 7), TABLE)
    given = first_parameters(encoding, 2, 3, 1, 0)
    given["table"] *= 1e4
    expected = network_reference.evaluate(rows, weights, {n: p.double() for n, p in given.items()}, torch.ones(1))
    found, *gradients = _passes(encoding, given)
    assert torch.allclose(found.double(), expected, rtol=1e-6) and all(g.isfinite().all() for g in gradients)


def test_what_is_no_number_is_seen():
    encoding = Encoding.of(grid_of((9, 12, 10), 4), (3, 12), TABLE)
    given = first_parameters(encoding, 4, 8, 1, 1)
    given["table"][0] = np.nan
    assert _passes(encoding, given)[0].isnan().any()


@pytest.mark.parametrize("name", ["table", "w1", "b1", "w2", "b2", "scale"])
def test_shapes_and_types_are_checked_before_a_kernel_sees_them(name):
    encoding = Encoding.of(grid_of((9, 12, 10), 4), (3, 12), TABLE)
    given = first_parameters(encoding, 4, 8, 2, 1) | {"scale": torch.ones(2)}
    for wrong in (given[name][1:], given[name].double()):
        changed = given | {name: wrong}
        with pytest.raises(ValueError, match=r" must be float32 \("):
            encoding(changed, changed["scale"])


def test_levels_double_up_to_the_finest():
    assert resolutions_of(8, 64, None) == (8, 16, 32, 64)
    assert resolutions_of(8, 100, 3) == (8, 28, 100)
    assert resolutions_of(8, 5, None) == (5,)
