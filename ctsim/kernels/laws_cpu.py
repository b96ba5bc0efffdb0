"""Random numbers of a history, and how a photon scatters, compiled."""

import math

import numpy as np
from numba import njit

from ctsim.kernels.noise_cpu import philox

E_MIN, PER_STEP = 1.0, 10.0  # as in `ctsim.montecarlo.tables`: keV, energy steps per keV
REST, HC = 510.998950, 12.3984198  # keV, keV·Å
_LOW, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)


@njit(cache=True, error_model="numpy")
def start(rng, key, history):
    """Begin a history's own stream: xoroshiro128+ (Blackman and Vigna 2018) from one Philox block."""
    w0, w1, w2, w3 = philox(history & _LOW, history >> _32, np.uint64(0), np.uint64(1), key & _LOW, key >> _32)
    rng[0], rng[1] = (w0 << _32) | w1, (w2 << _32) | w3 | np.uint64(1)  # all zeros would stay so


@njit(cache=True, error_model="numpy")
def uniform(rng):
    """Return a random number within (0, 1)."""
    s0, s1 = rng[0], rng[1]
    word = s0 + s1
    s1 ^= s0
    rng[0] = ((s0 << np.uint64(24)) | (s0 >> np.uint64(40))) ^ s1 ^ (s1 << np.uint64(16))
    rng[1] = (s1 << np.uint64(37)) | (s1 >> np.uint64(27))
    return (float(word >> np.uint64(12)) + 0.5) * 2.0**-52


@njit(cache=True, error_model="numpy")
def turn(ray, cos, phi):
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


@njit(cache=True, error_model="numpy")
def at(table, energy):
    """Return a table by energy at one energy."""
    place = (energy - E_MIN) * PER_STEP
    i = int(place)
    return table[i] + (place - i) * (table[i + 1] - table[i])


@njit(cache=True, error_model="numpy")
def bounded(bound, m, q, per_q):
    """Return the incoherent scattering function of a material, per electron."""
    place = min(q * per_q, bound.shape[1] - 1.001)
    i = int(place)
    return bound[m, i] + (place - i) * (bound[m, i + 1] - bound[m, i])


@njit(cache=True, error_model="numpy", inline="always")
def compton(bound, m, energy, per_q, rng):
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
        accept *= bounded(bound, m, energy / HC * math.sqrt(0.5 * away), per_q)
        if uniform(rng) < accept:
            return ratio, 1.0 - away


@njit(cache=True, error_model="numpy", inline="always")
def rayleigh(form, m, energy, per_q, rng):
    """Draw the cosine of a Rayleigh collision: q² by the squared form factor, then Thomson's law by rejection."""
    last = min(energy / HC * per_q, form.shape[1] - 1.001)
    n = int(last)
    span = (last * last - n * n) / (2.0 * n + 1.0)
    total = form[m, n] + span * (form[m, n + 1] - form[m, n])
    while True:
        wanted = uniform(rng) * total
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
        if 2.0 * uniform(rng) < 1.0 + cos * cos:
            return cos
