"""A slice of the abdomen about the lumbar spine, with pedicle screws, the rods that join them, and a vessel's plug.

One relative unit is about 170 mm in a patient; the cube's `size` scales it. Patient's left is +x, front is +y, head is
+z; the third lumbar vertebra is at z = 0.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np

from ctsim.phantoms.bodies.tissue import (
    AIR,
    BLOOD,
    BONE,
    FAT,
    KIDNEY,
    MATERIALS,
    MUSCLE,
    SOFT,
    SPONGY,
    Part,
    bone,
    box_section,
    cut,
    mirrored,
    trabeculae,
)
from ctsim.phantoms.fields import Canvas, Field, Inside, LabelGrid, Mask, Noise
from ctsim.phantoms.inserts import Inserts, count, diameter, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

END = 0.62  # |z| of the planes in which the body is cut
SHRINK = 0.95  # of a relative unit to half the cube's edge
PITCH, HEIGHT = 0.215, 0.160  # of a vertebra with its disc, and of the vertebra
LEVELS = (0, 1, -1, 2, -2)  # vertebrae that carry screws, in order of use
ENTRY = np.array([0.135, -0.215, 0.012])  # of the left screw, from its vertebra's middle
TIP = np.array([0.060, 0.055, -0.002])
PLUG, WIDE = (0.335, -0.05, 0.21), 0.048  # where the artery enters the left kidney; 8 mm in a patient


class Spine(Recipe, frozen=True, kw_only=True, tag="spine"):
    """Lumbar spine with pedicle screws, their heads joined by rods of another metal.

    `metal` is that of the screws. `n_inserts` is the number of screws (6 by default, 2 a vertebra, at most 10);
    `insert_mm` is a screw's diameter.
    """

    height: ClassVar[float] = END * SHRINK

    metal: str = "Ti"
    rods: str = "CoCr"
    """Material of the rods."""
    plug: str = "none"
    """Material of the plug that closes the left kidney's artery, such as W: a nest of coils, drawn as one ball."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.known("rods")
        if self.plug != "none":
            self.known("plug")


def spine(grid: LabelGrid, rng: np.random.Generator, params: Spine) -> Phantom:
    """Draw an abdomen with kidneys, aorta, bowel and five vertebrae; metal: screws in pedicles, two rods."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=SHRINK)
    wall = _body(canvas, body)
    _muscles(canvas, wall)
    _organs(canvas, body)
    for k in range(-3, 4):
        _vertebra(canvas, k)
    trabeculae(canvas, body)
    cut(canvas, END)
    return assemble(canvas.whole, grid, MATERIALS, _metal(metal, params, canvas.unit))


class _Wall(NamedTuple):
    """Half axes of the skin's section, and the thickness of the fat under it."""

    a: float
    b: float
    fat: float


def _middle(z: Field | float) -> Field:
    """Place (y) of the vertebral bodies' middle: the lumbar spine bows forward."""
    return np.asarray(-0.10 + 0.035 * (1 - (np.asarray(z) / 0.6) ** 2))


def _body(canvas: Canvas, rng: np.random.Generator) -> _Wall:
    """Skin, fat, the ring of abdominal muscle, and fat inside it."""
    wall = _Wall(0.92 + 0.015 * rng.uniform(-1, 1), 0.64 + 0.02 * rng.uniform(-1, 1), rng.uniform(0.08, 0.11))
    wobble = Noise(rng, 5)

    def inside(less: float, wave: float) -> Inside:
        def test(x: Field, y: Field, z: Field) -> Mask:
            groove = 0.05 * np.exp(-((x / 0.10) ** 2)) * (y < 0)  # over the spine
            section = box_section(x, y, wall.a - less, wall.b - less, 2.3)
            return (section + groove + np.float32(wave) * wobble(x, y, z) <= 1) & (np.abs(z) < END)

        return test

    canvas.fill(SOFT, inside(0.0, 0.006))
    canvas.fill(FAT, inside(0.014, 0.006))
    canvas.fill(MUSCLE, inside(0.014 + wall.fat, 0.010))
    canvas.fill(FAT, inside(0.014 + wall.fat + 0.055, 0.010))
    sheet = Noise(rng, 8)
    canvas.fill(FAT, lambda x, y, z: np.abs(sheet(x, y, z)) < 0.06, over=(MUSCLE,))
    return wall


