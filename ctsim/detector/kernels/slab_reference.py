"""One photon after the other through a slab, in plain Python: the oracle of `slab_cpu`, whose numbers it draws."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ctsim.kernels.noise_reference import philox

CUT = 1.0  # keV
REST, HC = 510.998950, 12.3984198  # keV, keV·Å
_MASK = 0xFFFFFFFFFFFFFFFF
Uniform = Callable[[], float]


def stream(key: int, history: int) -> Uniform:
    """Return a history's random numbers: xoroshiro128+ (Blackman and Vigna 2018), begun by one Philox block."""
    low = 0xFFFFFFFF
    w = philox(history & low, history >> 32, 0, 1, key & low, key >> 32)
    state = [w[0] << 32 | w[1], w[2] << 32 | w[3] | 1]

    def turned(word: int, by: int) -> int:
        return (word << by | word >> (64 - by)) & _MASK

    def uniform() -> float:
        s0, s1 = state
        s1 ^= s0
        word = (s0 + state[1]) & _MASK
        state[:] = [turned(s0, 24) ^ s1 ^ (s1 << 16) & _MASK, turned(s1, 37)]
        return ((word >> 12) + 0.5) / 2.0**52

    return uniform


def compton(bound: NDArray, q: NDArray, energy: float, uniform: Uniform) -> tuple[float, float]:
    """Draw a Compton collision: the share of the energy that the photon keeps, and cos θ (Butcher and Messel 1960)."""
    least = 1 / (1 + 2 * energy / REST)
    one, two = -math.log(least), (1 - least**2) / 2
    while True:
        if uniform() * (one + two) < one:
            ratio = least ** uniform()
        else:
            ratio = math.sqrt(least**2 + (1 - least**2) * uniform())
        cos = max(1 - (1 / ratio - 1) * REST / energy, -1.0)
        accept = 1 - ratio * (1 - cos**2) / (1 + ratio**2)
        if uniform() < accept * np.interp(energy / HC * math.sqrt((1 - cos) / 2), q, bound):
            return ratio, cos


def rayleigh(form: NDArray, q: NDArray, energy: float, uniform: Uniform) -> float:
    """Draw the cosine of a Rayleigh collision by the squared form factor times (1 + cos²θ)/2."""
    last = (energy / HC) ** 2
    total = np.interp(last, q**2, form)
    while True:
        cos = 1 - 2 * np.interp(uniform() * total, form, q**2) / last
        if uniform() < (1 + cos**2) / 2:
            return float(cos)


def deposit(tables, thickness: float, energy: float, share: float, uniform: Uniform) -> tuple[float, float, float, int]:
    """Return the deposit, the energies that leave by the front and by the back, and 1 for a photon without collision.

    The arguments are those of `slab_cpu.slab`.
    """
    energies, rates, first, lines, bound, form, most = tables
    q = most * np.linspace(0, 1, bound.size) ** 2
    shells = first.size - 1
    left, front, back = 0.0, 0.0, 0.0
    waiting: list[tuple[float, float, float]] = []  # depth, cosine, energy

    def at(e: float) -> NDArray[np.float64]:
        return np.array([np.interp(e, energies, column) for column in rates.T])

    def collide(depth: float, along: float, e: float) -> float:
        sums = at(e)
        kind = int(np.searchsorted(sums[:-1], uniform() * sums[-1], side="right"))
        if kind < shells:
            return e - relax(depth, kind)
        if kind == shells:
            return e
        ratio, cos = compton(bound, q, e, uniform) if kind == shells + 1 else (1.0, rayleigh(form, q, e, uniform))
        if e * ratio < CUT:
            return e
        azimuth = 2 * math.pi * uniform()
        turned = along * cos + math.sqrt(1 - along**2) * math.sqrt(1 - cos**2) * math.cos(azimuth)
        waiting.append((depth, turned, e * ratio))
        return e * (1 - ratio)

    def relax(depth: float, shell: int) -> float:
        emitted = 0.0
        while shell >= 0:
            steps = lines[first[shell] : first[shell + 1]]
            chosen = int(np.searchsorted(steps[:, 0], uniform(), side="right"))
            if chosen == len(steps):
                break
            _, line, shell_after = steps[chosen]
            if line >= CUT:
                waiting.append((depth, 2 * uniform() - 1, line))
                emitted += line
            shell = int(shell_after)
        return emitted

    depth = -math.log(1 - share * uniform()) / at(energy)[-1]
    if depth >= thickness:
        return 0.0, 0.0, 0.0, 1
    left += collide(depth, 1.0, energy)
    while waiting:
        depth, along, e = waiting.pop()
        depth -= along * math.log(uniform()) / at(e)[-1]
        if depth < 0:
            front += e
        elif depth >= thickness:
            back += e
        else:
            left += collide(depth, along, e)
    return left, front, back, 0


def slab(tables, thickness, energy, share, key, count, out):
    """Follow `count` photons one by one and add to `out` [chunk, tally]; see `slab_cpu.slab`."""
    chunks = len(out)
    for chunk in range(chunks):
        for history in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            left, front, back, passed = deposit(tables, thickness, energy, share, stream(int(key), history))
            out[chunk] += [left > 0, left, left**2, front, back, passed]
