"""Scanned things from the kitchen: walnut, chicken drumstick, bell pepper; each fits the 60 mm cube."""

import math
from collections.abc import Callable

import numpy as np

from ctsim.geometry import Triple
from ctsim.solids import Solid
from ctsim.types import Phantom
from phantoms.bodies import Recipe, Shape, assemble
from phantoms.fields import Canvas, Field, Mask, Noise
from phantoms.inserts import count, diameter, inserts


class Walnut(Recipe, frozen=True, kw_only=True, tag="walnut"):
    """Walnut with pins pushed through its shell (Fe by default)."""

    metal: str = "Fe"


class Chicken(Recipe, frozen=True, kw_only=True, tag="chicken"):
    """Chicken drumstick with a wire wound round it (Fe by default); `turns` of the wire."""

    metal: str = "Fe"
    turns: float = 4.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("turns", 0.1, 20)


class BellPepper(Recipe, frozen=True, kw_only=True, tag="bell_pepper"):
    """Bell pepper with rivets through its wall (Al by default); `lobes` of the wall."""

    metal: str = "Al"
    lobes: int = 4

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("lobes", 2, 6)


def walnut(n: Shape, d_voxel: Triple, rng: np.random.Generator, params: Walnut) -> Phantom:
    """Draw a shell with seam, two folded kernel halves (fat), a membrane between them, and air gaps."""
    body, metal = rng.spawn(2)
    canvas = Canvas(n, d_voxel)
    dents, folds, warp = Noise(body, 9), Noise(body, 8), Noise(body, 4)
    radii = np.array([0.74, 0.70, 0.84]) * (1 + 0.03 * body.uniform(-1, 1, 3))

    def level(x: Field, y: Field, z: Field) -> Field:
        tip = 1 - 0.10 * np.clip(z, 0, 1) ** 3
        seam = 0.05 * np.exp(-((y / 0.05) ** 2))
        r = np.sqrt((x / (radii[0] * tip)) ** 2 + (y / (radii[1] * tip)) ** 2 + (z / radii[2]) ** 2)
        return r - seam - 0.014 * np.abs(dents(x, y, z))

    def kernel(x: Field, y: Field, z: Field) -> Mask:
        wave = np.sin(9.0 * z + 3.0 * folds(x, y, z)) * np.sin(8.0 * x + 2.6 * warp(x, y, z))
        depth = 0.79 + 0.09 * wave + 0.035 * folds(x, y, z)
        lobe = level(x, y, z) + 0.10 * np.exp(-((x / 0.10) ** 2)) * (np.abs(z) > 0.12)
        gap = 0.05 + 0.035 * warp(x, y, z) ** 2
        furrow = np.abs(folds(x, y, z) + 0.6 * wave) < 0.13
        heart = level(x, y, z) < 0.36
        return (lobe < depth) & (np.abs(y) > gap) & ~(furrow & (level(x, y, z) > 0.34)) & ~(heart & (np.abs(x) < 0.1))

    canvas.fill(1, lambda x, y, z: level(x, y, z) <= 1.0)
    canvas.fill(0, lambda x, y, z: level(x, y, z) <= 0.91)
    canvas.fill(1, lambda x, y, z: (np.abs(y - 0.03 * warp(x, y, z)) < 0.016) & (level(x, y, z) < 0.92))
    canvas.fill(2, kernel, over=(0,))
    canvas.fill(0, lambda x, y, z: level(x, y, z) > 1.0, over=(2,))
    make, d = inserts(params, canvas.unit), diameter(params, 2.4, canvas.unit)
    solids: list[Solid] = []
    for k in range(count(params, 3)):
        a = 2 * math.pi * (k + metal.uniform(-0.2, 0.2)) / 3
        way = np.array([math.cos(a), math.sin(a), metal.uniform(-0.3, 0.3)])
        way /= np.linalg.norm(way)
        solids.append(make.pin(f"pin{k}", 0.68 * way + [0, 0, 0.1 * (k - 1)], -way, d, 0.95 * canvas.unit))
    return assemble(canvas.labels, d_voxel, ("air", "cellulose", "adipose"), solids)


