"""Photons in a homogeneous slab: what they leave in it, compiled.

A photon hits the slab head-on at depth 0. It is followed with all that it sets free, K and L fluorescence included,
until everything is absorbed or outside; electrons stop where they are made. A history's random numbers depend on its
number alone, and histories are summed in `CHUNKS` fixed parts: results are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.laws_cpu import HC, REST, start, uniform

CHUNKS = 64
CUT = 1.0  # keV; a photon below it stays where it is
DEPTH = 32  # photons that wait at once: an event sets at most two free, with less energy each
HIT, DEPOSIT, SQUARE, FRONT, BACK, PASSED = range(6)


@njit(cache=True, error_model="numpy")
def _place(energies, energy):
    """Return the cell of the energy grid that an energy lies in, and where in it."""
    i = min(max(np.searchsorted(energies, energy, side="right") - 1, 0), energies.size - 2)
    return i, (energy - energies[i]) / (energies[i + 1] - energies[i])


@njit(cache=True, error_model="numpy")
def _between(table, i, part, k):
    return table[i, k] + part * (table[i + 1, k] - table[i, k])


@njit(cache=True, error_model="numpy")
def _bound(bound, most, q):
    """Return the incoherent scattering function at q; its nodes are most·(i/n)²."""
    n = bound.size - 1
    i = min(int(math.sqrt(q / most) * n), n - 1)
    low, high = most * (i / n) ** 2, most * ((i + 1) / n) ** 2
    return bound[i] + (q - low) / (high - low) * (bound[i + 1] - bound[i])


@njit(cache=True, error_model="numpy")
def _compton(bound, most, energy, rng):
    """Draw a Compton collision by Klein–Nishina times the incoherent scattering function; return ε and cos θ."""
    alpha = energy / REST
    least = 1.0 / (1.0 + 2.0 * alpha)
    one, two = -math.log(least), 0.5 * (1.0 - least * least)
    while True:
        if uniform(rng) * (one + two) < one:
            ratio = math.exp(-one * uniform(rng))
        else:
            ratio = math.sqrt(least * least + (1.0 - least * least) * uniform(rng))
        away = min((1.0 - ratio) / (ratio * alpha), 2.0)  # 1 − cos θ
        accept = 1.0 - ratio * away * (2.0 - away) / (1.0 + ratio * ratio)
        accept *= _bound(bound, most, energy / HC * math.sqrt(0.5 * away))
        if uniform(rng) < accept:
            return ratio, 1.0 - away


@njit(cache=True, error_model="numpy")
def _rayleigh(form, most, energy, rng):
    """Draw the cosine of a Rayleigh collision: q² by the squared form factor, then Thomson's law by rejection."""
    n = form.size - 1
    last = energy / HC  # q at 180°
    i = min(int(math.sqrt(last / most) * n), n - 1)
    low, high = (most * (i / n) ** 2) ** 2, (most * ((i + 1) / n) ** 2) ** 2
    total = form[i] + (last * last - low) / (high - low) * (form[i + 1] - form[i])
    while True:
        wanted = uniform(rng) * total
        i = min(max(np.searchsorted(form, wanted, side="right") - 1, 0), n - 1)
        low, high = (most * (i / n) ** 2) ** 2, (most * ((i + 1) / n) ** 2) ** 2
        squared = low + (wanted - form[i]) / (form[i + 1] - form[i]) * (high - low)
        cos = 1.0 - 2.0 * min(squared / (last * last), 1.0)
        if 2.0 * uniform(rng) < 1.0 + cos * cos:
            return cos


@njit(cache=True, error_model="numpy")
def _turn(along, cos, rng):
    """Return the cosine to the slab's normal after a turn by cos θ about a random azimuth."""
    sine = math.sqrt(max(0.0, (1.0 - along * along) * (1.0 - cos * cos)))
    return min(max(along * cos + sine * math.cos(2.0 * math.pi * uniform(rng)), -1.0), 1.0)


