"""The multiresolution hash encoding of points that do not move.

Müller, Evans, Schied and Keller, ACM Trans. Graph. 41, 2022, doi:10.1145/3528223.3530127. A level is a lattice of
cubes; the features of a point are those of the corners of its cube, interpolated trilinearly, level after level. A
level whose corners fit into its table has an entry for each ("dense"), any other finds them by the paper's hash.
As the points stay, all levels together are one sparse matrix, and its transpose, which is stored, too, takes
gradients back: no entry is looked up twice, and no two threads add to one place.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.reconstruct.field.kernels import sparse_cpu

PRIMES = (1, 2654435761, 805459861)  # Müller et al., section 3
PARTS = 64  # that the rows of a matrix are shared out in
CORNERS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Matrix:
    """A sparse matrix in compressed rows: the arguments of `sparse_cpu.multiply`, and its number of rows."""

    parts: NDArray[np.int64]
    starts: NDArray[np.int64]
    columns: NDArray[np.int32]
    values: NDArray[np.float32]

    @classmethod
    def of(cls, starts: NDArray[np.int64], columns: NDArray[np.int32], values: NDArray[np.float32]) -> "Matrix":
        """Share the rows out so that each part has as many entries."""
        wanted = np.linspace(0, starts[-1], min(PARTS, max(starts.size - 1, 1)) + 1)
        parts = np.searchsorted(starts, wanted).astype(np.int64)
        parts[-1] = starts.size - 1
        return cls(parts=np.unique(parts), starts=starts, columns=columns, values=values)

    def times(self, table: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the product with a table [column, feature]: [row, feature]."""
        out = np.zeros((self.starts.size - 1, table.shape[1]), table.dtype)
        sparse_cpu.multiply(self.parts, self.starts, self.columns, self.values, np.ascontiguousarray(table), out)
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """The features of n points: row n·L + l of `matrix` is level l of point n, its columns the rows of the table.

    `entries` is the number of rows of the table: only those that some point needs. `resolutions` are the numbers of
    cubes along the longest axis, and `dense` says which levels need no hash.
    """

    matrix: Matrix
    transposed: Matrix
    entries: int
    resolutions: tuple[int, ...]
    dense: tuple[bool, ...]

    @classmethod
    def of(cls, points: NDArray[np.float64], resolutions: tuple[int, ...], table: int) -> "Encoding":
        """Encode points [n, 3], within 0 … 1 along the longest axis, in tables of at most 2^`table` entries a level."""
        n, n_levels = len(points), len(resolutions)
        columns, values = np.empty((n, n_levels, CORNERS), np.int32), np.empty((n, n_levels, CORNERS), np.float32)
        rows, weights = np.empty((n_levels, n * CORNERS), np.int32), np.empty((n_levels, n * CORNERS), np.float32)
        entries, dense, counts = 0, [], []
        for level, resolution in enumerate(resolutions):  # one at a time, as sorting all would take more memory
            at, values[:, level], fits = corners(points, resolution, table)
            used, at = np.unique(at, return_inverse=True)
            order = np.argsort(at.reshape(-1), kind="stable")
            rows[level] = order // CORNERS * n_levels + level
            weights[level] = values[:, level].reshape(-1)[order]
            counts.append(np.bincount(at.reshape(-1), minlength=used.size))
            columns[:, level] = at.reshape(n, CORNERS) + entries
            entries += used.size
            dense.append(fits)
        starts = np.arange(0, columns.size + 1, CORNERS, dtype=np.int64)
        ends = np.append(0, np.cumsum(np.concatenate(counts))).astype(np.int64)
        return cls(
            matrix=Matrix.of(starts, columns.reshape(-1), values.reshape(-1)),
            transposed=Matrix.of(ends, rows.reshape(-1), weights.reshape(-1)),
            entries=entries,
            resolutions=resolutions,
            dense=tuple(dense),
        )

    def __call__(self, table: torch.Tensor) -> torch.Tensor:
        """Return the features of all points, [point, level · feature], for a table [entry, feature]."""
        return _Gather.apply(table, self)  # pyright: ignore[reportReturnType]


def resolutions_of(coarsest: int, finest: int, levels: int | None) -> tuple[int, ...]:
    """Return the cubes of each level along the longest axis, a geometric series; None: each about twice the last."""
    finest = max(finest, 2)
    coarsest = min(coarsest, finest)
    n = levels or 1 + max(round(math.log2(finest / coarsest)), 0)
    return tuple(int(r) for r in np.geomspace(coarsest, finest, n).round()) if n > 1 else (finest,)


def corners(
    points: NDArray[np.float64], resolution: int, table: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
    """Return the entries [n, 8] of the corners around each point, their weights [n, 8], and whether all fit the table.

    Corner c lies c & 1 cubes further along axis 0, c >> 1 & 1 along axis 1 and c >> 2 along axis 2.
    """
    scaled = points * resolution
    first = np.clip(np.floor(scaled), 0, resolution - 1).astype(np.int64)
    share = scaled - first
    sizes = np.max(first, axis=0, initial=0) + 2
    fits = int(np.prod(sizes)) <= 1 << table
    at, weights = np.empty((len(points), CORNERS), np.int64), np.empty((len(points), CORNERS))
    for c in range(CORNERS):
        step = np.array([c & 1, c >> 1 & 1, c >> 2])
        i, j, k = (first + step).T
        if fits:
            at[:, c] = (i * sizes[1] + j) * sizes[2] + k
        else:
            at[:, c] = (i * PRIMES[0] ^ j * PRIMES[1] ^ k * PRIMES[2]) % (1 << table)
        weights[:, c] = np.prod(np.where(step, share, 1 - share), 1)
    return at, weights, fits


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: torch.Tensor, encoding: Encoding) -> torch.Tensor:
        ctx.encoding = encoding
        features = encoding.matrix.times(table.detach().numpy())
        return torch.from_numpy(features.reshape(-1, len(encoding.resolutions) * table.shape[1]))

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        (gradient,), levels = gradients, len(ctx.encoding.resolutions)
        by_rows = gradient.detach().numpy().reshape(-1, gradient.shape[1] // levels)
        return torch.from_numpy(ctx.encoding.transposed.times(by_rows)), None
