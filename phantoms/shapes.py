"""Analytic solids by name: each function returns one `ctsim.solids.Solid`, in world x, y, z and mm."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid, Vector

_ORIGIN: Vector = (0.0, 0.0, 0.0)
_UP: Vector = (0.0, 0.0, 1.0)


def sphere(name: str, material: str, radius: float, *, centre: Vector = _ORIGIN, metal: bool = True) -> Solid:
    """Return a ball."""
    return ellipsoid(name, material, (radius, radius, radius), centre=centre, metal=metal)


def ellipsoid(
    name: str, material: str, radii: Vector, *, centre: Vector = _ORIGIN, axis: Vector = _UP, metal: bool = True
) -> Solid:
    """Return an ellipsoid with semi-axes `radii`, the third along `axis`."""
    _positive(name, radii=radii)
    return _one(name, material, Primitive(kind=ELLIPSOID, centre=centre, params=tuple(radii), axis=axis), metal)


def cylinder(
    name: str,
    material: str,
    size: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a cylinder of `size` = (radius, length)."""
    _positive(name, size=size)
    radius, length = size
    return cone(name, material, (radius, radius, length), centre=centre, axis=axis, metal=metal)


def capsule(
    name: str,
    material: str,
    size: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a rod with round ends of `size` = (radius, length over all); length ≥ 2·radius."""
    _positive(name, size=size)
    radius, length = size
    if length < 2 * radius:
        raise InputError(f"solid {name!r}: a capsule is at least 2·radius = {2 * radius} mm long, got {length}")
    params = (length / 2 - radius, radius)
    return _one(name, material, Primitive(kind=CAPSULE, centre=centre, params=params, axis=axis), metal)


def cone(
    name: str, material: str, size: Vector, *, centre: Vector = _ORIGIN, axis: Vector = _UP, metal: bool = True
) -> Solid:
    """Return a (truncated) cone of `size` = (radius at the low end, radius at the high end, length).

    `centre` is the middle of the axis, which runs from the low to the high end; one radius may be 0.
    """
    low, high, length = size
    _positive(name, length=(length,), widest=(max(low, high),))
    params = (length / 2, low, high)
    return _one(name, material, Primitive(kind=FRUSTUM, centre=centre, params=params, axis=axis), metal)


def box(
    name: str,
    material: str,
    edges: Vector,
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    spin: float = 0.0,
    metal: bool = True,
) -> Solid:
    """Return a box with full `edges`, the third along `axis`, turned about it by `spin` (radians)."""
    _positive(name, edges=edges)
    half = tuple(edge / 2 for edge in edges)
    return _one(name, material, Primitive(kind=BOX, centre=centre, params=half, axis=axis, spin=spin), metal)


def torus(
    name: str,
    material: str,
    radii: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a ring about `axis` with `radii` = (major, minor), major > minor."""
    _positive(name, radii=radii)
    if radii[0] <= radii[1]:
        raise InputError(f"solid {name!r}: a torus needs major > minor radius, got {tuple(radii)}")
    return _one(name, material, Primitive(kind=TORUS, centre=centre, params=tuple(radii), axis=axis), metal)


def wire(name: str, material: str, points: Sequence[Vector] | NDArray[np.float64], radius: float) -> Solid:
    """Return a metal wire through `points` [k ≥ 2, 3]: a chain of capsules, so its ends and joints are round."""
    at = np.asarray(points, np.float64)
    if at.ndim != 2 or at.shape[0] < 2 or at.shape[1] != 3:
        raise InputError(f"solid {name!r}: points must be [k >= 2, 3], got shape {at.shape}")
    _positive(name, radius=(radius,))
    lengths = np.linalg.norm(np.diff(at, axis=0), axis=1)
    if not np.all(lengths > 0):
        raise InputError(f"solid {name!r}: consecutive points must be finite and differ")
    pieces = [
        Primitive(kind=CAPSULE, centre=_triple((p + q) / 2), params=(float(length) / 2, radius), axis=_triple(q - p))
        for p, q, length in zip(at[:-1], at[1:], lengths, strict=True)
    ]
    return Solid(name=name, material=material, primitives=tuple(pieces), metal=True)


def helix(
    name: str,
    material: str,
    size: tuple[float, float, float, float],
    turns: float,
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    sagitta: float = 0.01,
) -> Solid:
    """Return a metal coil of `size` = (coil radius at the low end, at the high end, wire radius, length).

    The wire is a chain of capsules whose joints lie on the helix and whose middles are at most
    `sagitta` mm inside it; `length` is between its ends. It turns counter-clockwise as it rises along `axis`.
    """
    low, high, radius, length = size
    _positive(name, size=(low, high, radius), turns=(turns,), sagitta=(sagitta,))
    if not (math.isfinite(length) and length >= 0):
        raise InputError(f"solid {name!r}: length must be finite and not negative, got {length}")
    # A chord over the angle 2h stands coil·(1 − cos h) inside the arc.
    step = 2 * math.acos(max(1 - sagitta / max(low, high), 0.5))
    n = max(math.ceil(2 * math.pi * turns / step), 2)
    if n > 100_000:
        raise InputError(f"solid {name!r}: sagitta {sagitta} mm needs {n} pieces; at most 100000 are allowed")
    angle, coil = np.linspace(0, 2 * math.pi * turns, n + 1), np.linspace(low, high, n + 1)
    local = np.stack([coil * np.cos(angle), coil * np.sin(angle), np.linspace(-0.5, 0.5, n + 1) * length], 1)
    frame = Primitive(kind=BOX, centre=centre, params=(1.0, 1.0, 1.0), axis=axis).rotation()
    return wire(name, material, local @ frame + np.asarray(centre), radius)


def screw(
    name: str,
    material: str,
    diameters: Vector,
    lengths: Vector,
    *,
    taper: float = 1.0,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
) -> Solid:
    """Return a metal screw whose head begins at `centre` and whose shank runs along `axis`.

    `diameters` are (head, outer, core), `lengths` (head, shank, pitch). The V thread is a stack of
    coaxial rings with no lead: two frusta a turn, core to outer to core, in the whole number of turns
    nearest to the pitch. It narrows evenly to the share `taper` of its diameters at the tip, 0 for a point.
    """
    _positive(name, diameters=diameters, lengths=lengths)
    head, outer, core = (d / 2 for d in diameters)
    length, shank, pitch = lengths
    if not core < outer <= head:
        raise InputError(f"solid {name!r}: expected core < outer <= head diameter, got {tuple(diameters)}")
    if not shank >= pitch >= 1e-4 * shank:
        raise InputError(f"solid {name!r}: the shank must hold 1 to 10000 pitches of {pitch} mm, got {shank} mm")
    if not 0 <= taper <= 1:
        raise InputError(f"solid {name!r}: taper must be within [0, 1], got {taper}")
    at = np.linspace(0, 1, 2 * round(shank / pitch) + 1)
    radii = np.where(np.arange(at.size) % 2, outer, core) * (1 - (1 - taper) * at)
    thread = zip((length + shank * at).tolist(), radii.tolist(), strict=True)
    pieces = _turned([(0.0, head), (length, head), *thread], centre, axis)
    return Solid(name=name, material=material, primitives=pieces, metal=True)


def rivet(
    name: str,
    material: str,
    diameters: Vector,
    lengths: Vector,
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
) -> Solid:
    """Return a metal rivet, set at both ends, whose shank begins at `centre` and runs along `axis`.

    `diameters` are (head, shank, tail), `lengths` (head, shank, tail). Head and tail are ellipsoids about
    the shank's ends that stand out by their length; their inner halves surround the shank.
    """
    _positive(name, diameters=diameters, lengths=lengths)
    head, r, tail = (d / 2 for d in diameters)
    if min(head, tail) <= r:
        raise InputError(f"solid {name!r}: head and tail must be wider than the shank, got {tuple(diameters)}")
    shank = _turned([(0.0, r), (lengths[1], r)], centre, axis)
    end = _along(centre, axis, lengths[1])
    bulges = ((centre, (head, head, lengths[0])), (end, (tail, tail, lengths[2])))
    pieces = [Primitive(kind=ELLIPSOID, centre=at, params=radii, axis=axis) for at, radii in bulges]
    return Solid(name=name, material=material, primitives=(*pieces, *shank), metal=True)


def dome(name: str, material: str, radius: float, *, centre: Vector = _ORIGIN, axis: Vector = _UP) -> Solid:
    """Return a metal half ball of `radius` about `centre`, round towards `axis`.

    It is a stack of 16 frusta with their edges on the sphere, at most 0.12 % of the radius inside it.
    """
    _positive(name, radius=(radius,))
    turn = np.linspace(0, math.pi / 2, 17)
    profile = zip((radius * np.sin(turn)).tolist(), (radius * np.cos(turn)).tolist(), strict=True)
    return Solid(name=name, material=material, primitives=_turned(list(profile), centre, axis), metal=True)


def pin(
    name: str,
    material: str,
    diameters: tuple[float, float],
    lengths: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
) -> Solid:
    """Return a metal pin with a ball head about `centre` and a point; its shank begins there.

    `diameters` are (head, shank), `lengths` (shank, point) along `axis`.
    """
    _positive(name, diameters=diameters, lengths=lengths)
    head, r = (d / 2 for d in diameters)
    if head <= r:
        raise InputError(f"solid {name!r}: the head must be wider than the shank, got {tuple(diameters)}")
    shank = _turned([(0.0, r), (lengths[0], r), (sum(lengths), 0.0)], centre, axis)
    ball = Primitive(kind=ELLIPSOID, centre=centre, params=(head, head, head))
    return Solid(name=name, material=material, primitives=(ball, *shank), metal=True)


def _turned(profile: Sequence[tuple[float, float]], base: Vector, axis: Vector) -> tuple[Primitive, ...]:
    """Return frusta between neighbours of `profile`: (height along the axis from `base`, radius)."""
    return tuple(
        Primitive(
            kind=FRUSTUM, centre=_along(base, axis, (low + high) / 2), params=((high - low) / 2, r0, r1), axis=axis
        )
        for (low, r0), (high, r1) in itertools.pairwise(profile)
        if high > low
    )


def _along(base: Vector, axis: Vector, height: float) -> Vector:
    norm = math.hypot(*axis)
    if not (math.isfinite(norm) and norm > 0):
        raise InputError(f"a solid's axis must be finite and not the zero vector, got {tuple(axis)}")
    return _triple(np.asarray(base) + height / norm * np.asarray(axis))


def _one(name: str, material: str, primitive: Primitive, metal: bool) -> Solid:
    return Solid(name=name, material=material, primitives=(primitive,), metal=metal)


def _triple(at: NDArray[np.float64]) -> Vector:
    x, y, z = (float(c) for c in at)
    return x, y, z


def _positive(name: str, **sizes: Sequence[float]) -> None:
    for what, values in sizes.items():
        if not all(math.isfinite(v) and v > 0 for v in values):
            raise InputError(f"solid {name!r}: {what} must be finite and positive (mm), got {tuple(values)}")
