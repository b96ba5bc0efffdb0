"""The network of a field at all points, and its gradients, on the CPU.

A block of up to 64 points of a voxel column is worked on at a time, so that features and neurons stay in the cache;
the backward pass works them out again. Products with the weights keep eight sums in registers. A task has a run of
voxel columns, and sums of its own: results are bitwise equal for any number of threads. float32.

A column of voxels stands between four lattice columns of each level (`lattice_cpu`); `between` has, for each level,
the first lattice column and how many stand in a row, and for y and for x the lower corner and the share of the upper
one of each voxel, [level, y] and [level, x]. `columns` has y and x of each voxel column [column, 2], its first point
[column + 1], and z of each point. Task k has the voxel columns from `tasks[k]` to the next. Nothing is checked here:
inputs and neurons are filled up with zeros to multiples of `MULTIPLE`.
"""

import numpy as np
from numba import njit, prange

from ctsim.kernels.lanes import WIDTH, add, div, fma, load, mul, pick, positive, spread, sqrt, store, where_positive
from ctsim.kernels.once import compiled_once

BLOCK = 8 * WIDTH  # a multiple of 4 · WIDTH, which `_sums` takes at a time
MULTIPLE = 4  # of inputs and neurons, as their products take so many at a time
ZERO, HALF, ONE, FOUR = np.float32(0), np.float32(0.5), np.float32(1), np.float32(4)
_MATRIX = "float32[:,::1]"
_COLUMNS = "Tuple((int64[:,::1], int64[::1], int32[::1]))"
_BETWEEN = "Tuple((int64[::1], int64[::1], int32[:,::1], float32[:,::1], int32[:,::1], float32[:,::1]))"
_NETWORK = "Tuple((float32[:,::1], float32[:,::1], float32[:,::1], float32[:,::1], float32[::1]))"


@njit(cache=True, error_model="numpy")
def _weights(s, t):
    both = s * t
    return ONE - s - t + both, t - both, s - both, both


@njit(cache=True, error_model="numpy")
def _blend(lattice, between, at, out):
    """Write the features of a block, `out` [input, point]; `at` is (y, x, z, points, features a level)."""
    base, width, first_y, share_y, first_x, share_x = between
    y, x, z, n, n_f = at
    for level in range(base.size):
        column = base[level] + first_y[level, y] * width[level] + first_x[level, x]
        a, b, c, d = _weights(share_y[level, y], share_x[level, x])
        va, vb, vc, vd = spread(a), spread(b), spread(c), spread(d)
        for f in range(n_f):
            low, high = column * n_f + f, (column + width[level]) * n_f + f
            for i in range(0, n, WIDTH):
                value = mul(va, load(lattice, low, z + i))
                value = fma(vb, load(lattice, low + n_f, z + i), value)
                value = fma(vc, load(lattice, high, z + i), value)
                store(out, level * n_f + f, i, fma(vd, load(lattice, high + n_f, z + i), value))


@njit(cache=True, error_model="numpy")
def _blend_back(gradient, between, at, behind, sums):
    """Add the gradients by a block's features, [input, point], to those by lattice columns.

    `behind[level]` is by how much a task's own columns in `sums` lie behind those of the lattices.
    """
    base, width, first_y, share_y, first_x, share_x = between
    y, x, z, n, n_f = at
    for level in range(base.size):
        column = behind[level] + base[level] + first_y[level, y] * width[level] + first_x[level, x]
        a, b, c, d = _weights(share_y[level, y], share_x[level, x])
        va, vb, vc, vd = spread(a), spread(b), spread(c), spread(d)
        for f in range(n_f):
            low, high = column * n_f + f, (column + width[level]) * n_f + f
            for i in range(0, n, WIDTH):
                g = load(gradient, level * n_f + f, i)
                store(sums, low, z + i, fma(va, g, load(sums, low, z + i)))
                store(sums, low + n_f, z + i, fma(vb, g, load(sums, low + n_f, z + i)))
                store(sums, high, z + i, fma(vc, g, load(sums, high, z + i)))
                store(sums, high + n_f, z + i, fma(vd, g, load(sums, high + n_f, z + i)))