def _muscles(canvas: Canvas, wall: _Wall) -> None:
    """Muscles along the spine, with fat between them."""
    back = wall.b - wall.fat - 0.03

    def along(x: Field, y: Field, at: tuple[float, float], radii: tuple[Any, Any]) -> Mask:
        return ((np.abs(x) - at[0]) / radii[0]) ** 2 + ((y - at[1]) / radii[1]) ** 2 <= 1

    canvas.fill(
        MUSCLE,
        lambda x, y, z: (
            (
                along(x, y, (0.155, -0.37), (0.135, 0.125))  # erector spinae
                | along(x, y, (0.36, -0.29), (0.12, 0.065))  # quadratus lumborum
                | along(
                    x + 0.10 * z * np.sign(x), y - _middle(z), (0.215, 0.0), (0.085 - 0.035 * z, 0.105 - 0.035 * z)
                )  # psoas
            )
            & (box_section(x, y, wall.a - 0.06, back, 2.3) < 1)
            & (np.abs(z) < END)
        ),
        over=(FAT, MUSCLE),
    )
    canvas.fill(
        FAT,
        lambda x, y, z: (np.abs(np.hypot((np.abs(x) - 0.155) / 0.135, (y + 0.37) / 0.125) - 0.62) < 0.025) & (z > -9),
        over=(MUSCLE,),
    )


def _organs(canvas: Canvas, rng: np.random.Generator) -> None:
    """Liver, kidneys, great vessels, and bowel with some gas."""
    canvas.fill(
        SOFT,
        lambda x, y, z: (
            (((x + 0.42) / 0.38) ** 2 + ((y - 0.10) / 0.36) ** 2 + ((z - 0.70) / 0.62) ** 2 <= 1) & (np.abs(z) < END)
        ),
        over=(FAT,),
    )
    for side in (-1, 1):
        centre = np.array([0.42 * side, -0.08, 0.16 + 0.05 * side])
        tilt = np.array([-0.22 * side, -0.12, 0.97])
        tilt /= np.linalg.norm(tilt)
        across = np.cross([0, 1.0, 0], tilt)
        across /= np.linalg.norm(across)
        frame = np.stack([across, np.cross(tilt, across), tilt])
        canvas.ellipsoid(FAT, centre, (0.20, 0.18, 0.36), frame, over=(SOFT,))
        canvas.ellipsoid(KIDNEY, centre, (0.145, 0.125, 0.31), frame)
        hilum = centre - [0.085 * side, -0.03, 0.0]
        canvas.ellipsoid(FAT, hilum, (0.085, 0.07, 0.16), frame, over=(KIDNEY,))
        canvas.ellipsoid(SOFT, hilum, (0.045, 0.03, 0.08), frame, over=(FAT,))
        renal = [hilum, hilum * [0.5, 1, 1] + [0, 0.06, 0], (0.03, float(_middle(0.16)) + 0.17, 0.16)]
        canvas.tube(BLOOD, renal, 0.02, over=(FAT,))
    z = np.linspace(-END - 0.1, END + 0.1, 13)
    for x, radius in ((0.045, 0.058), (-0.10, 0.065)):  # aorta, inferior vena cava
        vessel = np.stack([np.full(13, x), _middle(z) + 0.118 + radius, z], 1)
        canvas.tube(SOFT, vessel, radius + 0.01, over=(FAT,))
        canvas.tube(BLOOD, vessel, radius, over=(FAT, SOFT))
    for k, centre in enumerate(rng.uniform((-0.45, 0.20, -0.52), (0.5, 0.40, 0.45), (20, 3))):
        axis = rng.uniform(-1, 1, 3) * [0.14, 0.05, 0.10]
        ends = np.clip([centre - axis, centre + axis], (-0.48, 0.20, -0.54), (0.52, 0.40, 0.54))
        canvas.capsule(SOFT, ends[0], ends[1], (0.07, 0.07), over=(FAT, SOFT))
        if k % 3 == 0:
            canvas.capsule(AIR, ends[0], ends[1], (0.04, 0.05), over=(SOFT,))
    for side in (-1, 1):  # ascending and descending colon
        colon = [(0.66 * side, 0.06, -END), (0.70 * side, 0.04, -0.1), (0.64 * side, 0.08, 0.1)]
        canvas.tube(SOFT, colon, 0.085, over=(FAT, SOFT))
        canvas.tube(AIR, np.add(colon, (0, 0.02, 0)), (0.05, 0.035, 0.05), over=(SOFT,))


