"""Thorax of a specimen scanned in a micro-CT: ribs, spine, sternum, lungs with vessels, heart, fat, skin.

A miniature, as the paper's scenes are: the whole chest fits a 60 mm cube, so tissue reaches P of 2 to 3
and rods of a few mm starve the detector. Patient's left is +x, front is +y, head is +z.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.phantoms.fields import Canvas, Field, Inside, LabelGrid, Mask, Noise, supply_tree
from ctsim.phantoms.inserts import count, diameter, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

MATERIALS = ("air", "soft_tissue", "adipose", "lung", "cortical_bone")
AIR, SOFT, FAT, LUNG, BONE = range(5)
POWER = 2.4  # of the superellipse that the chest's and the rib cage's sections are
MIDDLE, FLATTER = -0.04, 1.12  # y of the widest place; how much flatter the back is than the front


class Lung(Recipe, frozen=True, kw_only=True, tag="lung"):
    """Thorax with metal rods next to the spine and balls in the chest (Fe by default)."""

    metal: str = "Fe"
    vessels: int = 160
    """Terminal vessels in each lung."""
    ribs: int = 8
    """Pairs of ribs."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("vessels", 1, 2000)
        self.within("ribs", 0, 12)


def lung(grid: LabelGrid, rng: np.random.Generator, params: Lung) -> Phantom:
    """Draw a thorax; metal: two rods along the spine, then balls in muscle, heart and chest wall."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=0.95)
    wall = _wall(canvas, body)
    _lungs(canvas, body, params.vessels)
    _pleura(canvas, wall)
    _heart(canvas, body, wall.spine)
    _ribs(canvas, body, params.ribs, wall)
    _shoulders(canvas, wall)
    _spine(canvas, body, wall)
    return assemble(canvas.whole, grid, MATERIALS, _metal(metal, params, canvas.unit))


class Wall(NamedTuple):
    """The chest wall of one individual: half axes of the skin's section and thickness of the fat (level)."""

    a: float
    b: float
    fat: float

    @property
    def cage(self) -> tuple[float, float]:
        """Return the half axes of the rib cage."""
        return self.a * (0.80 - self.fat / 2), self.b * (0.78 - self.fat / 2)

    @property
    def spine(self) -> float:
        """Return y of the vertebral bodies' middle, so that the spinous processes end where the muscle does."""
        return self.back(0.975 - self.fat) + 0.295  # a process reaches 0.273 back and is 0.022 thick

    def back(self, level: float, x: float = 0.0) -> float:
        """Return y on the back at `level` of the chest's section."""
        return MIDDLE - self.b / FLATTER * float(level**POWER - abs(x / self.a) ** POWER) ** (1 / POWER)


def _egg(x: Field, y: Field, z: Field, a: float, b: float, power: float = POWER) -> Field:
    """Level function of the chest's cross-section, flattened at the back; 1 on the surface."""
    y = y - np.float32(MIDDLE)
    back = np.where(y < 0, np.float32(FLATTER), np.float32(1.0))
    section = (np.abs(x / np.float32(a)) ** power + np.abs(y * back / np.float32(b)) ** power) ** np.float32(1 / power)
    return (section**8 + np.abs(z / np.float32(0.9)) ** 8) ** np.float32(1 / 8)


def _wall(canvas: Canvas, rng: np.random.Generator) -> Wall:
    """Skin, fat of varying thickness, muscle."""
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
    return Wall(a, b, fat)


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
        x, y, z = points.T
        ends = points[_in_lung(x, y, z, side, dome - 0.03)][:vessels]
        if not len(ends):
            continue
        _vessels(canvas, hilum, ends)
        _fissure(canvas, side, rng.uniform(-0.1, 0.1), Noise(rng, 3))


