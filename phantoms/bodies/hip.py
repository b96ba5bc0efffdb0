"""A slice of the pelvis, from the iliac wings to the upper thighs, with replaced hip joints.

One relative unit is about 190 mm in a patient; the cube's `size` scales it. Patient's left is +x, front is +y, head is
+z; the hip joints are at z = 0.
"""

from typing import ClassVar, NamedTuple

import numpy as np

from ctsim.phantoms.bodies.tissue import (
    AIR,
    BLOOD,
    BONE,
    FAT,
    MATERIALS,
    MUSCLE,
    SOFT,
    SPONGY,
    URINE,
    Part,
    bone,
    cut,
    mirrored,
    trabeculae,
)
from ctsim.phantoms.fields import Canvas, Field, Inside, LabelGrid, Mask, Noise
from ctsim.phantoms.inserts import Inserts, count, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

END = 0.62  # |z| of the planes in which the body is cut
SHRINK = 0.95  # of a relative unit to half the cube's edge
HEAD = np.array([0.47, -0.02, 0.0])  # centre of the left joint
OPENING = np.array([0.66, 0.26, -0.70])  # way in which the left socket opens: 45° down, 20° forward
KNEE = np.array([0.54, 0.0, -0.70])  # where the left shaft's axis goes
NECK = np.array([0.675, -0.05, -0.13])  # where neck and shaft meet


class Hip(Recipe, frozen=True, kw_only=True, tag="hip"):
    """Pelvis with hip replacements: metal heads in metal cups, on stems down the thigh bones.

    `metal` is that of cups and stems. `n_inserts` is the number of replaced joints, the left one first (2 by
    default); `insert_mm` is a head's diameter.
    """

    height: ClassVar[float] = END * SHRINK

    metal: str = "Ti"
    head: str = "CoCr"
    """Material of the heads."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.known("head")


def hip(grid: LabelGrid, rng: np.random.Generator, params: Hip) -> Phantom:
    """Draw a pelvis with muscles, bladder, bowel and vessels; metal: a cup, a head and a stem a side."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=SHRINK)
    wall = _body(canvas, body)
    _muscles(canvas, body, wall)
    _organs(canvas, body)
    for side in (-1, 1):
        _hip_bone(canvas, side)
        _joint(canvas, side)
    _sacrum(canvas)
    trabeculae(canvas, body)
    cut(canvas, END)
    return assemble(canvas.whole, grid, MATERIALS, _metal(metal, params, canvas.unit))


class _Wall(NamedTuple):
    """Half axes of the skin's section at the hips, and the thickness of the fat under it."""

    a: float
    b: float
    fat: float


def _level(x: Field, y: Field, z: Field, wall: _Wall) -> Field:
    """Level of the body's section: an oval that becomes two thighs below the crotch; 1 on the skin."""
    width = wall.a * (1 - 0.10 * np.clip((z - 0.1) / 0.5, 0, 1) ** 2 - 0.04 * np.clip(-z / 0.6, 0, 1))
    trunk = (np.abs(x / width) ** 2.4 + np.abs((y + 0.02) / wall.b) ** 2.2) ** np.float32(1 / 2.3)
    half = width / 2 - 0.004
    thigh = np.hypot((np.abs(x) - half - 0.008) / half, (y - 0.01) / (0.98 * wall.b))
    legs = np.clip((-0.30 - z) / 0.10, 0, 1)  # 0 above the crotch, 1 where the thighs are apart
    return (1 - legs) * trunk + legs * np.maximum(thigh, trunk)


def _body(canvas: Canvas, rng: np.random.Generator) -> _Wall:
    """Skin, fat that is thicker behind, and the muscle under its sheath."""
    wall = _Wall(0.925 + 0.01 * rng.uniform(-1, 1), 0.60 + 0.02 * rng.uniform(-1, 1), rng.uniform(0.10, 0.13))
    wobble = Noise(rng, 5)

    def inside(scale: float, wave: float, behind: float = 0.0) -> Inside:
        def test(x: Field, y: Field, z: Field) -> Mask:
            thick = np.float32(scale) - behind * np.clip(-y / wall.b, 0, 1) ** 2
            return (_level(x, y, z, wall) + np.float32(wave) * wobble(x, y, z) <= thick) & (np.abs(z) < END)

        return test

    canvas.fill(SOFT, inside(1.0, 0.006))
    canvas.fill(FAT, inside(0.982, 0.006))
    canvas.fill(MUSCLE, inside(0.982 - wall.fat, 0.012, 0.07))
    return wall


