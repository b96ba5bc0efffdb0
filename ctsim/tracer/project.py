"""Rays through a phantom: what every pixel of a view crosses, and what it measures.

A `Tracer` holds a phantom in the form the kernels want. What the central rays cross in the label volume
comes from its columns where the detector stands upright, else from its bricks; the solids are put on top.
Only pixels inside the shadow of the object are measured, primitives are tested only where their shadow
lies, and sub-rays are cast only where the solids' optical thickness changes within a pixel.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import EnergyRule
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.solids import pack
from ctsim.tracer import shadow
from ctsim.tracer.bricks import Bricks, make_bricks
from ctsim.tracer.columns import Columns, DensityColumns, make_columns, make_density_columns
from ctsim.tracer.kernels import bricks_cpu, columns_cpu, density_cpu, raytrace_cpu
from ctsim.tracer.kernels.footprint_cpu import LANES
from ctsim.tracer.layers import layers_seen
from ctsim.types import Phantom

# Over a pixel in which the thickness changes linearly by R the intensity mean differs from the central
# ray by R²/24 in P, so R = 0.1 costs 4e-4, below the photon noise of 1e6 photons; at a kink it is R/4. Where a solid
# begins within the pixel the mean can differ by R/2.
EDGE_THRESHOLD, STEP_THRESHOLD = 0.1, 0.004
CAST = 1024  # rows of detectors whose shadows are cast at once: of all views of a small one


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shadows:
    """Where parts of a phantom are seen in some views of a geometry, `first` and those after it.

    `fat` [view, primitive, …] are the primitives as `shadow.inflate` has them, `parts` [view, v, primitive, 2] and
    `body` [view, v, 2] the columns in which they and the label volume are seen.
    """

    geometry: Geometry
    first: int
    poses: NDArray[np.float64]
    fat: NDArray[np.float64]
    parts: NDArray[np.int64]
    body: NDArray[np.int64]

    def holds(self, geometry: Geometry, view: int) -> bool:
        """Say whether a view is among them."""
        return self.geometry is geometry and 0 <= view - self.first < len(self.poses)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracer:
    """A phantom ready to be traced. `materials[0]` is air and has no length."""

    bricks: Bricks
    columns: Columns | DensityColumns | None
    prims: NDArray[np.float64]
    materials: tuple[str, ...]
    metal: NDArray[np.bool_]
    skip: bool = True
    cast: list[_Shadows] = field(init=False, default_factory=list, compare=False, repr=False)
    """The shadows that were cast last."""

    @staticmethod
    def of(
        phantom: Phantom, *, skip: bool = True, extra: str | None = None, geometry: Geometry | None = None
    ) -> "Tracer":
        """Prepare a phantom; with `extra`, that material is appended for a layer that every ray crosses.

        Where the `geometry` of all rays is known, only the layers that they can cross are prepared.
        """
        if skip and geometry is not None:
            phantom = layers_seen(phantom, geometry)
        return Tracer(
            bricks=make_bricks(phantom),
            columns=make_columns(phantom) or make_density_columns(phantom),
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
        shape, pose = geometry.n_detector, self.pose(geometry, view)
        if out is None:
            out = np.zeros((len(self.materials), *shape), np.float32)
        # a single row shares no footprint with others, and bricks of one label are crossed in one step
        fan = isinstance(self.columns, Columns) and shape[0] == 1
        if self.columns is not None and _upright(pose) and not fan:
            order = work_order(-(-shape[1] // LANES))
            fill = columns_cpu.fill_view if isinstance(self.columns, Columns) else density_cpu.fill_view
            fill(tuple(self.columns), self.bricks.grid, pose, order, out)
        else:
            seen = self._seen(geometry, view)
            bricks_cpu.fill_view(self.bricks[:5], pose, work_order(shape[0]), seen.body[view - seen.first], out)
        return out

    def shadows(self, geometry: Geometry, view: int) -> NDArray[np.int64]:
        """Columns (from, to) of each row in which each primitive is seen, as `shadow.cast` has them: [v, primitive, 2].

        Without `skip` that is everywhere.
        """
        seen = self._seen(geometry, view)
        return seen.parts[view - seen.first]

    def pose(self, geometry: Geometry, view: int) -> NDArray[np.float64]:
        """Return what `geometry.pose` does, [12]."""
        seen = self._seen(geometry, view)
        return seen.poses[view - seen.first]

    def solids(self, geometry: Geometry, view: int) -> tuple[NDArray, NDArray, NDArray]:
        """Return the primitives, their inflated twins and their `shadows` in a view, as the kernels want them."""
        seen = self._seen(geometry, view)
        return self.prims, seen.fat[view - seen.first], seen.parts[view - seen.first]

    def _seen(self, geometry: Geometry, view: int) -> _Shadows:
        """Return the shadows of some views, this one among them; those of the views that follow serve later."""
        for seen in self.cast:
            if seen.holds(geometry, view):
                return seen
        shape = geometry.n_detector
        step = max(1, CAST // max(shape[0], len(self.prims)))
        first = view - view % step
        poses = geometry.pose_array()[first : first + step]
        low, high = self.bricks.box[:3], self.bricks.box[3:]
        box = shadow.box_corners(low, high)[: int(low[0] <= high[0])]

        def cast(corners: NDArray[np.float64]) -> NDArray[np.int64]:
            if self.skip:
                return shadow.cast(poses, shape, corners)
            return np.tile(shadow.everywhere(shape, len(corners)), (len(poses), 1, 1, 1))

        seen = _Shadows(
            geometry=geometry,
            first=first,
            poses=poses,
            fat=shadow.inflate(self.prims, poses),
            parts=cast(shadow.primitive_corners(self.prims)),
            body=shadow.row_spans(cast(box), shape[1]),
        )
        self.cast[:] = [seen]
        return seen


def _upright(pose: NDArray[np.float64]) -> bool:
    """Whether the detector's columns stand along +z and its rows are horizontal."""
    e_u, e_v = pose[6:9], pose[9:]
    slant = max(abs(e_v[0]), abs(e_v[1])) / np.linalg.norm(e_v), abs(e_u[2]) / np.linalg.norm(e_u)
    return bool(e_v[2] > 0 and max(slant) < 1e-14)