@njit(cache=True, error_model="numpy")
def _neurons(w, b, inputs, n, out):
    """Write relu(wᵀ · inputs + b), `out` [neuron, point]; w [input, neuron], b [1, neuron]."""
    for j in range(0, w.shape[1], 4):
        for i in range(0, n, 2 * WIDTH):
            p0, p1, p2, p3 = pick(b, 0, j), pick(b, 0, j + 1), pick(b, 0, j + 2), pick(b, 0, j + 3)
            q0, q1, q2, q3 = p0, p1, p2, p3
            for k in range(w.shape[0]):
                u, v = load(inputs, k, i), load(inputs, k, i + WIDTH)
                w0, w1, w2, w3 = pick(w, k, j), pick(w, k, j + 1), pick(w, k, j + 2), pick(w, k, j + 3)
                p0, p1, p2, p3 = fma(w0, u, p0), fma(w1, u, p1), fma(w2, u, p2), fma(w3, u, p3)
                q0, q1, q2, q3 = fma(w0, v, q0), fma(w1, v, q1), fma(w2, v, q2), fma(w3, v, q3)
            store(out, j, i, positive(p0))
            store(out, j + 1, i, positive(p1))
            store(out, j + 2, i, positive(p2))
            store(out, j + 3, i, positive(p3))
            store(out, j, i + WIDTH, positive(q0))
            store(out, j + 1, i + WIDTH, positive(q1))
            store(out, j + 2, i + WIDTH, positive(q2))
            store(out, j + 3, i + WIDTH, positive(q3))


@njit(cache=True, error_model="numpy")
def _by_inputs(w, gradient, n, out):
    """Write w · gradient, the gradients by inputs, `out` [input, point], from those by neurons [neuron, point]."""
    for k in range(0, w.shape[0], 4):
        for i in range(0, n, 2 * WIDTH):
            p0 = p1 = p2 = p3 = q0 = q1 = q2 = q3 = spread(ZERO)
            for j in range(w.shape[1]):
                u, v = load(gradient, j, i), load(gradient, j, i + WIDTH)
                w0, w1, w2, w3 = pick(w, k, j), pick(w, k + 1, j), pick(w, k + 2, j), pick(w, k + 3, j)
                p0, p1, p2, p3 = fma(w0, u, p0), fma(w1, u, p1), fma(w2, u, p2), fma(w3, u, p3)
                q0, q1, q2, q3 = fma(w0, v, q0), fma(w1, v, q1), fma(w2, v, q2), fma(w3, v, q3)
            store(out, k, i, p0)
            store(out, k + 1, i, p1)
            store(out, k + 2, i, p2)
            store(out, k + 3, i, p3)
            store(out, k, i + WIDTH, q0)
            store(out, k + 1, i + WIDTH, q1)
            store(out, k + 2, i + WIDTH, q2)
            store(out, k + 3, i + WIDTH, q3)


@njit(cache=True, error_model="numpy")
def _by_weights(inputs, gradient, n, sums):
    """Add the gradients by weights to `sums` [input · neurons + neuron, WIDTH], to be added up over the lanes."""
    n_j = gradient.shape[0]
    for k in range(0, inputs.shape[0], 4):
        for j in range(0, n_j, 2):
            r0, r1, r2, r3 = k * n_j + j, (k + 1) * n_j + j, (k + 2) * n_j + j, (k + 3) * n_j + j
            p0, p1, p2, p3 = load(sums, r0, 0), load(sums, r1, 0), load(sums, r2, 0), load(sums, r3, 0)
            q0, q1 = load(sums, r0 + 1, 0), load(sums, r1 + 1, 0)
            q2, q3 = load(sums, r2 + 1, 0), load(sums, r3 + 1, 0)
            for i in range(0, n, WIDTH):
                u, v = load(gradient, j, i), load(gradient, j + 1, i)
                a, b, c, d = load(inputs, k, i), load(inputs, k + 1, i), load(inputs, k + 2, i), load(inputs, k + 3, i)
                p0, p1, p2, p3 = fma(a, u, p0), fma(b, u, p1), fma(c, u, p2), fma(d, u, p3)
                q0, q1, q2, q3 = fma(a, v, q0), fma(b, v, q1), fma(c, v, q2), fma(d, v, q3)
            store(sums, r0, 0, p0)
            store(sums, r1, 0, p1)
            store(sums, r2, 0, p2)
            store(sums, r3, 0, p3)
            store(sums, r0 + 1, 0, q0)
            store(sums, r1 + 1, 0, q1)
            store(sums, r2 + 1, 0, q2)
            store(sums, r3 + 1, 0, q3)


