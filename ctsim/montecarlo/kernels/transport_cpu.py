"""Photons through bricks and solids: Woodcock tracking with a majorant for each block, compiled.

A photon flies through blocks of voxels. In a block it meets tentative collisions at the rate of the block's greatest
attenuation, and one is real with the share that the material at its place has of it (Woodcock 1965); solids have
exact boundaries instead, so that metal slows nothing else. A history's random numbers depend on its number alone, and
histories are summed in `CHUNKS` fixed parts: results are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.bricks_cpu import CELLS, CODE_BITS, MIXED, SIDE, walk
from ctsim.kernels.noise_cpu import philox
from ctsim.kernels.once import compiled_once
from ctsim.kernels.raytrace_cpu import _paint
from ctsim.kernels.solids_cpu import intersect

CHUNKS = 64
COMPTON, RAYLEIGH = 2, 32
"""Directions that are scored of one collision. Rayleigh scatter is rare, and most of what reaches the detector."""
E_MIN, PER_STEP = 1.0, 10.0  # as in `ctsim.montecarlo.tables`: keV, energy steps per keV
REST, HC = 510.998950, 12.3984198
CUT = 2.0  # keV; a photon below it stays where it is
FARTHEST = 1e30
EDGE = 1e-9  # of a block: a photon that enters the grid may lie this far outside it by rounding
_LOW, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
PRIMARY, SINGLE, MULTIPLE, SQUARED = 0, 1, 2, 3
"""Planes of an image: signal of photons by how often they scattered, and the squared signal of all that did."""


@njit(cache=True, error_model="numpy", inline="always")
def _start(rng, key, history):
    """Begin a history's own stream: xoroshiro128+ (Blackman and Vigna 2018) from one Philox block."""
    w0, w1, w2, w3 = philox(history & _LOW, history >> _32, np.uint64(0), np.uint64(1), key & _LOW, key >> _32)
    rng[0], rng[1] = (w0 << _32) | w1, (w2 << _32) | w3 | np.uint64(1)  # all zeros would stay so


@njit(cache=True, error_model="numpy", inline="always")
def _uniform(rng):
    """Return a random number within (0, 1)."""
    s0, s1 = rng[0], rng[1]
    word = s0 + s1
    s1 ^= s0
    rng[0] = ((s0 << np.uint64(24)) | (s0 >> np.uint64(40))) ^ s1 ^ (s1 << np.uint64(16))
    rng[1] = (s1 << np.uint64(37)) | (s1 >> np.uint64(27))
    return (float(word >> np.uint64(12)) + 0.5) * 2.0**-52


@njit(cache=True, error_model="numpy", inline="always")
def _label(code, slot, pool, density, grid, x, y, z):
    """Return the label of a place in the volume and its relative density; 0 outside."""
    i, j, k = (x - grid[6]) * grid[3], (y - grid[7]) * grid[4], (z - grid[8]) * grid[5]
    label, relative = 0, np.float32(1.0)
    if 0 <= i < grid[0] and 0 <= j < grid[1] and 0 <= k < grid[2]:
        ix, iy, iz = int(i), int(j), int(k)
        bz, by, bx = iz // SIDE, iy // SIDE, ix // SIDE
        label = np.int64(code[0, bz, by, bx] & CODE_BITS)
        if label == MIXED:
            cell = np.int64(slot[bz, by, bx]) * CELLS + ((iz % SIDE) * SIDE + iy % SIDE) * SIDE + ix % SIDE
            label = np.int64(pool[cell])
            if density.size > 0:
                relative = density[cell]
    return label, relative


@njit(cache=True, error_model="numpy", inline="always")
def _crossed(prims, first, listed, block, ray, start, pair, seen, hits, n):
    """Add the parts (enter, leave, number, material) of a ray beyond `start` in a block's solids to the n known ones.

    Each solid is intersected once in a flight, however many blocks it reaches into: `seen` marks those that were.
    """
    for k in range(first[block], first[block + 1]):
        number = listed[k]
        if seen[number]:
            continue
        seen[number] = 1
        prim = prims[number]
        for i in range(intersect(prim, ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * i], start), pair[2 * i + 1]
            if leave > enter:
                hits[n, 0], hits[n, 1], hits[n, 2], hits[n, 3] = enter, leave, number, prim[1]
                n += 1
    return n