def chicken(n: Shape, d_voxel: Triple, rng: np.random.Generator, params: Chicken) -> Phantom:
    """Draw skin, fat, muscle bundles, a long bone with marrow and knobs, a splint bone; wire: a helix."""
    body, _ = rng.spawn(2)
    canvas = Canvas(n, d_voxel)
    _, meat, fat, bone = range(4)
    bumps, sheets, spongy = Noise(body, 6), Noise(body, 7), Noise(body, 50)

    def flesh(scale: float) -> Callable[[Field, Field, Field], Mask]:
        def inside(x: Field, y: Field, z: Field) -> Mask:
            t = np.clip((z + 0.86) / 1.5, 0, 1)  # thin at the ankle below, thick above
            r = 0.17 + 0.42 * np.sin(np.pi / 2 * t**1.3) + 0.02 * bumps(x, y, z)
            cap = np.sqrt(np.clip(1 - (np.clip(z - 0.35, 0, 1) / 0.48) ** 2, 0, 1))
            side = np.sqrt(((x - 0.08 * t) / 1.12) ** 2 + (y / 0.95) ** 2)
            return (side <= scale * r * cap) & (z < 0.83 * scale) & (z > -0.72)

        return inside

    canvas.fill(meat, flesh(1.0))
    canvas.fill(fat, flesh(0.95))
    canvas.fill(meat, flesh(0.90))
    canvas.fill(fat, lambda x, y, z: np.abs(sheets(x, y, 0.35 * z)) < 0.07, over=(meat,))
    canvas.fill(meat, lambda x, y, z: flesh(1.0)(x, y, z) & ~flesh(0.95)(x, y, z))
    shaft = np.array([(0.0, 0.0, -0.78), (0.03, 0.01, -0.3), (0.06, 0.0, 0.2), (0.09, 0.0, 0.56)])
    canvas.tube(bone, shaft, (0.10, 0.085, 0.095, 0.12))
    for at, r in (
        ((0.03, 0.0, 0.6), 0.15),
        ((0.17, 0.02, 0.6), 0.14),
        ((-0.05, 0, -0.76), 0.115),
        ((0.06, 0, -0.76), 0.11),
    ):
        canvas.ellipsoid(bone, at, r)
    for at, r in (
        ((0.03, 0.0, 0.6), 0.12),
        ((0.17, 0.02, 0.6), 0.11),
        ((-0.05, 0, -0.76), 0.09),
        ((0.06, 0, -0.76), 0.085),
    ):
        canvas.fill(
            fat,
            lambda x, y, z, c=at, q=r: (
                ((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 < q * q) & (spongy(x, y, z) > -0.3)
            ),
        )
    canvas.tube(fat, np.add(shaft[:-1], [0, 0, 0.1]), (0.05, 0.045, 0.055))
    canvas.tube(bone, [(0.16, 0.1, 0.45), (0.14, 0.09, 0.1), (0.08, 0.06, -0.4)], (0.032, 0.026, 0.012))
    solids: list[Solid] = []
    if count(params, 1):
        make, d, u = inserts(params, canvas.unit), diameter(params, 1.4, canvas.unit), canvas.unit
        solids.append(make.helix("wire", (0.04, 0.0, 0.1), (0.36 * u, 0.62 * u, d / 2, 0.76 * u), params.turns))
    return assemble(canvas.labels, d_voxel, ("air", "soft_tissue", "adipose", "cortical_bone"), solids)


def bell_pepper(n: Shape, d_voxel: Triple, rng: np.random.Generator, params: BellPepper) -> Phantom:
    """Draw a hollow lobed wall with skin, ribs within, the seeded core and the stem."""
    body, metal = rng.spawn(2)
    canvas = Canvas(n, d_voxel)
    air, water, fibre = range(3)
    wobble, phase, lobes = Noise(body, 4), body.uniform(0, 2 * math.pi), params.lobes

    def level(x: Field, y: Field, z: Field) -> Field:
        angle = np.arctan2(y, x) * lobes + np.float32(phase)
        crease = np.abs(np.cos(angle / 2)) ** np.float32(0.7)
        t = np.clip((z + 0.78) / 1.4, 0, 1)
        width = 0.74 * (0.62 + 0.38 * np.sin(np.pi * (0.18 + 0.55 * t))) * (0.80 + 0.20 * crease)
        r2 = x**2 + y**2
        top = 0.60 - 0.20 * np.exp(-r2 / 0.07) + 0.04 * crease  # dimple under the stem
        low = -0.84 + 0.12 * np.exp(-r2 / 0.05)
        u = (2 * z - (top + low)) / (top - low)
        return (((np.sqrt(r2)) / width) ** 4 + np.abs(u) ** 4) ** np.float32(0.25) + 0.012 * wobble(x, y, z)

    canvas.fill(fibre, lambda x, y, z: level(x, y, z) <= 1.0)
    canvas.fill(water, lambda x, y, z: level(x, y, z) <= 0.975)
    canvas.fill(air, lambda x, y, z: level(x, y, z) + 0.02 * wobble(x, y, z) <= 0.86)
    core = np.array([0.0, 0.0, 0.30])
    for k in range(lobes):  # ribs stand where the wall is creased
        a = (math.pi + 2 * math.pi * k - phase) / lobes
        across = (-math.sin(a), math.cos(a))
        canvas.fill(
            water,
            lambda x, y, z, a=a, c=across: (
                (np.abs(x * c[0] + y * c[1]) < 0.022 + 0.008 * wobble(x, y, z))
                & (x * math.cos(a) + y * math.sin(a) > 0.0)
                & (np.hypot(x, y) > 0.50 - 0.7 * np.clip(z, 0, 1))
                & (level(x, y, z) < 0.9)
            ),
            over=(air,),
        )
    canvas.ellipsoid(water, core, (0.19, 0.19, 0.26), over=(air,))
    for way in body.standard_normal((150, 3)):
        way[2] = abs(way[2]) * -0.6 if way[2] < 0 else way[2] * 0.3
        out = way / np.linalg.norm(way)
        seat = core + np.array([0.21, 0.21, 0.28]) * out
        frame = np.linalg.qr(np.stack([out, *body.standard_normal((2, 3))], 1))[0].T
        canvas.ellipsoid(fibre, seat, (0.014, 0.04, 0.036), frame, over=(air,))
    bend = body.uniform(-0.12, 0.12, 2)
    stalk = [(0, 0, 0.40), (0.3 * bend[0], 0.3 * bend[1], 0.62), (bend[0], bend[1], 0.84)]
    canvas.tube(fibre, stalk, (0.12, 0.075, 0.07))
    canvas.tube(water, stalk, (0.10, 0.058, 0.04), over=(fibre,))
    make, d = inserts(params, canvas.unit), diameter(params, 4.0, canvas.unit)
    solids = []
    for k in range(count(params, 3)):
        a = (2 * math.pi * ((k % lobes) + 0.05 * metal.uniform(-1, 1)) - phase) / lobes
        out = np.array([math.cos(a), math.sin(a), 0.0])
        height = metal.uniform(-0.2, 0.15)
        solids.append(make.rivet(f"rivet{k}", 0.64 * out + [0, 0, height], -out, d, 0.24 * canvas.unit))
    return assemble(canvas.labels, d_voxel, ("air", "water", "cellulose"), solids)
