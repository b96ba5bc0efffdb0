"""The ray tracer in float64 for reading: every plane crossing is listed, sorted and looked up.

`transmit_view` takes what `raytrace_cpu.transmit_view` does, `trace_view` is the twin of `bricks_cpu`,
`columns_cpu`, `density_cpu` and `raytrace_cpu.replace_view` together. Nothing is skipped, and the position of every
piece of a ray is found from its midpoint.
"""

import itertools
import math

import numpy as np

from ctsim.tracer.bricks import SIDE
from ctsim.tracer.kernels.solids_reference import inside, intersect

GOLDEN = 0.6180339887498949
RUNGS = [2, 4, 8, *(17 * 2**k for k in range(20))]


def _label_volume(bricks):
    """Undo the bricks: labels and density, [z, y, x]."""
    code, slots, pool, dense, grid = bricks[:5]
    _, mz, my, mx = code.shape
    labels = np.zeros((mz, my, mx, SIDE, SIDE, SIDE), np.uint8)
    density = np.ones(labels.shape)
    for z, y, x in np.ndindex(mz, my, mx):
        slot = slots[z, y, x]
        cells = slice(slot * SIDE**3, (slot + 1) * SIDE**3)
        if slot < 0:
            labels[z, y, x] = code[0, z, y, x] & 255
            continue
        labels[z, y, x] = pool[cells].reshape(SIDE, SIDE, SIDE)
        if dense.size:
            density[z, y, x] = dense[cells].reshape(SIDE, SIDE, SIDE)
    full = (mz * SIDE, my * SIDE, mx * SIDE)
    nx, ny, nz = grid[:3].astype(int)
    labels = labels.transpose(0, 3, 1, 4, 2, 5).reshape(full)[:nz, :ny, :nx]
    return labels, density.transpose(0, 3, 1, 4, 2, 5).reshape(full)[:nz, :ny, :nx]


def _ray(pose, u, v):
    source, centre, e_u, e_v = pose.reshape(4, 3)
    towards = centre + u * e_u + v * e_v - source
    distance = np.linalg.norm(towards)
    return source, towards / distance, distance


def _intervals(prim, source, direction, pairs):
    ox, oy, oz = source
    dx, dy, dz = direction
    return intersect(prim, ox, oy, oz, dx, dy, dz, pairs)


def _lengths(volume, grid, prims, ray, n_materials, central=None):
    """Path length in every material along one ray: in the open volume, in the volume under solids, in solids.

    The volume is met along the ray `central`, if given, instead.
    """
    labels, density = volume
    source, direction, distance = ray
    along = (central or ray)[1]
    n, per_mm, low = grid[:3], grid[3:6], grid[6:]
    cuts = [0.0, distance]
    for axis in range(3):
        if abs(along[axis]) > 1e-12:
            planes = low[axis] + np.arange(int(n[axis]) + 1) / per_mm[axis]
            cuts += list((planes - source[axis]) / along[axis])
    for prim in prims:
        pairs = np.empty(4)
        found = _intervals(prim, source, direction, pairs)
        cuts += list(pairs[: 2 * found])
    cuts = np.unique(np.clip(cuts, 0.0, distance))
    lengths = np.zeros((3, n_materials))
    for t0, t1 in itertools.pairwise(cuts):
        covering = [prim for prim in prims if inside(prim, *(source + direction * (t0 + t1) / 2))]
        if covering:
            lengths[2, int(covering[-1][1])] += t1 - t0
        x, y, z = np.floor((source + along * (t0 + t1) / 2 - low) * per_mm).astype(int)
        if 0 <= x < n[0] and 0 <= y < n[1] and 0 <= z < n[2]:
            lengths[1 if covering else 0, labels[z, y, x]] += (t1 - t0) * density[z, y, x]
    lengths[:, 0] = 0.0
    return lengths


def _thickness(prims, ray, edge_mu):
    source, direction, distance = ray
    total, hits = 0.0, 0
    for prim in prims:
        pairs = np.empty(4)
        found = _intervals(prim, source, direction, pairs)
        for t0, t1 in pairs[: 2 * found].reshape(-1, 2):
            length = max(min(t1, distance) - max(t0, 0.0), 0.0)
            total += length * edge_mu[int(prim[1])]
            hits += length > 0
    return total, hits