@njit(cache=True, error_model="numpy", inline="always")
def _within(hits, n, t, end):
    """Return the material of the solid painted last at t, 0 where there is none, and where that ends at the latest."""
    m, until, last = 0, end, -1.0
    for k in range(n):
        if hits[k, 0] <= t < hits[k, 1]:
            if hits[k, 2] > last:
                last, m = hits[k, 2], np.int64(hits[k, 3])
            until = min(until, hits[k, 1])
        elif hits[k, 0] > t:
            until = min(until, hits[k, 0])
    return m, until


@njit(cache=True, error_model="numpy", inline="always")
def _fly(volume, prims, blocks, mu, energy, ray, pair, seen, hits, rng, found):
    """Move a photon to its next collision; fill `found` with the attenuations, return the material, -1 if it leaves."""
    kind, most, first, listed, frame = blocks
    code, slot, pool, density, grid = volume
    mz, my, mx = kind.shape
    x, y, z, dx, dy, dz = ray[0], ray[1], ray[2], ray[3], ray[4], ray[5]
    wx, wy, wz = frame[3], frame[4], frame[5]
    lx, ly, lz = frame[0] - x, frame[1] - y, frame[2] - z
    ix = 1.0 / dx if abs(dx) > 1e-12 else FARTHEST
    iy = 1.0 / dy if abs(dy) > 1e-12 else FARTHEST
    iz = 1.0 / dz if abs(dz) > 1e-12 else FARTHEST
    ux, uy, uz = 1 if ix > 0 else 0, 1 if iy > 0 else 0, 1 if iz > 0 else 0
    t = max((lx + (1 - ux) * mx * wx) * ix, (ly + (1 - uy) * my * wy) * iy)
    t = max(max(t, (lz + (1 - uz) * mz * wz) * iz), 0.0)
    bx, by, bz = (dx * t - lx) / wx, (dy * t - ly) / wy, (dz * t - lz) / wz
    if min(bx, min(by, bz)) < -EDGE or bx > mx + EDGE or by > my + EDGE or bz > mz + EDGE:
        return -1
    bx, by, bz = min(max(int(bx), 0), mx - 1), min(max(int(by), 0), my - 1), min(max(int(bz), 0), mz - 1)
    sx, sy, sz = 2 * ux - 1, 2 * uy - 1, 2 * uz - 1
    tx, ty, tz = (lx + (bx + ux) * wx) * ix, (ly + (by + uy) * wy) * iy, (lz + (bz + uz) * wz) * iz
    jx, jy, jz = wx * abs(ix), wy * abs(iy), wz * abs(iz)
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    part = np.float32(place - i)
    left = -math.log(_uniform(rng))
    seen[:] = 0
    n = 0
    while True:
        near = min(tx, min(ty, tz))
        block = (bz * my + by) * mx + bx
        if first[block + 1] > first[block]:
            n = _crossed(prims, first, listed, block, ray, t, pair, seen, hits, n)
        while t < near:
            m, until = _within(hits, n, t, near)
            if m > 0:
                _attenuations(mu, m, i, part, np.float32(1.0), found)
                rate = found[0] + found[1] + found[2]
            else:
                rate = most[kind[bz, by, bx], i]
            if rate * (until - t) < left:
                left -= rate * (until - t)
                t = until
                continue
            t += left / rate
            px, py, pz = x + dx * t, y + dy * t, z + dz * t
            if m == 0:
                m, relative = _label(code, slot, pool, density, grid, px, py, pz)
                _attenuations(mu, m, i, part, relative, found)
                if _uniform(rng) * rate >= found[0] + found[1] + found[2]:
                    left = -math.log(_uniform(rng))
                    continue
            ray[0], ray[1], ray[2] = px, py, pz
            return m
        if tx == near:
            bx += sx
            tx += jx
            if bx < 0 or bx >= mx:
                return -1
        elif ty == near:
            by += sy
            ty += jy
            if by < 0 or by >= my:
                return -1
        else:
            bz += sz
            tz += jz
            if bz < 0 or bz >= mz:
                return -1


