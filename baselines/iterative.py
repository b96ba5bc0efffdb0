"""What the iterative methods share: the linear system of a scan, their course, and how they end.

A x = p with A of `ctsim.reconstruct.projector`, x the attenuation in 1/mm and p the measured line integrals; residuals
are ‖A x − p‖_W / ‖p‖_W, so an empty volume has 1. Volumes are kept as [y, x, z] while iterating. Only voxels
within the field of view that some ray meets are unknowns; all others are and stay zero.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.kernels.dot_cpu import dot_by_row
from ctsim.baselines.metal import Trace, auto_mask
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.beyond import field_radius, seen_beyond
from ctsim.reconstruct.fdk import ramp
from ctsim.reconstruct.log import NO_SIGNAL, is_blind, line_integrals
from ctsim.reconstruct.primary import Readings
from ctsim.reconstruct.projector import Views, adjoint_columns, forward_columns
from ctsim.reconstruct.settings import about
from ctsim.reconstruct.watch import Stopwatch
from ctsim.reconstruct.watch import watch as watch
from ctsim.types import Scan, Status, Volume

Array = NDArray[np.float32]
Weighting = Literal["none", "trace", "exp(-l)"]
Weights = Weighting | torch.Tensor
Count = Annotated[int, about("iterations over all views", ge=1, le=100_000)]
WORST = 1.5  # a relative residual that no fit of pure noise reaches: one view fitted to another's gives √2


class Iterations(Readings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all iterative methods are given; a method adds its own and may set other defaults.

    `weights` of the rays is "none" (all 1), "trace" (0 in the trace of the metal that `ctsim.baselines.metal.auto_mask`
    finds in FDK's volume, else 1), "exp(-l)" (the share of photons that came through a line integral l, hence the
    inverse variance of l up to a factor, where no scatter was taken off), or a tensor [view, v, u] of one's own.
    """

    iterations: Count = 10
    weights: Annotated[
        Weighting,
        about(
            "of the rays: all 1, 0 in the metal's trace, or the share of photons that come through", also=torch.Tensor
        ),
    ] = "none"


class System:
    """A scan's linear system: data, ray weights, and the projector restricted to the unknowns.

    `data`, `weights` and `lengths` of rays through the unknowns (mm) are float32 [view, v, u], `support` is bool
    [y, x, z]. Counts the views projected
    and backprojected. `given` are the weights as in `Iterations`.
    """

    def __init__(self, scan: Scan, given: Weights = "none") -> None:
        self.geometry = scan.geometry
        data, clamped = line_integrals(scan, slice(None))
        self.data: Array = data.numpy()
        self.clamped = int(clamped.sum())
        self.blind = is_blind(scan, self.clamped)
        self.weights, self.about_weights = _weights(given, scan, self.data)
        self.views_projected = self.views_backprojected = 0
        n_z, n_y, n_x = self.geometry.n_voxel
        self.support = np.ones((n_y, n_x, n_z), np.bool_)
        self.support &= _within_field_of_view(self.geometry)[:, :, None]
        self.support &= self.adjoint(np.ones_like(self.data)) > 0
        self.scale = weighted_norm(self.data, self.weights) or 1.0
        self.lengths = self.forward(self.support.astype(np.float32))
        self.beyond = seen_beyond(self.data, self.geometry, scan.i0, self.lengths)

    def empty(self) -> Array:
        """Return the volume that all methods start from."""
        return np.zeros(self.support.shape, np.float32)

    def forward(self, x: Array, views: Views = None) -> Array:
        """Project the chosen views (default: all), [view, v, u]."""
        projections = forward_columns(x, self.geometry, views)
        self.views_projected += len(projections)
        return projections

    def adjoint(self, projections: Array, views: Views = None) -> Array:
        """Backproject the chosen views onto the unknowns, [y, x, z]."""
        x = adjoint_columns(projections, self.geometry, views)
        self.views_backprojected += len(projections)
        x *= self.support
        return x

    def residual(self, x: Array) -> float:
        """Return ‖A x − p‖_W / ‖p‖_W."""
        difference = self.forward(x)
        difference -= self.data
        return weighted_norm(difference, self.weights) / self.scale


