"""Both jaws in a face with its tissues: skin, fat, muscles, tongue, glands and vessels.

Teeth, arches and restorations are those of `teeth`. Bones have a compact shell, spongy bone with struts, and marrow.
Patient's left is +x, front is +y, up is +z; the teeth meet at z = 0.
"""

import numpy as np

from ctsim.phantoms.bodies import teeth, tissue
from ctsim.phantoms.bodies.teeth import AIR, BONE, MOUTH_BOX, NOSE, SHRINK, SOFT, arch_gap, ridge, section
from ctsim.phantoms.bodies.tissue import mirrored
from ctsim.phantoms.fields import Canvas, Field, LabelGrid, Mask, Noise
from ctsim.phantoms.recipe import assemble
from ctsim.types import Phantom

MATERIALS = (*teeth.MATERIALS, "adipose", "muscle", "spongiosa", "blood")
FAT, MUSCLE, SPONGY, BLOOD = range(len(teeth.MATERIALS), len(MATERIALS))
FLESH = (SOFT, FAT, MUSCLE)
SKIN = 0.05  # its thickness


class Jaw(teeth.Teeth, frozen=True, kw_only=True, tag="jaw"):
    """Jaws as those of `teeth`, with the same metal, in a face of fat, muscle, glands and vessels."""


def jaw(grid: LabelGrid, rng: np.random.Generator, params: Jaw) -> Phantom:
    """Draw the face from the skin inwards, then the jaws and their teeth; metal as in `teeth`."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=SHRINK)
    wobble = Noise(body, 4)
    _face(canvas, body, wobble)
    _mouth(canvas, body, wobble)
    _vessels(canvas)
    for side in (-1, 1):
        _ramus(canvas, side)
    solids = teeth.dentition(canvas, (body, metal), params, lambda which: _bone(canvas, which))
    _palate(canvas)
    tissue.trabeculae(canvas, body, core=SPONGY, marrow=FAT, struts=BONE)
    canvas.ellipsoid(AIR, *NOSE)
    return assemble(canvas.whole, grid, MATERIALS, solids)


def _face(canvas: Canvas, rng: np.random.Generator, wobble: Noise) -> None:
    """Skin, the fat of the cheeks, which is thin at the lips, and the muscles under it with fat between them."""
    thick, sheet = Noise(rng, 5), Noise(rng, 9)

    def depth(x: Field, y: Field, z: Field) -> Field:
        """Relative distance to the skin's surface, as a share of the face's half width."""
        return 0.98 - 0.012 * wobble(x, y, z) - section(x, y)

    def fat(x: Field, y: Field, z: Field) -> Field:
        lips = np.clip((y - 0.35) / 0.4, 0, 1) * np.clip(1.4 - np.abs(z) / 0.45, 0, 1)
        return SKIN + np.clip(0.075 + 0.02 * thick(x, y, z), 0.03, None) * (1 - 0.85 * lips)

    def whole(x: Field, y: Field, z: Field) -> Mask:
        level = (section(x, y) ** 8 + np.abs(z / 0.97) ** 8) ** np.float32(1 / 8)
        return level + 0.012 * wobble(x, y, z) < 0.98

    canvas.fill(SOFT, whole)
    canvas.fill(FAT, lambda x, y, z: depth(x, y, z) > SKIN, over=(SOFT,))
    canvas.fill(MUSCLE, lambda x, y, z: depth(x, y, z) > fat(x, y, z), over=(FAT,))
    canvas.fill(FAT, lambda x, y, z: np.abs(sheet(x, y, z)) < 0.10, over=(MUSCLE,))
    for side in (-1, 1):
        # the pad between the cheek's muscle and the chewing ones, and the gland behind the jaw
        canvas.ellipsoid(FAT, (0.76 * side, -0.12, 0.20), (0.07, 0.24, 0.34), over=(MUSCLE,))
        canvas.ellipsoid(SOFT, (0.55 * side, -0.74, 0.15), (0.17, 0.10, 0.42), over=(FAT, MUSCLE))


def _mouth(canvas: Canvas, rng: np.random.Generator, wobble: Noise) -> None:
    """Mouth with its lining, tongue, what lies under it, and the throat."""
    grain = Noise(rng, 20)
    # inside the lower arch: fat, two muscles from the chin to the tongue's root, glands at their sides
    canvas.fill(
        FAT,
        lambda x, y, z: (arch_gap(x, y) < -0.19) & (y > -0.45) & (z < -0.30),
        over=FLESH,
    )
    canvas.fill(
        MUSCLE,  # the floor, a sheet that sags between the two halves of the jaw
        lambda x, y, z: (arch_gap(x, y) < -0.15) & (y > -0.45) & (np.abs(z + 0.72 - 0.3 * x**2) < 0.035),
        over=FLESH,
    )
    # above the palate there is the nose's lining instead
    canvas.fill(SOFT, lambda x, y, z: (arch_gap(x, y) < -0.13) & (y > -0.40) & (z > 0.48), over=(FAT, MUSCLE))
    for side in (-1, 1):
        canvas.tube(MUSCLE, mirrored([(0.06, 0.48, -0.66), (0.07, 0.1, -0.60), (0.08, -0.4, -0.55)], side), 0.06)
        canvas.tube(MUSCLE, mirrored([(0.10, 0.40, -0.86), (0.22, 0.05, -0.84), (0.34, -0.3, -0.80)], side), 0.065)
        canvas.ellipsoid(SOFT, (0.25 * side, 0.08, -0.50), (0.07, 0.22, 0.08))
        canvas.ellipsoid(SOFT, (0.33 * side, -0.30, -0.72), (0.10, 0.16, 0.11), over=FLESH)
    canvas.fill(SOFT, lambda x, y, z: teeth.mouth(x * 0.95, y * 0.95, z * 0.90, wobble), over=FLESH)  # the lining
    canvas.fill(AIR, lambda x, y, z: teeth.mouth(x, y, z, wobble), MOUTH_BOX)
    canvas.fill(SOFT, lambda x, y, z: teeth.tongue(x, y, z, wobble) <= 1, over=(AIR, *FLESH))
    canvas.fill(MUSCLE, lambda x, y, z: teeth.tongue(x, y, z, wobble) <= 0.86, over=(SOFT,))

    def fatty(x: Field, y: Field, z: Field) -> Mask:
        within = teeth.tongue(x, y, z, wobble) <= 0.8
        return within & ((np.abs(x) < 0.014) | (grain(x, y, z) + 1.2 * np.clip(-0.1 - z, -0.3, 0.3) > 1.5))

    canvas.fill(FAT, fatty, over=(MUSCLE,))
    canvas.ellipsoid(MUSCLE, (0.0, -0.66, 0.0), (0.30, 0.11, 2.0), over=(FAT, SOFT))
    canvas.ellipsoid(SOFT, (0.0, -0.63, 0.0), (0.22, 0.085, 2.0), over=(FAT, MUSCLE))
    canvas.ellipsoid(AIR, (0.0, -0.62, 0.0), (0.17, 0.055, 2.0), over=(SOFT,))


def _vessels(canvas: Canvas) -> None:
    """Arteries of face and tongue, veins under the skin, and the great vessels behind the throat."""
    ways = (
        (
            [(0.50, -0.55, -0.95), (0.60, -0.30, -0.80), (0.74, 0.05, -0.60), (0.62, 0.38, -0.25), (0.42, 0.60, 0.35)],
            0.028,
        ),
        ([(0.40, -0.60, -0.80), (0.24, -0.35, -0.50), (0.16, 0.05, -0.38), (0.10, 0.28, -0.28)], 0.024),
        ([(0.66, -0.52, -0.90), (0.79, -0.20, -0.55), (0.78, 0.10, 0.10), (0.58, 0.50, 0.60)], 0.030),
        ([(0.36, -0.72, -0.95), (0.38, -0.74, 0.0), (0.36, -0.72, 0.95)], 0.060),
        ([(0.42, -0.60, -0.95), (0.43, -0.62, 0.0), (0.42, -0.62, 0.95)], 0.045),
    )
    for way, radius in ways:
        for side in (-1, 1):
            canvas.tube(BLOOD, mirrored(way, side), radius, over=FLESH)


def _bone(canvas: Canvas, which: int) -> None:
    """Gum and alveolar bone of one jaw: a compact shell round spongy bone, with the nerve's canal in the lower one."""
    box = teeth.ridge_box(which)
    canvas.fill(SOFT, lambda x, y, z: ridge(x, y, z, which) <= 1.12, box, over=(AIR, *FLESH))
    canvas.fill(BONE, lambda x, y, z: ridge(x, y, z, which) <= 1, box)
    canvas.fill(SPONGY, lambda x, y, z: ridge(x, y, z, which) <= 0.80, box, over=(BONE,))
    if which < 0:
        for side in (-1, 1):
            canal = mirrored(
                [(0.62, -0.40, -0.66), (0.58, -0.05, -0.76), (0.46, 0.25, -0.74), (0.52, 0.34, -0.62)], side
            )
            canvas.tube(BONE, canal, 0.055, over=(SPONGY,))
            canvas.tube(SOFT, canal, 0.034, over=(BONE, SPONGY))