@njit(cache=True, error_model="numpy")
def _sums(w, b, neurons, n, out):
    """Write wᵀ · neurons + b, what the outputs are before squareplus: `out` [output, point]; b [1, output]."""
    for o in range(w.shape[1]):
        for i in range(0, n, 4 * WIDTH):
            p = pick(b, 0, o)
            q, r, s = p, p, p
            for j in range(w.shape[0]):
                v = pick(w, j, o)
                p, q = fma(v, load(neurons, j, i), p), fma(v, load(neurons, j, i + WIDTH), q)
                r = fma(v, load(neurons, j, i + 2 * WIDTH), r)
                s = fma(v, load(neurons, j, i + 3 * WIDTH), s)
            store(out, o, i, p)
            store(out, o, i + WIDTH, q)
            store(out, o, i + 2 * WIDTH, r)
            store(out, o, i + 3 * WIDTH, s)


@njit(cache=True, error_model="numpy")
def _by_neurons(w, neurons, gradient, n, out, sums):
    """Write the gradients by neurons before relu, `out` [neuron, point], from those by the sums [output, point].

    Adds those by w, by b and by the neurons' own b to `sums` [neuron · outputs + output, 8], [output, 8], [neuron, 8].
    """
    by_w, by_b, by_own = sums
    n_o = w.shape[1]
    for j in range(w.shape[0]):
        own = load(by_own, j, 0)
        for i in range(0, n, WIDTH):
            value = spread(ZERO)
            for o in range(n_o):
                value = fma(pick(w, j, o), load(gradient, o, i), value)
            value = where_positive(load(neurons, j, i), value)
            own = add(own, value)
            store(out, j, i, value)
        store(by_own, j, 0, own)
        for o in range(n_o):
            value = load(by_w, j * n_o + o, 0)
            for i in range(0, n, WIDTH):
                value = fma(load(neurons, j, i), load(gradient, o, i), value)
            store(by_w, j * n_o + o, 0, value)
    for o in range(n_o):
        value = load(by_b, o, 0)
        for i in range(0, n, WIDTH):
            value = add(value, load(gradient, o, i))
        store(by_b, o, 0, value)


@njit(cache=True, error_model="numpy")
def _squareplus(x, n, slope, out):
    """Write (x + √(x² + 4))/2, or multiply `out` by its slope: [output, point]."""
    half, one, four = spread(HALF), spread(ONE), spread(FOUR)
    for o in range(x.shape[0]):
        for i in range(0, n, WIDTH):
            v = load(x, o, i)
            root = sqrt(fma(v, v, four))
            if slope:
                store(out, o, i, mul(load(out, o, i), mul(half, add(one, div(v, root)))))
            else:
                store(out, o, i, mul(half, add(v, root)))


@compiled_once("int64", "int64", _COLUMNS, _MATRIX, "int64", _BETWEEN, _NETWORK, _MATRIX)
def _forward_task(column, end, columns, lattice, n_f, between, network, out):
    yx, firsts, z_of = columns
    w1, b1, w2, b2, scale = network
    n_o = w2.shape[1]
    inputs, neurons = np.zeros((w1.shape[0], BLOCK), np.float32), np.zeros((w1.shape[1], BLOCK), np.float32)
    sums, values = np.zeros((n_o, BLOCK), np.float32), np.zeros((n_o, BLOCK), np.float32)
    for c in range(column, end):
        point, last = firsts[c], firsts[c + 1]
        while point < last:
            z = z_of[point]
            n = min(z_of[last - 1] + 1 - z, BLOCK)
            _blend(lattice, between, (yx[c, 0], yx[c, 1], z, n, n_f), inputs)
            _neurons(w1, b1, inputs, n, neurons)
            _sums(w2, b2, neurons, n, sums)
            _squareplus(sums, n, False, values)
            while point < last and z_of[point] < z + n:
                for o in range(n_o):
                    out[point, o] = scale[o] * values[o, z_of[point] - z]
                point += 1


@njit(parallel=True, cache=True, error_model="numpy")
def _forward(task, tasks, columns, lattice, n_f, between, network, out):
    for k in prange(tasks.size - 1):
        _forward_task(task, tasks[k], tasks[k + 1], columns, lattice, n_f, between, network, out)


