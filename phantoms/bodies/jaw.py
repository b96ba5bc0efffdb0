"""Both jaws in a face with its tissues: skin, fat, muscles, tongue, glands and vessels.

Arches, teeth and restorations are of the kinds of `teeth`, at about two thirds of an adult's size in the 60 mm cube.
Bones have a compact shell, spongy bone with struts, and marrow. Patient's left is +x, front is +y, up is +z; the teeth
meet at z = 0.
"""

from typing import ClassVar

import numpy as np

from ctsim.phantoms.bodies import teeth, tissue
from ctsim.phantoms.bodies.teeth import AIR, BONE, MOUTH_BOX, SHRINK, SOFT, arch_gap, ridge
from ctsim.phantoms.bodies.tissue import mirrored
from ctsim.phantoms.fields import Canvas, Field, LabelGrid, Mask, Noise
from ctsim.phantoms.recipe import assemble
from ctsim.types import Phantom

MATERIALS = (*teeth.MATERIALS, "adipose", "muscle", "spongiosa", "blood")
FAT, MUSCLE, SPONGY, BLOOD = range(len(teeth.MATERIALS), len(MATERIALS))
FLESH = (SOFT, FAT, MUSCLE)
END = 0.93  # |z| of the planes in which neck and face are cut
FIT = 0.80  # of a tooth's width along the arch in `teeth`, where two molars stand in one place
SKIN = 0.05  # thickness of the skin, as a level of the face's section: 1.2 mm at the cheeks of a 60 mm cube


class Jaw(teeth.Teeth, frozen=True, kw_only=True, tag="jaw"):
    """Jaws with the metal of `teeth`, in a face of fat, muscle, glands and vessels."""

    height: ClassVar[float] = END * SHRINK


def jaw(grid: LabelGrid, rng: np.random.Generator, params: Jaw) -> Phantom:
    """Draw the face from the skin inwards, then the jaws and their teeth; metal as in `teeth`."""
    body, metal, struts = rng.spawn(3)
    canvas = Canvas(grid, shrink=SHRINK)
    wobble = Noise(body, 4)
    _face(canvas, body, wobble)
    _under_the_tongue(canvas, wobble)
    _mouth(canvas, body, wobble)
    _vessels(canvas)
    for side in (-1, 1):
        _chewing_muscles(canvas, side)
    solids = teeth.dentition(canvas, body, metal, params, lambda which: _compact_bone(canvas, which), fit=FIT)
    _spongy_bone(canvas)
    for side in (-1, 1):
        _ramus(canvas, side)
    _nose(canvas, wobble)
    tissue.trabeculae(canvas, struts, core=SPONGY, marrow=FAT, struts=BONE)
    tissue.cut(canvas, END)
    return assemble(canvas.whole, grid, MATERIALS, solids)


def _face(canvas: Canvas, rng: np.random.Generator, wobble: Noise) -> None:
    """Skin, the fat of the cheeks, which is thin at the lips, and the muscles under it with fat between them."""
    thick, sheet = Noise(rng, 5), Noise(rng, 9)

    def depth(x: Field, y: Field, z: Field) -> Field:
        """Level of the face's section, which narrows a little above and below, counted inwards from the skin."""
        return 0.985 - 0.012 * wobble(x, y, z) - 0.04 * z**2 - teeth.section(x, y)

    def fat(x: Field, y: Field, z: Field) -> Field:
        lips = np.clip((y - 0.35) / 0.4, 0, 1) * np.clip(1.4 - np.abs(z) / 0.45, 0, 1)
        return SKIN + np.clip(0.075 + 0.02 * thick(x, y, z), 0.03, None) * (1 - 0.85 * lips)

    canvas.fill(SOFT, lambda x, y, z: depth(x, y, z) > 0)
    canvas.fill(FAT, lambda x, y, z: depth(x, y, z) > SKIN, over=(SOFT,))
    canvas.fill(MUSCLE, lambda x, y, z: depth(x, y, z) > fat(x, y, z), over=(FAT,))
    canvas.fill(FAT, lambda x, y, z: np.abs(sheet(x, y, z)) < 0.10, over=(MUSCLE,))
    for side in (-1, 1):
        # the cheek's pad of fat, and the gland behind the jaw
        canvas.ellipsoid(FAT, (0.81 * side, -0.10, 0.20), (0.05, 0.22, 0.32), over=(MUSCLE,))
        canvas.ellipsoid(SOFT, (0.56 * side, -0.72, 0.10), (0.15, 0.10, 0.42), over=(MUSCLE,))


def _before_throat(x: Field, y: Field, z: Field, wobble: Noise, middle: float) -> Mask:
    """Tell points before the bowed border to the throat, which is at y = `middle` in the middle."""
    return y > middle + 0.6 * x**2 + 0.25 * (np.abs(z) - 0.6) ** 2 + 0.05 * wobble(x, y, z)


