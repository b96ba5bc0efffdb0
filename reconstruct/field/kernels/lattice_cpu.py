"""From a table of features to the lattices of an encoding, on the CPU, and back.

Voxels lie in columns along z, and so do the corners of a level's cubes. Trilinear interpolation is a product of one
along each axis, so it is done once a lattice column along z, here, and once a voxel between four such columns
(`network_cpu`): a corner is looked up once, not once for each of the voxels around it.

`entry` [corner] is the row of the table that a corner has, of all levels, z fastest. A lattice column is an index into
`level` (its level) and `start` (its first corner). Every sum has one thread and one order: results are bitwise equal
for any number of threads. float32.
"""

import numpy as np
from numba import njit, prange

ZERO = np.float32(0)


@njit(parallel=True, cache=True, error_model="numpy")
def spread(table, entry, tasks, used, level, start, along_z, out):
    """Interpolate along z the features of the lattice columns `used`, shared out in `tasks`.

    `table` is [entry, feature], `along_z` a voxel's lower corner and its share of the upper one, both [level, z];
    `out` [lattice column · feature, z or more].
    """
    first, share = along_z
    n_f, n_z = table.shape[1], first.shape[1]
    for task in prange(tasks.size - 1):
        features = np.empty((n_f, first[:, n_z - 1].max() + 2), np.float32)
        for k in range(tasks[task], tasks[task + 1]):
            column = used[k]
            at, of = start[column], level[column]
            for corner in range(start[column + 1] - at):
                for f in range(n_f):
                    features[f, corner] = table[entry[at + corner], f]
            for f in range(n_f):
                row, line = features[f], out[column * n_f + f]
                for z in range(n_z):
                    low = row[first[of, z]]
                    line[z] = low + share[of, z] * (row[first[of, z] + 1] - low)


@njit(parallel=True, cache=True, error_model="numpy")
def collapse(sums, copies, tasks, used, level, start, along_z, out):
    """Take gradients by the lattice columns along z to those by corners: the transpose of `spread`, but for the table.

    `sums` [copy · feature, z or more] holds a lattice column once for each task that adds to it: `copies` has
    the starts [lattice column + 1] of a lattice column's copies, and the copies. `out` [corner, feature].
    """
    first, share = along_z
    starts, numbers = copies
    n_f, n_z = out.shape[1], first.shape[1]
    for task in prange(tasks.size - 1):
        line, corners = np.empty(n_z, np.float32), np.empty(first[:, n_z - 1].max() + 2, np.float32)
        for k in range(tasks[task], tasks[task + 1]):
            column = used[k]
            at, of = start[column], level[column]
            n = start[column + 1] - at
            for f in range(n_f):
                line[:] = ZERO
                for copy in range(starts[column], starts[column + 1]):
                    own = sums[numbers[copy] * n_f + f]
                    for z in range(n_z):
                        line[z] += own[z]
                corners[:n] = ZERO
                for z in range(n_z):
                    upper = share[of, z] * line[z]
                    corners[first[of, z]] += line[z] - upper
                    corners[first[of, z] + 1] += upper
                for corner in range(n):
                    out[at + corner, f] = corners[corner]


@njit(parallel=True, cache=True, error_model="numpy")
def collect(by_corner, starts, corners, tasks, out):
    """Add up what the corners of each entry have: `out` [entry, feature].

    Entry e has the corners `corners[starts[e] : starts[e + 1]]`; a task has the entries from `tasks[k]` to the next.
    """
    n_f = out.shape[1]
    for task in prange(tasks.size - 1):
        for e in range(tasks[task], tasks[task + 1]):
            for f in range(n_f):
                out[e, f] = 0
            for k in range(starts[e], starts[e + 1]):
                for f in range(n_f):
                    out[e, f] += by_corner[corners[k], f]
