"""What the views of a scan measure without noise and scatter, and those of its variants along the same rays.

Variants have the same body, solids of the same shape and the same geometry. Metal, spectrum, dose and noise may differ.
Path lengths, of sub-rays too, are found once for all of them, and each gets, to the last bit, what it gets alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.look import all_rays
from ctsim.plan import Plan
from ctsim.readout import Image, Moments
from ctsim.scaninfo import TWIN
from ctsim.tracer.project import Response, Responses, Tracer, path_lengths, transmit_all
from ctsim.tracer.shadow import join, row_spans
from ctsim.types import Phantom, Scanner

Seen = tuple[Moments, Moments | None, NDArray[np.int64] | None]
"""Moments [variant, v, u] of the scan and of its twin, and the columns of each row in which these can differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One scan to simulate: its plan, its phantom and its scanner.

    `layer` [v, u] is the thickness (mm) of `layer_material`, which every ray crosses before the object; None for none.
    """

    plan: Plan
    phantom: Phantom
    scanner: Scanner
    layer: Image | None
    layer_material: str | None

    @property
    def materials(self) -> tuple[str, ...]:
        """The materials that rays meet, that of the layer last."""
        return self.plan.materials + ((self.layer_material,) if self.layer_material else ())

    @property
    def twin(self) -> bool:
        """Whether there is a metal-free twin."""
        return any(o.name == f"{TWIN}counts" for o in self.plan.outputs)


def same_rays(a: Part, b: Part) -> bool:
    """Say whether two scans are variants of each other: their rays cross the same lengths of materials."""
    ours, theirs = a.plan, b.plan
    known = (
        a.phantom.labels is b.phantom.labels
        and a.phantom.density is b.phantom.density
        and _numbers(a) == _numbers(b)
        and (a.phantom.d_voxel, a.phantom.off_origin) == (b.phantom.d_voxel, b.phantom.off_origin)
        and a.scanner.geometry == b.scanner.geometry
        and all_rays(a.scanner) == all_rays(b.scanner)
        and ours.settings == theirs.settings
        and (a.twin, len(a.materials), a.layer_material) == (b.twin, len(b.materials), b.layer_material)
        and (a.layer is None or (b.layer is not None and np.array_equal(a.layer, b.layer)))
        and _shapes(a) == _shapes(b)
    )
    if ours.spot is None or theirs.spot is None:
        return known and ours.spot is theirs.spot
    spots = zip((ours.spot.offsets, ours.spot.weights), (theirs.spot.offsets, theirs.spot.weights), strict=True)
    return known and all(np.array_equal(*pair) for pair in spots)


def _numbers(part: Part) -> list[int]:
    """Return the labels of the materials that rays meet."""
    return [part.phantom.materials.index(m) for m in part.plan.materials]


def _shapes(part: Part) -> list[tuple[Any, ...]]:
    """Return the solids without what they are called and made of, but for its place in the list of materials."""
    return [(s.primitives, s.metal, part.plan.materials.index(s.material)) for s in part.phantom.solids]


def compact(phantom: Phantom, materials: tuple[str, ...]) -> Phantom:
    """Return the phantom with its labels renumbered to `materials`, which must hold all that occur."""
    if materials == phantom.materials:
        return phantom
    table = np.array([materials.index(m) if m in materials else 0 for m in phantom.materials], np.uint8)
    return Phantom(
        labels=table[phantom.labels],
        materials=materials,
        d_voxel=phantom.d_voxel,
        off_origin=phantom.off_origin,
        density=phantom.density,
        solids=phantom.solids,
    )


class Signals:
    """The noise-free signals of scans that `same_rays` holds for, view by view."""

    def __init__(self, parts: Sequence[Part]) -> None:
        part = parts[0]
        self.plan, self.geometry, self.twin, self.layer = part.plan, part.scanner.geometry, part.twin, part.layer
        rays = all_rays(part.scanner)
        body = compact(part.phantom, part.plan.materials)
        self.tracer = Tracer.of(body, skip=part.plan.settings.skip, extra=part.layer_material, geometry=rays)
        self.bare = self.tracer.without_metal()
        self.lengths = np.zeros((len(self.tracer.materials), *self.geometry.n_detector), np.float32)
        distinct: list[Response] = []
        self.place = [_placed(Response.of(one.plan.rule, one.materials), distinct) for one in parts]
        self.responses = Responses.of(distinct)
        self.known: tuple[int, Seen] | None = None
        self.crossed: int | None = None  # the view whose central rays `lengths` holds

    def moments(self, k: int, variant: int) -> Seen:
        """Return what a variant's view k measures, [v, u]; variants that ask for one view in turn share the work."""
        if self.known is None or self.known[0] != k:
            self.known = k, self._view(k)
        scan, twin, spans = self.known[1]
        j = self.place[variant]
        return (scan[0][j], scan[1][j]), None if twin is None else (twin[0][j], twin[1][j]), spans

    def paths(self, k: int, *, twin: bool = False) -> NDArray[np.float32]:
        """Return path lengths (mm) [material, v, u] along the central rays of view k, of the scan or of its twin."""
        if self.crossed != k:
            self._cross(self.geometry, k)  # the rays from the spot's centre, where it has a size
            self.crossed = k
        return path_lengths(self.bare if twin else self.tracer, self.geometry, k, self.lengths)

    def _view(self, k: int) -> Seen:
        spot = self.plan.spot
        self.crossed = None
        if spot is None or not spot.offsets.any():
            seen = self._seen(self.geometry, k)
            self.crossed = k
            return seen
        geometry = spot.geometry(self.geometry, k)
        images = 2 if self.twin else 1, 2, len(self.responses.nodes), *self.geometry.n_detector
        sums, spans = np.zeros(images), None
        for j, weight in enumerate(spot.weights):
            *moments, found = self._seen(geometry, j)
            sums += weight * np.stack([pair for pair in moments if pair is not None])
            spans = found if spans is None or found is None else join(spans, found)
        scan, *twin = sums.astype(np.float32)
        return (scan[0], scan[1]), (twin[0][0], twin[0][1]) if twin else None, spans

    def _cross(self, geometry: Geometry, k: int) -> None:
        """Fill `lengths` with what the central rays of a view cross but for solids."""
        self.tracer.background(geometry, k, self.lengths)  # serves the scans, their twins and the path lengths
        if self.layer is not None:
            self.lengths[-1] += self.layer

    def _seen(self, geometry: Geometry, k: int) -> Seen:
        """Return what `_view` does, of a point source."""
        self._cross(geometry, k)
        scan = self._transmit(self.tracer, geometry, k)
        if not self.twin:
            return scan, None, None
        if not self.plan.settings.skip:
            return scan, self._transmit(self.bare, geometry, k), None
        # only pixels in the metal's shadow can differ
        shape = geometry.n_detector
        spans = row_spans(self.tracer.shadows(geometry, k)[:, self.tracer.metal], shape[1])
        return scan, self._transmit(self.bare, geometry, k, (scan[0].copy(), scan[1].copy(), spans)), spans

    def _transmit(
        self, tracer: Tracer, geometry: Geometry, k: int, out: tuple[Image, Image, NDArray] | None = None
    ) -> Moments:
        settings = self.plan.settings
        return transmit_all(
            tracer,
            geometry,
            k,
            self.responses,
            subrays=settings.subrays,
            edge_tolerance=settings.edge_tolerance,
            background=self.lengths,
            out=out,
        )


def _placed(response: Response, distinct: list[Response]) -> int:
    """Return the place of a response among the distinct ones, where it is put if it is new."""
    for k, other in enumerate(distinct):
        if all(np.array_equal(getattr(response, name), getattr(other, name)) for name in Response.__slots__):
            return k
    distinct.append(response)
    return len(distinct) - 1


def share_rays(parts: Sequence[Part]) -> list[tuple[Signals, int]]:
    """Return for each scan the signals that it shares with its variants among the others, and its place there."""
    groups: list[list[int]] = []
    for k, part in enumerate(parts):
        group = next((g for g in groups if same_rays(parts[g[0]], part)), None)
        if group is None:
            groups.append([k])
        else:
            group.append(k)
    found: dict[int, tuple[Signals, int]] = {}
    for group in groups:
        signals = Signals([parts[k] for k in group])
        found |= {k: (signals, place) for place, k in enumerate(group)}
    return [found[k] for k in range(len(parts))]