@njit(cache=True, error_model="numpy", inline="always")
def _attenuations(mu, m, i, part, relative, found):
    for k in range(3):
        found[k] = (mu[m, i, k] + part * (mu[m, i + 1, k] - mu[m, i, k])) * relative


@njit(cache=True, error_model="numpy", inline="always")
def _turn(ray, cos, phi):
    """Turn the direction of a ray by a polar angle and an azimuth about itself."""
    sin = math.sqrt(max(0.0, 1.0 - cos * cos))
    a, b = sin * math.cos(phi), sin * math.sin(phi)
    dx, dy, dz = ray[3], ray[4], ray[5]
    # Duff et al. 2017: a frame about the direction without a singular pole
    sign = math.copysign(1.0, dz)
    c = -1.0 / (sign + dz)
    d = dx * dy * c
    x = a * (1.0 + sign * dx * dx * c) + b * d + cos * dx
    y = a * (sign * d) + b * (sign + dy * dy * c) + cos * dy
    z = a * (-sign * dx) + b * (-dy) + cos * dz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    ray[3], ray[4], ray[5] = x * scale, y * scale, z * scale


@njit(cache=True, error_model="numpy", inline="always")
def _bound(bound, m, q, per_q):
    place = min(q * per_q, bound.shape[1] - 1.001)
    i = int(place)
    return bound[m, i] + (place - i) * (bound[m, i + 1] - bound[m, i])


@njit(cache=True, error_model="numpy", inline="always")
def _compton(bound, m, energy, per_q, rng):
    """Draw a Compton collision by Klein–Nishina times the incoherent scattering function; return ε and cos θ."""
    alpha = energy / REST
    least = 1.0 / (1.0 + 2.0 * alpha)
    one, two = -math.log(least), 0.5 * (1.0 - least * least)
    while True:
        if _uniform(rng) * (one + two) < one:
            ratio = math.exp(-one * _uniform(rng))
        else:
            ratio = math.sqrt(least * least + (1.0 - least * least) * _uniform(rng))
        away = min((1.0 - ratio) / (ratio * alpha), 2.0)  # 1 − cos θ
        accept = 1.0 - ratio * away * (2.0 - away) / (1.0 + ratio * ratio)
        accept *= _bound(bound, m, energy / HC * math.sqrt(0.5 * away), per_q)
        if _uniform(rng) < accept:
            return ratio, 1.0 - away


@njit(cache=True, error_model="numpy", inline="always")
def _rayleigh(form, m, energy, per_q, rng):
    """Draw the cosine of a Rayleigh collision: q² by the squared form factor, then Thomson's law by rejection."""
    last = min(energy / HC * per_q, form.shape[1] - 1.001)
    n = int(last)
    span = (last * last - n * n) / (2.0 * n + 1.0)
    total = form[m, n] + span * (form[m, n + 1] - form[m, n])
    while True:
        wanted = _uniform(rng) * total
        low, high = 0, n + 1
        while high - low > 1:
            middle = (low + high) >> 1
            if form[m, middle] <= wanted:
                low = middle
            else:
                high = middle
        part = (wanted - form[m, low]) / max(form[m, low + 1] - form[m, low], 1e-300)
        squared = (low * low + part * (2.0 * low + 1.0)) / (last * last)  # sin²(θ/2)
        cos = 1.0 - 2.0 * min(squared, 1.0)
        if 2.0 * _uniform(rng) < 1.0 + cos * cos:
            return cos


