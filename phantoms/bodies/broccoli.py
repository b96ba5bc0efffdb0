"""A head of broccoli: a stem that forks again and again, tipped with florets of tiny buds.

A small head that fits the 60 mm cube. The tissue is nine tenths water; its fibres are cellulose.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ctsim.phantoms.fields import Canvas, Field, LabelGrid, Mask, Noise, frame_along
from ctsim.phantoms.inserts import count, diameter, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

MATERIALS = ("air", "water", "cellulose")
AIR, WATER, FIBRE = range(3)
ROOT = np.array([0.0, 0.0, -0.86])
FORK = np.array([0.0, 0.0, -0.30])


class Broccoli(Recipe, frozen=True, kw_only=True, tag="broccoli"):
    """Broccoli with rivets in its stem and florets (Al by default)."""

    metal: str = "Al"
    levels: int = 4
    """Number of forkings."""
    forks: int = 5
    """Branches at each forking."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("levels", 1, 5)
        self.within("forks", 2, 6)


def broccoli(grid: LabelGrid, rng: np.random.Generator, params: Broccoli) -> Phantom:
    """Draw the head; metal: rivets through the stem, then in the crown."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid)
    buds = _branches(canvas, body, params)
    grains = body.standard_normal((32, 6, 3))
    grains /= np.linalg.norm(grains, axis=2, keepdims=True)
    for k, (at, r) in enumerate(buds):
        canvas.ellipsoid(WATER, at, r)
        if k % 3 == 0:
            canvas.ellipsoid(FIBRE, at, 0.45 * r)
        for way in grains[k % len(grains)]:
            canvas.ellipsoid(WATER, at + 0.95 * r * way, 0.36 * r)
    _stem(canvas, body)
    return assemble(canvas.whole, grid, MATERIALS, _metal(metal, params, canvas.unit))


def _stem(canvas: Canvas, rng: np.random.Generator) -> None:
    """Thick stalk with a fibrous rind, a ring of bundles and a soft pith; it narrows into the first branch."""
    ridges = Noise(rng, 7)
    neck, high = FORK[2] - 0.10, FORK[2] + 0.24
    turn = rng.uniform(0, 1)
    knife = rng.uniform(0, 2 * np.pi)  # the cut below is askew, as a knife leaves it
    slope = 0.15 * np.array([np.cos(knife), np.sin(knife)])

    def inside(scale: float) -> Callable[[Field, Field, Field], Mask]:
        def within(x: Field, y: Field, z: Field) -> Mask:
            dome = np.sqrt(np.clip(1 - (np.clip(z - neck, 0, None) / (high - neck)) ** 2, 0, 1))
            width = 0.235 - 0.10 * (z + 0.5) + 0.014 * ridges(x, y, z)
            cut = ROOT[2] + (1 - scale) * 0.1 + slope[0] * x + slope[1] * y
            return (np.hypot(x, y) <= scale * dome * width) & (z > cut)

        return within

    box = ((-0.4, -0.4, ROOT[2] - 0.06), (0.4, 0.4, high))
    canvas.fill(FIBRE, inside(1.0), box, over=(AIR,))  # no rind where the stalk runs on as the first branch
    canvas.fill(WATER, inside(0.93), box)
    for angle in np.linspace(0, 2 * np.pi, 17)[:-1] + turn:
        c = np.array([np.cos(angle), np.sin(angle), 0])
        canvas.tube(FIBRE, [ROOT + 0.17 * c + [0, 0, 0.02], FORK + 0.14 * c], 0.016, over=(WATER,))


def _branches(canvas: Canvas, rng: np.random.Generator, params: Broccoli) -> list[tuple[NDArray[np.float64], float]]:
    """Grow the branches, painting them; returns the buds (centre, radius)."""
    buds: list[tuple[NDArray[np.float64], float]] = []
    shells: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []
    dome = np.array([0.0, 0.0, -0.02])

    def grow(start: NDArray[np.float64], along: NDArray[np.float64], length: float, r: float, level: int) -> None:
        end = start + along * length
        canvas.capsule(WATER, start, end, (r, 0.78 * r))
        shells.append((start, end, r))
        forks = params.forks + (2 if level == 0 else 0)
        spin, frame = rng.uniform(0, 2 * np.pi), frame_along(along)
        for k in range(forks + 1):
            jitter = rng.uniform(-0.12, 0.12, 2)
            tilt = (0.0 if k == forks else (1.02 if level == 0 else 0.74)) + jitter[0]
            a = spin + 2 * np.pi * k / forks + jitter[1]
            way = np.cos(tilt) * frame[2] + np.sin(tilt) * (np.cos(a) * frame[0] + np.sin(a) * frame[1])
            if level + 1 < params.levels:
                grow(end, way, length * (0.70 + 0.2 * jitter[0]), r * (0.62 if k < forks else 0.7), level + 1)
            else:
                buds.append((end + way * length * 0.55, 0.30 * length + 0.012))

    grow(FORK - [0, 0, 0.22], np.array([0.0, 0.0, 1.0]), 0.5, 0.2, 0)
    for start, end, r in shells:  # a bundle in the middle of each branch
        canvas.capsule(FIBRE, start, end, (0.22 * r, 0.18 * r), over=(WATER,))
    kept = []
    for at, r in buds:
        out = (at - dome) / np.array([0.88, 0.88, 0.88])
        far = float(np.linalg.norm(out))
        limit = (0.88 - r) / 0.88
        kept.append((dome + (at - dome) * min(1.0, limit / max(far, 1e-9)), r))
    return kept


def _metal(rng: np.random.Generator, params: Broccoli, unit: float) -> list[Solid]:
    make, d = inserts(params, unit), diameter(params, 4.0, unit)
    solids: list[Solid] = []
    for k in range(count(params, 4)):
        turn = rng.uniform(0, 2 * np.pi)
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        if k < 2:
            at = ROOT + [0, 0, 0.2 + 0.26 * k] + 0.2 * out
            solids.append(make.rivet(f"rivet{k}", at, -out, d, 0.34 * unit))
        else:
            turn += 2 * np.pi * k / 3
            way = np.array([np.cos(turn), np.sin(turn), 0.55])
            way /= np.linalg.norm(way)
            solids.append(make.rivet(f"rivet{k}", [0, 0, 0.05] + 0.6 * way, -way, d, 0.3 * unit))
    return solids