def _muscles(canvas: Canvas, rng: np.random.Generator, wall: _Wall) -> None:
    """Fat between the muscles: thin sheets, the pelvis's inside, and the fold at the groin."""
    sheet, other = Noise(rng, 7), Noise(rng, 9)
    inner = 0.955 - wall.fat
    canvas.fill(
        FAT,
        lambda x, y, z: (
            ((np.abs(sheet(x, y, z)) < 0.085) | (np.abs(other(x, y, z)) < 0.05)) & (_level(x, y, z, wall) < inner)
        ),
        over=(MUSCLE,),
    )
    canvas.fill(  # the pelvic cavity, wide above and narrow at its floor
        FAT,
        lambda x, y, z: (
            ((np.abs(x) / (0.30 + 0.30 * np.clip(z, -0.2, 0.6))) ** 2.4 + np.abs((y - 0.02) / 0.37) ** 2.4 <= 1)
            & (z > -0.22 + 0.5 * x**2)
            & (z < END)
        ),
        over=(MUSCLE,),
    )
    for side in (-1, 1):
        canvas.ellipsoid(FAT, (0.36 * side, 0.36, -0.06), (0.11, 0.08, 0.30), over=(MUSCLE,))
        iliopsoas = mirrored([(0.30, 0.10, END + 0.1), (0.38, 0.17, 0.2), (0.47, 0.24, 0.0), (0.60, 0.05, -0.3)], side)
        canvas.tube(MUSCLE, iliopsoas, (0.12, 0.10, 0.085, 0.05), over=(FAT,))
        canvas.ellipsoid(MUSCLE, (0.17 * side, -0.02, -0.02), (0.05, 0.24, 0.13), over=(FAT,))  # obturator
        for x, radius in ((0.33, 0.030), (0.395, 0.025)):  # femoral vein and artery
            vessel = mirrored(
                [(x - 0.16, 0.0, END), (x - 0.1, 0.15, 0.3), (x, 0.36, 0.02), (x + 0.02, 0.28, -END)], side
            )
            canvas.tube(BLOOD, vessel, radius, over=(FAT, MUSCLE))


def _organs(canvas: Canvas, rng: np.random.Generator) -> None:
    """Bladder, rectum with gas, and loops of bowel."""
    full = rng.uniform(0.85, 1.1)
    bladder, size = np.array([0.0, 0.14, 0.05]), np.array([0.205, 0.155, 0.15]) * full
    canvas.ellipsoid(SOFT, (0.0, 0.05, -0.10), (0.085, 0.075, 0.10))  # below it
    loops = rng.uniform((-0.28, -0.05, 0.26), (0.28, 0.30, 0.56), (7, 3))
    for k, centre in enumerate(loops):
        axis = rng.uniform(-1, 1, 3) * [0.16, 0.09, 0.06]
        ends = np.clip([centre - axis, centre + axis], (-0.32, -0.1, 0.24), (0.32, 0.31, 0.54))
        canvas.capsule(SOFT, ends[0], ends[1], (0.068, 0.068), over=(FAT, SOFT))
        if k < 3:
            canvas.capsule(AIR, ends[0], ends[1], (0.035, 0.045), over=(SOFT,))
    canvas.ellipsoid(SOFT, bladder, size + 0.018)
    canvas.ellipsoid(URINE, bladder, size)
    rectum = [(0.03, -0.10, 0.34), (0.02, -0.24, 0.18), (0.0, -0.25, 0.0), (0.0, -0.20, -0.20)]
    canvas.tube(SOFT, rectum, (0.075, 0.085, 0.08, 0.05))
    canvas.tube(AIR, np.add(rectum[:3], (0, 0.02, 0)), (0.025, 0.035, 0.02), over=(SOFT,))