def _vertebra(canvas: Canvas, k: int) -> None:
    """Body, disc above it, canal, pedicles, joints and processes of vertebra k, counted up from the middle one."""
    z, y = k * PITCH, float(_middle(k * PITCH))

    def oval(x: Field, w: Field, h: Field, less: float) -> Mask:
        up = np.clip((h - z) / (HEIGHT / 2), -1, 1)
        waist = 1 - np.float32(0.10) * (1 - up**2)
        hollow = 0.45 * np.clip(-(w - y) / 0.1, 0, 1) * np.exp(-((x / 0.07) ** 2))  # the back is flat
        edge = (np.abs(x) / (0.148 - less)) ** 2.2 + np.abs((w - y) / (0.108 - less)) ** 2.2 + hollow
        return edge <= waist**2

    def slab(h: Field, low: float, high: float) -> Mask:
        return (h > z + low) & (h < z + high)

    box, half = ((-0.3, y - 0.3, z - 0.3), (0.3, y + 0.3, z + 0.3)), HEIGHT / 2
    canvas.fill(SOFT, lambda x, w, h: oval(x, w, h, 0.004) & slab(h, half, PITCH - half), box)
    canvas.fill(BONE, lambda x, w, h: oval(x, w, h, 0.0) & slab(h, -half, half), box)
    canvas.fill(SPONGY, lambda x, w, h: oval(x, w, h, 0.010) & slab(h, 0.012 - half, half - 0.012), box, over=(BONE,))
    for side in (-1, 1):
        pedicle = mirrored([(0.085, y - 0.06, z + 0.025), (0.105, y - 0.175, z + 0.02)], side)
        joints = mirrored([(0.115, y - 0.20, z + 0.085), (0.110, y - 0.21, z), (0.10, y - 0.225, z - 0.115)], side)
        across = mirrored([(0.11, y - 0.175, z + 0.01), (0.20, y - 0.20, z + 0.015), (0.27, y - 0.205, z + 0.02)], side)
        lamina = mirrored([(0.10, y - 0.20, z - 0.02), (0.0, y - 0.265, z - 0.04)], side)
        parts = [
            Part(pedicle, (0.045, 0.042)),
            Part(joints, (0.032, 0.036, 0.034)),
            Part(across, (0.028, 0.022, 0.020)),
        ]
        bone(canvas, [*parts, Part(lamina, 0.028)], 0.012)
    bone(canvas, [Part([(0, y - 0.26, z - 0.04), (0, y - 0.37, z - 0.065)], (0.026, 0.026))], 0.010)
    bone(canvas, [Part([(0, y - 0.27, z - 0.075), (0, y - 0.37, z - 0.095)], (0.022, 0.024))], 0.010)
    middle = [(0, y - 0.160, z - PITCH / 2), (0, y - 0.160, z + PITCH / 2)]
    canvas.tube(FAT, middle, 0.062, over=(FAT, MUSCLE, SOFT, BONE, SPONGY))
    canvas.tube(SOFT, middle, 0.047)  # the dural sac


def _metal(rng: np.random.Generator, params: Spine, unit: float) -> list[Solid]:
    """Return screws with slotted heads, and a rod through the heads of each side."""
    make, rod = inserts(params, unit), Inserts(params.rods, unit)
    d, total = diameter(params, 1.2, unit), min(count(params, 6), 2 * len(LEVELS))
    turn = rng.uniform(-0.012, 0.012, (2 * len(LEVELS), 2))
    heads: dict[int, list[np.ndarray]] = {1: [], -1: []}
    solids: list[Solid] = []
    for k in range(total):
        side, level = 1 - 2 * (k % 2), LEVELS[k // 2]
        base = np.array([0.0, float(_middle(level * PITCH)), level * PITCH])
        entry = base + mirrored(ENTRY, side)
        tip = base + mirrored(TIP, side) + [turn[k, 0], 0.0, turn[k, 1]]
        way = (tip - entry) / np.linalg.norm(tip - entry)
        name = f"{'left' if side > 0 else 'right'}{level:+d}"
        solids.append(make.screw(f"screw{name}", entry, way, d, float(np.linalg.norm(tip - entry)) * unit))
        head = entry - 0.030 * way
        solids.append(make.rod(f"head{name}", entry - 0.062 * way, entry + 0.012 * way, 2.1 * d))
        heads[side].append(head)
    for side, places in heads.items():
        if len(places) > 1:
            at = np.array(sorted(places, key=lambda p: p[2]))
            ends = at[[0, -1]] + np.array([[0, 0, -0.05], [0, 0, 0.05]])
            points = np.concatenate([ends[:1], at, ends[1:]])
            solids.append(rod.wire(f"rod-{'left' if side > 0 else 'right'}", points, 0.85 * d))
    if params.plug != "none" and params.metal != "none":
        solids.append(Inserts(params.plug, unit).ball("plug", PLUG, WIDE * unit))
    return solids
