"""Counter-based random numbers and the detector's read-out, compiled.

Images are [v, u]. A pixel's random words depend on the stream's key and on the pixel's own number only, so
nothing changes with the number of threads, the order, or what other pixels see. Draw n of pixel i is the
block philox((i low, i high, n, 0), key); its words 0 and 1 make one uniform number, word 2 another; word 3 of
draw 0 is the pixel's Gaussian number.
"""

import math

import numpy as np
from numba import njit, prange

_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_11 = np.uint64(11)
_TWO_M53, _TWO_M32 = 2.0**-53, 2.0**-32
_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
# Below this mean inversion is used; the transformed rejection needs at least 10.
_SMALL = 10.0
# Up to here k·log(mean) − mean − log k! loses less than 1e-12, and a table is faster than Stirling's series.
_TABLE = 1024
# A mean above this is a mistake (m2 far below m1², say), not a signal.
_MOST = 1e30
_FLOAT32_MAX = float(np.finfo(np.float32).max)
_LOG_FACTORIAL = np.array([math.lgamma(k + 1.0) for k in range(_TABLE)])
_RECIPROCAL = np.array([0.0] + [1.0 / k for k in range(1, 128)])


@njit(cache=True, inline="always")
def philox(c0, c1, c2, c3, k0, k1):
    """Return the four 32-bit words, as uint64, of Philox4x32-10 (Salmon et al. 2011, doi:10.1145/2063384.2063405)."""
    for _ in range(10):
        a = _M0 * c0
        b = _M1 * c2
        c0 = (b >> _32) ^ c1 ^ k0
        c2 = (a >> _32) ^ c3 ^ k1
        c1 = b & _LOW
        c3 = a & _LOW
        k0 = (k0 + _W0) & _LOW
        k1 = (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@njit(cache=True)
def blocks(key, first, draw, out):
    """Fill `out` uint32 [n, 4] with draw number `draw` of the pixels first, first + 1 and on."""
    key = np.uint64(key)
    for i in range(out.shape[0]):
        index = np.uint64(first + i)
        w0, w1, w2, w3 = philox(
            index & _LOW, index >> _32, np.uint64(draw) & _LOW, np.uint64(0), key & _LOW, key >> _32
        )
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = w0, w1, w2, w3


@njit(cache=True)
def normal(word):
    """Turn one 32-bit word into a standard normal number by the inverse distribution function.

    Wichura 1988, AS 241 (doi:10.2307/2347330), the 7-digit variant; |result| <= 6.3, so its far tail is never met.
    """
    q = (float(word) + 0.5) * _TWO_M32 - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
        return q * top / (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0)
    r = math.sqrt(-math.log(0.5 - abs(q))) - 1.6
    top = ((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777
    return math.copysign(top / ((0.12021132975 * r + 0.73700164250) * r + 1.0), q)


@njit(cache=True)
def log_poisson(k, mean):
    """Return log(mean^k·e^(−mean)/k!) to about 1e-12 even at means of 1e12, where the plain formula loses 1e-2.

    Stirling's series for k!, and k·log(k/mean) + mean − k by the series of log((1+v)/(1−v)) near k = mean.
    """
    if k < _TABLE:
        return k * math.log(mean) - mean - _LOG_FACTORIAL[int(k)]
    v = (k - mean) / (k + mean)
    if abs(v) < 0.1:
        deviance = (k - mean) * v
        term = 2.0 * k * v
        for j in range(1, 20):
            term *= v * v
            step = term * _RECIPROCAL[2 * j + 1]
            deviance += step
            if abs(step) <= 1e-17 * deviance:
                break
    else:
        deviance = k * math.log(k / mean) + mean - k
    tail = (1 / 12.0 - (1 / 360.0 - (1 / 1260.0 - 1 / (1680.0 * k * k)) / (k * k)) / (k * k)) / k
    return -deviance - tail - _HALF_LOG_2PI - 0.5 * math.log(k)


@njit(cache=True)
def _poisson_small(mean, u):
    p = math.exp(-mean)
    k = 0
    while u >= p and k < 127:
        u -= p
        k += 1
        p *= mean * _RECIPROCAL[k]
    return float(k)


@njit(cache=True)
def _poisson_retry(mean, b, a, v_quick, u, v, index, key):
    """Finish Hörmann's rejection from a first pair (u, v) that missed the quick test."""
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    draw = 0
    while True:
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= v_quick:
            return k
        if (
            k >= 0.0
            and not (us < 0.013 and v > us)
            and math.log(v * inverse_alpha / (a / (us * us) + b)) <= log_poisson(k, mean)
        ):
            return k
        draw += 1
        w0, w1, w2, _ = philox(index & _LOW, index >> _32, np.uint64(draw), np.uint64(0), key & _LOW, key >> _32)
        u = float(((w0 << _32) | w1) >> _11) * _TWO_M53 - (0.5 - 0.5 * _TWO_M53)
        v = (float(w2) + 0.5) * _TWO_M32


@njit(cache=True, inline="always")
def _poisson(mean, w0, w1, w2, index, key):
    """Draw a Poisson number: inversion below 10, else transformed rejection (PTRS).

    Hörmann 1993, doi:10.1016/0167-6687(93)90997-4. About 9 of 10 draws end here, without a logarithm.
    """
    u = float(((w0 << _32) | w1) >> _11) * _TWO_M53
    if mean < _SMALL:
        return _poisson_small(mean, u)
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    u -= 0.5 - 0.5 * _TWO_M53
    v = (float(w2) + 0.5) * _TWO_M32
    us = 0.5 - abs(u)
    v_quick = 0.9277 - 3.6224 / (b - 2.0)
    if us >= 0.07 and v <= v_quick:
        return np.floor((2.0 * a / us + b) * u + mean + 0.43)
    return _poisson_retry(mean, b, a, v_quick, u, v, index, key)


@njit(cache=True)
def poisson(means, key, out):
    """Draw out[i] ~ Poisson(means[i]) for the pixels i of stream `key`; float64 [n] both."""
    key = np.uint64(key)
    for i in range(means.size):
        index = np.uint64(i)
        w0, w1, w2, _ = philox(index & _LOW, index >> _32, np.uint64(0), np.uint64(0), key & _LOW, key >> _32)
        out[i] = _poisson(means[i], w0, w1, w2, index, key)


@njit(cache=True)
def _row_words(key, first, words):
    k0, k1 = key & _LOW, key >> _32
    for u in range(words.shape[1]):
        index = first + np.uint64(u)
        w0, w1, w2, w3 = philox(index & _LOW, index >> _32, np.uint64(0), np.uint64(0), k0, k1)
        words[0, u] = (w0 << _32) | w1
        words[1, u] = (w2 << _32) | w3


@njit(cache=True, inline="always")
def _reading(signal, p0, p1, word, electronic, gain, dark, full):
    """Return what is written of a relative signal; `word` holds the random bits of the electronic noise."""
    value = dark
    factor = p0 * (1.0 + p1 * max(1.0 - signal, 0.0))
    if factor > 0.0:
        if electronic > 0.0:
            value += gain * (signal * factor + electronic * normal(word & _LOW))
        else:
            value += gain * signal * factor
    if full > 0.0:
        value = min(max(np.floor(value + 0.5), 0.0), full)
    return value


@njit(parallel=True, cache=True)
def detect(m1, m2, pattern, spans, i0, electronic, gain, dark, full, key, out, bad):
    """Draw the counts of one view in columns spans[v] = (from, to) of its rows.

    `m1`, `m2` [v, u] are mean and second moment relative to the open field; `pattern` float32 [2, v, u] multiplies the
    photons' signal s by p0·(1 + p1·(1 − s)), with s at most 1 in it (size 0: by one everywhere; a pixel with p0 = 0 is
    dead and reads `dark`). out = dark + gain·signal, rounded and clipped to 0..full where full > 0. bad[v] becomes 1 in
    rows with an impossible moment.
    """
    n_v, n_u = m1.shape
    key = np.uint64(key)
    electronic = electronic / i0
    for v in prange(n_v):
        begin, end = spans[v, 0], spans[v, 1]
        words = np.empty((2, end - begin), np.uint64)
        first = np.uint64(v) * np.uint64(n_u)
        _row_words(key, first + np.uint64(begin), words)
        wrong = False
        for u in range(begin, end):
            mean = float(m1[v, u])
            second = float(m2[v, u])
            signal = 0.0
            photons = 0.0
            if mean > 0.0 and second > 0.0:
                photons = i0 * mean * (mean / second)
            if 0.0 < photons <= _MOST:
                hi, lo = words[0, u - begin], words[1, u - begin]
                k = _poisson(photons, hi >> _32, hi & _LOW, lo >> _32, first + np.uint64(u), key)
                signal = k * (second / (mean * i0))
            elif not (mean == 0.0 and 0.0 <= second < np.inf):
                wrong = True
            p0, p1 = 1.0, 0.0
            if pattern.size > 0:
                p0, p1 = float(pattern[0, v, u]), float(pattern[1, v, u])
            out[v, u] = _reading(signal, p0, p1, words[1, u - begin], electronic, gain, dark, full)
        bad[v] = wrong


@njit(parallel=True, cache=True)
def read_out(drawn, pattern, i0, electronic, gain, dark, full, key, out):
    """Write the counts of a signal [v, u] that was drawn already, in photons; arguments as in `detect`."""
    n_v, n_u = drawn.shape
    key = np.uint64(key)
    electronic = electronic / i0
    for v in prange(n_v):
        words = np.empty((2, n_u), np.uint64)
        _row_words(key, np.uint64(v) * np.uint64(n_u), words)
        for u in range(n_u):
            p0, p1 = 1.0, 0.0
            if pattern.size > 0:
                p0, p1 = float(pattern[0, v, u]), float(pattern[1, v, u])
            out[v, u] = _reading(float(drawn[v, u]) / i0, p0, p1, words[1, u], electronic, gain, dark, full)


@njit(parallel=True, cache=True)
def detect_tigre(m1, top, i0, electronic, key, out):
    """Draw one view's photons as TIGRE's CTnoise does, with p = −log m1 normalised by `top` before the draw.

    counts = Poisson(i0·exp(−p/top)) + electronic·Gaussian, not below 1e-6; out = i0·(counts/i0)^top, finite.
    """
    n_v, n_u = m1.shape
    key = np.uint64(key)
    for v in prange(n_v):
        words = np.empty((2, n_u), np.uint64)
        first = np.uint64(v) * np.uint64(n_u)
        _row_words(key, first, words)
        for u in range(n_u):
            mean = i0 * float(m1[v, u]) ** (1.0 / top)
            hi, lo = words[0, u], words[1, u]
            k = _poisson(mean, hi >> _32, hi & _LOW, lo >> _32, first + np.uint64(u), key)
            k = max(k + electronic * normal(lo & _LOW), 1e-6)
            out[v, u] = min(i0 * (k / i0) ** top, _FLOAT32_MAX)