def _under_the_tongue(canvas: Canvas, wobble: Noise) -> None:
    """Fat within the lower arch, the sheet of muscle that closes it below, muscles from the chin back, and glands."""

    def room(x: Field, y: Field, z: Field) -> Mask:
        return (arch_gap(x, y) < -0.19) & _before_throat(x, y, z, wobble, -0.45) & (z < -0.30 + 0.05 * wobble(x, y, z))

    def floor(x: Field, y: Field, z: Field) -> Mask:
        sheet = np.abs(z + 0.72 - 0.3 * x**2 - 0.02 * wobble(x, y, z)) < 0.035
        return (arch_gap(x, y) < -0.15) & _before_throat(x, y, z, wobble, -0.45) & sheet

    canvas.fill(FAT, room, over=FLESH)
    canvas.fill(MUSCLE, floor, over=FLESH)
    for side in (-1, 1):
        inner = mirrored([(0.06, 0.48, -0.66), (0.07, 0.1, -0.60), (0.08, -0.4, -0.55)], side)
        outer = mirrored([(0.10, 0.40, -0.86), (0.22, 0.05, -0.84), (0.34, -0.3, -0.80)], side)
        canvas.tube(MUSCLE, inner, 0.060, over=FLESH)
        canvas.tube(MUSCLE, outer, 0.065, over=FLESH)
        canvas.ellipsoid(SOFT, (0.25 * side, 0.08, -0.56), (0.07, 0.22, 0.08), over=(FAT, MUSCLE))
        canvas.ellipsoid(SOFT, (0.33 * side, -0.30, -0.74), (0.10, 0.16, 0.11), over=(FAT, MUSCLE))


def _mouth(canvas: Canvas, rng: np.random.Generator, wobble: Noise) -> None:
    """Throat in its muscle, mouth with its lining, the passage between them, and the tongue."""
    grain = Noise(rng, 20)
    canvas.ellipsoid(MUSCLE, (0.0, -0.66, 0.0), (0.30, 0.11, 2.0), over=(FAT, SOFT))
    canvas.ellipsoid(SOFT, (0.0, -0.63, 0.0), (0.22, 0.085, 1.0), over=(FAT, MUSCLE))
    canvas.fill(SOFT, lambda x, y, z: teeth.mouth(x * 0.93, y * 0.93, z * 0.87, wobble), over=(FAT, MUSCLE))
    canvas.ellipsoid(SOFT, (0.0, -0.54, 0.03), (0.19, 0.15, 0.16), over=(FAT, MUSCLE))
    canvas.fill(AIR, lambda x, y, z: teeth.mouth(x, y, z, wobble), MOUTH_BOX)
    canvas.ellipsoid(AIR, (0.0, -0.62, 0.0), (0.17, 0.055, 0.86), over=(SOFT,))  # ends below the planes of the cut
    canvas.ellipsoid(AIR, (0.0, -0.54, 0.03), (0.13, 0.10, 0.10), over=(SOFT,))

    def muscle(x: Field, y: Field, z: Field) -> Mask:
        return teeth.tongue(x, y, z, wobble) <= 0.86

    def fatty(x: Field, y: Field, z: Field) -> Mask:
        septum = np.abs(x - 0.05 * wobble(x, y, z)) < 0.02
        streaks = grain(x, y, z) + 1.2 * np.clip(-0.1 - z, -0.3, 0.3) > 1.5
        return (teeth.tongue(x, y, z, wobble) <= 0.8) & (septum | streaks)

    canvas.fill(SOFT, lambda x, y, z: teeth.tongue(x, y, z, wobble) <= 1, over=(AIR, *FLESH))
    canvas.fill(MUSCLE, muscle, over=(SOFT,))
    canvas.fill(FAT, fatty, over=(MUSCLE,))


def _vessels(canvas: Canvas) -> None:
    """Arteries of face and tongue, veins of the face, and the great vessels next to the throat."""
    ways = (  # on the left: points and radius
        ([(0.82, -0.40, -0.50), (0.84, -0.10, -0.45), (0.74, 0.28, -0.20), (0.50, 0.60, 0.30)], 0.026),
        ([(0.40, -0.60, -0.80), (0.24, -0.35, -0.50), (0.16, 0.05, -0.38), (0.10, 0.28, -0.28)], 0.024),
        ([(0.80, -0.36, -0.10), (0.83, -0.05, 0.10), (0.70, 0.36, 0.45), (0.52, 0.58, 0.70)], 0.030),
        ([(0.34, -0.74, -1.0), (0.36, -0.75, 0.0), (0.34, -0.74, 1.0)], 0.050),
        ([(0.38, -0.62, -1.0), (0.39, -0.64, 0.0), (0.38, -0.62, 1.0)], 0.040),
    )
    for way, radius in ways:
        for side in (-1, 1):
            canvas.tube(BLOOD, mirrored(way, side), radius, over=(FAT, MUSCLE))


