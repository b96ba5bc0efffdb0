"""Thorax of a specimen scanned in a micro-CT: ribs, spine, sternum, lungs with vessels, heart, fat, skin.

A miniature, as the paper's scenes are: the whole chest fits a 60 mm cube, so tissue reaches P of 2 to 3
and rods of a few mm starve the detector. Patient's left is +x, front is +y, head is +z.
"""

from collections.abc import Callable

import numpy as np

from ctsim.geometry import Triple
from ctsim.solids import Solid
from ctsim.types import Phantom
from phantoms.bodies import Recipe, Shape, assemble
from phantoms.fields import Canvas, Field, Mask, Noise, supply_tree
from phantoms.inserts import count, diameter, inserts

MATERIALS = ("air", "soft_tissue", "adipose", "lung", "cortical_bone")
AIR, SOFT, FAT, LUNG, BONE = range(5)


class Lung(Recipe, frozen=True, kw_only=True, tag="lung"):
    """Thorax with metal rods beside the spine and balls in the chest (Fe by default).

    `vessels` is the number of terminal vessels in each lung, `ribs` the number of rib pairs.
    """

    metal: str = "Fe"
    vessels: int = 160
    ribs: int = 8

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("vessels", 1, 2000)
        self.within("ribs", 0, 12)


def lung(n: Shape, d_voxel: Triple, rng: np.random.Generator, params: Lung) -> Phantom:
    """Draw a thorax; metal: two rods along the spine, then balls in muscle, heart and chest wall."""
    body, metal = rng.spawn(2)
    canvas = Canvas(n, d_voxel, shrink=0.95)
    wall = _wall(canvas, body)
    _lungs(canvas, body, params.vessels)
    _heart(canvas, body)
    _ribs(canvas, body, params.ribs, wall)
    _spine(canvas, body)
    return assemble(canvas.labels, d_voxel, MATERIALS, _metal(metal, params, canvas.unit))


def _egg(x: Field, y: Field, z: Field, a: float, b: float, power: float = 2.4) -> Field:
    """Level function of the chest's cross-section, flattened at the back; 1 on the surface."""
    y = y + np.float32(0.04)
    back = np.where(y < 0, np.float32(1.12), np.float32(1.0))
    section = (np.abs(x / np.float32(a)) ** power + np.abs(y * back / np.float32(b)) ** power) ** np.float32(1 / power)
    return (section**8 + np.abs(z / np.float32(0.9)) ** 8) ** np.float32(1 / 8)


def _wall(canvas: Canvas, rng: np.random.Generator) -> tuple[float, float]:
    """Skin, fat of varying thickness, muscle; returns the half axes of the rib cage's inside."""
    a, b = 0.88 + 0.02 * rng.uniform(-1, 1), 0.68 + 0.03 * rng.uniform(-1, 1)
    fat, noise = rng.uniform(0.05, 0.09), Noise(rng, 5)

    def inside(scale: float, wobble: float) -> Callable[[Field, Field, Field], Mask]:
        return lambda x, y, z: _egg(x, y, z, a, b) + np.float32(wobble) * noise(x, y, z) <= scale

    canvas.fill(SOFT, inside(1.0 - 0.0, 0.008))
    canvas.fill(FAT, inside(0.975, 0.008))
    canvas.fill(SOFT, inside(0.975 - fat, 0.02))
    # fat between the muscles, which makes the wall look like one
    sheet = Noise(rng, 9)
    canvas.fill(
        FAT,
        lambda x, y, z: (np.abs(sheet(x, y, z)) < 0.16) & (_egg(x, y, z, a, b) < 0.93 - fat),
        over=(SOFT,),
    )
    return a * (0.80 - fat / 2), b * (0.78 - fat / 2)


def _in_lung(x: Field, y: Field, z: Field, side: int, dome: float) -> Mask:
    """Tell points of the left (side 1) or right (−1) lung, heart and vessels not yet cut out."""
    centre = np.float32(0.36 * side)
    egg = ((x - centre) / 0.285) ** 2 + ((y + 0.03) / 0.46) ** 2 + ((z - 0.05) / 0.80) ** 4
    floor = np.float32(-0.62 + dome) - 1.1 * (x - np.float32(0.3 * side)) ** 2 - 0.9 * (y - 0.05) ** 2
    return (egg <= 1) & (z > floor) & (side * x > 0.10 + 0.05 * (1 - 3 * (y + 0.05) ** 2) * (1 - 0.6 * z**2))


