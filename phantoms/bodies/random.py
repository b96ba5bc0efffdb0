"""Random bodies with random inserts: an endless family for training sets, one member a seed."""

import numpy as np

from ctsim.phantoms.fields import Canvas, LabelGrid, Noise
from ctsim.phantoms.inserts import Inserts, count, diameter, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

MATERIALS = ("air", "soft_tissue", "adipose", "lung", "cortical_bone", "water")


class Random(Recipe, frozen=True, kw_only=True, tag="random"):
    """Random organs in a random body, with random metal shapes (Ti by default)."""

    metal: str = "Ti"
    organs: int = 24
    """Number of inner ellipsoids."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("organs", 0, 500)


def random(grid: LabelGrid, rng: np.random.Generator, params: Random) -> Phantom:
    """Draw a warped ellipsoid of tissue with a fat layer, organs, bones; metal of random kinds inside."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=0.95)
    wobble, texture = Noise(body, 4), Noise(body, 12)
    a, b, c = body.uniform((0.62, 0.55, 0.65), (0.84, 0.8, 0.84))
    power = body.uniform(2.0, 4.0)
    for label, scale in ((1, 1.0), (2, 0.96), (1, 0.96 - body.uniform(0.03, 0.15))):
        canvas.fill(
            label,
            lambda x, y, z, s=scale: (
                np.abs(x / a) ** power + np.abs(y / b) ** power + np.abs(z / c) ** power + 0.07 * wobble(x, y, z)
                <= s**power
            ),
        )
    canvas.fill(2, lambda x, y, z: np.abs(texture(x, y, z)) < 0.08, over=(1,))
    for _ in range(params.organs):
        way = body.standard_normal(3)
        place = way / np.linalg.norm(way) * body.uniform(0, 1) ** (1 / 3) * 0.6 * np.array([a, b, c])
        radii = body.uniform(0.03, 0.22, 3)
        frame = np.linalg.qr(body.standard_normal((3, 3)))[0]
        label = int(body.choice([1, 2, 3, 4, 5, 0], p=[0.25, 0.2, 0.15, 0.2, 0.15, 0.05]))
        canvas.ellipsoid(label, place, radii, frame, over=(1, 2, 3, 4, 5))
        if label == 4:  # bones have marrow
            canvas.ellipsoid(2, place, 0.65 * radii, frame, over=(4,))
    make, d = inserts(params, canvas.unit), diameter(params, 5.0, canvas.unit)
    solids = [_insert(make, metal, k, d, 0.45 * min(a, b, c)) for k in range(count(params, int(metal.integers(1, 6))))]
    return assemble(canvas.whole, grid, MATERIALS, solids)


def _insert(make: Inserts, rng: np.random.Generator, k: int, d: float, reach: float) -> Solid:
    """Return one insert of a random kind within `reach` of the centre."""
    way, axis = rng.standard_normal((2, 3))
    place = way / np.linalg.norm(way) * reach * rng.uniform(0.2, 1)
    axis /= np.linalg.norm(axis)
    d = d * rng.uniform(0.5, 1.1)
    length = min(rng.uniform(1.5, 3.5) * d, 0.5 * reach * make.unit)
    half = 0.5 * length / make.unit * axis
    kind = rng.integers(0, 9)
    if kind == 0:
        return make.ball(f"ball{k}", place, d)
    if kind == 1:
        return make.ellipsoid(f"ellipsoid{k}", place, (0.6 * d, 0.4 * d, 0.8 * d), axis)
    if kind == 2:
        return make.box(f"box{k}", place, (0.6 * d, 1.0 * d, 1.2 * d), axis)
    if kind == 3:
        return make.ring(f"ring{k}", place, (0.7 * d, 0.2 * d), axis)
    if kind == 4:
        return make.rivet(f"rivet{k}", place - half, axis, 0.6 * d, length)
    if kind == 5:
        return make.screw(f"screw{k}", place - half, axis, 0.7 * d, length)
    if kind == 6:
        return make.pin(f"pin{k}", place - half, axis, 0.4 * d, length)
    if kind == 7:
        return make.helix(f"wire{k}", place, (0.12 * make.unit, 0.12 * make.unit, 0.1 * d, 0.3 * make.unit), 3.0)
    return make.rod(f"rod{k}", place - half, place + half, 0.7 * d, round_ends=bool(rng.integers(0, 2)))
