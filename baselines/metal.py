"""Where the metal is: masks in the volume, and the trace that they leave in the projections."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray

from ctsim.baselines.morphology import dilate, filled, pieces, spread
from ctsim.dataset.arrayfile import read_array
from ctsim.errors import InputError
from ctsim.geometry import Geometry, crosswise
from ctsim.reconstruct.log import LineIntegrals
from ctsim.reconstruct.settings import about, names_of
from ctsim.tracer.project import Tracer
from ctsim.types import Phantom, Scan

PEAK, HALF, SMALLEST = 0.25, 0.5, 8  # of the maximum; of the metal's value; voxels
TISSUE, METAL = 5.0, 7.0  # times water: the least threshold, and what a piece of metal reaches over 3³ voxels
SOFT = 0.045  # 1/mm: water's attenuation above which both limits grow with its root, for enamel stands out more
APART = 1.5  # times the body's 99.9th percentile, which metal must exceed
THINNEST = 0.05  # length in metal, in voxels, from which a pixel belongs to the trace

Mask = Annotated[str, about("where the metal is: oracle (the scan's own), auto (found), a TIFF or a .npy file")]
Insert = Annotated[Literal["fdk", "mean", "none"], about("values that are put back into the metal")]
INSERTS = names_of(Insert)


@dataclass(frozen=True, slots=True, kw_only=True)
class Metal:
    """A metal mask, bool [z, y, x], where it comes from, and why it cannot be relied on ("" if it can)."""

    mask: NDArray[np.bool_]
    source: str
    doubt: str = ""
    level: float | None = None

    @property
    def found(self) -> bool:
        """Whether there is metal that can be relied on."""
        return not self.doubt and bool(self.mask.any())

    def details(self) -> dict[str, object]:
        """Return what a result says of its mask."""
        status = "mask_unreliable" if self.doubt else "ok" if self.mask.any() else "no_metal"
        return {
            "mask": self.source,
            "mask_status": status,
            "mask_reason": self.doubt,
            "metal_voxels": int(self.mask.sum()),
            "metal_level_per_mm": self.level,
        }


def find_metal(scan: Scan, volume: NDArray[np.float32], mask: str) -> Metal:
    """Return the metal mask of a scan.

    `mask` is "oracle" (`scan.metal`, the true mask), "auto" (from the uncorrected reconstruction `volume`
    [z, y, x] in 1/mm, see `auto_mask`) or the path of a TIFF stack or .npy array [z, y, x], not 0 in metal.

    Raises
    ------
    InputError
        When the oracle mask is asked of a scan that has none, and when a file cannot be read or has another shape.
    """
    if mask == "auto":
        return auto_mask(volume)
    if mask == "oracle":
        if scan.metal is None:
            raise InputError("mask = 'oracle': the scan has no true metal mask; say 'auto' or name a file")
        found = scan.metal.numpy() != 0
    else:
        check_mask(mask)
        found = _read(Path(mask), volume.shape)
    if found.shape != volume.shape:
        raise InputError(f"mask {mask!r} has shape {found.shape}, the volume {volume.shape}")
    return Metal(mask=found, source=mask)


def check_mask(mask: str) -> None:
    """Raise InputError unless `mask` is a known word or a file that is there."""
    if mask not in ("oracle", "auto") and not Path(mask).is_file():
        raise InputError(f"mask: expected oracle, auto, a TIFF or a .npy file; there is no file {mask!r}")


def _read(path: Path, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    try:
        return read_array(path, shape) != 0
    except InputError as error:
        raise InputError(f"mask: {error}") from None


def auto_mask(volume: NDArray[np.float32]) -> Metal:
    """Find metal in an uncorrected reconstruction [z, y, x] in 1/mm.

    The metal's value is the 90th percentile of what exceeds a quarter of the maximum. Half of it is the threshold, for
    the best multiple of water was 20 for Fe and 10 for Ti, but at least 5 times water, since enamel is nearly that.
    Pieces that nowhere reach 7 times water, averaged over 3³ voxels, are tissue (a jaw without metal has 6.4 in single
    voxels), those of fewer than 8 voxels noise; holes are filled. In a soft beam, where water has more than 0.045/mm,
    both limits grow: enamel of a jaw of 10 mm has 6.6, 7.2 and 8.7 times water at 90, 70 and 40 kV, where they are 7.0,
    7.7 and 9.5. Where nothing is left, or the metal does not stand out from the densest of the body, the mask is
    doubted, since correcting next to bone does more harm than leaving it: then it holds what exceeds half of the value.
    Aluminium, of 2 to 5 times water, is not found.
    """
    top = float(volume.max(initial=0.0))
    if not np.isfinite(volume).all() or top <= 0:
        return Metal(mask=np.zeros(volume.shape, bool), source="auto", doubt="the reconstruction has no finite maximum")
    level = float(np.percentile(volume[volume > PEAK * top], 90))
    water = water_value(volume)
    soft = math.sqrt(max(1.0, water / SOFT))
    mask = _pieces_above(volume, max(HALF * level, soft * TISSUE * water), soft * METAL * water)
    if not mask.any():
        doubt = f"nothing reaches {soft * METAL:.2g} times water over 3³ voxels" if water else "there is no water"
        return Metal(mask=_pieces_above(volume, HALF * level, 0.0), source="auto", doubt=doubt, level=level)
    body = volume[(volume > 0.5 * water) & ~dilate(mask, 2, corners=True)]
    dense = float(np.percentile(body, 99.9)) if body.size else 0.0
    found = float(np.percentile(volume[mask], 90))
    doubt = ""
    if found < APART * dense:
        doubt = f"the metal's value is {found / dense:.2f} times the body's densest, expected {APART:g} or more"
    return Metal(mask=mask, source="auto", doubt=doubt, level=found)


def _pieces_above(volume: NDArray[np.float32], threshold: float, peak: float) -> NDArray[np.bool_]:
    """Return what exceeds a threshold in pieces of 8 voxels or more that somewhere reach a peak over 3³ voxels."""
    names, n = pieces(volume > threshold)
    sizes = np.bincount(names.ravel(), minlength=n + 1)
    kept = sizes >= SMALLEST
    kept[0] = False
    if peak > 0 and n:
        highest = scipy.ndimage.maximum(scipy.ndimage.uniform_filter(volume, 3), names, np.arange(n + 1))
        kept &= np.asarray(highest) >= peak
    return filled(kept[names])


def water_value(volume: NDArray[np.float32]) -> float:
    """Value of water-like tissue in a reconstruction, in 1/mm; 0 where nothing stands out from air.

    Measured, since beam hardening moves it: FDK's water lay 28 % above that at 50 keV for 90 kVp. Of the peaks in
    the histogram of what exceeds the noise of air it is the highest in value that has a third of the tallest one's
    height: lungs lie below, and bone is less.
    """
    smooth = scipy.ndimage.gaussian_filter(volume, 1.0)
    air = smooth[smooth < 0]
    noise = float(np.sqrt(np.mean(np.square(air, dtype=np.float64)))) if air.size else 0.0
    body = smooth[smooth > max(5 * noise, 0.02 * float(np.percentile(smooth, 99)), 1e-9)]
    if body.size < SMALLEST:
        return 0.0
    counts, edges = np.histogram(body, 256, (0.0, float(np.percentile(body, 97))))
    height = scipy.ndimage.gaussian_filter1d(counts.astype(float), 4, mode="constant")
    peak = (height >= np.roll(height, 1)) & (height > np.roll(height, -1)) & (height > height.max() / 3)
    at = int(np.flatnonzero(peak)[-1]) if peak.any() else int(height.argmax())
    return float((edges[at] + edges[at + 1]) / 2)


def reach(geometry: Geometry) -> tuple[int, int]:
    """Return how many pixels (v, u) beyond a mask's shadow metal may still be seen.

    A voxel belongs to the mask from half its volume on, so metal ends up to half a voxel beyond, and a pixel
    averages over its own width: half a voxel, magnified, and half a pixel, rounded. Of a voxel's edges the one counts
    that spans most pixels along rows or columns in any view.
    """
    poses = geometry.pose_array().reshape(-1, 4, 3)
    axes = np.stack(crosswise(poses[:, 2], poses[:, 3]), 1)
    lengths = np.linalg.norm(axes, axis=2)
    along = np.abs(axes / lengths[..., None]) * np.array(geometry.d_voxel[::-1])
    if geometry.poses is None:
        u, v = along.max((0, 2)) * geometry.dsd / geometry.dso / np.array(geometry.d_detector[::-1])
    else:
        spans = along.max(2) / lengths * _magnification(poses, np.array(geometry.off_origin[::-1]))[:, None]
        u, v = np.minimum(spans.max(0), max(geometry.n_detector))
    return math.floor(0.5 * v + 1.0), math.floor(0.5 * u + 1.0)


def _magnification(poses: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much larger each view of `poses` [view, 4, xyz] shows what is at a point; 1 for one it cannot see."""
    source, centre, e_u, e_v = poses.transpose(1, 0, 2)
    normal = np.cross(e_u, e_v)
    height, depth = (((x - source) * normal).sum(1) for x in (centre, point))
    ahead = height * depth > 0
    return np.where(ahead, height / np.where(ahead, depth, 1.0), 1.0)


