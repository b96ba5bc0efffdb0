"""The random numbers and the detector's read-out in plain Python, float64: the oracle of `noise_cpu`.

Images are [v, u]. The counters, the words' use and the formulas are stated there.
"""

import math

import numpy as np
from scipy.special import gammaln, ndtri

_MASK = 0xFFFFFFFF


def philox(c0, c1, c2, c3, k0, k1):
    """Return the four words of Philox4x32-10 (Salmon et al. 2011, doi:10.1145/2063384.2063405) as Python integers."""
    for _ in range(10):
        a, b = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (b >> 32) ^ c1 ^ k0, b & _MASK, (a >> 32) ^ c3 ^ k1, a & _MASK
        k0, k1 = (k0 + 0x9E3779B9) & _MASK, (k1 + 0xBB67AE85) & _MASK
    return c0, c1, c2, c3


def _block(key, index, draw):
    key, index = int(key), int(index)
    return philox(index & _MASK, index >> 32, int(draw), 0, key & _MASK, key >> 32)


def blocks(key, first, draw, out):
    """Fill `out` uint32 [n, 4] with draw number `draw` of the pixels first, first + 1 and on."""
    for i in range(len(out)):
        out[i] = _block(key, first + i, draw)


def normal(word):
    """Turn one 32-bit word into a standard normal number by the inverse distribution function."""
    return float(ndtri((int(word) + 0.5) / 2.0**32))


def log_poisson(k, mean):
    """Return log(mean^k·e^(−mean)/k!) by the plain formula."""
    return k * math.log(mean) - mean - float(gammaln(k + 1.0))


def _poisson(mean, index, key):
    """Draw one Poisson number: inversion below 10, else Hörmann's PTRS (doi:10.1016/0167-6687(93)90997-4)."""
    for draw in range(1000):
        w0, w1, w2, _ = _block(key, index, draw)
        u = ((w0 << 32 | w1) >> 11) / 2.0**53
        v = (w2 + 0.5) / 2.0**32
        if mean < 10:
            p, k = math.exp(-mean), 0
            while u >= p and k < 127:
                u -= p
                k += 1
                p *= mean / k
            return float(k)
        b = 0.931 + 2.53 * math.sqrt(mean)
        a = -0.059 + 0.02483 * b
        u -= 0.5 - 0.5 / 2.0**53
        us = 0.5 - abs(u)
        k = float(math.floor((2 * a / us + b) * u + mean + 0.43))
        if us >= 0.07 and v <= 0.9277 - 3.6224 / (b - 2):
            return k
        if k < 0 or (us < 0.013 and v > us):
            continue
        if math.log(v * (1.1239 + 1.1328 / (b - 3.4)) / (a / us**2 + b)) <= log_poisson(k, mean):
            return k
    raise RuntimeError("a thousand rejections in a row cannot happen")


def poisson(means, key, out):
    """Draw out[i] ~ Poisson(means[i]) for the pixels i of stream `key`; float64 [n] both."""
    for i, mean in enumerate(means):
        out[i] = _poisson(float(mean), i, key)


def _reading(signal, pattern, gauss, electronic, gain, dark, full):
    """Return what is written of a relative signal; `gauss` is a normal number."""
    factor = float(pattern[0]) * (1 + float(pattern[1]) * max(1 - signal, 0))
    value = dark
    if factor > 0:
        value += gain * (signal * factor + electronic * gauss)
    if full > 0:
        value = min(max(math.floor(value + 0.5), 0.0), full)
    return value


def detect(m1, m2, pattern, i0, electronic, gain, dark, full, key, out, bad):
    """Draw the counts of one view; see `noise_cpu.detect`."""
    bad[:] = 0
    for index, (v, u) in enumerate(np.ndindex(m1.shape)):
        mean, second = float(m1[v, u]), float(m2[v, u])
        photons = i0 * mean * (mean / second) if mean > 0 and second > 0 else 0.0
        signal = 0.0
        if 0 < photons <= 1e30:
            signal = _poisson(photons, index, key) * (second / (mean * i0))
        elif not (mean == 0 and 0 <= second < math.inf):
            bad[v] = 1
        gauss, own = normal(_block(key, index, 0)[3]), pattern[:, v, u] if pattern.size else (1.0, 0.0)
        out[v, u] = _reading(signal, own, gauss, electronic / i0, gain, dark, full)


def read_out(drawn, pattern, i0, electronic, gain, dark, full, key, out):
    """Write the counts of a signal that was drawn already; see `noise_cpu.read_out`."""
    for index, (v, u) in enumerate(np.ndindex(drawn.shape)):
        gauss, own = normal(_block(key, index, 0)[3]), pattern[:, v, u] if pattern.size else (1.0, 0.0)
        out[v, u] = _reading(float(drawn[v, u]) / i0, own, gauss, electronic / i0, gain, dark, full)


def detect_tigre(m1, top, i0, electronic, key, out):
    """Draw one view's photons as TIGRE's CTnoise does; see `noise_cpu.detect_tigre`."""
    for index, (v, u) in enumerate(np.ndindex(m1.shape)):
        p = -math.log(float(m1[v, u])) if m1[v, u] > 0 else math.inf
        photons = _poisson(i0 * math.exp(-p / top), index, key)
        photons = max(photons + electronic * normal(_block(key, index, 0)[3]), 1e-6)
        out[v, u] = i0 * math.exp(top * math.log(photons / i0))
