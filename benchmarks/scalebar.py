"""A scale bar in mm on a picture of a slice."""

import math

from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

STEPS = (5.0, 2.0, 1.0)
LONGEST = 0.3  # of the picture's width
INSET = 0.05  # of the picture, between the bar and the edges


def length_of(width: float) -> float:
    """Return the longest of 1, 2, 5 times a power of ten (mm) within 0.3 of a picture's `width` (mm)."""
    most = LONGEST * width
    power = 10.0 ** math.floor(math.log10(most))
    return next(step * power for step in STEPS if step * power <= most * (1 + 1e-9))


def scale_bar(axes: Axes, shape: tuple[int, ...], d_voxel: float, *, size: float = 6.5, where: str = "") -> None:
    """Draw a bar and its length into the lower left of an image.

    `shape` is the image's (rows, columns), row 0 at the bottom, `d_voxel` the size of a column in mm, and `size` that
    of the text in points. The text ends with `where`, if these mm are not those of the image's plane. White on a black
    rim, so that it is seen on any grey.
    """
    rows, columns = shape[:2]
    length = length_of(columns * d_voxel)
    left, bottom = INSET * columns - 0.5, INSET * rows - 0.5
    rim = [withStroke(linewidth=3, foreground="black")]
    axes.plot([left, left + length / d_voxel], [bottom] * 2, color="white", lw=1.6, path_effects=rim, zorder=5)
    axes.annotate(
        f"{length:g} mm {where}".rstrip(), (left, bottom), xytext=(0, 2.5), textcoords="offset points", color="white",
        fontsize=size, va="bottom", path_effects=[withStroke(linewidth=1.6, foreground="black")], zorder=5,
    )  # fmt: skip
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(-0.5, rows - 0.5))