@njit(cache=True, error_model="numpy", inline="always")
def _depth(volume, prims, mu, energy, ray, work):
    """Return the optical thickness from a ray's start to its end, `ray[6]` mm along it."""
    lengths, covered, painted, pieces, hits, pair = work
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    part = place - i
    n = walk(volume[0], volume[1], volume[2], volume[3], volume[4], ray, 0.0, ray[6], pieces)
    lengths[:] = 0.0
    t = 0.0
    for k in range(n):
        if pieces[k, 0] > t:
            lengths[int(pieces[k, 1])] += (pieces[k, 0] - t) * pieces[k, 2]
            t = pieces[k, 0]
    hit = 0
    for p in range(prims.shape[0]):
        for k in range(intersect(prims[p], ray[0], ray[1], ray[2], ray[3], ray[4], ray[5], pair)):
            enter, leave = max(pair[2 * k], 0.0), min(pair[2 * k + 1], ray[6])
            if leave > enter:
                hits[hit, 0], hits[hit, 1], hits[hit, 2] = enter, leave, prims[p, 1]
                hit += 1
    if hit > 0:
        _paint(hits, hit, pieces, n, covered, painted)
        for m in range(1, lengths.size):
            lengths[m] = max(lengths[m] - covered[m], 0.0) + painted[m]
    tau = 0.0
    for m in range(1, lengths.size):
        if lengths[m] > 0:
            low = mu[m, i, 0] + mu[m, i, 1] + mu[m, i, 2]
            high = mu[m, i + 1, 0] + mu[m, i + 1, 1] + mu[m, i + 1, 2]
            tau += (low + part * (high - low)) * lengths[m]
    return tau


@njit(cache=True, error_model="numpy", inline="always")
def _at(table, energy):
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    return table[i] + (place - i) * (table[i + 1] - table[i])


@njit(cache=True, error_model="numpy", inline="always")
def _score(images, order, v, u, share, signals, energy):
    """Add a scattered photon's share to the cell at (v, u) within 0 … 1."""
    rows, columns = images.shape[1:]
    j, i = min(int(v * rows), rows - 1), min(int(u * columns), columns - 1)
    images[SINGLE if order == 1 else MULTIPLE, j, i] += share * _at(signals[0], energy)
    images[SQUARED, j, i] += share * _at(signals[1], energy)