def _hip_bone(canvas: Canvas, side: int) -> None:
    """Ilium, ischium and pubis about the socket."""
    roof = (0.46, -0.04, 0.15)
    crest = [(0.70, 0.16, 0.66), (0.71, 0.03, 0.68), (0.68, -0.12, 0.68), (0.58, -0.26, 0.66), (0.45, -0.36, 0.60)]
    wing = [Part(mirrored([roof + 0.25 * (c - roof), c], side), (0.085, 0.034)) for c in np.array(crest)]
    front = [(0.42, 0.08, 0.02), (0.22, 0.27, -0.05), (0.07, 0.34, -0.11)]
    seat = [(0.43, -0.14, 0.02), (0.38, -0.25, -0.14), (0.34, -0.25, -0.26)]
    below = [(0.065, 0.32, -0.15), (0.18, 0.10, -0.25), (0.30, -0.17, -0.29)]
    parts = [
        *wing,
        Part(mirrored([roof, (0.40, -0.14, 0.2), (0.31, -0.30, 0.34)], side), (0.10, 0.09, 0.07)),  # to the sacrum
        Part(mirrored(front, side), (0.07, 0.052, 0.060)),
        Part(mirrored(seat, side), (0.085, 0.070, 0.085)),
        Part(mirrored(below, side), 0.036),
    ]
    bone(canvas, parts, 0.018)
    centre, out = mirrored(HEAD, side), mirrored(OPENING, side) / np.linalg.norm(OPENING)

    def socket(x: Field, y: Field, z: Field, radius: float, depth: float) -> Mask:
        p = [x - np.float32(centre[0]), y - np.float32(centre[1]), z - np.float32(centre[2])]
        ahead = out[0] * p[0] + out[1] * p[1] + out[2] * p[2]
        return (p[0] ** 2 + p[1] ** 2 + p[2] ** 2 <= radius**2) & (ahead < depth)

    box = (centre - 0.2, centre + 0.2)
    canvas.fill(BONE, lambda x, y, z: socket(x, y, z, 0.192, 0.02), box)
    canvas.fill(SPONGY, lambda x, y, z: socket(x, y, z, 0.176, 0.004), box, over=(BONE,))
    canvas.fill(BONE, lambda x, y, z: socket(x, y, z, 0.150, 0.02), box)


def _joint(canvas: Canvas, side: int) -> None:
    """Thigh bone with cartilage on its head, neck, trochanters and the marrow of its shaft."""
    head, neck, knee = mirrored(HEAD, side), mirrored(NECK, side), mirrored(KNEE, side)
    canvas.ellipsoid(SOFT, head, 0.137)
    greater = mirrored([(0.715, -0.08, 0.0), (0.70, -0.06, -0.12)], side)
    lesser = mirrored([(0.60, -0.09, -0.24), (0.65, -0.05, -0.25)], side)
    middle = neck + 0.35 * (knee - neck)
    parts = [
        Part([head, head + 1e-6], 0.127),
        Part([head, neck], (0.080, 0.095)),
        Part(greater, (0.075, 0.095)),
        Part(lesser, 0.045),
        Part([neck, middle], (0.100, 0.078)),
    ]
    shaft = [middle, knee]
    canvas.tube(BONE, shaft, 0.078)
    bone(canvas, parts, 0.014)
    canvas.tube(FAT, [neck + 0.28 * (knee - neck), knee], 0.046, over=(SPONGY, BONE))


def _sacrum(canvas: Canvas) -> None:
    """Sacrum with its canal, coccyx, and the cartilage between the pubic bones."""
    parts = [
        Part([(-0.13, -0.30, 0.60), (0.13, -0.30, 0.60)], 0.11),
        Part([(-0.15, -0.32, 0.46), (0.15, -0.32, 0.46)], 0.10),
        Part([(-0.13, -0.36, 0.32), (0.13, -0.36, 0.32)], 0.075),
        Part([(-0.06, -0.39, 0.20), (0.06, -0.39, 0.20)], 0.055),
        Part([(0.0, -0.39, 0.14), (0.0, -0.36, 0.04), (0.0, -0.31, -0.02)], (0.04, 0.03, 0.02)),
    ]
    bone(canvas, parts, 0.016)
    canvas.tube(FAT, [(0, -0.36, END + 0.1), (0, -0.40, 0.34)], (0.04, 0.02), over=(BONE, SPONGY))
    canvas.ellipsoid(SOFT, (0, 0.34, -0.12), (0.02, 0.05, 0.07))


def _metal(rng: np.random.Generator, params: Hip, unit: float) -> list[Solid]:
    """Return cup, head, neck and stem of each replaced joint; later ones cover earlier ones."""
    make, ball = inserts(params, unit), Inserts(params.head, unit)
    solids: list[Solid] = []
    for k in range(min(count(params, 2), 2)):
        side = 1 - 2 * k
        centre, neck, knee = (mirrored(p, side) for p in (HEAD, NECK, KNEE))
        out = mirrored(OPENING, side)
        head = params.insert_mm or 0.246 * unit
        thick = 0.024 * unit * rng.uniform(0.9, 1.1)
        name = ("left", "right")[k]
        tip, shoulder = neck + 0.72 * (knee - neck), neck + 0.06 * (knee - neck)
        solids += [
            make.dome(f"cup-{name}", centre, head + 2 * thick, -out),
            make.rod(f"neck-{name}", centre, shoulder, 0.075 * unit),
            make.cone(f"stem-{name}", shoulder - 0.05 * (knee - neck), tip, (0.125 * unit, 0.055 * unit)),
            make.ball(f"tip-{name}", tip, 0.055 * unit),
            ball.ball(f"head-{name}", centre, head),
        ]
    return solids
