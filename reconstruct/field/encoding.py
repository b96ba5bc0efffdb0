"""A field μ(x) = s · squareplus(w2ᵀ · relu(w1ᵀ · h(x) + b1) + b2) at the voxels of a grid, h being a hash encoding.

Müller, Evans, Schied and Keller, ACM Trans. Graph. 41, 2022, doi:10.1145/3528223.3530127. A level is a lattice of
cubes; the features of a point are those of the corners of its cube, interpolated trilinearly, level after level. A
level whose corners fit into its table has an entry for each ("dense"), any other finds them by the paper's hash.
The points are voxels and do not move. So every corner is looked up once, interpolation is a product along each axis,
and the corners of each entry are listed, which takes gradients back without two threads that add to one place.
squareplus(z) = (z + √(z² + 4))/2 is 1 at 0 (Barron, arXiv:2112.11687, with b = 4).
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.field.grid import Grid
from ctsim.reconstruct.field.kernels import lattice_cpu, network_cpu

PRIMES = (1, 2654435761, 805459861)  # Müller et al., section 3
TASKS = 16  # that the points are shared out in; each has gradients of its own
ENTRIES, COLUMNS = 4096, 64  # entries and lattice columns in a task of those
NAMES = ("table", "w1", "b1", "w2", "b2")
Ints, Floats = NDArray[np.int32], NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """The lattice of one level about the points.

    Along an axis it has the corners beside some voxel alone. `lower` is the number of the lower corner of each voxel
    along y, x and z, the upper one is the next, and `share` is the share of that. `used` says which corners [y, x, z]
    some point needs, and `rows` which of the level's rows in the table each of these has.
    """

    lower: tuple[Ints, ...]
    share: tuple[Floats, ...]
    used: NDArray[np.bool_]
    rows: NDArray[np.int64]
    n_rows: int
    dense: bool

    @classmethod
    def of(cls, grid: Grid, resolution: int, table: int) -> "Level":
        """Lay `resolution` cubes along the longest axis, with at most 2^`table` entries."""
        reached, lower, share = [], [], []
        for at in grid.axes():
            scaled = at * resolution
            first = np.clip(np.floor(scaled), 0, resolution - 1).astype(np.int64)
            reached.append(np.union1d(first, first + 1))
            lower.append(np.searchsorted(reached[-1], first).astype(np.int32))
            share.append((scaled - first).astype(np.float32))
        used = _around(grid.inside(), lower)
        dense = math.prod(int(corners[-1]) + 1 for corners in reached) <= 1 << table
        if dense:
            rows = np.arange(np.count_nonzero(used))
        else:
            at = (corners[k] for corners, k in zip(reached, np.nonzero(used), strict=True))
            y, x, z = (corner * prime for corner, prime in zip(at, PRIMES, strict=True))
            slots = (y ^ x ^ z) % (1 << table)
            taken = np.zeros(1 << table, bool)
            taken[slots] = True
            rows = (np.cumsum(taken) - 1)[slots]
        n_rows = int(rows.max()) + 1
        return cls(lower=tuple(lower), share=tuple(share), used=used, rows=rows, n_rows=n_rows, dense=dense)


def _around(inside: NDArray[np.bool_], lower: list[Ints]) -> NDArray[np.bool_]:
    """Return the corners around the voxels `inside`, both [y, x, z]."""
    for axis, corners in enumerate(lower):
        moved = np.moveaxis(inside, axis, 0)
        found = np.zeros((int(corners[-1]) + 2, *moved.shape[1:]), bool)
        for voxels, corner in zip(moved, corners, strict=True):
            found[corner] |= voxels
            found[corner + 1] |= voxels
        inside = np.moveaxis(found, 0, axis)
    return np.ascontiguousarray(inside)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """The lattices of all levels as `lattice_cpu` and `network_cpu` know them, and buffers that each step fills.

    Columns of corners: `used` are those that some point needs, `column_tasks` share them out, `level` and `start` are
    the level and the first corner of each column, `along_z` says between which of its corners a voxel lies. `entry` is
    each corner's row of the table, `corners` lists the corners of each row, and `entry_tasks` share the rows out.
    Columns of voxels: `columns`, `between` and `tasks` are those of `network_cpu`. A task adds to copies of the
    columns of corners that it reaches: `behind` says where they are, `copies` which ones each column has.
    """

    entry: Ints
    corners: tuple[NDArray[np.int64], Ints]
    entry_tasks: NDArray[np.int64]
    used: NDArray[np.int64]
    column_tasks: NDArray[np.int64]
    level: NDArray[np.int64]
    start: NDArray[np.int64]
    along_z: tuple[Ints, Floats]
    between: tuple[Any, ...]
    columns: tuple[NDArray[np.int64], NDArray[np.int64], Ints]
    tasks: NDArray[np.int64]
    behind: NDArray[np.int64]
    copies: tuple[NDArray[np.int64], NDArray[np.int64]]
    buffers: dict[str, Floats] = field(default_factory=dict)
    owner: list[object] = field(default_factory=list)

    @classmethod
    def of(cls, grid: Grid, levels: list[Level]) -> "Lattice":
        """Lay the columns of all levels one after another, z fastest."""
        n_y, n_x, n_z = (np.array(n) for n in zip(*(level.used.shape for level in levels), strict=True))
        n_columns = n_y * n_x
        base, offsets = _starts(n_columns)[:-1], _starts([level.n_rows for level in levels])
        entry = np.concatenate([_rows(level, first) for level, first in zip(levels, offsets[:-1], strict=True)])
        order = np.argsort(entry, kind="stable").astype(np.int32)
        unused = np.count_nonzero(entry < 0)
        corners = (_starts(np.bincount(entry[order[unused:]], minlength=offsets[-1])), order[unused:])
        of_column = np.repeat(np.arange(len(levels)), n_columns)
        (low_y, low_x, low_z), (of_y, of_x, of_z) = (
            [np.stack([getattr(level, name)[axis] for level in levels]) for axis in range(3)]
            for name in ("lower", "share")
        )
        used = np.flatnonzero(np.concatenate([level.used.any(2).reshape(-1) for level in levels]))
        columns = _columns(grid)
        tasks = np.searchsorted(columns[1], np.linspace(0, len(grid), TASKS + 1).round())
        tasks = np.unique(tasks)
        behind, copies = _copies(tasks, columns[0], low_y, base, n_x)
        return cls(
            entry=np.maximum(entry, 0),  # what lies around no point has any row, as it is nowhere read
            corners=corners,
            entry_tasks=np.append(np.arange(0, offsets[-1], ENTRIES), offsets[-1]),
            used=used,
            column_tasks=np.append(np.arange(0, used.size, COLUMNS), used.size),
            level=of_column,
            start=_starts(n_z[of_column]),
            along_z=(low_z, of_z),
            between=(base, n_x, low_y, of_y, low_x, of_x),
            columns=columns,
            tasks=tasks,
            behind=behind,
            copies=copies,
        )

    def buffer(self, name: str, rows: int, length: int) -> Floats:
        """Return an array that is kept from step to step, zero at first."""
        if name not in self.buffers or self.buffers[name].shape != (rows, length):
            self.buffers[name] = np.zeros((rows, length), np.float32)
        return self.buffers[name]

    def spread(self, table: Floats, owner: object) -> Floats:
        """Return a table's features in the lattice columns at each z, [lattice column · feature, z + WIDTH].

        They stay until another owner asks. A pass is one: its backward half may find that another has come between.
        """
        if self.owner and self.owner[0] is owner:
            return self.buffers["lattice"]
        self.owner[:] = [owner]
        n_f, length = table.shape[1], self.along_z[0].shape[1] + WIDTH
        out = self.buffer("lattice", self.level.size * n_f, length)
        lattice_cpu.spread(table, self.entry, self.column_tasks, self.used, self.level, self.start, self.along_z, out)
        return out

    def collect(self, by_lattice: Floats, n_f: int) -> Floats:
        """Return the gradients by a table from those by the lattice columns of each task."""
        by_corner = self.buffer("corners", self.entry.size, n_f)
        lattice_cpu.collapse(
            by_lattice, self.copies, self.column_tasks, self.used, self.level, self.start, self.along_z, by_corner
        )
        out = np.empty((self.corners[0].size - 1, n_f), np.float32)
        lattice_cpu.collect(by_corner, *self.corners, self.entry_tasks, out)
        return out


def _starts(counts: Any) -> NDArray[np.int64]:
    return np.append(0, np.cumsum(counts)).astype(np.int64)


def _rows(level: Level, first: int) -> Ints:
    """Return the row of each corner of a level, −1 where no point needs it."""
    rows = np.full(level.used.size, -1, np.int32)
    rows[level.used.reshape(-1)] = level.rows + first
    return rows


def _columns(grid: Grid) -> tuple[NDArray[np.int64], NDArray[np.int64], Ints]:
    """Return y and x of each voxel column that has a point, its first point, and z of each point."""
    n_z, n_y, n_x = grid.geometry.n_voxel
    y, x, z = np.unravel_index(grid.index, (n_y, n_x, n_z))
    at, first = np.unique(y * n_x + x, return_index=True)
    return np.stack([at // n_x, at % n_x], 1), np.append(first, len(grid)), z.astype(np.int32)


def _copies(
    tasks: NDArray[np.int64], yx: NDArray[np.int64], low_y: Ints, base: NDArray[np.int64], width: NDArray[np.int64]
) -> tuple[NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Give each task a copy of the rows of lattice columns that its voxels lie between, level after level.

    Returns by how much copies lie behind their originals [task + 1, level + 1], and in the last place where the task's
    begin; and for each lattice column the starts of its copies, and the copies.
    """
    n_levels, originals = base.size, []
    behind, n = np.zeros((tasks.size, n_levels + 1), np.int64), 0
    for task in range(tasks.size - 1):
        behind[task, -1] = n
        first_y, last_y = yx[tasks[task], 0], yx[tasks[task + 1] - 1, 0]
        for level in range(n_levels):
            rows = low_y[level, first_y], low_y[level, last_y] + 2
            first, end = (base[level] + row * width[level] for row in rows)
            behind[task, level] = n - first
            originals.append(np.arange(first, end))
            n += end - first
    behind[-1, -1] = n
    original = np.concatenate(originals)
    counts = np.bincount(original, minlength=int(base[-1] + width[-1] * (low_y[-1, -1] + 2)))
    return behind, (_starts(counts), np.argsort(original, kind="stable"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """The features of the points of a grid.

    `entries` is the number of rows of the table: only those that some point needs. `resolutions` are the numbers of
    cubes along the longest axis, and `dense` says which levels need no hash.
    """

    lattice: Lattice
    points: int
    entries: int
    resolutions: tuple[int, ...]
    dense: tuple[bool, ...]

    @classmethod
    def of(cls, grid: Grid, resolutions: tuple[int, ...], table: int) -> "Encoding":
        """Encode the points of a grid in tables of at most 2^`table` entries a level."""
        levels = [Level.of(grid, resolution, table) for resolution in resolutions]
        return cls(
            lattice=Lattice.of(grid, levels),
            points=len(grid),
            entries=sum(level.n_rows for level in levels),
            resolutions=resolutions,
            dense=tuple(level.dense for level in levels),
        )

    def __call__(self, parameters: dict[str, torch.Tensor], scale: torch.Tensor) -> torch.Tensor:
        """Return scale · squareplus(w2ᵀ · relu(w1ᵀ · h + b1) + b2) at all points, [point, output].

        All is float32: table [entry, feature], w1 [input, neuron], b1 [neuron], w2 [neuron, output], b2 [output],
        scale [output]. Raises ValueError for anything else, as kernels check nothing.
        """
        given = [parameters[name] for name in NAMES]
        table, w1, _, w2, _ = given
        n_i, n_j, n_o = table.shape[1] * len(self.resolutions), w1.shape[1], w2.shape[1]
        expected = ((self.entries, table.shape[1]), (n_i, n_j), (n_j,), (n_j, n_o), (n_o,), (n_o,))
        for name, tensor, shape in zip((*NAMES, "scale"), (*given, scale), expected, strict=True):
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
                raise ValueError(f"{name} must be float32 {shape}, got {tensor.dtype} {tuple(tensor.shape)}")
        return _Evaluate.apply(*given, scale, self)  # pyright: ignore[reportReturnType]


def resolutions_of(coarsest: int, finest: int, levels: int | None) -> tuple[int, ...]:
    """Return the cubes of each level along the longest axis, a geometric series; None: each about twice the last."""
    finest = max(finest, 2)
    coarsest = min(coarsest, finest)
    n = levels or 1 + max(round(math.log2(finest / coarsest)), 0)
    return tuple(int(r) for r in np.geomspace(coarsest, finest, n).round()) if n > 1 else (finest,)


def _filled(weights: torch.Tensor, rows: bool, columns: bool) -> Floats:
    """Return weights with zeros up to multiples of 4."""
    missing = [-n % network_cpu.MULTIPLE * fill for n, fill in zip(weights.shape, (rows, columns), strict=True)]
    return np.pad(np.ascontiguousarray(weights.detach().numpy()), [(0, n) for n in missing])


class _Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table, w1, b1, w2, b2, scale, encoding) -> torch.Tensor:
        ctx.save_for_backward(table)
        ctx.lattice, ctx.owner, ctx.sizes = encoding.lattice, object(), w1.shape
        ctx.network = (
            _filled(w1, True, True), _filled(b1[None], False, True), _filled(w2, True, False),
            b2[None].detach().numpy().copy(), scale.numpy().copy(),
        )  # fmt: skip
        values = ctx.lattice.spread(np.ascontiguousarray(table.detach().numpy()), ctx.owner)
        out = np.empty((encoding.points, w2.shape[1]), np.float32)
        shared = (ctx.lattice.tasks, ctx.lattice.columns, values, table.shape[1], ctx.lattice.between, ctx.network)
        network_cpu.forward(*shared, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (table,), lattice, (n_i, n_j) = ctx.saved_tensors, ctx.lattice, ctx.sizes
        values, n_f = lattice.spread(np.ascontiguousarray(table.detach().numpy()), ctx.owner), table.shape[1]
        sums = lattice.buffer("copies", lattice.behind[-1, -1] * n_f, values.shape[1])
        gradient = np.ascontiguousarray(gradients[0].numpy())
        shared = (lattice.tasks, lattice.columns, values, n_f, lattice.between, ctx.network)
        by_w1, by_b1, by_w2, by_b2 = network_cpu.backward(*shared, gradient, lattice.behind, sums)
        found = (lattice.collect(sums, n_f), by_w1[:n_i, :n_j], by_b1[:n_j], by_w2[:n_j], by_b2)
        return *(torch.from_numpy(np.ascontiguousarray(g)) for g in found), None, None
