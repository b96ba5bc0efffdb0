"""Insert layouts in relative units: metal rods, balls, pins, rivets, screws, crowns and wires as solids."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctsim.geometry import Triple
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid, Vector
from phantoms.bodies import Recipe


def _vector(at: ArrayLike) -> Vector:
    x, y, z = (float(c) for c in np.asarray(at, np.float64))
    return x, y, z


@dataclass(frozen=True, slots=True)
class Inserts:
    """Makes metal solids from relative coordinates; `unit` is mm per relative unit.

    Every method takes centres and axes as x, y, z in relative units and sizes in mm.
    """

    material: str
    unit: float

    def _solid(self, name: str, primitives: Sequence[Primitive]) -> Solid:
        return Solid(name=name, material=self.material, primitives=tuple(primitives), metal=True)

    def _mm(self, at: ArrayLike) -> Vector:
        return _vector(np.asarray(at, np.float64) * self.unit)

    def ball(self, name: str, centre: ArrayLike, diameter: float) -> Solid:
        """Return a sphere."""
        r = diameter / 2
        return self._solid(name, [Primitive(kind=ELLIPSOID, centre=self._mm(centre), params=(r, r, r))])

    def ellipsoid(self, name: str, centre: ArrayLike, radii: Triple, axis: ArrayLike = (0, 0, 1)) -> Solid:
        """Return an ellipsoid with semi-axes `radii` (mm), the third along `axis`."""
        return self._solid(name, [Primitive(kind=ELLIPSOID, centre=self._mm(centre), params=radii, axis=_vector(axis))])

    def box(self, name: str, centre: ArrayLike, half: Triple, axis: ArrayLike = (0, 0, 1)) -> Solid:
        """Return a box with half edges `half` (mm), the third along `axis`."""
        return self._solid(name, [Primitive(kind=BOX, centre=self._mm(centre), params=half, axis=_vector(axis))])

    def ring(self, name: str, centre: ArrayLike, radii: tuple[float, float], axis: ArrayLike = (0, 0, 1)) -> Solid:
        """Return a torus with (major, minor) radii (mm) about `axis`."""
        return self._solid(name, [Primitive(kind=TORUS, centre=self._mm(centre), params=radii, axis=_vector(axis))])

    def rod(self, name: str, a: ArrayLike, b: ArrayLike, diameter: float, *, round_ends: bool = False) -> Solid:
        """Return a cylinder from a to b, or a capsule inscribed between the same ends."""
        p, q = np.asarray(a, float) * self.unit, np.asarray(b, float) * self.unit
        half, r = float(np.linalg.norm(q - p)) / 2, diameter / 2
        kind, params = (CAPSULE, (max(half - r, 0.0), r)) if round_ends else (FRUSTUM, (half, r, r))
        return self._solid(
            name, [Primitive(kind=kind, centre=_vector((p + q) / 2), params=params, axis=_vector(q - p))]
        )

    def rivet(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return a blind rivet: a domed head at `head`, a shank of `length` mm along `axis` (inwards), a tip."""
        w = np.asarray(axis, float) / np.linalg.norm(axis)
        p, r = np.asarray(head, float) * self.unit, diameter / 2
        return self._solid(
            name,
            [
                Primitive(kind=ELLIPSOID, centre=_vector(p), params=(1.9 * r, 1.9 * r, 0.7 * r), axis=_vector(w)),
                Primitive(kind=FRUSTUM, centre=_vector(p + w * length / 2), params=(length / 2, r, r), axis=_vector(w)),
                Primitive(
                    kind=ELLIPSOID, centre=_vector(p + w * length), params=(1.3 * r, 1.3 * r, r), axis=_vector(w)
                ),
            ],
        )

    def pin(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return a pin: a ball head, a shank along `axis`, and a cone to the point; `length` in mm overall."""
        w = np.asarray(axis, float) / np.linalg.norm(axis)
        p, r = np.asarray(head, float) * self.unit, diameter / 2
        tip = min(4 * r, 0.4 * length)
        shank = length - tip
        ball = 1.8 * r
        return self._solid(
            name,
            [
                Primitive(kind=ELLIPSOID, centre=_vector(p), params=(ball, ball, ball)),
                Primitive(kind=FRUSTUM, centre=_vector(p + w * shank / 2), params=(shank / 2, r, r), axis=_vector(w)),
                Primitive(
                    kind=FRUSTUM, centre=_vector(p + w * (shank + tip / 2)), params=(tip / 2, r, 0.0), axis=_vector(w)
                ),
            ],
        )

    def screw(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return an implant screw: collar at `head`, tapering core along `axis`, thread as stacked frusta."""
        w = np.asarray(axis, float) / np.linalg.norm(axis)
        p, r = np.asarray(head, float) * self.unit, diameter / 2
        pitch = max(0.28 * diameter, length / 14)
        turns = max(int(0.85 * length / pitch), 1)

        def piece(start: float, stop: float, r0: float, r1: float) -> Primitive:
            centre = _vector(p + w * (start + stop) / 2)
            return Primitive(kind=FRUSTUM, centre=centre, params=((stop - start) / 2, r0, r1), axis=_vector(w))

        pieces = [piece(0.0, 0.12 * length, r, r), piece(0.12 * length, length, 0.78 * r, 0.5 * r)]
        for k in range(turns):
            start = 0.14 * length + k * pitch
            crest = r * (1 - 0.25 * k / turns)
            if start + 0.8 * pitch > length:
                break
            pieces += [piece(start, start + 0.4 * pitch, 0.7 * crest, crest)]
            pieces += [piece(start + 0.4 * pitch, start + 0.8 * pitch, crest, 0.7 * crest)]
        return self._solid(name, pieces)

    def wire(self, name: str, points: ArrayLike, diameter: float) -> Solid:
        """Return a wire of capsules through the points [k, 3]."""
        at, r = np.asarray(points, float) * self.unit, diameter / 2
        pieces = [
            Primitive(
                kind=CAPSULE,
                centre=_vector((p + q) / 2),
                params=(float(np.linalg.norm(q - p)) / 2, r),
                axis=_vector(q - p),
            )
            for p, q in itertools.pairwise(at)
        ]
        return self._solid(name, pieces)


def inserts(params: Recipe, unit: float) -> Inserts:
    """Return the maker of a recipe's inserts; `unit` is mm per relative unit."""
    return Inserts(params.metal, unit)


def count(params: Recipe, default: int) -> int:
    """Return how many inserts to place: none for metal "none"."""
    return 0 if params.metal == "none" else default if params.n_inserts is None else params.n_inserts


def diameter(params: Recipe, default: float, unit: float) -> float:
    """Return the inserts' diameter in mm; `default` is mm in a 60 mm cube and scales with it."""
    return params.insert_mm if params.insert_mm is not None else default * unit / 30


def helix(centre: ArrayLike, radius: Sequence[float], half: float, turns: float) -> np.ndarray:
    """Return points of a helix about z whose radius runs from radius[0] to radius[1]; relative units."""
    k = max(int(24 * turns), 2)
    t = np.linspace(0, 1, k + 1)
    r = radius[0] + t * (radius[1] - radius[0])
    a = 2 * math.pi * turns * t
    return np.asarray(centre, float) + np.stack([r * np.cos(a), r * np.sin(a), (2 * t - 1) * half], 1)