@njit(cache=True, error_model="numpy", inline="always")
def _aim(ray, way, x, y, z):
    """Set `way` to the ray from `ray`'s place to (x, y, z), and its length."""
    dx, dy, dz = x - ray[0], y - ray[1], z - ray[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    way[0], way[1], way[2] = ray[0], ray[1], ray[2]
    way[3], way[4], way[5], way[6] = dx / length, dy / length, dz / length, length


@njit(cache=True, error_model="numpy", inline="always")
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
def _force(volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images):
    """Score what a Compton collision sends to a random place of the detector, on average over all its outcomes."""
    mu, klein, bound, _, per_q = tables
    pose, extent, normal, signals, _, _ = beam
    u, v = _uniform(rng), _uniform(rng)
    a, b = (u - 0.5) * extent[1], (v - 0.5) * extent[0]
    _aim(
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
    whole = _at(klein[m], energy)
    law = ratio * ratio * (ratio + 1.0 / ratio - 1.0 + cos * cos)
    law *= _bound(bound, m, energy / HC * math.sqrt(max(0.5 * (1.0 - cos), 0.0)), per_q) / whole
    slant = abs(way[3] * normal[0] + way[4] * normal[1] + way[5] * normal[2])  # detector area times cos, in mm²
    share = law * slant / (way[6] * way[6])
    share *= _grid(beam, way, u, v)
    if share > 0:
        tau = _depth(volume, prims, mu, later, way, work)
        _score(images, order, v, u, share * math.exp(-tau) / COMPTON, signals, later)


@njit(cache=True, error_model="numpy", inline="always")
def _reach(volume, prims, tables, beam, energy, order, ray, way, work, images):
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
            tau = _depth(volume, prims, tables[0], energy, way, work)
            _score(images, order, v, u, share * math.exp(-tau), signals, energy)


@njit(cache=True, error_model="numpy", inline="always")
def _scatter_coherently(volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images):
    """Turn a photon by Rayleigh scatter, and score several of the ways that it may take."""
    _, _, _, form, per_q = tables
    n = RAYLEIGH if images.size > 0 else 1
    x, y, z = ray[3], ray[4], ray[5]
    for _ in range(n):  # the photon goes on the last of these ways
        ray[3], ray[4], ray[5] = x, y, z
        _turn(ray, _rayleigh(form, m, energy, per_q, rng), 2.0 * math.pi * _uniform(rng))
        if images.size > 0:
            _reach(volume, prims, tables, beam, energy, order, ray, way, work, images)


@njit(cache=True, error_model="numpy", inline="always")
def _history(volume, prims, blocks, tables, beam, regions, source, scratch, rng, images, deposit):
    """Follow one photon from the source until it is absorbed or leaves."""
    mu, _, bound, _, per_q = tables
    pose, extent, _, signals, nearest, _ = beam
    ray, way, found, seen, work = scratch
    cumulative, energies, gain, layer, stops = source
    wanted = _uniform(rng) * cumulative[-1]
    energy = energies[min(np.searchsorted(cumulative, wanted, side="right"), energies.size - 1)]
    ray[0], ray[1], ray[2] = pose[0], pose[1], pose[2]
    while True:
        a, b = (_uniform(rng) - 0.5) * extent[1], (_uniform(rng) - 0.5) * extent[0]
        x = pose[3] + a * pose[6] + b * pose[9]
        y = pose[4] + a * pose[7] + b * pose[10]
        z = pose[5] + a * pose[8] + b * pose[11]
        _aim(ray, way, x, y, z)
        # of a source that sends as many photons into every solid angle fewer reach a unit of area far off the middle
        if nearest <= 0 or _uniform(rng) < (nearest / way[6]) ** 3:
            break
    ray[3], ray[4], ray[5] = way[3], way[4], way[5]
    v, u = b / extent[0] + 0.5, a / extent[1] + 0.5
    if gain.size > 0 or layer.size > 0:
        j, i = min(int(v * extent[0]), int(extent[0]) - 1), min(int(u * extent[1]), int(extent[1]) - 1)
        passes = 1.0
        if gain.size > 0:
            passes = float(gain[j, i])
        if layer.size > 0:
            passes *= math.exp(-_at(stops, energy) * layer[j, i])
        if _uniform(rng) >= passes:
            return
    order = 0
    while True:
        m = _fly(volume, prims, blocks, mu, energy, ray, work[5], seen, work[4], rng, found)
        if m < 0:
            if order == 0 and images.size > 0:
                rows, columns = images.shape[1:]
                j, i = min(int(v * rows), rows - 1), min(int(u * columns), columns - 1)
                images[PRIMARY, j, i] += _at(signals[0], energy)
            return
        pick = _uniform(rng) * (found[0] + found[1] + found[2])
        where = -1
        if deposit.size > 0:
            where = _region(regions, volume[4], ray)
        if pick < found[0]:
            if where >= 0:
                deposit[where] += energy
            return
        order += 1
        if pick < found[0] + found[1]:
            if images.size > 0:
                for _ in range(COMPTON):
                    _force(volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images)
            ratio, cos = _compton(bound, m, energy, per_q, rng)
            if where >= 0:
                deposit[where] += energy * (1.0 - ratio)
            energy *= ratio
            _turn(ray, cos, 2.0 * math.pi * _uniform(rng))
        else:
            _scatter_coherently(volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images)
        if energy < CUT:
            if where >= 0:
                deposit[where] += energy
            return


@njit(cache=True, error_model="numpy", inline="always")
def _region(regions, grid, ray):
    i, j, k = (ray[0] - grid[6]) * grid[3], (ray[1] - grid[7]) * grid[4], (ray[2] - grid[8]) * grid[5]
    if 0 <= i < grid[0] and 0 <= j < grid[1] and 0 <= k < grid[2]:
        return np.int64(regions[int(k), int(j), int(i)])
    return 0


VOLUME = "Tuple((uint16[:,:,:,::1], int32[:,:,::1], uint8[::1], float32[::1], float64[::1]))"
BLOCKS = "Tuple((int64[:,:,::1], float32[:,::1], int64[::1], int64[::1], float64[::1]))"
TABLES = "Tuple((float32[:,:,::1], float32[:,::1], float32[:,::1], float64[:,::1], float64))"
BEAM = "Tuple((float64[::1], float64[::1], float64[::1], float64[:,::1], float64, float64))"
SOURCE = "Tuple((float64[::1], float64[::1], float32[:,::1], float32[:,::1], float64[::1]))"

SCRATCH = (  # of a chunk
    "Tuple((float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float32[::1], uint8[::1], uint64[::1]))"
)


@compiled_once(
    *(VOLUME, "float64[:,::1]", BLOCKS, TABLES, BEAM, "uint8[:,:,::1]", SOURCE, SCRATCH, "uint64"),
    *("int64", "int64", "float64[:,:,::1]", "float64[::1]"),
)
def _histories(volume, prims, blocks, tables, beam, regions, source, scratch, key, first, last, images, deposit):
    rays, lengths, pieces, hits, found, seen, rng = scratch
    work = lengths[0], lengths[1], lengths[2], pieces, hits, rays[2]
    parts = rays[0], rays[1], found, seen, work
    for history in range(first, last):
        _start(rng, key, np.uint64(history))
        _history(volume, prims, blocks, tables, beam, regions, source, parts, rng, images, deposit)


@njit(parallel=True, cache=True, error_model="numpy")
def _chunks(
    histories, volume, prims, blocks, tables, beam, regions, source, scratch, key, first, count, images, deposit
):  # fmt: skip
    rays, lengths, pieces, hits, found, seen, rng = scratch
    for chunk in prange(CHUNKS):
        start, stop = first + chunk * count // CHUNKS, first + (chunk + 1) * count // CHUNKS
        mine = rays[chunk], lengths[chunk], pieces[chunk], hits[chunk], found[chunk], seen[chunk], rng[chunk]
        _histories(
            histories, volume, prims, blocks, tables, beam, regions, source, mine, key, start, stop, images[chunk],
            deposit[chunk],
        )  # fmt: skip


def _scratch(n_materials, n_prims, grid):
    """Return memory for each chunk.

    It is made here, since Numba counts references, atomically, of arrays that compiled code made: they would take more
    than half of the time.
    """
    return (
        np.empty((CHUNKS, 3, 8)),
        np.empty((CHUNKS, 3, n_materials)),
        np.empty((CHUNKS, int(grid[:3].sum()) + 8, 3)),
        np.empty((CHUNKS, 2 * n_prims + 1, 4)),
        np.empty((CHUNKS, 3), np.float32),
        np.empty((CHUNKS, n_prims), np.uint8),
        np.empty((CHUNKS, 2), np.uint64),
    )


def transport(volume, prims, blocks, tables, beam, regions, source, key, first, count, images, deposit):
    """Follow histories first … first + count − 1 of the stream `key`, and add up what they leave.

    `volume` is (code, slot, pool, density, grid) of `ctsim.bricks.Bricks`; `prims` as in `ctsim.solids.pack`; `blocks`
    (kind, most, first, listed, frame) of `ctsim.montecarlo.world.Blocks`; `tables` (mu, klein, bound, form, 1/d_q);
    `beam` (pose, pixels (v, u), detector normal times area in mm², mean and mean squared signal by energy, distance of
    the source from the detector's plane, or 0 for as many photons on every unit of its area, ratio of the grid or 0);
    `regions` uint8 [z, y, x]; `source` (cumulative weights, energies, intensity of each pixel (at most 1), thickness in
    mm of a layer before each pixel, attenuation of that layer by energy; images float32 [v, u] or empty). `images`
    [chunk, plane, v, u] gets the signals, see SQUARED; `deposit` [chunk, region] the absorbed energy (keV). Either may
    be empty.
    """
    scratch = _scratch(tables[0].shape[0], prims.shape[0], volume[4])
    _chunks(
        _histories.address(), volume, prims, blocks, tables, beam, regions, source, scratch, key, first, count,
        images, deposit,
    )  # fmt: skip
