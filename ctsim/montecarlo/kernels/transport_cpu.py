"""Photons from the source until they are absorbed or leave, compiled.

A history's random numbers depend on its number alone, and histories are summed in `CHUNKS` fixed parts: results are
bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.laws_cpu import at, compton, start, turn, uniform
from ctsim.kernels.once import compiled_once
from ctsim.montecarlo.kernels.flight_cpu import VOLUME, depth, fly
from ctsim.montecarlo.kernels.scoring_cpu import COMPTON, CUT, PRIMARY, aim, force, scatter_coherently

CHUNKS = 64


@njit(cache=True, error_model="numpy", inline="always")
def _history(depths, volume, prims, blocks, tables, beam, regions, source, scratch, rng, images, deposit):
    """Follow one photon from the source until it is absorbed or leaves."""
    mu, _, bound, _, per_q = tables
    pose, extent, _, signals, nearest, _ = beam
    ray, way, found, seen, work = scratch
    cumulative, energies, gain, layer, stops = source
    wanted = uniform(rng) * cumulative[-1]
    energy = energies[min(np.searchsorted(cumulative, wanted, side="right"), energies.size - 1)]
    ray[0], ray[1], ray[2] = pose[0], pose[1], pose[2]
    while True:
        a, b = (uniform(rng) - 0.5) * extent[1], (uniform(rng) - 0.5) * extent[0]
        x = pose[3] + a * pose[6] + b * pose[9]
        y = pose[4] + a * pose[7] + b * pose[10]
        z = pose[5] + a * pose[8] + b * pose[11]
        aim(ray, way, x, y, z)
        # of a source that sends as many photons into every solid angle fewer reach a unit of area far off the middle
        if nearest <= 0 or uniform(rng) < (nearest / way[6]) ** 3:
            break
    ray[3], ray[4], ray[5] = way[3], way[4], way[5]
    v, u = b / extent[0] + 0.5, a / extent[1] + 0.5
    if gain.size > 0 or layer.size > 0:
        j, i = min(int(v * extent[0]), int(extent[0]) - 1), min(int(u * extent[1]), int(extent[1]) - 1)
        passes = 1.0
        if gain.size > 0:
            passes = float(gain[j, i])
        if layer.size > 0:
            passes *= math.exp(-at(stops, energy) * layer[j, i])
        if uniform(rng) >= passes:
            return
    order = 0
    while True:
        m = fly(volume, prims, blocks, mu, energy, ray, work[5], seen, work[4], rng, found)
        if m < 0:
            if order == 0 and images.size > 0:
                rows, columns = images.shape[1:]
                j, i = min(int(v * rows), rows - 1), min(int(u * columns), columns - 1)
                images[PRIMARY, j, i] += at(signals[0], energy)
            return
        pick = uniform(rng) * (found[0] + found[1] + found[2])
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
                    force(depths, volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images)
            ratio, cos = compton(bound, m, energy, per_q, rng)
            if where >= 0:
                deposit[where] += energy * (1.0 - ratio)
            energy *= ratio
            turn(ray, cos, 2.0 * math.pi * uniform(rng))
        else:
            scatter_coherently(depths, volume, prims, tables, beam, m, energy, order, ray, way, work, rng, images)
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


BLOCKS = "Tuple((int64[:,:,::1], float32[:,::1], int64[::1], int64[::1], float64[::1]))"
TABLES = "Tuple((float32[:,:,::1], float32[:,::1], float32[:,::1], float64[:,::1], float64))"
BEAM = "Tuple((float64[::1], float64[::1], float64[::1], float64[:,::1], float64, float64))"
SOURCE = "Tuple((float64[::1], float64[::1], float32[:,::1], float32[:,::1], float64[::1]))"

SCRATCH = (  # of a chunk
    "Tuple((float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float32[::1], uint8[::1], uint64[::1]))"
)


@compiled_once(
    *("int64", VOLUME, "float64[:,::1]", BLOCKS, TABLES, BEAM, "uint8[:,:,::1]", SOURCE, SCRATCH, "uint64"),
    *("int64", "int64", "float64[:,:,::1]", "float64[::1]"),
)
def _histories(
    depths, volume, prims, blocks, tables, beam, regions, source, scratch, key, first, last, images, deposit
):
    rays, lengths, pieces, hits, found, seen, rng = scratch
    work = lengths[0], lengths[1], lengths[2], pieces, hits, rays[2]
    parts = rays[0], rays[1], found, seen, work
    for history in range(first, last):
        start(rng, key, np.uint64(history))
        _history(depths, volume, prims, blocks, tables, beam, regions, source, parts, rng, images, deposit)


@njit(parallel=True, cache=True, error_model="numpy")
def _chunks(
    histories, depths, volume, prims, blocks, tables, beam, regions, source, scratch, key, first, count, images,
    deposit,
):  # fmt: skip
    rays, lengths, pieces, hits, found, seen, rng = scratch
    for chunk in prange(CHUNKS):
        begin, stop = first + chunk * count // CHUNKS, first + (chunk + 1) * count // CHUNKS
        mine = rays[chunk], lengths[chunk], pieces[chunk], hits[chunk], found[chunk], seen[chunk], rng[chunk]
        _histories(
            histories, depths, volume, prims, blocks, tables, beam, regions, source, mine, key, begin, stop,
            images[chunk], deposit[chunk],
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

    `volume` is (code, slot, pool, density, grid) of `ctsim.tracer.bricks.Bricks`; `prims` as in `ctsim.solids.pack`;
    `blocks` (kind, most, first, listed, frame) of `ctsim.montecarlo.world.Blocks`; `tables` (mu, klein, bound, form,
    1/d_q); `beam` (pose, pixels (v, u), detector normal times area in mm², mean and mean squared signal by energy,
    distance of the source from the detector's plane, or 0 for as many photons on every unit of its area, ratio of the
    grid or 0); `regions` uint8 [z, y, x]; `source` (cumulative weights, energies, intensity of each pixel (at most 1),
    thickness in mm of a layer before each pixel, attenuation of that layer by energy; images float32 [v, u] or empty).
    `images` [chunk, plane, v, u] gets the signals, see SQUARED; `deposit` [chunk, region] the absorbed energy (keV).
    Either may be empty.
    """
    scratch = _scratch(tables[0].shape[0], prims.shape[0], volume[4])
    _chunks(
        _histories.address(), depth.address(), volume, prims, blocks, tables, beam, regions, source, scratch, key,
        first, count, images, deposit,
    )  # fmt: skip