def _vessels(canvas: Canvas, hilum: NDArray[np.float64], ends: NDArray[np.float64]) -> None:
    """Paint the vessels that supply points [k, 3] of a lung, and the bronchi beside every eighth of them."""
    if not canvas.labels.size:  # where only the metal is asked for
        return
    for start, end, r0, r1 in supply_tree(hilum, ends, 0.07, 0.011):
        canvas.capsule(SOFT, start, end, (r0, r1), over=(LUNG,))
    for start, end, r0, r1 in supply_tree(hilum - np.array([0, 0.05, 0]), ends[::8] + 0.03, 0.045, 0.012):
        canvas.capsule(SOFT, start, end, (r0 + 0.008, r1 + 0.006), over=(LUNG,))
        canvas.capsule(AIR, start, end, (r0, r1), over=(LUNG, SOFT))


def _pleura(canvas: Canvas, wall: Wall) -> None:
    """Muscle in place of what lies outside the ribs' inner face; air of bronchi ends deeper in the lung."""

    def beyond(depth: float) -> Inside:
        a, b = (np.float32(axis - depth) for axis in wall.cage)

        def outside(x: Field, y: Field, z: Field) -> Mask:
            section = np.abs(x / a) ** POWER + np.abs((y - np.float32(MIDDLE)) / b) ** POWER
            return (section > _narrow(z) ** POWER) & (_egg(x, y, z, wall.a, wall.b) < 0.95)

        return outside

    canvas.fill(SOFT, beyond(0.045), over=(LUNG,))
    canvas.fill(SOFT, beyond(0.1), over=(AIR,))


def _narrow(z: Field) -> Field:
    """Width of the rib cage at height z relative to its half axes: a barrel that narrows towards the neck."""
    return 1.01 - 0.06 * z**2 - 0.36 * np.maximum(z - 0.5, 0)


def _fissure(canvas: Canvas, side: int, height: float, bend: Noise) -> None:
    """Oblique fissure of one lung, bowed backwards at its edges."""

    def inside(x: Field, y: Field, z: Field) -> Mask:
        bow = 0.9 * (x - np.float32(0.36 * side)) ** 2
        return (np.abs(0.75 * y + 0.66 * z + bow + 0.04 * bend(x, y, z) - np.float32(height)) < 0.005) & (side * x > 0)

    canvas.fill(SOFT, inside, over=(LUNG,))


def _heart(canvas: Canvas, rng: np.random.Generator, spine: float) -> None:
    """Heart in its fat, great vessels, windpipe and gullet; aorta and gullet run along the spine's front."""
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
        (0.02, 0.10, 0.02), (-0.05, 0.12, 0.24), (-0.02, 0.06, 0.40), (0.06, -0.06, 0.45),
        (0.13, spine + 0.14, 0.38), (0.14, spine + 0.10, 0.2), (0.12, spine + 0.11, -0.78),
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
    gullet = spine + 0.125
    canvas.tube(SOFT, [(0.03, gullet, 0.86), (0.04, gullet, -0.8)], 0.04)
    canvas.capsule(AIR, (0.03, gullet, 0.8), (0.035, gullet, 0.5), (0.012, 0.012))


def _ribs(canvas: Canvas, rng: np.random.Generator, pairs: int, wall: Wall) -> None:
    """Ribs from the spine around the cage, falling from back to front, with marrow; cartilage to the sternum."""
    a, b = wall.cage
    t = np.linspace(0.0, 1.0, 49)
    turn = np.radians(12 + 150 * t)  # from next to the spine, round the flank, to the front
    round_ = (np.abs(np.sin(turn)) ** POWER + np.abs(np.cos(turn)) ** POWER) ** (-1 / POWER)
    neck = 6  # points from the head at the vertebra over the transverse process to the cage
    for k in range(pairs):
        level = 0.80 - 1.5 * (k + 0.5) / max(pairs, 1)
        drop = 0.40 + 0.04 * rng.uniform(-1, 1)
        z = level + 0.08 - drop * t**1.2 + 0.16 * np.clip(t - 0.8, 0, 1)
        within = z > -0.78  # the lowest ribs end free in the flank
        for side in (-1, 1):
            x = _narrow(z) * a * round_ * np.sin(turn)
            y = MIDDLE - _narrow(z) * b * round_ * np.cos(turn)
            x[:neck] = np.interp(np.arange(neck), (0, 2, neck), (0.10, 0.20, x[neck]))
            y[:neck] = np.interp(np.arange(neck), (0, 2, neck), (wall.spine - 0.06, wall.spine - 0.15, y[neck]))
            points = np.stack([side * x, y, z], 1)
            bony = points[(t < 0.82) & within]
            canvas.tube(SOFT, points[(t >= 0.8) & within], 0.036)
            canvas.tube(BONE, bony, 0.038)
            canvas.tube(SOFT, bony[2:-2], 0.017)
    _sternum(canvas, b - 0.01)