def _chewing_muscles(canvas: Canvas, side: int) -> None:
    """Muscles on the outer and on the inner side of the lower jaw's branch."""
    for x, lean in ((0.655, 0.0), (0.45, -0.03)):
        way = mirrored([(x, -0.56, -0.78), (x + lean, -0.60, -0.1), (x + lean - 0.02, -0.58, 0.6)], side)
        canvas.tube(MUSCLE, way, (0.05, 0.07, 0.05), over=(FAT,))


def _compact_bone(canvas: Canvas, which: int) -> None:
    """Gum and alveolar bone of the lower (−1) or upper (1) jaw, in which roots and their ligaments are to stand."""
    box = teeth.ridge_box(which)
    canvas.fill(SOFT, lambda x, y, z: ridge(x, y, z, which) <= 1.12, box, over=(AIR, *FLESH))
    canvas.fill(BONE, lambda x, y, z: ridge(x, y, z, which) <= 1, box)


def _spongy_bone(canvas: Canvas) -> None:
    """Spongy bone between the roots, and the canals of the lower jaw's nerves."""
    for which in (-1, 1):

        def core(x: Field, y: Field, z: Field, which: int = which) -> Mask:
            return ridge(x, y, z, which) <= 0.80

        canvas.fill(SPONGY, core, teeth.ridge_box(which), over=(BONE,))
    for side in (-1, 1):
        canal = mirrored([(0.62, -0.4, -0.66), (0.58, -0.05, -0.76), (0.46, 0.25, -0.74), (0.52, 0.34, -0.62)], side)
        canvas.tube(BONE, canal, 0.055, over=(SPONGY,))
        canvas.tube(SOFT, canal, 0.034, over=(BONE, SPONGY))


def _ramus(canvas: Canvas, side: int) -> None:
    """Draw the lower jaw's branch behind the upper one, on the inside of the cheek."""
    root = (0.60, -0.44, -0.68)
    ways = [mirrored([root, (0.55, y, -0.50), (0.54, y - 0.01, 0.74)], side) for y in (-0.585, -0.61, -0.635)]
    for way in ways:
        canvas.tube(SOFT, way, 0.085, over=(AIR,))  # the mouth's lining over it
    tissue.bone(canvas, [tissue.Part(way, 0.055) for way in ways], 0.022, shell=BONE, core=SPONGY)


def _nose(canvas: Canvas, wobble: Noise) -> None:
    """Palate, the lining over it, both halves of the nose with a turbinate each, and the sinuses at their sides."""

    def plate(x: Field, y: Field, z: Field, thick: float, edge: float) -> Mask:
        roof = np.abs(z - 0.60 + 0.25 * x**2) < thick
        return (arch_gap(x, y) < -edge) & _before_throat(x, y, z, wobble, -0.39 + edge / 3) & roof

    def lining(x: Field, y: Field, z: Field) -> Mask:
        above = z > 0.48 - 0.2 * x**2 + 0.04 * wobble(x, y, z)
        return (arch_gap(x, y) < -0.13) & _before_throat(x, y, z, wobble, -0.40) & above

    canvas.fill(SOFT, lining, over=(FAT, MUSCLE))
    canvas.fill(BONE, lambda x, y, z: plate(x, y, z, 0.045, 0.10), over=FLESH)
    canvas.fill(SPONGY, lambda x, y, z: plate(x, y, z, 0.018, 0.14), over=(BONE,))
    for side in (-1, 1):
        canvas.ellipsoid(SOFT, (0.10 * side, -0.08, 0.78), (0.11, 0.46, 0.13), over=(FAT, MUSCLE))
        canvas.ellipsoid(AIR, (0.10 * side, -0.08, 0.78), (0.07, 0.42, 0.09), over=(SOFT,))
        canvas.ellipsoid(SOFT, (0.12 * side, -0.08, 0.76), (0.025, 0.30, 0.035), over=(AIR,))
        canvas.ellipsoid(BONE, (0.29 * side, -0.02, 0.80), (0.105, 0.24, 0.105), over=FLESH)
        canvas.ellipsoid(SOFT, (0.29 * side, -0.02, 0.80), (0.085, 0.22, 0.085), over=(BONE,))
        canvas.ellipsoid(AIR, (0.29 * side, -0.02, 0.80), (0.060, 0.19, 0.060), over=(SOFT,))
