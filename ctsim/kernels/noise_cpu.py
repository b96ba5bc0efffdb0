"""Counter-based random numbers and the detector's read-out, compiled.

Images are [v, u]. A pixel's random words depend on the stream's key and on the pixel's own number only, so
nothing changes with the number of threads, the order, or what other pixels see. Draw n of pixel i is the
block philox((i low, i high, n, 0), key); its words 0 and 1 make one uniform number, word 2 another; word 3 of
draw 0 is the pixel's Gaussian number.

A row of pixels is drawn at once, in loops without branches, of which LLVM does several pixels at a time. What they
leave undecided, the functions of one number decide (`normal`, `accepts`); both give the same numbers.
"""

import math

import numpy as np
from numba import njit, prange

from ctsim.kernels.log64_cpu import log

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
# Normal numbers of probabilities this near to a half have a formula of their own.
_CENTRE = 0.425
# Fewer than this many counts are no matter for Stirling's series.
_FEW = 10.0
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


@njit(cache=True, inline="always")
def _central(q):
    r = 0.180625 - q * q
    top = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
    return q * top / (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0)


@njit(cache=True)
def normal(word):
    """Turn one 32-bit word into a standard normal number by the inverse distribution function.

    Wichura 1988, AS 241 (doi:10.2307/2347330), the 7-digit variant; |result| <= 6.3, so its far tail is never met.
    """
    q = (float(word) + 0.5) * _TWO_M32 - 0.5
    if abs(q) <= _CENTRE:
        return _central(q)
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


