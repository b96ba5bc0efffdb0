"""Slices for a page: 8 bits over the stated window, small enough to embed.

Volumes run over the window of their case, errors from minus to plus the error scale.
PNG keeps every grey; WebP would halve the size and smooth the noise.
"""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ctsim.benchmarks.scores.metrics import erode
from ctsim.reports.kept import Case, Measured

OUTLINE = 200  # points across an image: an outline is one of them wide, however few the voxels are
RING, UNJUDGED = (255, 176, 0), (140, 140, 140)  # as in the panels

Image8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Which part of a volume is shown: slices `z`, rows and columns of the case's box."""

    z: tuple[int, ...]
    rows: slice
    columns: slice

    def cut(self, volume: NDArray[Any], z: int) -> NDArray[Any]:
        """Return a slice for display: row 0 at the bottom."""
        return np.asarray(volume[z, self.rows, self.columns])[::-1]


def quantised(image: NDArray[Any], low: float, high: float) -> Image8:
    """Return `image` as 0 … 255 over [low, high]; values outside are clipped."""
    return np.rint(np.clip((image - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def frame_of(case: Case | Measured, most: int) -> Frame:
    """Choose at most `most` evenly spaced slices through the case's box, and its slice `at` among them."""
    z, rows, columns = case.box
    step = math.ceil((z.stop - z.start) / max(most, 1))
    first = z.start + (case.at[0] - z.start) % step
    return Frame(z=tuple(range(first, z.stop, step)), rows=rows, columns=columns)


def volume_image(case: Case | Measured, values: NDArray[Any], frame: Frame, z: int) -> Image8:
    """Return a slice of a volume over the case's window."""
    return quantised(frame.cut(values, z), case.low, case.top)


def error_image(case: Case, values: NDArray[Any], frame: Frame, z: int) -> Image8:
    """Return a slice of a volume minus the reference over the error scale; no error and the metal are 128."""
    error = np.where(case.truth.metal[z], 0, values[z] - case.reference[z])[None]
    inside = Frame(z=(0,), rows=frame.rows, columns=frame.columns)
    return quantised(inside.cut(error, 0), -case.look.error, case.look.error)


def png(image: Image8) -> str:
    """Encode a grey image as PNG, base64."""
    return _encoded(image, "L", optimize=True)


def stencil(mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> str:
    """Encode a mask as a PNG of one colour, transparent elsewhere, base64; "" where there is nothing."""
    if not mask.any():
        return ""
    return _encoded(mask.astype(np.uint8), "P", palette=(0, 0, 0, *colour), transparency=0, bits=1)


def _encoded(image: Image8, mode: str, palette: Sequence[int] = (), **options: Any) -> str:
    picture = Image.fromarray(np.ascontiguousarray(image), "L")
    if mode == "P":
        picture = Image.frombytes("P", picture.size, picture.tobytes())
        picture.putpalette(palette)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", **options)
    return base64.b64encode(buffer.getvalue()).decode()


def metal_stencils(case: Case, frame: Frame, z: int) -> tuple[str, str]:
    """Return the metal's outline, drawn within it so that it hides no tissue, and the metal filled."""
    metal = frame.cut(case.truth.metal, z)
    n = max(1, round(OUTLINE / metal.shape[1]))
    fine = np.kron(metal, np.ones((n, n), np.bool_))[None]
    ring = (fine & ~erode(np.repeat(fine, 3, axis=0))[1:2])[0]
    return stencil(ring, RING), stencil(metal, UNJUDGED)


def bytes_a_slice(case: Case | Measured) -> int:
    """Estimate the bytes of one slice of every volume and error, from the slice `at`."""
    frame, z = frame_of(case, 1), case.at[0]
    found = [volume_image(case, kept.values, frame, z) for kept in case.kept]
    if isinstance(case, Case):
        found += [error_image(case, kept.values, frame, z) for kept in case.kept]
    return sum(len(png(image)) for image in found)