class Trace:
    """The metal's shadow, by view: where the central ray crosses 0.05 voxels of the mask, and what its edge leaves out.

    A pixel within `reach` of the shadow belongs to it where it is darker than all around that are out of reach, as
    metal only darkens. What the edge left out made up to all of NMAR's error on iron, while bridging pixels that hold
    no metal cost up to a sixth of LIMAR's. `dilation` widens the shadow by this many pixels instead.
    """

    def __init__(self, metal: Metal, scan: Scan, dilation: int | None = None) -> None:
        self.geometry, self.dilation, self.logarithm = scan.geometry, dilation, LineIntegrals(scan)
        self.tracer = Tracer.of(
            Phantom(
                labels=metal.mask.astype(np.uint8),
                materials=("air", "metal"),
                d_voxel=self.geometry.d_voxel,
                off_origin=self.geometry.off_origin,
            )
        )
        self.thinnest = THINNEST * float(np.prod(self.geometry.d_voxel)) ** (1 / 3)
        self._lengths = np.zeros((2, *self.geometry.n_detector), np.float32)
        self._kept: dict[int, NDArray[np.uint8]] = {}  # a bit a pixel

    def view(self, view: int) -> NDArray[np.bool_]:
        """Return the trace in one view, [v, u]."""
        shape = self.geometry.n_detector
        if view not in self._kept:
            self._kept[view] = np.packbits(self._find(view))
        return np.unpackbits(self._kept[view], count=shape[0] * shape[1]).reshape(shape).astype(np.bool_)

    def _find(self, view: int) -> NDArray[np.bool_]:
        self.tracer.background(self.geometry, view, self._lengths)
        shadow = self._lengths[1] > self.thinnest
        if self.dilation is not None or not shadow.any():
            return dilate(shadow, self.dilation or 0)
        v, u = reach(self.geometry)
        window = around(shadow, (2 * v + 2, 2 * u + 2))
        near = spread(shadow[window], (v, u))
        p = self.logarithm.of(view)[0][window]
        darkest = scipy.ndimage.maximum_filter(np.where(near, np.float32(-np.inf), p), (2 * v + 3, 2 * u + 3))
        shadow[window] |= near & (p > darkest)
        return shadow

    def rows(self) -> slice:
        """Return the detector rows that hold metal in any view."""
        held = np.zeros(self.geometry.n_detector[0], np.bool_)
        for view in range(self.geometry.n_views):
            held |= self.view(view).any(1)
        found = np.flatnonzero(held)
        return slice(int(found[0]), int(found[-1]) + 1) if found.size else slice(0, 0)

    def lengths(self, view: int) -> NDArray[np.float32]:
        """Return the length in metal in one view in mm, [v, u]."""
        return self.tracer.background(self.geometry, view)[1]