@njit(cache=True, inline="always")
def _shape(mean):
    """Return b, a and the bound of the quick test of Hörmann's transformed rejection."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    return b, -0.059 + 0.02483 * b, 0.9277 - 3.6224 / (b - 2.0)


@njit(cache=True, inline="always")
def _pair(w01, w2):
    """Return the two uniform numbers of a draw, the first from −½ to ½, the second from 0 to 1."""
    return np.float64(w01 >> _11) * _TWO_M53 - (0.5 - 0.5 * _TWO_M53), (np.float64(w2) + 0.5) * _TWO_M32


@njit(cache=True)
def accepts(k, mean, us, v):
    """Say whether Hörmann's rejection takes k, which has missed the quick test.

    `us` is ½ less the magnitude of the first uniform number of `_pair`, `v` is the second.
    """
    b, a, _ = _shape(mean)
    if k < 0.0 or (us < 0.013 and v > us):
        return False
    return math.log(v * (1.1239 + 1.1328 / (b - 3.4)) / (a / (us * us) + b)) <= log_poisson(k, mean)


@njit(cache=True)
def _row_words(key, first, words):
    """Fill `words` [3, n] with words 0 and 1, word 2 and word 3 of draw 0 of the pixels first, first + 1 and on."""
    k0, k1 = key & _LOW, key >> _32
    for u in range(words.shape[1]):
        index = first + np.uint64(u)
        w0, w1, w2, w3 = philox(index & _LOW, index >> _32, np.uint64(0), np.uint64(0), k0, k1)
        words[0, u] = (w0 << _32) | w1
        words[1, u] = w2
        words[2, u] = w3


@njit(cache=True, error_model="numpy")
def _next_words(key, first, todo, draw, words):
    """Fill words[:2] with those of draw number `draw` of the pixels first + todo[i]."""
    k0, k1, draw = key & _LOW, key >> _32, np.uint64(draw)
    for i in range(todo.size):
        index = first + np.uint64(todo[i])
        w0, w1, w2, _ = philox(index & _LOW, index >> _32, draw, np.uint64(0), k0, k1)
        words[0, i] = (w0 << _32) | w1
        words[1, i] = w2


@njit(cache=True, error_model="numpy")
def judge(means, words, counts, verdicts):
    """Fill `counts` [n] with the number of each draw and `verdicts` [n] with 1 if it is taken, 0 if not, 2 in doubt.

    `means` [n] are 10 or more, `words` uint64 [2, n] are as in `_row_words`.
    `accepts` compares log(v/α…) with log_poisson(k, mean). Here both sides have half of log(mean) more, which leaves
    two logarithms. Beyond the margin, far above the error of `log` and of the sums, the comparison is the same.
    """
    for i in range(means.size):
        mean = means[i]
        b, a, quick = _shape(mean)
        u, v = _pair(words[0, i], words[1, i])
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + mean + 0.43)
        x = v * (1.1239 + 1.1328 / (b - 3.4)) / (a / (us * us) + b)
        some = max(k, _FEW)
        inverse = 1.0 / some
        ratio = log(some / mean)
        tail = inverse * (1 / 12.0 - inverse * inverse * (1 / 360.0 - inverse * inverse / 1260.0))
        left = 0.5 * log(x * x * mean)
        right = some - mean - some * ratio - tail - _HALF_LOG_2PI - 0.5 * ratio
        margin = 1e-7 + 1e-12 * mean
        verdict = 2
        verdict = 1 if left < right - margin else verdict
        verdict = 0 if left > right + margin else verdict
        verdict = 2 if k < _FEW else verdict
        verdict = 0 if (k < 0.0) | ((us < 0.013) & (v > us)) else verdict
        verdict = 1 if (us >= 0.07) & (v <= quick) else verdict
        counts[i] = k
        verdicts[i] = verdict


@njit(cache=True, error_model="numpy")
def _row_poisson(photons, words, first, key, drawn, room):
    """Draw a Poisson number for each mean of a row; `room` is that of `_room`.

    Inversion below 10, else transformed rejection (PTRS; Hörmann 1993, doi:10.1016/0167-6687(93)90997-4), whose first
    test takes a third (mean 10) to four fifths of the draws without a logarithm.
    """
    numbers, others, marks, todo = room
    left = marks[: photons.size]
    for u in range(photons.size):
        mean = photons[u]
        b, a, quick = _shape(mean)
        x, v = _pair(words[0, u], words[1, u])
        us = 0.5 - abs(x)
        drawn[u] = np.floor((2.0 * a / us + b) * x + mean + 0.43)
        left[u] = not ((mean >= _SMALL) & (us >= 0.07) & (v <= quick))
    n = 0
    for u in range(photons.size):
        todo[n] = u
        n += left[u]
    draw, kept = 0, 0
    for i in range(n):
        u = todo[i]
        if photons[u] < _SMALL:
            drawn[u] = _poisson_small(photons[u], float(words[0, u] >> _11) * _TWO_M53)
        else:
            others[0, kept], others[1, kept] = words[0, u], words[1, u]
            todo[kept] = u
            kept += 1
    while kept > 0:
        n = kept
        for i in range(n):
            numbers[0, i] = photons[todo[i]]
        if draw > 0:
            _next_words(key, first, todo[:n], draw, others)
        judge(numbers[0, :n], others, numbers[1], marks)
        kept = 0
        for i in range(n):
            u = todo[i]
            if marks[i] == 2:
                x, v = _pair(others[0, i], others[1, i])
                marks[i] = accepts(numbers[1, i], numbers[0, i], 0.5 - abs(x), v)
            drawn[u] = numbers[1, i]
            todo[kept] = u
            kept += 1 - marks[i]
        draw += 1


@njit(cache=True)
def _room(n):
    """Return what `_row_poisson` and `_row_normal` work in, for n pixels."""
    return np.empty((2, n)), np.empty((2, n), np.uint64), np.empty(n, np.int64), np.empty(n, np.int64)


@njit(cache=True)
def poisson(means, key, out):
    """Draw out[i] ~ Poisson(means[i]) for the pixels i of stream `key`; float64 [n] both."""
    key, words = np.uint64(key), np.empty((3, means.size), np.uint64)
    _row_words(key, np.uint64(0), words)
    _row_poisson(means, words, np.uint64(0), key, out, _room(means.size))


@njit(cache=True, error_model="numpy")
def _row_normal(words, normals, room):
    """Turn each word into a standard normal number, the one of `normal`; `room` is that of `_room`."""
    todo, n = room[3], 0
    for u in range(words.size):
        normals[u] = _central((np.float64(words[u]) + 0.5) * _TWO_M32 - 0.5)
    for u in range(words.size):
        todo[n] = u
        n += abs((np.float64(words[u]) + 0.5) * _TWO_M32 - 0.5) > _CENTRE
    for i in range(n):
        normals[todo[i]] = normal(words[todo[i]])


@njit(cache=True, error_model="numpy")
def _row_photons(m1, m2, i0, photons):
    """Fill `photons` with the means of the Poisson numbers; say whether a moment is impossible."""
    wrong = False
    for u in range(photons.size):
        mean, second = np.float64(m1[u]), np.float64(m2[u])
        lit = i0 * mean * (m1[u] / m2[u])  # a quotient of float32 stays one, as always
        seen = (mean > 0.0) & (second > 0.0) & (lit > 0.0) & (lit <= _MOST)
        wrong |= not (seen | ((mean == 0.0) & (second >= 0.0) & (second < np.inf)))
        photons[u] = lit if seen else 0.0
    return wrong


@njit(cache=True, error_model="numpy")
def _row_signals(m1, m2, i0, photons, signals):
    """Turn the photons drawn, in `signals`, into relative signals."""
    for u in range(signals.size):
        of_one = np.float64(m2[u]) / (np.float64(m1[u]) * i0)
        signals[u] = signals[u] * of_one if photons[u] > 0.0 else 0.0


@njit(cache=True, inline="always")
def _reading(signal, p0, p1, noisy, electrons, gain, dark, full):
    """Return what is written of a relative signal and of the electronic noise, if there is any."""
    factor = p0 * (1.0 + p1 * max(1.0 - signal, 0.0))
    value = gain * (signal * factor + electrons) if noisy else gain * signal * factor
    value = dark + value if factor > 0.0 else dark
    return min(max(np.floor(value + 0.5), 0.0), full) if full > 0.0 else value


@njit(cache=True, error_model="numpy")
def _row_readings(signals, pattern, v, begin, electronic, normals, gain, dark, full, out):
    """Write the counts of row v from column `begin` on."""
    noisy = electronic > 0.0
    if pattern.size > 0:
        for u in range(signals.size):
            p0, p1 = np.float64(pattern[0, v, begin + u]), np.float64(pattern[1, v, begin + u])
            out[u] = _reading(signals[u], p0, p1, noisy, electronic * normals[u], gain, dark, full)
    else:
        for u in range(signals.size):
            out[u] = _reading(signals[u], 1.0, 0.0, noisy, electronic * normals[u], gain, dark, full)


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
    for v in prange(n_v):
        begin, end = spans[v, 0], spans[v, 1]
        n, first = end - begin, np.uint64(v) * np.uint64(n_u) + np.uint64(begin)
        words, room = np.empty((3, n), np.uint64), _room(n)
        photons, signals, normals = np.empty(n), np.empty(n), np.zeros(n)
        mean, second = m1[v, begin:end], m2[v, begin:end]
        _row_words(key, first, words)
        bad[v] = _row_photons(mean, second, i0, photons)
        _row_poisson(photons, words, first, key, signals, room)
        _row_signals(mean, second, i0, photons, signals)
        if electronic > 0.0:
            _row_normal(words[2], normals, room)
        _row_readings(signals, pattern, v, begin, electronic / i0, normals, gain, dark, full, out[v, begin:end])


@njit(parallel=True, cache=True)
def read_out(drawn, pattern, i0, electronic, gain, dark, full, key, out):
    """Write the counts of a signal [v, u] that was drawn already, in photons; arguments as in `detect`."""
    n_v, n_u = drawn.shape
    key = np.uint64(key)
    for v in prange(n_v):
        signals, normals = np.empty(n_u), np.zeros(n_u)
        for u in range(n_u):
            signals[u] = np.float64(drawn[v, u]) / i0
        if electronic > 0.0:
            words = np.empty((3, n_u), np.uint64)
            _row_words(key, np.uint64(v) * np.uint64(n_u), words)
            _row_normal(words[2], normals, _room(n_u))
        _row_readings(signals, pattern, v, 0, electronic / i0, normals, gain, dark, full, out[v])


@njit(parallel=True, cache=True)
def detect_tigre(m1, top, i0, electronic, key, out):
    """Draw one view's photons as TIGRE's CTnoise does, with p = −log m1 normalised by `top` before the draw.

    counts = Poisson(i0·exp(−p/top)) + electronic·Gaussian, not below 1e-6; out = i0·(counts/i0)^top, finite.
    """
    n_v, n_u = m1.shape
    key = np.uint64(key)
    for v in prange(n_v):
        words, room = np.empty((3, n_u), np.uint64), _room(n_u)
        means, drawn, normals = np.empty(n_u), np.empty(n_u), np.empty(n_u)
        first = np.uint64(v) * np.uint64(n_u)
        _row_words(key, first, words)
        for u in range(n_u):
            means[u] = i0 * float(m1[v, u]) ** (1.0 / top)
        _row_poisson(means, words, first, key, drawn, room)
        _row_normal(words[2], normals, room)
        for u in range(n_u):
            k = max(drawn[u] + electronic * normals[u], 1e-6)
            out[v, u] = min(i0 * (k / i0) ** top, _FLOAT32_MAX)