def forward(tasks, columns, lattice, n_f, between, network, out):
    """Fill `out` [point, output] with the field: scale · squareplus(w2ᵀ · relu(w1ᵀ · h + b1) + b2).

    `lattice` [lattice column · feature, z + WIDTH] is what `lattice_cpu.spread` made of a table with `n_f` features;
    `network` w1 [input, neuron], b1 [1, neuron], w2 [neuron, output], b2 [1, output] and scale [output].
    """
    _forward(_forward_task.address(), tasks, columns, lattice, n_f, between, network, out)


@compiled_once(
    "int64", "int64", _COLUMNS, _MATRIX, "int64", _BETWEEN, _NETWORK, _MATRIX, "int64[::1]", _MATRIX,
    f"UniTuple({_MATRIX}, 4)",
)  # fmt: skip
def _backward_task(column, end, columns, lattice, n_f, between, network, gradient, behind, by_lattice, by_weights):
    yx, firsts, z_of = columns
    w1, b1, w2, b2, scale = network
    n_o = w2.shape[1]
    inputs, by_inputs = np.zeros((w1.shape[0], BLOCK), np.float32), np.zeros((w1.shape[0], BLOCK), np.float32)
    neurons, by_neurons = np.zeros((w1.shape[1], BLOCK), np.float32), np.zeros((w1.shape[1], BLOCK), np.float32)
    sums, by_sums = np.zeros((n_o, BLOCK), np.float32), np.zeros((n_o, BLOCK), np.float32)
    by_w1, by_b1, by_w2, by_b2 = by_weights
    for c in range(column, end):
        point, last = firsts[c], firsts[c + 1]
        while point < last:
            z = z_of[point]
            n = min(z_of[last - 1] + 1 - z, BLOCK)
            at = (yx[c, 0], yx[c, 1], z, n, n_f)
            by_sums[:] = ZERO  # a voxel between points is none
            while point < last and z_of[point] < z + n:
                for o in range(n_o):
                    by_sums[o, z_of[point] - z] = scale[o] * gradient[point, o]
                point += 1
            _blend(lattice, between, at, inputs)
            _neurons(w1, b1, inputs, n, neurons)
            _sums(w2, b2, neurons, n, sums)
            _squareplus(sums, n, True, by_sums)
            _by_neurons(w2, neurons, by_sums, n, by_neurons, (by_w2, by_b2, by_b1))
            _by_weights(inputs, by_neurons, n, by_w1)
            _by_inputs(w1, by_neurons, n, by_inputs)
            _blend_back(by_inputs, between, at, behind, by_lattice)


@njit(parallel=True, cache=True, error_model="numpy")
def _backward(task, tasks, columns, lattice, n_f, between, network, gradient, behind, by_lattice, by_weights):
    by_w1, by_b1, by_w2, by_b2 = by_weights
    for k in prange(tasks.size - 1):
        own = (by_w1[k], by_b1[k], by_w2[k], by_b2[k])
        for row in range(n_f * behind[k, -1], n_f * behind[k + 1, -1]):
            for z in range(by_lattice.shape[1]):
                by_lattice[row, z] = ZERO
        _backward_task(
            task, tasks[k], tasks[k + 1], columns, lattice, n_f, between, network, gradient, behind[k], by_lattice, own
        )


def backward(tasks, columns, lattice, n_f, between, network, gradient, behind, by_lattice):
    """Take gradients by the field [point, output] back: fill `by_lattice`, and return those by w1, b1, w2 and b2.

    `by_lattice` [copy · feature, z + WIDTH] has lattice columns of its own for each task: `behind`
    [task + 1, level + 1] says by how much they lie behind those of the lattices, and in the last place where the
    task's begin.
    """
    w1, _, w2, _, _ = network
    (n_i, n_j), n_o = w1.shape, w2.shape[1]
    sums = tuple(np.zeros((tasks.size - 1, n, WIDTH), np.float32) for n in (n_i * n_j, n_j, n_j * n_o, n_o))
    _backward(
        _backward_task.address(), tasks, columns, lattice, n_f, between, network, gradient, behind, by_lattice, sums
    )
    by_w1, by_b1, by_w2, by_b2 = (s.sum((0, 2), dtype=np.float64).astype(np.float32) for s in sums)
    return by_w1.reshape(n_i, n_j), by_b1, by_w2.reshape(n_j, n_o), by_b2
