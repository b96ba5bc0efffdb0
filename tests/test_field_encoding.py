"""The field at the voxels of a grid: hash encoding and network, against a direct evaluation of every point."""

import itertools

import msgspec
import numba
import numpy as np
import pytest
import torch
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
    terms = len(grid) + features * len(levels) + width + 20  # of the longest sum, and what a term is a product of
    for one, other, total in zip(found, expected, sums, strict=True):
        assert one.shape == other.shape
        assert bool(((one - other).abs() <= terms * U * 2 * total).all())  # 2: squareplus' slope is ½ at 0, not 1


def test_no_bit_depends_on_the_number_of_threads():
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("one core")
    grid = grid_of((70, 20, 24), 2)
    encoding = Encoding.of(grid, (8, 24, 70), 10)
    before, results = numba.get_num_threads(), []
    for threads in (1, 2):
        numba.set_num_threads(threads)
        parameters = {n: p.requires_grad_() for n, p in first_parameters(encoding, 4, 32, 2, 1).items()}
        values = encoding(parameters, torch.tensor([1.0, 2.0]))
        gradients = torch.autograd.grad((values * values.detach()).sum(), list(parameters.values()))
        results.append([values.detach(), *gradients])
    numba.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_a_second_pass_has_the_gradients_of_the_first():
    """Buffers are kept from step to step."""
    grid = grid_of((9, 12, 10), 4)
    encoding = Encoding.of(grid, (3, 12), TABLE)
    parameters = {n: p.requires_grad_() for n, p in first_parameters(encoding, 4, 8, 1, 1).items()}
    passes = []
    for _ in range(2):
        values = encoding(parameters, torch.ones(1))
        passes.append(torch.autograd.grad((values**2).sum(), list(parameters.values())))
    assert all(torch.equal(a, b) and bool(a.any()) for a, b in zip(*passes, strict=True))


def test_levels_double_up_to_the_finest():
    assert resolutions_of(8, 64, None) == (8, 16, 32, 64)
    assert resolutions_of(8, 100, 3) == (8, 28, 100)
    assert resolutions_of(8, 5, None) == (5,)