@functools.lru_cache(16)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Responses:
    """Responses of several variants of a scan to the same materials: mu [variant, material, node], w1 [variant, node].

    Variant j has the first `nodes[j]` nodes.
    """

    mu: NDArray[np.float32]
    w1: NDArray[np.float32]
    w2: NDArray[np.float32]
    nodes: NDArray[np.int64]
    edge_mu: NDArray[np.float64]

    @staticmethod
    def of(responses: Sequence[Response]) -> "Responses":
        """Put responses side by side."""
        most = max(r.w1.size for r in responses)

        def padded(part: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, most - part.shape[-1])])

        return Responses(
            mu=np.stack([padded(r.mu) for r in responses]),
            w1=np.stack([padded(r.w1) for r in responses]),
            w2=np.stack([padded(r.w2) for r in responses]),
            nodes=np.array([r.w1.size for r in responses]),
            edge_mu=np.stack([r.edge_mu for r in responses]),
        )


Images = tuple[NDArray[np.float32], NDArray[np.float32]]


def transmit(
    tracer: Tracer,
    geometry: Geometry,
    view: int,
    response: Response,
    *,
    subrays: int = 34,
    edge_tolerance: float = 0.03,
    background: NDArray[np.float32] | None = None,
    out: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]] | None = None,
) -> Images:
    """Measure one view without noise: signal and second moment relative to the open field, each [v, u].

    The signal is Σ w1·exp(−Σ μ·L) averaged over the pixel; the variance of one photon-noise draw is the
    second moment over the photons of an open pixel. The label volume is sampled along the central ray, the
    solids along every sub-ray. `background` is what `Tracer.background` returned for this view,
    if known, plus what else the rays cross. `subrays` and `edge_tolerance` are those of `ctsim.settings.Simulation`.
    `out` = (signal, second moment, spans) writes all of those columns of given images, and no others.
    """
    settings = {"subrays": subrays, "edge_tolerance": edge_tolerance}
    images = None if out is None else (out[0][None], out[1][None], out[2])
    m1, m2 = transmit_all(
        tracer, geometry, view, Responses.of([response]), background=background, out=images, **settings
    )
    return m1[0], m2[0]


def transmit_all(
    tracer: Tracer,
    geometry: Geometry,
    view: int,
    responses: Responses,
    *,
    subrays: int = 34,
    edge_tolerance: float = 0.03,
    background: NDArray[np.float32] | None = None,
    out: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]] | None = None,
) -> Images:
    """Measure one view of several variants along the same rays, each [variant, v, u]: see `transmit`.

    Each variant gets, to the last bit, what `transmit` gives it.
    """
    shape, pose = geometry.n_detector, tracer.pose(geometry, view)
    if out is None:
        images = len(responses.nodes), *shape
        m1, m2 = np.empty(images, np.float32), np.empty(images, np.float32)
        spans = np.tile(np.array([0, shape[1]]), (shape[0], 1))
    else:
        m1, m2, spans = out
    most = subrays if len(tracer.prims) else 1
    raytrace_cpu.transmit_variants(
        tracer.bricks[:5],
        tracer.solids(geometry, view),
        pose,
        work_order(-(-shape[0] // raytrace_cpu.STRIP)),
        spans,
        tracer.background(geometry, view) if background is None else background,
        (responses.mu, responses.w1, responses.w2, responses.nodes),
        (responses.edge_mu, EDGE_THRESHOLD, STEP_THRESHOLD, most, edge_tolerance),
        tracer.skip,
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
    shape, pose = geometry.n_detector, tracer.pose(geometry, view)
    lengths = np.zeros_like(background)
    solids = tracer.solids(geometry, view)
    raytrace_cpu.replace_view(tracer.bricks[:5], solids, pose, work_order(shape[0]), background, lengths)
    return lengths
