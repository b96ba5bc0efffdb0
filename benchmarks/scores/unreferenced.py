"""The protocol `no_reference`: what can be said of a volume of a measured scan, which has no truth.

Air attenuates nothing, so what a volume shows around the body is artefact and noise. Line integrals of the volume are
compared with measured views that no method saw. Volumes are [z, y, x] in 1/mm, projections [view, v, u].
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.baselines.metal import auto_mask, water_value
from ctsim.benchmarks.scores.artefact import effective_attenuation, is_near
from ctsim.benchmarks.scores.judge import Twin
from ctsim.benchmarks.scores.metrics import Mask, dilate
from ctsim.benchmarks.scores.protocol import METAL_MARGIN, field_of_view
from ctsim.benchmarks.scores.score import COLUMNS, NEED_TRUTH, NO_REFERENCE, Score
from ctsim.dataset.store import StoredScan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.log import LineIntegrals
from ctsim.reconstruct.projector import forward_columns
from ctsim.types import Scan

AIR_MARGIN = 3  # voxels between the body and the air that is judged
BODY = 0.5  # of water's value in FDK, above which a voxel is the body's
COARSE = 1.5  # voxels: standard deviation of the filter that leaves streaks and takes noise
BIN, MOST_BINS = 20.0, 2000  # HU of a bin of the histogram of air; what is beyond ± 20 000 HU counts as that
MIN_VOXELS = 64
TRACE_MARGIN = 2  # pixels
SUSPECT = 2.0  # times water: what is brighter may be metal, also where its mask cannot be relied on, or dense bone
MISSED = 5.0  # times water: what is brighter outside of the mask is metal, too, and what is near it not far from metal
QUIETER = 0.8  # of the spread far from the metal; of a hundred voxels, alike by threes, it is known to 0.12
REGION = (
    "air at least 3 voxels outside the body, soft tissue within 5 mm or 6 voxels (the greater) of the metal and "
    "beyond, and rays of views held out; body and metal are those of FDK without correction"
)
REFERENCE = "none; 0 in air, and measured views that no method saw"


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldViews:
    """Measured views that methods do not get: their line integrals and which rays count, by region, [view, v, u]."""

    geometry: Geometry
    p: NDArray[np.float32]
    regions: dict[str, NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Unreferenced:
    """What volumes of one measured scan are scored with; `views` as `Judge` has them, for the caller to keep.

    `water` is the attenuation (1/mm) that HU are scaled by. `near` and `far` hold soft tissue.
    """

    air: Mask
    near: Mask
    far: Mask
    water: float
    views: HeldViews | str
    note: str

    @classmethod
    def of(cls, stored: StoredScan, views: object = None) -> "Unreferenced":
        """Find body, metal and air of a measured scan, and read its views held out."""
        scan = stored.scan
        body, metal, suspect, scale, said, dense = _regions(scan)
        field = field_of_view(stored.geometry)
        near_metal = dilate(metal, METAL_MARGIN) if metal.any() else metal
        inside = body & ~near_metal & field
        soft = inside & ~dense.any
        near, close = (_around(mask, stored.geometry) for mask in (metal, metal | dense.missed))
        water = effective_attenuation(stored) or scale
        found = views if isinstance(views, HeldViews | str) else held_views(stored, metal, suspect)
        notes = [
            f"without a truth these protocols are skipped: {', '.join(NEED_TRUTH)}",
            said,
            f"water {water:.5g} 1/mm{'' if effective_attenuation(stored) else ', as FDK shows it'}",
            found if isinstance(found, str) else f"{found.geometry.n_views} views held out",
        ]
        return cls(
            air=field & ~dilate(body | metal, AIR_MARGIN),
            near=soft & near,
            far=soft & ~close,
            water=water,
            views=found,
            note="; ".join([*notes, *stored.info.notes]),
        )

    def scores(
        self, values: NDArray[Any], variant: str, twin: Twin, at_50kev: NDArray[Any] | None = None
    ) -> dict[str, Score]:
        """Score a volume. There is one protocol and no twin."""
        found: dict[str, float | None] = dict.fromkeys(COLUMNS[NO_REFERENCE])
        index, doubt = self._artefact_index(values)
        found |= self._air(values) | {"artefact_index": index}
        if isinstance(self.views, HeldViews):
            found |= consistency(values, self.views)
        return {
            NO_REFERENCE: Score(
                region=REGION,
                reference=REFERENCE,
                alignment="none",
                data_range=None,
                n_voxels=int(self.air.sum()),
                values=found,
                note="; ".join(filter(None, [self.note, doubt])),
            )
        }

    def _air(self, values: NDArray[Any]) -> dict[str, float | None]:
        """Return the RMS of smoothed air, and the entropy of its histogram in bits."""
        if self.air.sum() < MIN_VOXELS or not self.water > 0:
            return {}
        scale = 1000 / self.water
        weight = ndimage.gaussian_filter(self.air.astype(np.float32), COARSE)
        # of air alone: what the body spreads beyond its edge is no streak
        smooth = ndimage.gaussian_filter(np.where(self.air, values, 0).astype(np.float32), COARSE)
        streak = smooth[self.air] / np.maximum(weight[self.air], 1e-3) * scale
        bins = np.clip(np.rint(values[self.air] * (scale / BIN)), -MOST_BINS, MOST_BINS).astype(np.int64)
        share = np.unique(bins, return_counts=True)[1] / bins.size
        entropy = -float((share * np.log2(share)).sum())
        return {
            "air_streak": math.sqrt(float(np.mean(np.square(streak, dtype=np.float64)))),
            "air_entropy": abs(entropy),
        }

    def _artefact_index(self, values: NDArray[Any]) -> tuple[float | None, str]:
        """Return √(σ² near the metal − σ² far from it) in HU, and why there is none.

        It is that of Lin et al. (J Comput Assist Tomogr 35, 2011), who drew regions in soft tissue. A difference below
        0 that noise may make counts as 0; a larger one says that the regions hold different things.
        """
        if self.near.sum() < MIN_VOXELS or self.far.sum() < MIN_VOXELS or not self.water > 0:
            return None, f"no artefact index: fewer than {MIN_VOXELS} voxels of soft tissue near the metal or beyond"
        near, far = (float(values[mask].astype(np.float64).std()) * 1000 / self.water for mask in (self.near, self.far))
        if near < QUIETER * far:
            return None, f"no artefact index: the body varies by {near:.0f} HU near the metal, by {far:.0f} HU beyond"
        return math.sqrt(max(near**2 - far**2, 0.0)), ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Dense:
    """What is denser than soft tissue in FDK's volume: all of it, and what of that must be metal outside the mask."""

    any: Mask
    missed: Mask