@njit(cache=True, error_model="numpy")
def _relax(first, lines, shell, depth, stack, waiting, rng):
    """Fill a vacancy, and those that this makes, and let the photons wait; return their number and energy."""
    emitted = 0.0
    while shell >= 0:
        wanted = uniform(rng)
        step = first[shell]
        while step < first[shell + 1] and lines[step, 0] <= wanted:
            step += 1
        if step == first[shell + 1]:  # an Auger electron
            break
        if lines[step, 1] >= CUT:
            stack[waiting, 0], stack[waiting, 1] = depth, 2.0 * uniform(rng) - 1.0
            stack[waiting, 2] = lines[step, 1]
            emitted += lines[step, 1]
            waiting += 1
        shell = int(lines[step, 2])
    return waiting, emitted


@njit(cache=True, error_model="numpy")
def _collide(tables, at, stack, waiting, rng):
    """Let a photon (depth, cosine, energy, cell, part) interact; return how many wait and the energy left behind."""
    _, rates, first, lines, bound, form, most = tables
    depth, along, energy, i, part = at
    shells, last = first.size - 1, rates.shape[1] - 1
    wanted = uniform(rng) * _between(rates, i, part, last)
    kind = 0
    while kind < last and _between(rates, i, part, kind) <= wanted:
        kind += 1
    if kind < shells:
        waiting, emitted = _relax(first, lines, kind, depth, stack, waiting, rng)
        return waiting, energy - emitted
    if kind == shells:  # an outer electron: no fluorescence above CUT
        return waiting, energy
    if kind == shells + 1:
        ratio, cos = _compton(bound, most, energy, rng)
        later = energy * ratio
        if later < CUT:
            return waiting, energy
    else:
        later, cos = energy, _rayleigh(form, most, energy, rng)
    stack[waiting, 0], stack[waiting, 1], stack[waiting, 2] = depth, _turn(along, cos, rng), later
    return waiting + 1, energy - later


@njit(cache=True, error_model="numpy")
def _history(tables, thickness, energy, share, stack, rng, out):
    """Follow one photon and what it sets free."""
    energies, rates = tables[0], tables[1]
    last = rates.shape[1] - 1
    i, part = _place(energies, energy)
    depth = -math.log(1.0 - share * uniform(rng)) / _between(rates, i, part, last)
    if depth >= thickness:
        out[PASSED] += 1.0
        return
    waiting, deposit = _collide(tables, (depth, 1.0, energy, i, part), stack, 0, rng)
    while waiting > 0:
        waiting -= 1
        depth, along, e = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2]
        i, part = _place(energies, e)
        depth -= along * math.log(uniform(rng)) / _between(rates, i, part, last)
        if depth < 0.0:
            out[FRONT] += e
        elif depth >= thickness:
            out[BACK] += e
        else:
            waiting, left = _collide(tables, (depth, along, e, i, part), stack, waiting, rng)
            deposit += left
    if deposit > 0.0:
        out[HIT] += 1.0
    out[DEPOSIT] += deposit
    out[SQUARE] += deposit * deposit


@njit(parallel=True, cache=True, error_model="numpy")
def _chunks(tables, photon, key, count, scratch, out):
    thickness, energy, share = photon
    stack, rng = scratch
    for chunk in prange(CHUNKS):
        for history in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            start(rng[chunk], key, np.uint64(history))
            _history(tables, thickness, energy, share, stack[chunk], rng[chunk], out[chunk])


def slab(tables, thickness, energy, share, key, count, out):
    """Follow `count` photons of `energy` keV into a slab of `thickness` mm and add to `out` float64 [chunk, tally].

    `tables` is `ctsim.detector.slab.Slab`. `share` is the share of the first free paths that may be drawn: 1 for
    photons as they are, 1 − exp(−μt) for photons that all collide, whose tallies count that much less. The tallies:
    photons that deposited energy, deposits (keV), squared deposits, energy that left by the front and by the back
    after a collision, and photons that passed without one.
    """
    # memory is made here: Numba counts references to arrays that compiled code makes, atomically
    scratch = np.empty((CHUNKS, DEPTH, 3)), np.empty((CHUNKS, 2), np.uint64)
    _chunks(tuple(tables), (float(thickness), float(energy), float(share)), np.uint64(key), count, scratch, out)
