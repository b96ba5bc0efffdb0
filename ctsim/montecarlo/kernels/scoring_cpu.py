"""What scattered photons would send to the detector (forced detection), compiled."""

import math

from numba import njit

from ctsim.kernels.laws_cpu import HC, REST, at, bounded, rayleigh, turn, uniform
from ctsim.montecarlo.kernels.flight_cpu import depth

COMPTON, RAYLEIGH = 2, 32
"""Directions that are scored of one collision. Rayleigh scatter is rare, and most of what reaches the detector."""
CUT = 2.0  # keV; a photon below it stays where it is
PRIMARY, SINGLE, MULTIPLE, SQUARED = 0, 1, 2, 3
"""Planes of an image: signal of photons by how often they scattered, and the squared signal of all that did."""


@njit(cache=True, error_model="numpy")
def _score(images, order, v, u, share, signals, energy):
    """Add a scattered photon's share to the cell at (v, u) within 0 … 1."""
    rows, columns = images.shape[1:]
    j, i = min(int(v * rows), rows - 1), min(int(u * columns), columns - 1)
    images[SINGLE if order == 1 else MULTIPLE, j, i] += share * at(signals[0], energy)
    images[SQUARED, j, i] += share * at(signals[1], energy)


@njit(cache=True, error_model="numpy")
def aim(ray, way, x, y, z):
    """Set `way` to the ray from `ray`'s place to (x, y, z), and its length."""
    dx, dy, dz = x - ray[0], y - ray[1], z - ray[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    way[0], way[1], way[2] = ray[0], ray[1], ray[2]
    way[3], way[4], way[5], way[6] = dx / length, dy / length, dz / length, length


@njit(cache=True, error_model="numpy")
def _grid(beam, way, u, v):
    """Return the share of photons that the anti-scatter grid lets pass: 1 for the source's own direction."""
    pose, extent, normal, _, _, ratio = beam
    if ratio <= 0:
        return 1.0
    a, b = (u - 0.5) * extent[1], (v - 0.5) * extent[0]
    along, towards, seen, far, step, area = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        from_source = pose[3 + k] + a * pose[6 + k] + b * pose[9 + k] - pose[k]
        along += way[3 + k] * pose[6 + k]
        towards += way[3 + k] * normal[k]
        seen += from_source * pose[6 + k]
        far += from_source * normal[k]
        step += pose[6 + k] * pose[6 + k]
        area += normal[k] * normal[k]
    return max(0.0, 1.0 - ratio * abs(along / towards - seen / far) * math.sqrt(area / step))


@njit(cache=True, error_model="numpy", inline="always")
def force(depths, volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images):
    """Score what a Compton collision sends to a random place of the detector, on average over all its outcomes."""
    mu, klein, bound, _, per_q = tables
    pose, extent, normal, signals, _, _ = beam
    u, v = uniform(rng), uniform(rng)
    a, b = (u - 0.5) * extent[1], (v - 0.5) * extent[0]
    aim(
        ray, way,
        pose[3] + a * pose[6] + b * pose[9],
        pose[4] + a * pose[7] + b * pose[10],
        pose[5] + a * pose[8] + b * pose[11],
    )  # fmt: skip
    cos = way[3] * ray[3] + way[4] * ray[4] + way[5] * ray[5]
    ratio = 1.0 / (1.0 + energy / REST * (1.0 - cos))
    later = energy * ratio
    if later < CUT:
        return
    whole = at(klein[m], energy)
    law = ratio * ratio * (ratio + 1.0 / ratio - 1.0 + cos * cos)
    law *= bounded(bound, m, energy / HC * math.sqrt(max(0.5 * (1.0 - cos), 0.0)), per_q) / whole
    slant = abs(way[3] * normal[0] + way[4] * normal[1] + way[5] * normal[2])  # detector area times cos, in mm²
    share = law * slant / (way[6] * way[6])
    share *= _grid(beam, way, u, v)
    if share > 0:
        depth(depths, volume, prims, mu, later, way, work)
        _score(images, order, v, u, share * math.exp(-way[7]) / COMPTON, signals, later)


@njit(cache=True, error_model="numpy", inline="always")
def _reach(depths, volume, prims, tables, beam, energy, order, ray, way, work, images):
    """Score a photon at the place of the detector that it flies to, by its chance to get there."""
    pose, extent, normal, signals, _, _ = beam
    towards = ray[3] * normal[0] + ray[4] * normal[1] + ray[5] * normal[2]
    if abs(towards) < 1e-9:
        return
    cx, cy, cz = pose[3] - ray[0], pose[4] - ray[1], pose[5] - ray[2]
    length = (cx * normal[0] + cy * normal[1] + cz * normal[2]) / towards
    if length <= 0:
        return
    x, y, z = length * ray[3] - cx, length * ray[4] - cy, length * ray[5] - cz
    uu = pose[6] * pose[6] + pose[7] * pose[7] + pose[8] * pose[8]
    vv = pose[9] * pose[9] + pose[10] * pose[10] + pose[11] * pose[11]
    uv = pose[6] * pose[9] + pose[7] * pose[10] + pose[8] * pose[11]
    xu, xv = x * pose[6] + y * pose[7] + z * pose[8], x * pose[9] + y * pose[10] + z * pose[11]
    scale = 1.0 / (uu * vv - uv * uv)
    u, v = (xu * vv - xv * uv) * scale / extent[1] + 0.5, (xv * uu - xu * uv) * scale / extent[0] + 0.5
    if 0 <= u < 1 and 0 <= v < 1:
        for k in range(6):
            way[k] = ray[k]
        way[6] = length
        share = _grid(beam, way, u, v) / RAYLEIGH
        if share > 0:
            depth(depths, volume, prims, tables[0], energy, way, work)
            _score(images, order, v, u, share * math.exp(-way[7]), signals, energy)


@njit(cache=True, error_model="numpy", inline="always")
def scatter_coherently(depths, volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images):
    """Turn a photon by Rayleigh scatter, and score several of the ways that it may take."""
    _, _, _, form, per_q = tables
    n = RAYLEIGH if images.size > 0 else 1
    x, y, z = ray[3], ray[4], ray[5]
    for _ in range(n):  # the photon goes on the last of these ways
        ray[3], ray[4], ray[5] = x, y, z
        turn(ray, rayleigh(form, m, energy, per_q, rng), 2.0 * math.pi * uniform(rng))
        if images.size > 0:
            _reach(depths, volume, prims, tables, beam, energy, order, ray, way, work, images)
