"""L1 and SSIM of two images with their gradient, in two sweeps over rows (numba).

The first blurs the images, their squares and their product with SSIM's window, and leaves per pixel what SSIM changes
by with the three blurs that hold x. The window is even, so that the blur is its own transpose, and the second sweep
blurs these. Images [v, u] are C-contiguous and of one type, float32 or float64; outside them all is zero.
"""

import numpy as np
from numba import njit, prange

RADIUS, SIGMA = 5, 1.5  # of the window, in pixels
TAPS = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
TAPS = TAPS / TAPS.sum()
CHUNKS = 16  # of rows, one a task
FAST = {"contract", "reassoc", "nsz"}


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _add(weight, a, row):
    for u in range(a.size):
        row[u] += weight * a[u]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_product(weight, a, b, row):
    for u in range(a.size):
        row[u] += weight * a[u] * b[u]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _along(wide, taps, out):
    """Blur a row that has RADIUS zeros on both sides."""
    t0, t1, t2, t3, t4, t5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for u in range(out.size):
        inner = t5 * wide[u + 5] + t4 * (wide[u + 4] + wide[u + 6]) + t3 * (wide[u + 3] + wide[u + 7])
        outer = t1 * (wide[u + 1] + wide[u + 9]) + t0 * (wide[u] + wide[u + 10])
        out[u] = inner + t2 * (wide[u + 2] + wide[u + 8]) + outer


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _similarity(means, moments, constants, parts, ssim):
    """Write SSIM of a row [u] and its derivatives by the blurs of x, x² and x·y into `parts` [3, u].

    No loop writes more than two arrays: with three, LLVM gives up proving them distinct and does not vectorise.
    """
    mean_x, mean_y = means
    square_x, square_y, product = moments
    c1, c2, two = constants  # numbers of the images' type: with a literal all would be float64
    by_mean, by_variance, by_covariance = parts[0], parts[1], parts[2]
    for u in range(mean_x.size):
        x, y = mean_x[u], mean_y[u]
        b1, b2 = x * x + y * y + c1, (square_x[u] - x * x) + (square_y[u] - y * y) + c2
        a1, a2 = two * x * y + c1, two * (product[u] - x * y) + c2
        by_covariance[u] = two * a1 / (b1 * b2)
        ssim[u] = a1 * a2 / (b1 * b2)
    for u in range(mean_x.size):
        x, y = mean_x[u], mean_y[u]
        b1, b2 = x * x + y * y + c1, (square_x[u] - x * x) + (square_y[u] - y * y) + c2
        a2 = two * (product[u] - x * y) + c2
        variance = -ssim[u] / b2
        by_variance[u] = variance
        by_mean[u] = two * (y * a2 / (b1 * b2) - x * (ssim[u] / b1 + variance)) - y * by_covariance[u]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _sum(row):
    total = 0.0
    for u in range(row.size):
        total += row[u]
    return total


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _first_rows(images, rows, taps, constants, parts, sums):
    x, y = images
    n_v, n_u = x.shape
    wide = np.zeros((5, n_u + 2 * RADIUS), x.dtype)
    blurred, ssim = np.empty((5, n_u), x.dtype), np.empty(n_u, x.dtype)
    for v in range(rows[0], rows[1]):
        wide[:] = 0
        for k in range(max(0, RADIUS - v), min(2 * RADIUS + 1, n_v + RADIUS - v)):
            a, b = x[v + k - RADIUS], y[v + k - RADIUS]
            inner = wide[:, RADIUS : RADIUS + n_u]
            _add(taps[k], a, inner[0])
            _add(taps[k], b, inner[1])
            _add_product(taps[k], a, a, inner[2])
            _add_product(taps[k], b, b, inner[3])
            _add_product(taps[k], a, b, inner[4])
        for q in range(5):
            _along(wide[q], taps, blurred[q])
        means, moments = (blurred[0], blurred[1]), (blurred[2], blurred[3], blurred[4])
        _similarity(means, moments, constants, parts[v], ssim)
        sums[v] = _sum(ssim)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _combine(x, y, blurred, weights, out):
    """Write weights[0]·sign(x − y) + weights[1]·dSSIM/dx of a row; return Σ |x − y|."""
    by_l1, by_ssim = weights
    total = 0.0
    for u in range(x.size):
        difference = x[u] - y[u]
        total += abs(difference)
        by_similarity = blurred[0, u] + (x[u] + x[u]) * blurred[1, u] + y[u] * blurred[2, u]
        sign = by_l1 if difference > 0 else (-by_l1 if difference < 0 else difference)
        out[u] = sign + by_ssim * by_similarity
    return total


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _second_rows(images, rows, taps, weights, parts, out, sums):
    x, y = images
    n_v, n_u = x.shape
    wide = np.zeros((3, n_u + 2 * RADIUS), x.dtype)
    blurred = np.empty((3, n_u), x.dtype)
    for v in range(rows[0], rows[1]):
        wide[:] = 0
        for k in range(max(0, RADIUS - v), min(2 * RADIUS + 1, n_v + RADIUS - v)):
            for q in range(3):
                _add(taps[k], parts[v + k - RADIUS, q], wide[q, RADIUS : RADIUS + n_u])
        for q in range(3):
            _along(wide[q], taps, blurred[q])
        sums[v] = _combine(x[v], y[v], blurred, weights, out[v])


@njit(cache=True, error_model="numpy", parallel=True)
def l1_ssim(x, y, taps, constants, weights, parts, out, sums):
    """Write weights[0]·sign(x − y) + weights[1]·d(Σ SSIM)/dx into `out` [v, u].

    `sums` float64 [2, v] gets Σ |x − y| and Σ SSIM of each row; `parts` [v, 3, u] is scratch; `taps` and the tuples
    constants, (C1, C2, 2), and weights are of the images' type.
    """
    n_v = x.shape[0]
    for c in prange(CHUNKS):
        _first_rows((x, y), (c * n_v // CHUNKS, (c + 1) * n_v // CHUNKS), taps, constants, parts, sums[1])
    for c in prange(CHUNKS):
        _second_rows((x, y), (c * n_v // CHUNKS, (c + 1) * n_v // CHUNKS), taps, weights, parts, out, sums[0])
