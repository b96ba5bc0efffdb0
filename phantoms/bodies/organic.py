"""Scanned things from the kitchen: walnut, chicken drumstick, bell pepper; each fits the 60 mm cube."""

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from ctsim.phantoms.fields import Canvas, Field, LabelGrid, Mask, Noise, frame_along
from ctsim.phantoms.inserts import count, diameter, inserts
from ctsim.phantoms.recipe import REACH, Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom


class Walnut(Recipe, frozen=True, kw_only=True, tag="walnut"):
    """Walnut with pins pushed through its shell (Fe by default)."""

    by_layers: ClassVar[bool] = False  # what is loose in it is known by the whole
    metal: str = "Fe"


class Chicken(Recipe, frozen=True, kw_only=True, tag="chicken"):
    """Chicken drumstick with a wire wound round it (Fe by default)."""

    metal: str = "Fe"
    turns: float = 4.0
    """Turns of the wire."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("turns", 0.1, 20)


class BellPepper(Recipe, frozen=True, kw_only=True, tag="bell_pepper"):
    """Bell pepper with rivets through its wall (Al by default)."""

    metal: str = "Al"
    lobes: int = 4
    """Lobes of the wall."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("lobes", 2, 6)


def _skin(level: Callable[[Field, Field, Field], Field], start: ArrayLike, way: ArrayLike) -> NDArray[np.float64]:
    """Return the point of level 1 on the ray from `start`, a point within, along the unit vector `way`."""
    low, high = 0.0, 1.0
    for _ in range(24):
        middle = (low + high) / 2
        x, y, z = (np.full((1, 1, 1), c, np.float32) for c in np.add(start, middle * np.asarray(way)))
        low, high = (middle, high) if level(x, y, z).item() < 1 else (low, middle)
    return np.add(start, low * np.asarray(way))


def _held(at: NDArray[np.float64], margin: float) -> NDArray[np.float64]:
    """Return the point, moved towards the z axis if what stands out by `margin` would leave the reach."""
    return at * [*(2 * [min(1.0, (REACH - margin) / math.hypot(at[0], at[1]))]), 1.0]


def _ripples(rng: np.random.Generator, wave: float, terms: int = 10) -> Callable[[Field, Field, Field], Field]:
    """Draw a smooth random function of direction with unit standard deviation: plane waves on the unit sphere."""
    ways = rng.standard_normal((terms, 3))
    ways = (wave * ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)
    phases = rng.uniform(0, 2 * math.pi, terms).astype(np.float32)
    scale = np.float32(math.sqrt(2 / terms))

    def at(x: Field, y: Field, z: Field) -> Field:
        waves = (np.sin(w[0] * x + w[1] * y + w[2] * z + p) for w, p in zip(ways, phases, strict=True))
        return np.asarray(scale * sum(waves))

    return at


def _drop_crumbs(labels: NDArray[np.uint8], of: int) -> None:
    """Clear, in place, loose pieces of the label `of` below a hundredth of it, which a fold may have undercut."""
    pieces = np.zeros(labels.shape, np.int32)
    ndimage.label(labels > 0, np.ones((3, 3, 3)), output=pieces)
    sizes = np.bincount(pieces.ravel())
    loose = sizes < 0.01 * np.count_nonzero(labels == of)
    if loose.any():
        labels[loose[pieces] & (labels == of)] = 0