def _lungs(canvas: Canvas, rng: np.random.Generator, vessels: int) -> None:
    liver = Noise(rng, 6)
    canvas.fill(  # the abdomen's top below the domes, with some fat
        SOFT,
        lambda x, y, z: ((x / 0.62) ** 2 + ((y + 0.03) / 0.48) ** 2 <= 1) & (z < -0.35) & (z > -0.88),
        over=(FAT,),
    )
    canvas.fill(
        FAT,
        lambda x, y, z: (
            ((x / 0.6) ** 2 + ((y + 0.03) / 0.46) ** 2 <= 1)
            & (z < -0.5)
            & (z > -0.86)
            & (np.abs(liver(x, y, z)) < 0.12)
        ),
        over=(SOFT,),
    )
    canvas.ellipsoid(AIR, (0.3, 0.16, -0.74), (0.16, 0.12, 0.07))  # gas in the stomach
    for side in (-1, 1):
        dome = 0.24 if side < 0 else 0.16  # the liver lifts the right dome
        canvas.fill(LUNG, lambda x, y, z, s=side, d=dome: _in_lung(x, y, z, s, d))
        hilum = np.array([0.15 * side, -0.06, 0.10])
        points = rng.uniform((-0.3, -0.5, -0.75), (0.3, 0.45, 0.85), (vessels * 12, 3))
        points[:, 0] += 0.36 * side
        kept = [p for p in points if _in_lung(p[0], p[1], p[2], side, dome - 0.03)][:vessels]
        if not kept:
            continue
        for start, end, r0, r1 in supply_tree(hilum, np.array(kept), 0.07, 0.011):
            canvas.capsule(SOFT, start, end, (r0, r1), over=(LUNG,))
        for start, end, r0, r1 in supply_tree(hilum - np.array([0, 0.05, 0]), np.array(kept[::8]) + 0.03, 0.045, 0.012):
            canvas.capsule(SOFT, start, end, (r0 + 0.008, r1 + 0.006), over=(LUNG,))
            canvas.capsule(AIR, start, end, (r0, r1), over=(LUNG, SOFT))
        fissure, bend = rng.uniform(-0.1, 0.1), Noise(rng, 3)
        canvas.fill(
            SOFT,
            lambda x, y, z, f=fissure, w=bend: np.abs(0.75 * y + 0.66 * z + 0.04 * w(x, y, z) - np.float32(f)) < 0.005,
            over=(LUNG,),
        )


def _heart(canvas: Canvas, rng: np.random.Generator) -> None:
    """Heart in its fat, great vessels, windpipe and gullet."""
    tilt = rng.uniform(-0.1, 0.1)
    axis = np.array([0.62, 0.45 + tilt, -0.62])
    axis /= np.linalg.norm(axis)
    u = np.cross(axis, [0, 0, 1.0])
    u /= np.linalg.norm(u)
    frame = np.stack([u, np.cross(axis, u), axis])
    centre = np.array([0.09, 0.14, -0.14])
    canvas.ellipsoid(FAT, centre, (0.255, 0.255, 0.345), frame)
    canvas.ellipsoid(SOFT, centre, (0.235, 0.235, 0.325), frame)
    groove = np.array([centre + 0.235 * (np.cos(t) * frame[0] + np.sin(t) * frame[1]) for t in np.linspace(0, 6.3, 25)])
    canvas.tube(FAT, groove, 0.022)
    arch = [
        (0.02, 0.10, 0.02), (-0.05, 0.12, 0.24), (-0.02, 0.06, 0.40), (0.06, -0.06, 0.45), (0.12, -0.20, 0.38),
        (0.12, -0.29, 0.2), (0.10, -0.29, -0.85),
    ]  # fmt: skip
    canvas.tube(FAT, arch, 0.092, over=(LUNG,))
    canvas.tube(SOFT, arch, 0.078)
    canvas.tube(SOFT, [(-0.12, 0.1, 0.8), (-0.12, 0.1, 0.0)], 0.055)  # superior vena cava
    for side in (-1, 1):
        canvas.tube(SOFT, [(0.03, 0.05, 0.1), (0.1 * side, -0.03, 0.13), (0.2 * side, -0.06, 0.10)], 0.06)
    for airway in (
        [(0.0, -0.02, 0.83), (0.0, -0.08, 0.26)],
        [(0.0, -0.08, 0.26), (0.17, -0.10, 0.11)],
        [(0.0, -0.08, 0.26), (-0.17, -0.10, 0.13)],
    ):
        canvas.tube(SOFT, airway, 0.066)
        canvas.tube(AIR, airway, 0.05)
    canvas.tube(SOFT, [(0.03, -0.2, 0.86), (0.04, -0.2, -0.8)], 0.04)
    canvas.capsule(AIR, (0.03, -0.2, 0.8), (0.035, -0.2, 0.5), (0.012, 0.012))


