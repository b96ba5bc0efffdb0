"""What a user of a scan should know of it and would not look for: whether its metal is on the grid and in view."""

from collections.abc import Iterable

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.tracer.project import Response, Tracer, path_lengths, transmit
from ctsim.tracer.shadow import primitive_corners, row_spans
from ctsim.tracer.voxelise import metal_mask
from ctsim.types import Phantom

NOT_ON_GRID = "no metal on the reconstruction grid"
PIECES = 4  # of metal that are looked at first
SHOWN = 0.01  # of a pixel's signal: less than 10 000 photons tell from noise


def metal_notes(phantom: Phantom, geometry: Geometry, response: Response, subrays: int) -> tuple[str, ...]:
    """Say where a phantom's metal is missing: on the reconstruction grid, or in every view; () for one without metal.

    `response` is that of the phantom's materials. A view shows metal where the signal of a pixel would be another one
    by a hundredth or more without it.
    """
    metals = ", ".join(sorted({s.material for s in phantom.solids if s.metal}))
    if not metals:
        return ()
    solids = _solids(phantom)
    tracer = Tracer.of(solids)
    notes = []
    if not _on_grid(solids, tracer, geometry):
        notes.append(f"{NOT_ON_GRID}: no voxel is {metals} by half or more")
    if not any(_in_view(tracer, geometry, view, response, subrays) for view in range(geometry.n_views)):
        notes.append(f"no metal in any view: without {metals} no pixel would read 1 % more or less")
    return tuple(notes)


def metal_share(phantom: Phantom, geometry: Geometry, views: Iterable[int] | None = None) -> float:
    """Return the share of all rays through pixel centres that meet metal, in these views or in all."""
    tracer = Tracer.of(_solids(phantom))
    metal = np.array([any(s.metal and s.material == m for s in phantom.solids) for m in phantom.materials])
    if not metal.any():
        return 0.0
    nothing = np.zeros((len(tracer.materials), *geometry.n_detector), np.float32)
    shares = [
        float((path_lengths(tracer, geometry, view, nothing)[metal].sum(0) > 0).mean())
        for view in (range(geometry.n_views) if views is None else views)
    ]
    return float(np.mean(shares))


def _solids(phantom: Phantom) -> Phantom:
    """Return the solids without the body, which then cost next to nothing a view."""
    return Phantom(
        labels=np.zeros((1, 1, 1), np.uint8), materials=phantom.materials, d_voxel=(1, 1, 1), solids=phantom.solids
    )


def _on_grid(solids: Phantom, tracer: Tracer, geometry: Geometry) -> bool:
    """Look for a voxel of metal, first around the middles of some pieces, which mostly hold it."""
    middles = [p.centre[::-1] for s in solids.solids if s.metal for p in s.primitives][:PIECES]
    corners = primitive_corners(tracer.prims[tracer.metal]).reshape(-1, 3)[:, ::-1]  # z, y, x
    places = [np.array([middle]) for middle in middles] + [corners]
    return any(_in_box(solids, geometry, points) for points in places)


def _in_box(solids: Phantom, geometry: Geometry, points: NDArray[np.float64]) -> bool:
    """Look for a voxel of metal in the box of voxels around points [k, 3] (z, y, x)."""
    first, n_voxel, off = [], [], []
    for k, centres in enumerate(geometry.voxel_centres()):
        reach = geometry.d_voxel[k]
        low, high = np.searchsorted(centres, [points[:, k].min() - reach, points[:, k].max() + reach])
        if low == high:
            return False
        first.append(low)
        n_voxel.append(int(high - low))
        off.append(float(centres[low] + centres[high - 1]) / 2)
    part = msgspec.structs.replace(geometry, n_voxel=tuple(n_voxel), off_origin=tuple(off))
    return bool(metal_mask(solids, part).any())


def _in_view(tracer: Tracer, geometry: Geometry, view: int, response: Response, subrays: int) -> bool:
    """Measure a view's pixels in the metal's shadow with it and without."""
    shape = geometry.n_detector
    spans = row_spans(tracer.shadows(geometry, view)[:, tracer.metal], shape[1])
    if not spans.any():
        return False
    nothing = np.zeros((len(tracer.materials), *shape), np.float32)
    signals = []
    for traced in (tracer, tracer.without_metal()):
        out = (np.zeros(shape, np.float32), np.zeros(shape, np.float32), spans)
        signals.append(transmit(traced, geometry, view, response, subrays=subrays, background=nothing, out=out)[0])
    return bool((np.abs(signals[0] - signals[1]) > SHOWN * signals[1]).any())
