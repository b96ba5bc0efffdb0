"""Rows of the detector: which primitives are seen in one, and the columns in which there is nothing to trace."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def seen_in_row(shadow):
    """Return the indices of the primitives that are seen in a row."""
    out = np.empty(shadow.shape[0], np.int64)
    n = 0
    for p in range(shadow.shape[0]):
        if shadow[p, 0] <= shadow[p, 1]:
            out[n] = p
            n += 1
    return out[:n]


@njit(cache=True, error_model="numpy")
def columns_near(shadow, active, n_u):
    """Mark the columns that the shadows of the active primitives may reach."""
    out = np.zeros(n_u + 1, np.bool_)
    for p in active:
        out[max(shadow[p, 0], 0) : shadow[p, 1] + 2] = True
    return out


@njit(inline="always", error_model="numpy")
def _is_open(background, u):
    total = np.float32(0)
    for m in range(1, background.shape[0]):
        total += background[m, u]
    return total == 0


@njit(cache=True, error_model="numpy")
def trim(background, span, near, skip):
    """Leave out the columns at both ends of a row in which nothing is met."""
    first, last = span[0], span[1]
    if not skip:
        return first, last
    while first < last and not near[first] and _is_open(background, first):
        first += 1
    while first < last and not near[last - 1] and _is_open(background, last - 1):
        last -= 1
    return first, last


@njit(cache=True, error_model="numpy")
def fill_open(rules, j, span, columns, m1, m2):
    """Write the open field's signal of variant j to a row's columns of `span` outside `columns`.

    The images may hold another scan. Weights are summed in the order of `ray_cpu.signal`, so that a skipped ray
    equals a traced one.
    """
    _, w1, w2, nodes = rules
    open1, open2 = np.float32(0), np.float32(0)
    for k in range(nodes[j]):
        open1 += w1[j, k]
        open2 += w2[j, k]
    for u in range(span[0], span[1]):
        if u < columns[0] or u >= columns[1]:
            m1[u], m2[u] = open1, open2
