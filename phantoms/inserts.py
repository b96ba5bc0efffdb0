"""Metal inserts in a recipe's relative coordinates; `ctsim.phantoms.shapes` makes the solids."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctsim.geometry import Triple
from ctsim.phantoms import shapes
from ctsim.phantoms.recipe import Recipe
from ctsim.solids import Solid, Vector


@dataclass(frozen=True, slots=True)
class Inserts:
    """Makes metal solids from relative coordinates; `unit` is mm per relative unit.

    Every method takes centres, ends and axes as x, y, z in relative units and sizes in mm.
    """

    material: str
    unit: float

    def _mm(self, at: ArrayLike) -> Vector:
        x, y, z = (float(c) * self.unit for c in np.asarray(at, np.float64))
        return x, y, z

    def ball(self, name: str, centre: ArrayLike, diameter: float) -> Solid:
        """Return a sphere."""
        return shapes.sphere(name, self.material, diameter / 2, centre=self._mm(centre))

    def ellipsoid(self, name: str, centre: ArrayLike, radii: Triple, axis: ArrayLike) -> Solid:
        """Return an ellipsoid with semi-axes `radii`, the third along `axis`."""
        return shapes.ellipsoid(name, self.material, radii, centre=self._mm(centre), axis=self._mm(axis))

    def box(self, name: str, centre: ArrayLike, edges: Triple, axis: ArrayLike, spin: float = 0.0) -> Solid:
        """Return a box with full `edges`, the third along `axis`, turned about it by `spin` (radians)."""
        return shapes.box(name, self.material, edges, centre=self._mm(centre), axis=self._mm(axis), spin=spin)

    def ring(self, name: str, centre: ArrayLike, radii: tuple[float, float], axis: ArrayLike) -> Solid:
        """Return a torus with (major, minor) `radii` about `axis`."""
        return shapes.torus(name, self.material, radii, centre=self._mm(centre), axis=self._mm(axis))

    def helix(self, name: str, centre: ArrayLike, size: tuple[float, float, float, float], turns: float) -> Solid:
        """Return a coil about z of `size` = (coil radius at the low end, at the high end, wire radius, length)."""
        sagitta = 0.008 * max(size[:2])  # 25 pieces a turn
        return shapes.helix(name, self.material, size, turns, centre=self._mm(centre), sagitta=sagitta)

    def wire(self, name: str, points: NDArray[np.float64], diameter: float) -> Solid:
        """Return a wire through `points` [k ≥ 2, 3]."""
        return shapes.wire(name, self.material, points * self.unit, diameter / 2)

    def rod(self, name: str, a: ArrayLike, b: ArrayLike, diameter: float, *, round_ends: bool = False) -> Solid:
        """Return a cylinder from a to b, or a capsule inscribed between the same ends and at least a ball."""
        middle, along = self._mm(np.add(a, b) / 2), self._mm(np.subtract(b, a))
        make, least = (shapes.capsule, diameter) if round_ends else (shapes.cylinder, 0.0)
        size = (diameter / 2, max(math.hypot(*along), least))
        return make(name, self.material, size, centre=middle, axis=along)

    def cone(self, name: str, a: ArrayLike, b: ArrayLike, diameters: tuple[float, float]) -> Solid:
        """Return a truncated cone from a to b, of these diameters there."""
        middle, along = self._mm(np.add(a, b) / 2), self._mm(np.subtract(b, a))
        size = (diameters[0] / 2, diameters[1] / 2, math.hypot(*along))
        return shapes.cone(name, self.material, size, centre=middle, axis=along)

    def dome(self, name: str, centre: ArrayLike, diameter: float, axis: ArrayLike) -> Solid:
        """Return a half ball about `centre`, round towards `axis`."""
        return shapes.dome(name, self.material, diameter / 2, centre=self._mm(centre), axis=self._mm(axis))

    def rivet(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return a blind rivet: a domed head at `head`, a shank of `length` along `axis` (inwards), a bulge."""
        diameters = (1.9 * diameter, diameter, 1.3 * diameter)
        lengths = (0.35 * diameter, length, 0.5 * diameter)
        return shapes.rivet(name, self.material, diameters, lengths, centre=self._mm(head), axis=self._mm(axis))

    def pin(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return a pin with a ball head at `head`, `length` from there along `axis` to the point."""
        point = min(2 * diameter, 0.4 * length)
        diameters, lengths = (1.8 * diameter, diameter), (length - point, point)
        return shapes.pin(name, self.material, diameters, lengths, centre=self._mm(head), axis=self._mm(axis))

    def screw(self, name: str, head: ArrayLike, axis: ArrayLike, diameter: float, length: float) -> Solid:
        """Return a tapering implant screw of `length` with its collar at `head`."""
        shank = 0.88 * length
        lengths = (length - shank, shank, min(max(0.28 * diameter, length / 14), shank))
        diameters = (diameter, diameter, 0.7 * diameter)
        at, along = self._mm(head), self._mm(axis)
        return shapes.screw(name, self.material, diameters, lengths, taper=0.6, centre=at, axis=along)


def inserts(params: Recipe, unit: float) -> Inserts:
    """Return the maker of a recipe's inserts; `unit` is mm per relative unit."""
    return Inserts(params.metal, unit)


def count(params: Recipe, default: int) -> int:
    """Return how many inserts to place: none for metal "none"."""
    return 0 if params.metal == "none" else default if params.n_inserts is None else params.n_inserts


def diameter(params: Recipe, default: float, unit: float) -> float:
    """Return the inserts' diameter in mm; `default` is mm in a 60 mm cube and scales with it."""
    return params.insert_mm if params.insert_mm is not None else default * unit / 30
