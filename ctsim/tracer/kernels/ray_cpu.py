"""One ray through the solids: which it meets, what it crosses in them and in the volume that they replace, its signal.

What runs once a ray is inlined: a call would count references of its arrays atomically, which costs more than the ray.
Variants of a scan differ in metal and spectrum: its rays are the same, its attenuation is not.
"""

import numpy as np
from numba import njit

from ctsim.tracer.kernels.bricks_cpu import add_pieces
from ctsim.tracer.kernels.exp_cpu import exp_minus
from ctsim.tracer.kernels.solids_cpu import intersect

FAST = {"contract", "reassoc", "nsz", "arcp"}
WIDTH = 16  # float32 numbers in the widest vector of today's processors


@njit(inline="always", error_model="numpy")
def collect(prims, shadow, active, u, ray, pair, hits):
    """List the intervals of the active primitives near column u as (enter, leave, material); return how many."""
    n = 0
    for p in active:
        if u < shadow[p, 0] or u > shadow[p, 1]:
            continue
        for i in range(intersect(prims[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * i], 0.0), min(pair[2 * i + 1], ray[6])
            if leave > enter:
                hits[n, 0], hits[n, 1], hits[n, 2] = enter, leave, prims[p, 1]
                n += 1
    return n


@njit(inline="always", error_model="numpy")
def paint(hits, n, pieces, n_pieces, covered, painted):
    """Set a ray's path lengths in the n solids hit, in paint order, and in the volume's pieces that they replace."""
    covered[:] = 0.0
    painted[:] = 0.0
    t, far = hits[0, 0], hits[0, 1]
    for i in range(1, n):
        t, far = min(t, hits[i, 0]), max(far, hits[i, 1])
    while t < far:
        # the topmost interval that covers t decides, until it ends or one painted later begins
        top, until = -1, far
        for i in range(n):
            if hits[i, 0] <= t < hits[i, 1]:
                top = i
        if top >= 0:
            until = hits[top, 1]
        for i in range(top + 1, n):
            if t < hits[i, 0] < until:
                until = hits[i, 0]
        if top >= 0:
            painted[int(hits[top, 2])] += until - t
            add_pieces(pieces, n_pieces, t, until, covered)
        t = until


@njit(inline="always", error_model="numpy")
def thickness(hits, n, edge_mu, j):
    """Optical thickness of the solids alone in variant j; overlaps count twice, since only its change matters."""
    total = 0.0
    for i in range(n):
        total += (hits[i, 1] - hits[i, 0]) * edge_mu[j, int(hits[i, 2])]
    return total


@njit(cache=True, fastmath=FAST, error_model="numpy")
def signal(lengths, n, rule, j, tau, s1, s2):
    """Sum the nodes of variant j: s1 = Σ w1·exp(−Σ mu·L) and s2 likewise, for n rays at once."""
    mu, w1, w2, nodes = rule
    for i in range(n):
        s1[i] = 0
        s2[i] = 0
    for k in range(nodes[j]):
        for i in range(n):
            tau[i] = 0
        for m in range(mu.shape[1]):
            mu_mk = mu[j, m, k]
            for i in range(n):
                tau[i] += mu_mk * lengths[m, i]
        for i in range(n):
            e = exp_minus(tau[i])
            s1[i] += w1[j, k] * e
            s2[i] += w2[j, k] * e


@njit(cache=True, fastmath=FAST, error_model="numpy")
def signal_near(lengths, at, n, order, few, rule, j, same, tau, s1, s2):
    """Sum as `signal` does, for n rays that differ in the materials order[at, :few] alone, not in order[at, few:].

    Path lengths are lengths[at]. Whole arrays are passed: references of a slice would be counted in every call.
    Up to WIDTH − 1 rays more are read and summed, since rays that do not fill a vector are done one by one.
    """
    mu, w1, w2, nodes = rule
    whole = -(-n // WIDTH) * WIDTH
    for i in range(whole):
        s1[i] = 0
        s2[i] = 0
    for k in range(nodes[j]):
        same[k] = 0
    for c in range(few, order.shape[1]):
        for k in range(nodes[j]):
            same[k] += mu[j, order[at, c], k] * lengths[at, order[at, c], 0]
    # the last two materials are added where their sum is used
    a, b = order[at, max(few - 1, 0)], order[at, max(few - 2, 0)]
    for k in range(nodes[j]):
        for i in range(whole):
            tau[i] = same[k]
        for c in range(few - 2):
            m = order[at, c]
            mu_mk = mu[j, m, k]
            for i in range(whole):
                tau[i] += mu_mk * lengths[at, m, i]
        mu_a, mu_b = mu[j, a, k] * np.float32(few > 0), mu[j, b, k] * np.float32(few > 1)
        for i in range(whole):
            e = exp_minus(tau[i] + mu_a * lengths[at, a, i] + mu_b * lengths[at, b, i])
            s1[i] += w1[j, k] * e
            s2[i] += w2[j, k] * e