class Course:
    """The residuals of a run by iteration, and the reason to stop it early, if any."""

    def __init__(self) -> None:
        self.view_updates = 0
        self.residuals: list[float] = []
        self.reason = ""
        self._stopwatch = Stopwatch()

    def note(self, x: Array, views: int, residual: float) -> bool:
        """Record an iteration that used `views` views; tell whether to go on.

        A residual well above that of an empty volume, or not finite, is divergence.
        """
        self.view_updates += views
        self.residuals.append(residual)
        if not residual <= WORST:
            self.reason = f"the data residual of iteration {len(self.residuals)} is {residual:.3g}, an empty volume's 1"
        self._stopwatch.show(self.view_updates, lambda: as_volume(x))
        return not self.reason


def finish(system: System, course: Course, x: Array, **details: Any) -> Volume:
    """Measure the final residual and say how the run ended."""
    values = as_volume(x)
    finite = bool(np.isfinite(values).all())
    if not finite:
        values = np.nan_to_num(values, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    residual = system.residual(x) if finite else math.inf
    reason, beyond = course.reason, system.beyond.sentence
    if not reason and not residual <= 1 + 1e-3:
        reason = f"the final data residual is {residual:.3g}, an empty volume's 1"
    status = Status.DIVERGED if reason else Status.OK
    if system.blind:
        values, status, reason = np.zeros_like(values), Status.ERROR, NO_SIGNAL
    return Volume(
        values=torch.from_numpy(values),
        status=status,
        reason=reason,
        details={
            "view_updates": course.view_updates,
            "residual": residual if finite else None,
            "residuals": [r if math.isfinite(r) else None for r in course.residuals],
            "views_projected": system.views_projected,
            "views_backprojected": system.views_backprojected,
            "clamped_pixels": system.clamped,
            **system.beyond.details(),
            **system.about_weights,
            **details,
            **({"limitation": beyond} if beyond else {}),
        },
    )


def as_volume(x: Array) -> Array:
    """Turn [y, x, z] into [z, y, x]."""
    return np.ascontiguousarray(x.transpose(2, 0, 1))


def visiting_order(n: int) -> list[int]:
    """Order n subsets so that each lies far from those before it: steps of the golden section, mod n."""
    step = max(1, round(n * (math.sqrt(5) - 1) / 2))
    while math.gcd(step, n) != 1:
        step += 1
    return [k * step % n for k in range(n)]


def weighted_norm(values: Array, weights: Array) -> float:
    """Return the square root of Σ w·a², summed in float64 in one order for any number of threads."""
    return math.sqrt(weighted_dot(values, values, weights))


def weighted_dot(a: Array, b: Array, weights: Array) -> float:
    """Return Σ w·a·b, summed in float64 in one order for any number of threads."""
    sums = np.zeros(len(a), np.float64)
    dot_by_row(a.reshape(len(a), -1), b.reshape(len(a), -1), weights.reshape(len(a), -1), sums)
    return float(sums.sum())


def _weights(given: Weights, scan: Scan, data: Array) -> tuple[Array, dict[str, object]]:
    """Return the weights and what a result says of them."""
    if isinstance(given, torch.Tensor):
        weights = np.array(given.detach().cpu().numpy(), np.float32)
        if weights.shape != data.shape or not np.isfinite(weights).all() or weights.min() < 0 or weights.max() == 0:
            raise InputError(f"weights must be {data.shape}, finite, not negative and not all zero")
        return weights, {}
    if given == "exp(-l)":
        return np.exp(-np.maximum(data, 0), dtype=np.float32), {}
    weights, about = np.ones_like(data), {}
    if given == "trace":
        metal = auto_mask(ramp(scan).values.numpy())
        about = metal.details()
        if metal.found:
            trace = Trace(metal, scan)
            for view in range(scan.geometry.n_views):
                weights[view][trace.view(view)] = 0
    return weights, about


def _within_field_of_view(geometry: Geometry) -> NDArray[np.bool_]:
    """Mark the voxel columns [y, x] that FDK reconstructs as well; with poses given, all of them."""
    _, y, x = geometry.voxel_centres()
    return np.add.outer(y**2, x**2) <= field_radius(geometry) ** 2
