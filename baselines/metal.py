"""Where the metal is: masks in the volume, and the trace that they leave in the projections."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.project import Tracer
from ctsim.types import Phantom, Scan

PEAK, HALF, SMALLEST = 0.25, 0.5, 8  # of the maximum; of the metal's value; voxels
FACTORS = (8.0, 1.5)  # metal must exceed this many times water, and this many times the body's 99.9th percentile
THINNEST = 0.05  # length in metal, in voxels, from which a pixel belongs to the trace
_TOUCHING = np.ones((3, 3, 3), bool)  # 26 neighbours


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
    [z, y, x] in 1/mm, see `auto_mask`) or the path of a TIFF stack [z, y, x] that is not 0 in metal.

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
        found = _read(Path(mask))
    if found.shape != volume.shape:
        raise InputError(f"mask {mask!r} has shape {found.shape}, the volume {volume.shape}")
    return Metal(mask=found, source=mask)


def _read(path: Path) -> NDArray[np.bool_]:
    import tifffile

    if not path.is_file():
        raise InputError(f"mask: expected 'oracle', 'auto' or a TIFF file, and there is no file {path}")
    try:
        return np.asarray(tifffile.imread(path)) != 0
    except (OSError, ValueError, tifffile.TiffFileError) as error:
        raise InputError(f"mask: {path} cannot be read as TIFF: {error}") from None


def auto_mask(volume: NDArray[np.float32]) -> Metal:
    """Find metal in an uncorrected reconstruction [z, y, x] in 1/mm.

    The metal's value is the 90th percentile of what exceeds a quarter of the maximum; half of it is the threshold.
    Components of fewer than 8 voxels are dropped, holes filled. A fixed multiple of water does not serve: the
    best was 20 for Fe, 10 for Ti and 4 for Al. Where the metal does not stand out from the densest of the body
    the mask is doubted, since correcting beside bone does more harm than leaving it.
    """
    top = float(volume.max(initial=0.0))
    if not np.isfinite(volume).all() or top <= 0:
        return Metal(mask=np.zeros(volume.shape, bool), source="auto", doubt="the reconstruction has no finite maximum")
    level = float(np.percentile(volume[volume > PEAK * top], 90))
    mask = volume > HALF * level
    names, n = scipy.ndimage.label(mask, _TOUCHING)
    sizes = np.bincount(names.ravel(), minlength=n + 1)
    sizes[0] = 0
    mask = scipy.ndimage.binary_fill_holes(sizes[names] >= SMALLEST)
    assert mask is not None
    water = water_value(volume)
    around = scipy.ndimage.binary_dilation(mask, _TOUCHING, iterations=2)
    body = volume[(volume > 0.5 * water) & ~around]
    dense = float(np.percentile(body, 99.9)) if body.size else 0.0
    doubt = ""
    if level < FACTORS[0] * water:
        doubt = f"the metal's value is {level / water:.1f} times water, expected {FACTORS[0]:g} times or more"
    elif level < FACTORS[1] * dense:
        doubt = f"the metal's value is {level / dense:.2f} times the body's densest, expected {FACTORS[1]:g} or more"
    return Metal(mask=mask, source="auto", doubt=doubt, level=level)


def water_value(volume: NDArray[np.float32]) -> float:
    """Value of water-like tissue in a reconstruction, in 1/mm: the highest peak above what parts air from body.

    Measured, since beam hardening moves it: FDK's water lay 28 % above that at 50 keV for 90 kVp.
    """
    smooth = scipy.ndimage.gaussian_filter(volume, 1.0)
    values = smooth[smooth > 0]
    if values.size < 2:
        return 0.0
    values = np.minimum(values, np.percentile(values, 99))
    counts, edges = np.histogram(values, 512)
    middle = (edges[1:] + edges[:-1]) / 2
    part = middle[_otsu(counts, middle)]
    body = np.where(middle > part, scipy.ndimage.gaussian_filter1d(counts.astype(float), 3), 0)
    return float(middle[int(body.argmax())])


def _otsu(counts: NDArray[np.int64], middle: NDArray[np.float64]) -> int:
    """Bin that parts a histogram in two with the greatest variance between (Otsu, doi:10.1109/TSMC.1979.4310076)."""
    below = np.cumsum(counts)
    above = below[-1] - below
    first = np.cumsum(counts * middle)
    with np.errstate(invalid="ignore", divide="ignore"):
        between = below * above * (first / below - (first[-1] - first) / above) ** 2
    return int(np.nanargmax(np.where((below > 0) & (above > 0), between, -1.0)))


class Trace:
    """The mask's shadow: for every view the pixels whose central ray crosses 0.05 voxels of metal or more."""

    def __init__(self, metal: Metal, geometry: Geometry, dilation: int = 0) -> None:
        self.geometry, self.dilation = geometry, dilation
        self.tracer = Tracer.of(
            Phantom(
                labels=metal.mask.astype(np.uint8),
                materials=("air", "metal"),
                d_voxel=geometry.d_voxel,
                off_origin=geometry.off_origin,
            )
        )
        self.thinnest = THINNEST * float(np.prod(geometry.d_voxel)) ** (1 / 3)
        self._lengths = np.zeros((2, *geometry.n_detector), np.float32)

    def view(self, view: int) -> NDArray[np.bool_]:
        """Return the trace in one view, [v, u]."""
        self.tracer.background(self.geometry, view, self._lengths)
        trace = self._lengths[1] > self.thinnest
        if self.dilation and trace.any():
            trace = scipy.ndimage.binary_dilation(trace, iterations=self.dilation)
        return np.asarray(trace)

    def lengths(self, view: int) -> NDArray[np.float32]:
        """Return the length in metal in one view in mm, [v, u]."""
        return self.tracer.background(self.geometry, view)[1]


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
    names, n = scipy.ndimage.label(mask, _TOUCHING)
    means = np.asarray(scipy.ndimage.mean(first, names, np.arange(1, n + 1)), np.float32)
    out[mask] = means[names[mask] - 1]


INSERTS = ("fdk", "mean", "none")
