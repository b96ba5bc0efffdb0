"""What a scene is like before it is simulated: how thick, how fast on this machine, how good at edges.

A coarse detector in a few views tells which lengths the energies must serve; one view at full size is timed;
and in a few windows on the edges of solids the result of sub-rays is compared with a much finer detector.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import EnergyRule
from ctsim.geometry import Geometry, few_views
from ctsim.materials import attenuation
from ctsim.settings import Simulation
from ctsim.tracer.project import Response, Responses, Tracer, path_lengths, transmit, transmit_all
from ctsim.tracer.shadow import row_spans

VIEWS, PIXELS = 8, 48
WINDOWS, WINDOW, FINER = 8, 8, 8  # windows, pixels along a window's side, finer pixels along a pixel's side
PROBE_KEV = 60.0  # at which windows are chosen, so that they are the same for any spectrum
FINER_RAYS = 8  # of a finer pixel at first: with those that it gets where they do not suffice, P is right to 0.02


Window = tuple[slice, slice]
"""Rows and columns of a detector."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Path lengths (mm) [material, view, v, u] of coarse views, of the whole phantom and of it without metal."""

    lengths: NDArray[np.float32]
    body: NDArray[np.float32]

    def median_path(self, materials: tuple[str, ...], energy: float) -> float:
        """Median water-equivalent path (mm), at `energy` (keV), of the rays that meet the metal-free body."""
        at = np.array([energy])
        mu = np.array([0.0, *(float(attenuation(m, at)[0]) for m in materials[1:])])
        tau = np.tensordot(mu, self.body, 1)
        met = tau[tau > 0]
        return float(np.median(met) / attenuation("water", at)[0]) if met.size else 0.0


def survey(tracer: Tracer, geometry: Geometry) -> Survey:
    """Trace a coarse detector in a few views spread over the scan."""
    n = tuple(min(PIXELS, k) for k in geometry.n_detector)
    v, u = (k / m for k, m in zip(geometry.n_detector, n, strict=True))
    views = few_views(geometry.n_views, VIEWS)
    poses = geometry.pose_array()[views]
    poses[:, 6:9] *= u
    poses[:, 9:] *= v
    coarse = _with_poses(geometry, poses, n)
    bare = tracer.without_metal()
    lengths = np.stack([path_lengths(tracer, coarse, k) for k in range(len(views))], 1)
    body = np.stack([path_lengths(bare, coarse, k) for k in range(len(views))], 1) if tracer.metal.any() else lengths
    return Survey(lengths=lengths, body=body)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One view at full size: seconds without noise and writing, and the largest |ΔP| in the windows looked at."""

    seconds: float
    edge_error: float


def trial(
    tracer: Tracer, geometry: Geometry, responses: Sequence[Response], *, settings: Simulation, twin: bool
) -> list[Trial]:
    """Measure one view, and its metal-free twin if there is to be one, as the simulator does, by each response.

    Seconds are an equal share of what all of them took. The largest |ΔP| is to the last bit that of a response alone.
    """
    view, shape, many = geometry.n_views // 2, geometry.n_detector, Responses.of(responses)
    rays = {"subrays": settings.subrays, "edge_tolerance": settings.edge_tolerance}
    spans = row_spans(tracer.shadows(geometry, view)[:, tracer.metal], shape[1])
    background, m1, seconds = tracer.background(geometry, view), np.empty(0), 0.0
    for _ in range(2):  # the first call compiles
        start = time.perf_counter()
        tracer.background(geometry, view, background)
        m1, m2 = transmit_all(tracer, geometry, view, many, background=background, **rays)
        if twin:
            bare, out = tracer.without_metal(), (m1.copy(), m2.copy(), spans)
            transmit_all(bare, geometry, view, many, background=background, out=out, **rays)
        seconds = time.perf_counter() - start
    worst = np.zeros(len(responses))
    for window in _windows(tracer, geometry, view, settings, background) if settings.subrays > 1 else ():
        exact = _finer(tracer, geometry, view, many, background, window)
        worst = np.maximum(worst, np.abs(np.log(m1[:, *window] / exact)).max((1, 2)))
    return [Trial(seconds=seconds / len(responses), edge_error=float(error)) for error in worst]


def _windows(
    tracer: Tracer, geometry: Geometry, view: int, settings: Simulation, background: NDArray
) -> Iterator[Window]:
    """Yield windows of a view, (v, u), around pixels that sub-rays change most, less and least at `PROBE_KEV`."""
    one = np.ones(1)
    rule = EnergyRule(energies=np.array([PROBE_KEV]), w1=one, w2=one, mean_signal=1.0, error=0.0)
    probe, shape = Response.of(rule, tracer.materials), geometry.n_detector
    plain, seen = (
        transmit(
            tracer, geometry, view, probe, subrays=n, edge_tolerance=settings.edge_tolerance, background=background
        )[0]
        for n in (1, settings.subrays)
    )
    change = np.abs(np.log(seen / plain)).ravel()
    edges = np.argsort(-change, kind="stable")[: np.count_nonzero(change)]
    if not edges.size:
        return
    n_v, n_u = (min(WINDOW, n) for n in shape)
    for at in edges[np.unique(np.linspace(0, edges.size - 1, WINDOWS).astype(int))]:
        v, u = np.unravel_index(at, shape)
        corner = min(max(int(v) - n_v // 2, 0), shape[0] - n_v), min(max(int(u) - n_u // 2, 0), shape[1] - n_u)
        yield slice(corner[0], corner[0] + n_v), slice(corner[1], corner[1] + n_u)


def _finer(
    tracer: Tracer, geometry: Geometry, view: int, many: Responses, background: NDArray, window: Window
) -> NDArray[np.float64]:
    """Signals in a window of the detector, [response, v, u], from 8² finer pixels a pixel over the same background."""
    (n_v, n_u), (v, u) = (tuple(s.stop - s.start for s in window), tuple(s.start for s in window))
    pose = geometry.pose(view).copy()
    pose[3:6] += (u + (n_u - geometry.n_detector[1]) / 2) * pose[6:9]
    pose[3:6] += (v + (n_v - geometry.n_detector[0]) / 2) * pose[9:]
    pose[6:] /= FINER
    fine = _with_poses(geometry, pose[None], (n_v * FINER, n_u * FINER))
    under = np.ascontiguousarray(background[:, *window].repeat(FINER, 1).repeat(FINER, 2))
    signals, _ = transmit_all(tracer, fine, 0, many, subrays=FINER_RAYS, background=under)
    return signals.reshape(-1, n_v, FINER, n_u, FINER).mean((2, 4), dtype=np.float64)


def _with_poses(geometry: Geometry, poses: NDArray[np.float64], n_detector: tuple[int, ...]) -> Geometry:
    n_v, n_u = n_detector
    rows = tuple(tuple(float(x) for x in row) for row in poses)
    return msgspec.structs.replace(geometry, n_detector=(n_v, n_u), n_views=len(rows), angles_deg=None, poses=rows)