def _ribs(canvas: Canvas, rng: np.random.Generator, pairs: int, wall: tuple[float, float]) -> None:
    """Ribs around the cage, falling from back to front, with marrow; cartilage to the sternum."""
    a, b = wall
    t = np.linspace(0.0, 1.0, 49)
    for k in range(pairs):
        level = 0.80 - 1.5 * (k + 0.5) / max(pairs, 1)
        narrow = 1 - 0.22 * max(level - 0.35, 0) / 0.5  # the cage narrows towards the neck
        drop = 0.40 + 0.04 * rng.uniform(-1, 1)
        for side in (-1, 1):
            turn = np.radians(12 + 150 * t)  # from beside the spine, round the flank, to the front
            x = side * narrow * a * np.sin(turn)
            y = -0.04 - narrow * b * np.cos(turn)
            z = level + 0.08 - drop * t**1.2 + 0.16 * np.clip(t - 0.8, 0, 1)
            points = np.stack([x, y, z], 1)
            bony = points[t < 0.82]
            canvas.tube(SOFT, points[t >= 0.8], 0.036)
            canvas.tube(BONE, bony, 0.038)
            canvas.tube(SOFT, bony[2:-2], 0.017)
    front = b - 0.01
    canvas.tube(BONE, [(0.0, front, 0.62), (0.0, front, 0.5)], 0.075)
    for x in np.linspace(-0.05, 0.05, 5):
        canvas.tube(BONE, [(x, front, 0.5), (x, front + 0.01, -0.15)], 0.04)
    for x in np.linspace(-0.045, 0.045, 5):
        canvas.tube(SOFT, [(x, front, 0.5), (x, front + 0.01, -0.13)], 0.018, over=(BONE,))
    for side in (-1, 1):  # shoulder blades and collar bones
        canvas.tube(BONE, [(0.42 * side, -0.53, 0.66), (0.40 * side, -0.56, 0.0)], (0.026, 0.018))
        canvas.tube(BONE, [(0.42 * side, -0.53, 0.64), (0.62 * side, -0.40, 0.52), (0.41 * side, -0.55, 0.1)], 0.022)
        canvas.tube(BONE, [(0.10 * side, front - 0.02, 0.68), (0.34 * side, front - 0.12, 0.74)], 0.034)


def _spine(canvas: Canvas, rng: np.random.Generator) -> None:
    """Vertebrae with spongy cores, discs, arches, processes and the cord."""
    spongy, count_, y = Noise(rng, 56), 9, -0.42
    canvas.fill(SOFT, lambda x, _y, z: ((x / 0.13) ** 2 + ((_y - y) / 0.11) ** 2 <= 1) & (np.abs(z) < 0.86))
    for k in range(count_):
        low, high = -0.86 + 1.72 * k / count_, -0.86 + 1.72 * (k + 0.8) / count_
        mid = (low + high) / 2

        def vertebra(x: Field, w: Field, z: Field, lo: float = low, hi: float = high, inset: float = 0.0) -> Mask:
            u = (2 * z - (lo + hi)) / (hi - lo)
            waist = 1 - np.float32(0.12) * (1 - u**2) - inset / 0.13
            round_ = (x / 0.14) ** 2 + ((w - y) / 0.115) ** 2 <= waist**2
            return round_ & (z > lo + inset) & (z < hi - inset)

        canvas.fill(BONE, vertebra, ((-0.2, y - 0.2, low), (0.2, y + 0.2, high)))
        canvas.fill(
            SOFT,
            lambda x, w, z, f=vertebra: f(x, w, z, inset=0.02) & (spongy(x, w, z) > -0.35),
            ((-0.2, y - 0.2, low), (0.2, y + 0.2, high)),
        )
        for side in (-1, 1):
            canvas.tube(BONE, [(0.09 * side, y - 0.08, mid), (0.1 * side, y - 0.19, mid), (0, y - 0.23, mid)], 0.034)
            canvas.tube(BONE, [(0.1 * side, y - 0.17, mid), (0.24 * side, y - 0.2, mid + 0.03)], (0.034, 0.026))
        canvas.tube(BONE, [(0, y - 0.22, mid), (0, y - 0.3, mid - 0.1)], (0.03, 0.022))
    canvas.tube(SOFT, [(0, y - 0.155, 0.88), (0, y - 0.155, -0.88)], 0.056)


def _metal(rng: np.random.Generator, params: Lung, unit: float) -> list[Solid]:
    make, d = inserts(params, unit), diameter(params, 5.0, unit)
    shift = rng.uniform(-0.02, 0.02, (16, 3))
    solids: list[Solid] = []
    for k in range(count(params, 4)):
        if k < 2:
            x = 0.2 * (1 - 2 * k) + shift[k, 0] / 2
            tilt = 0.5 * shift[k, 1]
            solids.append(make.rod(f"rod{k}", (x, -0.47, -0.55), (x + tilt, -0.47, 0.45), 0.9 * d, round_ends=True))
            continue
        places = ((0.1, 0.14, -0.12), (-0.30, -0.02, -0.66), (0.02, 0.38, 0.2), (0.68, 0.05, -0.05), (-0.68, 0.0, 0.1))
        place = np.array(places[(k - 2) % 5]) + shift[k] + [0, 0, 0.22 * ((k - 2) // 5)]
        solids.append(make.ball(f"ball{k}", place, 0.8 * d * rng.uniform(0.8, 1.2)))
    return solids