def walnut(grid: LabelGrid, rng: np.random.Generator, params: Walnut) -> Phantom:
    """Draw a shell with seam, two folded kernel halves (fat) joined by a neck, a membrane between, and air gaps."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid)
    dents, rough, warp = Noise(body, 9), Noise(body, 8), Noise(body, 4)
    radii = np.array([0.74, 0.70, 0.84]) * (1 + 0.03 * body.uniform(-1, 1, 3))
    folds = _ripples(body, 10.0)
    lean, spin = body.uniform(0, 2 * math.pi), body.uniform(0.4, 1.2)
    pose = frame_along((0.2 * math.cos(lean), 0.2 * math.sin(lean), 1), spin).astype(np.float32)  # it lies askew

    def level(x: Field, y: Field, z: Field) -> Field:
        u, v, w = (r[0] * x + r[1] * y + r[2] * z for r in pose)
        tip = 1 - 0.10 * np.clip(w, 0, 1) ** 3
        seam = 0.05 * np.exp(-((v / 0.05) ** 2))
        r = np.sqrt((u / (radii[0] * tip)) ** 2 + (v / (radii[1] * tip)) ** 2 + (w / radii[2]) ** 2)
        return r - seam - 0.014 * np.abs(dents(x, y, z))

    def kernel(x: Field, y: Field, z: Field) -> Mask:
        grain = rough(x, y, z)
        u, v, w = (r[0] * x + r[1] * y + r[2] * z for r in pose)
        hollow = (u / 0.15) ** 2 + (v / 0.22) ** 2 + (w / 0.36) ** 2 < 1 + 0.15 * grain
        inside = (levels < 0.88) & (np.abs(bend) > 0.05 + 0.02 * grain) & ~hollow
        u, v, w, grain, turn = (f[inside] for f in (u, v, w, grain, 0.22 * warped))
        r = np.sqrt(u**2 + v**2 + w**2)
        u, v, w = u / r + turn, v / r + 0.1 * grain, w / r - turn
        # The direction, a little turned, sets the depth, so that folds hardly undercut; the rim has none.
        fold = 0.34 * np.exp(-((folds(u, v, w) / 0.26) ** 2)) * np.clip(4 * np.abs(v) - 0.5, 0, 1)
        cleft = 0.30 * np.exp(-((u / 0.10) ** 2)) * np.clip(0.5 - 2 * w, 0, 1)
        inside[inside] = levels[inside] < 0.85 + 0.015 * grain - np.maximum(fold, cleft)
        return inside

    levels, warped = level(*canvas.mesh), warp(*canvas.mesh)
    bend = sum(c * k for c, k in zip(canvas.mesh, pose[1], strict=True)) - 0.03 * warped
    canvas.fill(1, lambda *_: levels <= 1.0)
    canvas.fill(0, lambda *_: levels <= 0.91)
    canvas.fill(1, lambda *_: (np.abs(bend) < 0.016) & (levels < 0.92))
    canvas.fill(2, kernel, over=(0,))
    canvas.ellipsoid(2, 0.45 * pose[2], (0.09, 0.15, 0.12), pose.astype(np.float64), over=(0,))
    _drop_crumbs(canvas.labels, 2)
    make, d = inserts(params, canvas.unit), diameter(params, 2.4, canvas.unit)
    solids: list[Solid] = []
    total = count(params, 3)
    for k in range(total):
        a = 2 * math.pi * (k + metal.uniform(-0.2, 0.2)) / max(total, 3)
        way = np.array([math.cos(a), math.sin(a), metal.uniform(-0.3, 0.3)])
        way /= np.linalg.norm(way)
        middle = np.array([0.0, 0.0, 0.14 * (k % 3 - 1)])  # the pins cross the axis at heights of their own
        head = _held(_skin(level, middle, way), 0.9 * d / canvas.unit)
        solids.append(make.pin(f"pin{k}", head, -way, d, 0.95 * canvas.unit))
    return assemble(canvas.whole, grid, ("air", "cellulose", "adipose"), solids)


def _drumstick(z: Field, bump: Field, sink: float = 0.0) -> tuple[Field, Field]:
    """Return the middle (in x) and the width of the flesh at height z, `sink` below its skin; `bump` is noise."""
    t = np.clip((z + 0.86) / 1.5, 0, 1)  # thin at the ankle below, thick above
    r = 0.17 + 0.42 * np.sin(np.pi / 2 * t**1.3) + 0.02 * np.clip(0.3 + t, 0, 1) * bump - sink
    round_off = np.clip(z - 0.35, 0, None) / (0.48 - sink) + np.clip(-0.62 - z, 0, None) / (0.17 - sink)
    return 0.08 * t, r * np.sqrt(np.clip(1 - round_off**2, 0, 1))


FLAT, DEEP = 1.12, 0.95
"""Half axes of the drumstick's cross-section in x and y, of its width."""

JOINTS = (((0.03, 0.0, 0.6), 0.15), ((0.17, 0.02, 0.6), 0.14), ((-0.05, 0, -0.76), 0.115), ((0.06, 0, -0.76), 0.11))
"""Middles and radii of the drumstick's knobs; the last two are the ankle's."""


