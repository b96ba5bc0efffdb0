"""The hash encoding as sparse matrices, against a direct evaluation of every point."""

import itertools

import numpy as np
import pytest
import torch

from ctsim.reconstruct.field.encoding import PRIMES, Encoding, Matrix, resolutions_of
from ctsim.reconstruct.field.kernels import sparse_cpu, sparse_reference

TABLE = 7  # 128 entries: 4 cubes a side have 125 corners and fit, 9 do not


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(3).random((77, 3))


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


def test_every_level_is_the_interpolation_of_its_corners(points):
    encoding = Encoding.of(points, (4, 9), TABLE)
    assert encoding.dense == (True, False)
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
    assert len(table) == encoding.entries
    expected = np.concatenate(
        [
            directly(points, 4, np.stack(list(dense.values())), lambda c: list(dense).index(tuple(c.tolist()))),
            directly(points, 9, hashed, lambda c: slot(c.tolist())),
        ],
        axis=1,
    )
    found = encoding(torch.from_numpy(table)).numpy()
    assert np.allclose(found, expected, atol=2e-7)  # weights are float32, features below 1


def test_the_stored_transpose_is_the_transpose(points):
    encoding = Encoding.of(points, (2, 4, 9), TABLE)
    random = np.random.default_rng(1)
    x, y = random.random((encoding.entries, 3)), random.random((3 * len(points), 3))
    forth, back = np.sum(encoding.matrix.times(x) * y), np.sum(x * encoding.transposed.times(y))
    assert forth == pytest.approx(back, rel=1e-12)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_kernel_is_its_reference(kind):
    random = np.random.default_rng(2)
    starts = np.array([0, 3, 3, 8, 11], np.int64)  # a row is empty
    columns, values = random.integers(0, 5, 11).astype(np.int32), random.random(11).astype(np.float32)
    matrix, table = Matrix.of(starts, columns, values), random.random((5, 7)).astype(kind)
    found, expected = np.empty((4, 7), kind), np.empty((4, 7))
    sparse_cpu.multiply(matrix.parts, starts, columns, values, table, found)
    sparse_reference.multiply(matrix.parts, starts, columns, values, table, expected)
    # at most 5 products below 1 a row
    assert np.allclose(found, expected, atol=8 * np.finfo(kind).eps)


def test_levels_double_up_to_the_finest():
    assert resolutions_of(8, 64, None) == (8, 16, 32, 64)
    assert resolutions_of(8, 100, 3) == (8, 28, 100)
    assert resolutions_of(8, 5, None) == (5,)