def _around(metal: Mask, geometry: Geometry) -> Mask:
    """Return where is near the metal, itself included."""
    if not metal.any():
        return np.zeros_like(metal)
    return is_near(np.asarray(ndimage.distance_transform_edt(~metal, sampling=geometry.d_voxel)), geometry.d_voxel)


def _regions(scan: Scan) -> tuple[Mask, Mask, Mask, float, str, _Dense]:
    """Return body, metal, and what may be metal of FDK's volume, water's value, what to say, and what is dense."""
    try:
        values = np.nan_to_num(fdk(scan).values.numpy())
    except InputError as error:
        nothing = np.zeros(scan.geometry.n_voxel, np.bool_)
        none = _Dense(any=nothing, missed=nothing)
        return nothing, nothing, nothing, 0.0, f"body and metal were not found: {error}", none
    metal = auto_mask(values)
    water = water_value(values)
    bright = {limit: values > (limit * water if water > 0 else np.inf) for limit in (BODY, SUSPECT, MISSED)}
    body: Mask = np.asarray(ndimage.binary_opening(bright[BODY]), np.bool_)
    dense = _Dense(any=bright[SUSPECT], missed=bright[MISSED] & ~dilate(metal.mask, METAL_MARGIN))
    if metal.found:
        return body, metal.mask, metal.mask, water, f"{int(metal.mask.sum())} voxels of metal were found", dense
    nothing = np.zeros_like(body)
    suspect = metal.mask if (metal.level or 0.0) > SUSPECT * water else nothing
    said = f"no metal was found: {metal.doubt or 'nothing stands out'}"
    if suspect.any():
        said += "; rays through what is bright count neither as outside the trace nor as in it"
    return body, nothing, suspect, water, said, dense


def held_views(stored: StoredScan, metal: Mask, suspect: Mask) -> HeldViews | str:
    """Read the views that were held out when the scan was imported, or say why there are none.

    Rays outside the trace are those that pass by all that may be metal, `suspect`.
    """
    geometry = stored.info.held
    if geometry is None or "held.tif" not in stored.files:
        return "no views were held out"
    counts = stored.array("held")
    if counts.shape != geometry.shape:
        raise InputError(f"{stored.folder}/held.tif: shape {counts.shape}, scan.json says {geometry.shape}")
    scan = stored.scan
    views = Scan(
        geometry=geometry,
        counts=torch.from_numpy(counts),
        flat=scan.flat,
        dark=scan.dark,
        i0=scan.i0,
        e_max=scan.e_max,
    )
    p, unseen = LineIntegrals(views).of(slice(0, geometry.n_views))
    trace, shadow = (
        forward_columns(np.ascontiguousarray(mask.transpose(1, 2, 0), np.float32), geometry) > 0
        for mask in (metal, suspect)
    )
    size = (1, 2 * TRACE_MARGIN + 1, 2 * TRACE_MARGIN + 1)
    near = ndimage.maximum_filter(shadow.astype(np.uint8), size, mode="constant", cval=0) > 0
    return HeldViews(geometry=geometry, p=p, regions={"outside": ~near & ~unseen, "trace": trace & ~unseen})


def consistency(values: NDArray[Any], held: HeldViews) -> dict[str, float | None]:
    """Return the RMSE of a volume's line integrals against measured ones, "held/outside" and "held/trace"."""
    found = forward_columns(np.ascontiguousarray(values.transpose(1, 2, 0), np.float32), held.geometry)
    squared = np.square(found - held.p, dtype=np.float64)
    return {
        f"held/{name}": float(np.sqrt(squared[mask].mean())) if mask.any() else None
        for name, mask in held.regions.items()
    }
