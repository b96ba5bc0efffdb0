"""Analytic solids by name: each function returns one `ctsim.solids.Solid`, in world x, y, z and mm."""

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


def wire(
    name: str, material: str, points: Sequence[Vector] | NDArray[np.float64], radius: float, *, metal: bool = True
) -> Solid:
    """Return a wire through `points` [k ≥ 2, 3]: a chain of capsules, so its ends and joints are round."""
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
    return Solid(name=name, material=material, primitives=tuple(pieces), metal=metal)


def helix(
    name: str,
    material: str,
    size: Vector,
    turns: float,
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    sagitta: float = 0.01,
) -> Solid:
    """Return a metal coil of `size` = (coil radius, wire radius, length between the wire's ends).

    The wire is a chain of capsules whose joints lie on the helix and whose middles are at most
    `sagitta` mm inside it. It turns counter-clockwise as it rises along `axis`.
    """
    coil, radius, length = size
    _positive(name, size=(coil, radius), turns=(turns,), sagitta=(sagitta,))
    if not (math.isfinite(length) and length >= 0):
        raise InputError(f"solid {name!r}: length must be finite and not negative, got {length}")
    # A chord over the angle 2h stands coil·(1 − cos h) inside the arc.
    step = 2 * math.acos(max(1 - sagitta / coil, 0.5))
    n = max(math.ceil(2 * math.pi * turns / step), 2)
    if n > 100_000:
        raise InputError(f"solid {name!r}: sagitta {sagitta} mm needs {n} pieces; at most 100000 are allowed")
    angle = np.linspace(0, 2 * math.pi * turns, n + 1)
    local = np.stack([coil * np.cos(angle), coil * np.sin(angle), np.linspace(-0.5, 0.5, n + 1) * length], 1)
    frame = Primitive(kind=BOX, centre=centre, params=(1.0, 1.0, 1.0), axis=axis).rotation()
    return wire(name, material, local @ frame + np.asarray(centre), radius)


def screw(
    name: str,
    material: str,
    diameters: Vector,
    lengths: Vector,
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a screw whose head begins at `centre` and whose shank runs along `axis`.

    `diameters` are (head, outer, core), `lengths` (head, shank, pitch). The V thread is a stack of
    coaxial rings with no lead: two frusta a pitch, core to outer to core, over whole pitches from the
    head on; the rest of the shank is a cone from the core to a point.
    """
    _positive(name, diameters=diameters, lengths=lengths)
    head, outer, core = (d / 2 for d in diameters)
    head_length, shank, pitch = lengths
    if not core < outer <= head:
        raise InputError(f"solid {name!r}: expected core < outer <= head diameter, got {tuple(diameters)}")
    if shank < pitch:
        raise InputError(f"solid {name!r}: the shank must hold one pitch of {pitch} mm, got {shank}")
    turns = int(shank / pitch * (1 + 1e-12))
    profile = [(0.0, head_length, head, head)]
    for k in range(turns):
        start = head_length + k * pitch
        profile += [(start, start + pitch / 2, core, outer), (start + pitch / 2, start + pitch, outer, core)]
    end, tip = head_length + turns * pitch, head_length + shank
    if tip - end > 1e-9 * shank:
        profile.append((end, tip, core, 0.0))
    return Solid(name=name, material=material, primitives=_stack(profile, centre, axis), metal=metal)


def rivet(
    name: str,
    material: str,
    diameters: tuple[float, float],
    lengths: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a round-head rivet whose shank begins at `centre` and runs along `axis`.

    `diameters` are (head, shank), `lengths` (head, shank). The head is an ellipsoid about `centre`
    whose height above it is the head's length; its lower half surrounds the shank.
    """
    _positive(name, diameters=diameters, lengths=lengths)
    if diameters[0] <= diameters[1]:
        raise InputError(f"solid {name!r}: the head must be wider than the shank, got {tuple(diameters)}")
    half, r = diameters[0] / 2, diameters[1] / 2
    dome = Primitive(kind=ELLIPSOID, centre=centre, params=(half, half, lengths[0]), axis=axis)
    pieces = (dome, *_stack([(0.0, lengths[1], r, r)], centre, axis))
    return Solid(name=name, material=material, primitives=pieces, metal=metal)


def pin(
    name: str,
    material: str,
    diameter: float,
    lengths: tuple[float, float],
    *,
    centre: Vector = _ORIGIN,
    axis: Vector = _UP,
    metal: bool = True,
) -> Solid:
    """Return a pointed pin that begins at `centre`: `lengths` = (shank, point) along `axis`."""
    _positive(name, diameter=(diameter,), lengths=lengths)
    r, (shank, point) = diameter / 2, lengths
    pieces = _stack([(0.0, shank, r, r), (shank, shank + point, r, 0.0)], centre, axis)
    return Solid(name=name, material=material, primitives=pieces, metal=metal)


def _stack(profile: Sequence[tuple[float, float, float, float]], base: Vector, axis: Vector) -> tuple[Primitive, ...]:
    """Coaxial frusta (start, stop, radius at start, radius at stop) along the axis from `base`."""
    norm = math.hypot(*axis)
    if not (math.isfinite(norm) and norm > 0):
        raise InputError(f"a solid's axis must be finite and not the zero vector, got {tuple(axis)}")
    w = np.asarray(axis, np.float64) / norm
    return tuple(
        Primitive(
            kind=FRUSTUM,
            centre=_triple(np.asarray(base) + (start + stop) / 2 * w),
            params=((stop - start) / 2, r0, r1),
            axis=axis,
        )
        for start, stop, r0, r1 in profile
    )


def _one(name: str, material: str, primitive: Primitive, metal: bool) -> Solid:
    return Solid(name=name, material=material, primitives=(primitive,), metal=metal)


def _triple(at: NDArray[np.float64]) -> Vector:
    x, y, z = (float(c) for c in at)
    return x, y, z


def _positive(name: str, **sizes: Sequence[float]) -> None:
    for what, values in sizes.items():
        if not all(math.isfinite(v) and v > 0 for v in values):
            raise InputError(f"solid {name!r}: {what} must be finite and positive (mm), got {tuple(values)}")