def chicken(grid: LabelGrid, rng: np.random.Generator, params: Chicken) -> Phantom:
    """Draw skin, fat, muscle bundles, a long bone with marrow and knobs, a splint bone; a wire wound on the skin."""
    body, _ = rng.spawn(2)
    canvas = Canvas(grid)
    _, meat, fat, bone = range(4)
    bumps, sheets, spongy = Noise(body, 6), Noise(body, 7), Noise(body, 50)

    def flesh(sink: float) -> Callable[[Field, Field, Field], Mask]:
        def inside(x: Field, y: Field, z: Field) -> Mask:
            middle, width = _drumstick(z, bumps(x, y, z), sink)
            return ((x - middle) / FLAT) ** 2 + (y / DEEP) ** 2 < width**2

        return inside

    for at, r in JOINTS[2:]:  # skin drawn over the ankle
        canvas.ellipsoid(meat, at, r + 0.035)
    canvas.fill(meat, flesh(0.0))
    canvas.fill(fat, flesh(0.03))
    canvas.fill(meat, flesh(0.055))
    canvas.fill(fat, lambda x, y, z: (np.abs(sheets(x, y, 0.35 * z)) < 0.07) & flesh(0.03)(x, y, z), over=(meat,))
    shaft = np.array([(0.0, 0.0, -0.78), (0.03, 0.01, -0.3), (0.06, 0.0, 0.2), (0.09, 0.0, 0.56)])
    widths = np.array([0.10, 0.085, 0.095, 0.12])
    canvas.tube(bone, shaft, widths)
    for at, r in JOINTS:
        canvas.ellipsoid(bone, at, r)
    canvas.tube(fat, shaft, widths - 0.042)  # marrow
    for at, r in JOINTS:
        q = 0.79 * r
        canvas.ellipsoid(bone, at, q)
        canvas.fill(
            fat,
            lambda x, y, z, c=at, q=q: (
                ((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 < q * q) & (spongy(x, y, z) > -0.3)
            ),
            (np.subtract(at, q), np.add(at, q)),
        )
    canvas.tube(bone, [(0.16, 0.1, 0.45), (0.14, 0.09, 0.1), (0.08, 0.06, -0.4)], (0.032, 0.026, 0.012))
    make, d = inserts(params, canvas.unit), diameter(params, 1.4, canvas.unit)
    total = count(params, 1)
    solids = [
        make.wire(f"wire{k}", _winding(bumps, params.turns, k / total, d / 2 / canvas.unit), d) for k in range(total)
    ]
    return assemble(canvas.whole, grid, ("air", "soft_tissue", "adipose", "cortical_bone"), solids)


def _winding(bumps: Noise, turns: float, start: float, radius: float) -> NDArray[np.float64]:
    """Return points [k, 3] of a wire wound round the drumstick, half its radius sunk into the skin; `start` in turns.

    A wire too thick for the cube lies deeper, within the reach.
    """
    s = np.linspace(0, 1, max(math.ceil(25 * turns), 2) + 1)
    angle, z = 2 * math.pi * (start + turns * s), -0.28 + 0.76 * s
    way = np.stack([np.cos(angle), np.sin(angle)], 1)
    oval = 1 / np.hypot(way[:, 0] / FLAT, way[:, 1] / DEEP)
    points = np.stack([np.zeros_like(z), np.zeros_like(z), z], 1)
    for _ in range(8):  # the bumps depend on where the skin is; a pass changes a tenth of what the last one did
        middle, width = _drumstick(z, bumps.at(points))
        points[:, :2] = (width * oval + radius / 2)[:, None] * way
        points[:, 0] += middle
    points[:, :2] *= np.minimum(1, (REACH - radius) / np.hypot(points[:, 0], points[:, 1]))[:, None]
    return points


def bell_pepper(grid: LabelGrid, rng: np.random.Generator, params: BellPepper) -> Phantom:
    """Draw a hollow lobed wall with skin, ribs within, the seeded core and the stem."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid)
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
                (np.abs(x * c[0] + y * c[1] - 0.04 * wobble(x, y, z) - 0.05 * np.sin(3 * z + phase)) < 0.022)
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
    around = ((-0.3, -0.3, 0.0), (0.3, 0.3, 0.7))
    canvas.fill(air, lambda x, y, z: level(x, y, z) > 1.0, around)  # what the core leaves outside, in the dimple
    bend = body.uniform(-0.12, 0.12, 2)
    stalk = [(0, 0, 0.40), (0.3 * bend[0], 0.3 * bend[1], 0.62), (bend[0], bend[1], 0.84)]
    canvas.tube(fibre, stalk, (0.12, 0.075, 0.07))
    canvas.tube(water, stalk, (0.10, 0.058, 0.04), over=(fibre,))
    make, d = inserts(params, canvas.unit), diameter(params, 4.0, canvas.unit)
    solids = []
    for k in range(count(params, 3)):
        a = (2 * math.pi * ((k % lobes) + 0.05 * metal.uniform(-1, 1)) - phase) / lobes
        out = np.array([math.cos(a), math.sin(a), 0.0])
        head = _held(_skin(level, [0.0, 0.0, metal.uniform(-0.2, 0.15)], out), 0.4 * d / canvas.unit)
        solids.append(make.rivet(f"rivet{k}", head, -out, d, 0.24 * canvas.unit))
    return assemble(canvas.whole, grid, ("air", "water", "cellulose"), solids)
