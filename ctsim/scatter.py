"""Scatter that is added to the mean signal before any photon is drawn.

Level 0 adds nothing; level 1 adds one constant to every pixel of every view, as a fraction S/I0 of the
open field; level 3 is a Monte Carlo simulation of the scene, see `ctsim.montecarlo.series`.
"""

import math
from typing import Annotated, Literal

import msgspec

from ctsim.errors import InputError
from ctsim.geometry import Geometry


class Scatter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scatter model."""

    level: Literal[0, 1, 3] = 0
    """0: none. 1: one constant in every pixel. 3: by Monte Carlo, for this object with and without its metal."""
    fraction: Annotated[float, msgspec.Meta(ge=0, lt=10)] | None = None
    """The constant as a share of the open field, instead of the geometry's; needs level 1."""
    grid_ratio: Annotated[float, msgspec.Meta(gt=0, le=50)] | None = None
    """Height over gap of a focused anti-scatter grid; its thin strips along v stop what hits them. Needs level 3."""

    def __post_init__(self) -> None:
        if self.level not in (0, 1, 3):
            raise InputError(f"scatter.level must be 0, 1 or 3, got {self.level}")
        if self.fraction is not None and not 0 <= self.fraction < 10:
            raise InputError(f"scatter.fraction must be within [0, 10) of the open field, got {self.fraction}")
        if self.fraction is not None and self.level != 1:
            raise InputError(f"scatter.fraction = {self.fraction} needs scatter.level = 1, got level {self.level}")
        if self.grid_ratio is not None and not 0 < self.grid_ratio <= 50:
            raise InputError(f"scatter.grid_ratio must be within (0, 50], got {self.grid_ratio}")
        if self.grid_ratio is not None and self.level != 3:
            raise InputError(f"scatter.grid_ratio = {self.grid_ratio} needs scatter.level = 3, got level {self.level}")


def constant_fraction(geometry: Geometry) -> float:
    """Return scatter over open field, S/I0, of a 60 mm scene in this geometry.

    With x = (dsd / (dso·(dsd − dso)))² in 1/mm², S/I0 = 0.0035·(x / 9e-6)^0.6: a power law through
    Monte Carlo results for a 60 mm object at 90 kVp (1.4–2 % at dso/dsd 180/360 mm, 0.8–1 % at 250/750,
    0.3–0.4 % at 1000/1500). x is the detected share of photons scattered at the isocentre per solid angle,
    relative to the primary ones; an interpolation, then, which does not know the object: another size or an
    off-centre one needs `Scatter.fraction`. For arbitrary poses dso and dsd still decide. The result is
    capped just below 10, the largest fraction that can be given.
    """
    air_gap = geometry.dsd - geometry.dso
    x = (geometry.dsd / (geometry.dso * air_gap)) ** 2
    return min(0.0035 * (x / 9e-6) ** 0.6, math.nextafter(10.0, 0.0))


def open_fraction(scatter: Scatter, geometry: Geometry) -> float:
    """Return the S/I0 that level 1 adds to every pixel, given or from the geometry; 0 at other levels."""
    if scatter.level != 1:
        return 0.0
    return constant_fraction(geometry) if scatter.fraction is None else scatter.fraction