def _ramus(canvas: Canvas, side: int) -> None:
    """Draw the lower jaw's branch behind the teeth, between the muscle outside it and the one inside."""
    ways = [
        mirrored([(0.605, y, -0.74), (0.60, y - 0.04, 0.20), (0.575, y + dy, 0.74)], side)
        for y, dy in ((-0.44, 0.0), (-0.48, -0.02), (-0.52, -0.04))
    ]
    for x, lean in ((0.70, 0.0), (0.49, -0.05)):
        muscle = mirrored([(x, -0.47, -0.78), (x + lean, -0.49, -0.1), (x + lean - 0.02, -0.46, 0.6)], side)
        canvas.tube(MUSCLE, muscle, (0.05, 0.07, 0.05), over=FLESH)
    for way in ways:
        canvas.tube(SOFT, way, 0.10, over=(AIR,))  # the mouth's lining over it
    tissue.bone(canvas, [tissue.Part(way, 0.06) for way in ways], 0.024, shell=BONE, core=SPONGY)


def _palate(canvas: Canvas) -> None:
    """Draw the roof of the mouth: a plate of bone between the arches under the nose."""

    def plate(x: Field, y: Field, z: Field) -> Mask:
        return (arch_gap(x, y) < -0.10) & (y > -0.35) & (np.abs(z - 0.60 + 0.25 * x**2) < 0.045)

    canvas.fill(BONE, plate, over=FLESH)
    canvas.fill(
        SPONGY,
        lambda x, y, z: (arch_gap(x, y) < -0.14) & (y > -0.31) & (np.abs(z - 0.60 + 0.25 * x**2) < 0.018),
        over=(BONE,),
    )
