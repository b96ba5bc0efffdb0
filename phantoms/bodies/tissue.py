"""What the patients' bodies share: their tissues, bones with spongy cores, and limbs' sections."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctsim.phantoms.fields import Canvas, Field, Mask, Noise

MATERIALS = (
    "air", "soft_tissue", "adipose", "muscle", "cortical_bone", "spongiosa", "blood", "urine", "kidney",
)  # fmt: skip
AIR, SOFT, FAT, MUSCLE, BONE, SPONGY, BLOOD, URINE, KIDNEY = range(9)


class Part(NamedTuple):
    """A piece of bone: a chain of capsules through `points`, with one radius or one per point."""

    points: ArrayLike
    radii: ArrayLike


def bone(canvas: Canvas, parts: Sequence[Part], wall: float, *, shell: int = BONE, core: int = SPONGY) -> None:
    """Paint one bone of several parts: compact `wall` thick, with a core where a part is thicker than twice that."""
    for part in parts:
        canvas.tube(shell, part.points, part.radii)
    for part in parts:
        inner = np.broadcast_to(np.asarray(part.radii, np.float64), (len(np.asarray(part.points)),)) - wall
        if inner.max() > 0.5 * wall:
            canvas.tube(core, part.points, np.maximum(inner, 0.2 * wall), over=(shell,))


def trabeculae(
    canvas: Canvas, rng: np.random.Generator, *, core: int = SPONGY, marrow: int = FAT, struts: int = BONE
) -> None:
    """Put marrow and struts of compact bone into all spongy bone, the label `core`."""
    coarse, fine = Noise(rng, 48), Noise(rng, 110)

    def between(x: Field, y: Field, z: Field) -> Mask:
        return (fine(x, y, z) + 0.5 * coarse(x, y, z)) > 1.15

    def solid(x: Field, y: Field, z: Field) -> Mask:
        return (fine(x, y, z) - 0.5 * coarse(x, y, z)) < -1.65

    canvas.fill(marrow, between, over=(core,))
    canvas.fill(struts, solid, over=(core,))


def cut(canvas: Canvas, end: float) -> None:
    """Take away what reaches beyond the planes |z| = end."""
    canvas.labels[np.abs(canvas.axes[2]) >= end] = AIR


def mirrored(points: ArrayLike, side: int) -> np.ndarray:
    """Return points [k, 3] of the left side, or their mirror image on the right for side −1."""
    return np.asarray(points, np.float64) * [side, 1, 1]


def box_section(x: Field, y: Field, a: float, b: float, power: float = 2.4) -> Field:
    """Level of a superellipse with half axes a and b; 1 on its edge."""
    return (np.abs(x / np.float32(a)) ** power + np.abs(y / np.float32(b)) ** power) ** np.float32(1 / power)