def _sternum(canvas: Canvas, front: float) -> None:
    """Breastbone with marrow: a slightly bowed plate that slopes forward from top to bottom."""

    def at(x: float, z: float) -> tuple[float, float, float]:
        return x, front + 0.007 - 0.054 * z - 2 * x**2, z

    canvas.tube(BONE, [at(0.0, 0.62), at(0.0, 0.5)], 0.075)
    for x in np.linspace(-0.05, 0.05, 5):
        canvas.tube(BONE, [at(x, 0.5), at(x, -0.15)], 0.04)
    for x in np.linspace(-0.045, 0.045, 5):
        canvas.tube(SOFT, [at(x, 0.5), at(x, -0.13)], 0.018, over=(BONE,))


def _shoulders(canvas: Canvas, wall: Wall) -> None:
    """Shoulder blades between the ribs and the back's fat, and collar bones."""
    front = wall.cage[1] - 0.01

    def at(x: float, z: float) -> tuple[float, float, float]:
        return x, wall.back(0.88, x), z

    for side in (-1, 1):
        canvas.tube(BONE, [at(0.42 * side, 0.66), at(0.40 * side, 0.0)], (0.026, 0.018))
        canvas.tube(BONE, [at(0.42 * side, 0.64), at(0.62 * side, 0.52), at(0.41 * side, 0.1)], 0.022)
        canvas.tube(BONE, [(0.10 * side, front - 0.02, 0.68), (0.34 * side, front - 0.12, 0.74)], 0.034)


def _spine(canvas: Canvas, rng: np.random.Generator, wall: Wall) -> None:
    """Vertebrae with spongy cores, discs, arches, processes and the cord."""
    spongy, count_, y, end = Noise(rng, 56), 9, wall.spine, 0.83
    canvas.fill(SOFT, lambda x, w, z: ((x / 0.13) ** 2 + ((w - y) / 0.105) ** 2 <= 1) & (np.abs(z) < end + 0.02))
    for k in range(count_):
        low, high = end * (2 * k / count_ - 1), end * (2 * (k + 0.8) / count_ - 1)
        mid = (low + high) / 2

        def vertebra(x: Field, w: Field, z: Field, lo: float = low, hi: float = high, inset: float = 0.0) -> Mask:
            u = (2 * z - (lo + hi)) / (hi - lo)
            waist = 1 - np.float32(0.12) * (1 - u**2) - inset / 0.11
            round_ = (x / 0.12) ** 2 + ((w - y) / 0.09) ** 2 <= waist**2
            return round_ & (z > lo + inset) & (z < hi - inset)

        canvas.fill(BONE, vertebra, ((-0.2, y - 0.2, low), (0.2, y + 0.2, high)))
        canvas.fill(
            SOFT,
            lambda x, w, z, f=vertebra: f(x, w, z, inset=0.02) & (spongy(x, w, z) > -0.35),
            ((-0.2, y - 0.2, low), (0.2, y + 0.2, high)),
        )
        for side in (-1, 1):
            canvas.tube(BONE, [(0.075 * side, y - 0.06, mid), (0.08 * side, y - 0.16, mid), (0, y - 0.20, mid)], 0.03)
            canvas.tube(BONE, [(0.08 * side, y - 0.15, mid), (0.22 * side, y - 0.19, mid + 0.03)], (0.032, 0.026))
        tip = max(mid - 0.1, 0.09 - end)  # the lowest ends level, above the cut through the body
        canvas.tube(BONE, [(0, y - 0.195, mid), (0, y - 0.273, tip)], (0.03, 0.022))
    canvas.tube(SOFT, [(0, y - 0.13, end), (0, y - 0.13, -end)], 0.045)


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