def _n_subrays(solids, pose, u, v, edge):
    """How many rays measure the pixel at detector position (u, v) at first."""
    prims, fat, _ = solids
    edge_mu, smooth, begins, most, _ = edge
    if most < 2 or len(prims) == 0:
        return 1
    centre = _ray(pose, u, v)
    hidden = [prim[1] for prim in fat if prim[0] >= 0 and _intervals(prim, centre[0], centre[1], np.empty(4)) > 0]
    if hidden:
        return most * int(max(hidden))
    corners = [_ray(pose, u + du, v + dv) for du in (-0.5, 0.5) for dv in (-0.5, 0.5)]
    tau, hits = zip(*(_thickness(prims, ray, edge_mu) for ray in (centre, *corners)), strict=True)
    change, threshold = max(tau) - min(tau), begins if len(set(hits[1:])) > 1 else smooth
    if change <= threshold:
        return 1
    share = max(2, int(most * min(1.0, (1 + change) / 8.5)))
    return min(min(RUNGS, key=lambda n: abs(math.log(n / share))), 16 * most)


def _uncertainty(signal, thickness, bounds):
    """Estimate the relative error of the mean of a pixel's sub-rays, as `raytrace_cpu._uncertainty` does."""
    brightest, darkest = max(signal), min(signal)
    if min(bounds) < min(thickness):
        brightest = max(brightest, min(1.0, brightest * math.exp(min(min(thickness) - min(bounds), 80.0))))
    if max(bounds) > max(thickness):
        darkest *= math.exp(max(thickness) - max(bounds))
    halves = abs(np.mean(signal[::2]) - np.mean(signal[1::2])) / 2
    return max(halves, 0.5 * (brightest - darkest) / len(signal)) / np.mean(signal)


def _subrays(volume, grid, solids, pose, at, n, background, rule, edge_mu):
    """Signal, second moment and thickness of the solids along the n sub-rays of the pixel at (u, v)."""
    mu, w1, w2 = rule
    u, v = at
    signal, second, thickness = [], [], []
    for i in range(n):
        du = (i + 0.5) / n - 0.5 if n > 1 else 0.0
        dv = math.fmod(i * GOLDEN + 0.5, 1.0) - 0.5
        ray, central = _ray(pose, u + du, v + dv), _ray(pose, u, v)
        _, under, solid = _lengths(volume, grid, solids[0], ray, len(mu), central)
        passed = np.exp(-np.minimum((np.maximum(background - under, 0) + solid) @ mu, 80.0))
        signal.append(w1 @ passed)
        second.append(w2 @ passed)
        thickness.append(_thickness(solids[0], ray, edge_mu)[0])
    return signal, second, thickness


def transmit_view(bricks, solids, pose, order, spans, background, rule, edge, skip, m1, m2):
    """Measure one view: mean signal `m1` and second moment `m2` [v, u] relative to the open field."""
    volume, strip = _label_volume(bricks), -(-len(m1) // len(order))
    rule = tuple(np.asarray(a, np.float64) for a in rule)
    n_v, n_u = m1.shape
    edge_mu, most, tolerance = edge[0], edge[3], edge[4]
    for row in (k * strip + i for k in order for i in range(strip) if k * strip + i < n_v):
        for column in range(*spans[row]):
            at = u, v = column - (n_u - 1) / 2, row - (n_v - 1) / 2
            n = _n_subrays(solids, pose, u, v, edge)
            corners = [(u + du, v + dv) for du in (-0.5, 0.5) for dv in (-0.5, 0.5)]
            bounds = [_thickness(solids[0], _ray(pose, *where), edge_mu)[0] for where in (at, *corners)]
            under = background[:, row, column]
            while True:
                rays = _subrays(volume, bricks[4], solids, pose, at, n, under, rule, edge_mu)
                excess = _uncertainty(rays[0], rays[2], bounds) / tolerance if n > 1 else 0.0
                if excess <= 1 or n == 16 * most:
                    break
                more = int(n * min(max(excess, 1.2) ** (4 / 3), 4.0)) + 1
                n = min(*(n for n in RUNGS if n >= more), 16 * most)
            m1[row, column], m2[row, column] = np.mean(rays[0]), np.mean(rays[1])


def trace_view(bricks, prims, pose, lengths):
    """Fill `lengths` [material, v, u] (mm) along the rays to the pixel centres of one view."""
    volume = _label_volume(bricks)
    n_materials, n_v, n_u = lengths.shape
    for row in range(n_v):
        for column in range(n_u):
            ray = _ray(pose, column - (n_u - 1) / 2, row - (n_v - 1) / 2)
            open_volume, _, solid = _lengths(volume, bricks[4], prims, ray, n_materials)
            lengths[:, row, column] = open_volume + solid
