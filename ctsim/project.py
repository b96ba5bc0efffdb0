"""Rays through a phantom: what every pixel of a view crosses, and what it measures.

A `Tracer` holds a phantom in the form the kernels want. What the central rays cross in the label volume
comes from its columns where the detector stands upright, else from its bricks; the solids are put on top.
Only pixels inside the shadow of the object are measured, primitives are tested only where their shadow
lies, and sub-rays are cast only where the solids' optical thickness changes within a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsim.bricks import Bricks, make_bricks
from ctsim.columns import Columns, make_columns
from ctsim.geometry import Geometry
from ctsim.kernels import bricks_cpu, columns_cpu, raytrace_cpu
from ctsim.materials import attenuation
from ctsim.quadrature import EnergyRule
from ctsim.solids import BOUND, BOX, CAPSULE, ELLIPSOID, FRUSTUM, KIND, MATERIAL, PARAMS, TORUS, pack
from ctsim.types import Phantom

# Over a pixel in which the thickness changes linearly by R the intensity mean differs from the central
# ray by R²/24 in P, so R = 0.1 costs 4e-4, below the photon noise of 1e6 photons.
EDGE_THRESHOLD = 0.1
THIN = 1.5  # primitives thinner than this many pixels can hide between the corners of a pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracer:
    """A phantom ready to be traced. `materials[0]` is air and has no length."""

    bricks: Bricks
    columns: Columns | None
    prims: NDArray[np.float64]
    materials: tuple[str, ...]
    metal: NDArray[np.bool_]
    skip: bool = True

    @staticmethod
    def of(phantom: Phantom, *, skip: bool = True, extra: str | None = None) -> "Tracer":
        """Prepare a phantom; with `extra`, that material is appended for a layer that every ray crosses."""
        return Tracer(
            bricks=make_bricks(phantom),
            columns=make_columns(phantom),
            prims=pack(phantom.solids, phantom.materials),
            materials=phantom.materials + ((extra,) if extra else ()),
            metal=np.concatenate(
                [np.full(len(pack([s], phantom.materials)), s.metal) for s in phantom.solids] or [np.zeros(0, bool)]
            ),
            skip=skip,
        )

    def without_metal(self) -> "Tracer":
        """Return the same tracer with the metal primitives taken out."""
        return replace(self, prims=self.prims[~self.metal], metal=self.metal[~self.metal])

    def background(self, geometry: Geometry, view: int, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Path length (mm) of one view's central rays in the label volume alone, solids left out: [material, v, u].

        It is written to `out` if given. Material 0 is air and is left as it is, 0 in a new array.
        """
        shape, pose = geometry.n_detector, geometry.pose(view)
        if out is None:
            out = np.zeros((len(self.materials), *shape), np.float32)
        if self.columns is not None and _upright(pose):
            order = work_order(-(-shape[1] // columns_cpu.LANES))
            columns_cpu.fill_view(tuple(self.columns), self.bricks.grid, pose, order, out)
        else:
            spans = self.spans(pose, shape)
            bricks_cpu.fill_view(self.bricks[:5], pose, work_order(shape[0]), spans, out)
        return out

    def shadows(self, pose: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
        """Rectangle (v from, v to, u from, u to) that holds each primitive's shadow: [primitive, 4]."""
        centres, radii = self.prims[:, BOUND][:, :3], self.prims[:, BOUND][:, 3:]
        return _rectangles(pose, shape, centres - radii, centres + radii)

    def spans(self, pose: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.int64]:
        """Columns (from, to) of each row that the object can darken: [v, 2]."""
        if not self.skip:
            return np.tile(np.array([0, shape[1]]), (shape[0], 1))
        rects = self.shadows(pose, shape)
        if self.bricks.box[0] <= self.bricks.box[3]:
            low, high = self.bricks.box[None, :3], self.bricks.box[None, 3:]
            rects = np.vstack([rects, _rectangles(pose, shape, low, high)])
        return row_spans(rects, shape)


def row_spans(rects: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Smallest column interval (from, to) of each row that covers all rectangles touching it: [v, 2]."""
    spans = np.zeros((shape[0], 2), np.int64)
    spans[:, 0] = shape[1]
    for v0, v1, u0, u1 in rects:
        rows = slice(max(int(v0), 0), max(int(v1) + 1, 0))
        spans[rows, 0] = np.minimum(spans[rows, 0], max(int(u0), 0))
        spans[rows, 1] = np.maximum(spans[rows, 1], min(int(u1) + 1, shape[1]))
    spans[spans[:, 1] <= spans[:, 0]] = 0
    return spans


def _rectangles(
    pose: NDArray[np.float64], shape: tuple[int, int], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shadows of the axis-parallel boxes low…high [box, 3] in pixels, [box, 4]; all pixels if behind the source.

    There is one pixel of margin.
    """
    corners = np.where(_CORNERS, high[:, None], low[:, None])  # [box, 8, 3]
    source, centre, e_u, e_v = pose.reshape(4, 3)
    normal = np.cross(e_u, e_v)
    reach = (corners - source) @ normal / ((centre - source) @ normal)
    behind = reach.min(1) <= 1e-9
    hit = source + (corners - source) / np.where(behind[:, None], 1.0, reach)[..., None] - centre
    u = hit @ e_u / (e_u @ e_u) + (shape[1] - 1) / 2
    v = hit @ e_v / (e_v @ e_v) + (shape[0] - 1) / 2
    tight = np.floor(v.min(1)) - 1, np.ceil(v.max(1)) + 1, np.floor(u.min(1)) - 1, np.ceil(u.max(1)) + 1
    everything = np.array([0.0, shape[0] - 1.0, 0.0, shape[1] - 1.0])
    return np.where(behind[:, None], everything, np.stack(tight, 1))


_CORNERS = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], bool)


def _upright(pose: NDArray[np.float64]) -> bool:
    """Whether the detector's columns stand along +z and its rows are horizontal."""
    e_u, e_v = pose[6:9], pose[9:]
    slant = max(abs(e_v[0]), abs(e_v[1])) / np.linalg.norm(e_v), abs(e_u[2]) / np.linalg.norm(e_u)
    return bool(e_v[2] > 0 and max(slant) < 1e-14)


def _inflate(prims: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grow the primitives that can hide within a pixel by its half diagonal; mark the others with kind −1."""
    source, centre, e_u, e_v = pose.reshape(4, 3)
    fat = prims.copy()
    pixel = np.hypot(np.linalg.norm(e_u), np.linalg.norm(e_v)) / np.linalg.norm(centre - source)
    pixel = pixel * np.linalg.norm(prims[:, BOUND][:, :3] - source, axis=1)
    kind, sizes = prims[:, KIND].astype(int), prims[:, PARAMS]
    thinnest = np.where(np.isin(kind, (ELLIPSOID, BOX)), sizes[:, :3].min(1), sizes[:, 1])
    radius = np.maximum(sizes[:, 1], sizes[:, 2])
    thinnest = np.where(kind == FRUSTUM, np.minimum(sizes[:, 0], radius), thinnest)
    fat[:, PARAMS] += _GROWING[kind] * pixel[:, None] / 2
    fat[:, BOUND.stop - 1] += 2 * pixel
    fat[2 * thinnest >= THIN * pixel, KIND] = -1
    # spacing of n lattice points is 1/√n of a pixel
    times = np.ceil(THIN * pixel / np.maximum(2 * thinnest, 1e-3 * pixel))
    fat[:, MATERIAL] = np.minimum(times, raytrace_cpu.MOST_TIMES)
    return fat


# which of a primitive's four parameters are half thicknesses, by kind
_GROWING = np.zeros((5, 4))
_GROWING[[ELLIPSOID, FRUSTUM, BOX], :3] = 1
_GROWING[[CAPSULE, TORUS], 1] = 1


def work_order(n_rows: int) -> NDArray[np.int64]:
    """Order the rows so that every contiguous share of them holds rows from all over the detector."""
    return np.argsort(np.arange(n_rows) * 0.6180339887498949 % 1.0, kind="stable")


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """The energy nodes of a scan as the kernel wants them, for the materials of one tracer."""

    mu: NDArray[np.float32]
    w1: NDArray[np.float32]
    w2: NDArray[np.float32]
    edge_mu: NDArray[np.float64]

    @staticmethod
    def of(rule: EnergyRule, materials: Sequence[str]) -> "Response":
        """Tabulate mu [material, node] in 1/mm; air counts as nothing, since the open field is taken through it."""
        mu = np.stack([np.zeros(len(rule.energies)), *(attenuation(m, rule.energies) for m in materials[1:])])
        edge_mu = mu @ rule.w1
        edge_mu[0] = edge_mu.max()  # a hole matters as much as what it was cut from
        return Response(
            mu=mu.astype(np.float32),
            w1=rule.w1.astype(np.float32),
            w2=rule.w2.astype(np.float32),
            edge_mu=edge_mu,
        )


def transmit(
    tracer: Tracer,
    geometry: Geometry,
    view: int,
    response: Response,
    *,
    subrays: int = 34,
    background: NDArray[np.float32] | None = None,
    out: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Measure one view without noise: signal and second moment relative to the open field, each [v, u].

    The signal is Σ w1·exp(−Σ μ·L) averaged over the pixel; the variance of one photon-noise draw is the
    second moment over the photons of an open pixel. The label volume is sampled along the central ray, solids
    and what they replace along every sub-ray. `background` is what `Tracer.background` returned for this view,
    if known, plus what else the rays cross. `out` = (signal, second moment, spans) updates only those columns
    of given images.
    """
    shape, pose = geometry.n_detector, geometry.pose(view)
    if out is None:
        # summed in the kernel's order, so that a skipped ray equals a traced one to the last bit
        m1, m2 = (np.full(shape, np.cumsum(w, dtype=np.float32)[-1]) for w in (response.w1, response.w2))
        spans = np.tile(np.array([0, shape[1]]), (shape[0], 1))
    else:
        m1, m2, spans = out
    most = subrays if len(tracer.prims) else 1
    raytrace_cpu.transmit_view(
        tracer.bricks[:5],
        _solids(tracer, pose, shape),
        pose,
        work_order(-(-shape[0] // raytrace_cpu.STRIP)),
        spans,
        tracer.background(geometry, view) if background is None else background,
        (response.mu, response.w1, response.w2),
        (response.edge_mu, EDGE_THRESHOLD, most),
        m1,
        m2,
    )
    return m1, m2


def path_lengths(
    tracer: Tracer, geometry: Geometry, view: int, background: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Path length (mm) in every material along the central rays of one view: [material, v, u].

    `background` is what `Tracer.background` returned for this view, if known.
    """
    if background is None:
        background = tracer.background(geometry, view)
    if len(tracer.prims) == 0:
        return background.copy()
    shape, pose = geometry.n_detector, geometry.pose(view)
    lengths = np.zeros_like(background)
    solids = _solids(tracer, pose, shape)
    raytrace_cpu.replace_view(tracer.bricks[:5], solids, pose, work_order(shape[0]), background, lengths)
    return lengths


def _solids(tracer: Tracer, pose: NDArray[np.float64], shape: tuple[int, int]) -> tuple[NDArray, NDArray, NDArray]:
    rects = tracer.shadows(pose, shape)
    if not tracer.skip:
        rects[:] = (-1.0, shape[0], -1.0, shape[1])
    return tracer.prims, _inflate(tracer.prims, pose), rects