def around(mask: NDArray[np.bool_], margins: tuple[int, int]) -> tuple[slice, slice]:
    """Return the smallest window of rows and columns that holds a mask [v, u] that is not empty, and margins."""
    ranges = []
    for axis, margin in zip((1, 0), margins, strict=True):
        found = np.flatnonzero(mask.any(axis))
        ranges.append(slice(max(int(found[0]) - margin, 0), int(found[-1]) + margin + 1))
    return ranges[0], ranges[1]


def reinsert(values: torch.Tensor, first: NDArray[np.float32], metal: Metal, insert: str) -> None:
    """Put the metal back into a corrected volume [z, y, x], in place.

    `insert` is "fdk" (the uncorrected values `first`), "mean" (their mean in each piece of metal) or "none".

    Raises
    ------
    InputError
        When `insert` is something else.
    """
    if insert not in INSERTS:
        raise InputError(f"insert must be one of {', '.join(INSERTS)}, got {insert!r}")
    if insert == "none":
        return
    out, mask = values.numpy(), metal.mask
    if insert == "fdk":
        out[mask] = first[mask]
        return
    names, n = pieces(mask)
    means = np.asarray(scipy.ndimage.mean(first, names, np.arange(1, n + 1)), np.float32)
    out[mask] = means[names[mask] - 1]
