"""Readable reference for `solids_cpu`: surface candidates by textbook formulas, kept by an inside test.

Every place where a ray may cross the surface of a primitive is collected (extended precision, local
coordinates) and sorted; a stretch between neighbours belongs to the primitive if its middle does.
"""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.solids import BOUND, BOX, CAPSULE, ELLIPSOID, FRUSTUM, KIND, MATRIX, OFFSET, PARAMS

_Real = np.longdouble
_Vector = NDArray[Any]  # three extended-precision numbers


def intersect(
    prim: NDArray[np.float64],
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    out: NDArray[np.float64],
) -> int:
    """Intersect a ray with one primitive: pairs t0 < t1 (mm) to `out`; returns their number.

    The semantics are those of `solids_cpu.intersect`.
    """
    matrix, origin = np.asarray(prim[MATRIX], _Real).reshape(3, 3), np.array([ox, oy, oz], _Real)
    direction = np.array([dx, dy, dz], _Real)
    point, direction = matrix @ (origin - np.asarray(prim[BOUND][:3], _Real)), matrix @ direction
    # Any fixed shift along the ray serves; the middle keeps polynomial coefficients small.
    shift = -(point @ direction) / (direction @ direction)
    point = point + shift * direction
    times = sorted(t for t in _candidates(prim, point, direction) if np.isfinite(t))
    intervals: list[list[Any]] = []
    for t0, t1 in itertools.pairwise(times):
        if t1 > t0 and _inside_local(prim, point + (t0 + t1) / 2 * direction):
            if intervals and intervals[-1][1] == t0:
                intervals[-1][1] = t1
            else:
                intervals.append([t0, t1])
    for i, (t0, t1) in enumerate(intervals):
        out[2 * i : 2 * i + 2] = t0 + shift, t1 + shift
    return len(intervals)


def inside(prim: NDArray[np.float64], x: float, y: float, z: float) -> bool:
    """Tell whether the world point (mm) is in the primitive; its surface counts as inside."""
    return _inside_local(prim, prim[MATRIX].reshape(3, 3) @ np.array([x, y, z]) + prim[OFFSET])


def _inside_local(prim: NDArray[np.float64], p: _Vector) -> bool:
    kind, (a, b, c, _) = int(prim[KIND]), prim[PARAMS]
    rho = np.hypot(p[0], p[1])
    if kind == ELLIPSOID:
        return bool((p[0] / a) ** 2 + (p[1] / b) ** 2 + (p[2] / c) ** 2 <= 1)
    if kind == BOX:
        return bool(np.all(np.abs(p) <= [a, b, c]))
    if kind == FRUSTUM:
        return bool(abs(p[2]) <= a and rho <= b + (c - b) * (p[2] + a) / (2 * a))
    if kind == CAPSULE:
        return bool(np.hypot(rho, p[2] - np.clip(p[2], -a, a)) <= b)
    return bool(np.hypot(rho - a, p[2]) <= b)


def _candidates(prim: NDArray[np.float64], p: _Vector, e: _Vector) -> list[Any]:
    """All t at which the ray may cross the surface of the primitive."""
    kind, (a, b, c, _) = int(prim[KIND]), np.asarray(prim[PARAMS], _Real)
    if kind == ELLIPSOID:
        scale = 1 / np.array([a, b, c])
        return _sphere(p * scale, e * scale, _Real(1))
    if kind == BOX:
        return [t for axis, half in enumerate((a, b, c)) for t in _planes(p[axis], e[axis], half)]
    if kind == FRUSTUM:
        slope = (c - b) / (2 * a)
        g = (b + c) / 2 + slope * p[2]
        side = _quadratic(e[:2] @ e[:2] - (slope * e[2]) ** 2, p[:2] @ e[:2] - g * slope * e[2], p[:2] @ p[:2] - g * g)
        return side + _planes(p[2], e[2], a)
    if kind == CAPSULE:
        times = _quadratic(e[:2] @ e[:2], p[:2] @ e[:2], p[:2] @ p[:2] - b * b)
        for end in (-a, a):
            times += _sphere(p - np.array([0, 0, end], _Real), e, b)
        return times
    return _torus(p, e, a, b)


def _planes(p: Any, e: Any, half: Any) -> list[Any]:
    return [] if e == 0 else [(-half - p) / e, (half - p) / e]


def _sphere(p: _Vector, e: _Vector, radius: Any) -> list[Any]:
    return _quadratic(e @ e, p @ e, p @ p - radius * radius)


def _quadratic(a: Any, b: Any, c: Any) -> list[Any]:
    """Real roots of a·t² + 2b·t + c."""
    disc = b * b - a * c
    if disc < 0:
        return []
    q = -(b + np.copysign(np.sqrt(disc), b))
    return [x / y for x, y in ((q, a), (c, q)) if y != 0]


def _torus(p: _Vector, e: _Vector, major: Any, minor: Any) -> list[Any]:
    """Sign changes of the distance to the ring, found on a fine set of samples and bisected.

    The samples include the stationary points of the quartic (|q|² + R² − r²)² − 4R²·ρ², so that no
    short interval is missed.
    """
    k = np.array([e @ e, 2 * (p @ e), p @ p + major * major - minor * minor])
    ring = 4 * major * major * np.array([e[:2] @ e[:2], 2 * (p[:2] @ e[:2]), p[:2] @ p[:2]])
    quartic = np.polysub(np.polymul(k, k), ring)
    reach = 1.013 * (major + minor)  # beyond the bounding sphere, so that both ends are outside
    stationary = np.roots(np.polyder(quartic).astype(np.float64)).real
    samples = np.unique(np.concatenate([np.linspace(-reach, reach, 257), stationary]).astype(_Real))

    def outside(t: Any) -> Any:
        q = p + t * e
        return np.hypot(np.hypot(q[0], q[1]) - major, q[2]) > minor

    times = []
    state = [outside(t) for t in samples]
    for i in np.flatnonzero(np.diff(np.array(state, int))):
        low, high = samples[i], samples[i + 1]
        for _ in range(70):
            middle = (low + high) / 2
            low, high = (middle, high) if outside(middle) == state[i] else (low, middle)
        times.append((low + high) / 2)
    return times
