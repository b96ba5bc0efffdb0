"""Weighted least squares by ordered subsets, one unknown a splat, edges kept.

Minimises ½ Σ_rays w (P(u) − p)² + TV with w = exp(−p), the share of photons that came through, so that starved rays
count for little and no mask is needed; edges count less still (`ctsim.reconstruct.weights`). A subset's step is
s·F(s·g), g the gradient, s² the inverse of a separable majoriser of the Hessian (Erdogan and Fessler, Phys. Med. Biol.
44, 1999, doi:10.1088/0031-9155/44/11/311), and F a ramp filter of the transverse frequencies: n views of a subset
overlap only below n/π cycles a field of view; above, one view alone answers for a frequency, and up to n times the step
is stable there. At half resolution one pass with F left a smaller error on a thorax with iron than three without.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.reconstruct.splat.columns import LatticeProjector
from ctsim.reconstruct.splat.curve import METAL, MaterialCurve
from ctsim.reconstruct.splat.kernels import step_cpu
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.level import Data
from ctsim.reconstruct.splat.response import Response, evaluate
from ctsim.reconstruct.splat.volume import voxelise

SUBSET, LEAST_SUBSETS = 10, 8
"""Views in a subset, fewer where there would be too few subsets."""
STEEPEST = 0.8
"""Greatest gain of the ramp, as a share of the views in a subset."""
REST, A_PASS = 4, 6
"""Subsets between two denoisings, six in a long pass; in the first pass also between measurements of the curvature."""
SMOOTHING = 8  # iterations of a denoising
SETTLED = 4
"""The pass whose denoising is as asked for, or the last; from there back to the first it is twice as strong in each.

What is then smoothed away too far is regained from the data, while streaks come back slowly.
"""
SHORTER = 2
"""The last two passes, or one of three and fewer, shorten their steps as 1/(1 + t) after t passes: to 1/2, then 1/3.

Subsets that disagree, by noise or by what no model explains, would keep the fit from settling.
"""
LONGEST = 3.0  # times the median root of a step: hardly seen splats, their steps spread by F, make a fit diverge
SAMPLE = 1 << 18  # roots of which the median is taken
FAINT = 0.5  # times water: splats below are preconditioned as if they held this

Image = NDArray[np.float32]


@dataclass(slots=True, kw_only=True)
class Fit:
    """The unknowns `u`, float32 [splat] in 1/mm of the hardened beam, on one lattice, and how they fare.

    `tv` is the denoiser's threshold a hundred views in units of water. `loss` is the mean |P − p| of the last subset,
    `misfit` that of the last pass. Splats are projected by EWA unless `exact`.
    """

    data: Data
    lattice: Lattice
    response: Response
    curve: MaterialCurve
    u: Image
    tv: float
    exact: bool = False
    loss: float = math.inf
    misfit: float = math.inf
    view_updates: int = 0
    steps: int = 0
    projector: LatticeProjector = field(init=False)
    _curvature: Image = field(init=False)  # by both densities, summed over the views that it was measured in
    _measured: int = 0
    _total: float = 0.0  # of the losses of this pass
    _pair: Image = field(init=False)  # densities, then sums by them: memory that is used again costs less than new
    _gradient: Image = field(init=False)
    _roots: Image = field(init=False)

    def __post_init__(self) -> None:
        self.projector = LatticeProjector(self.data.geometry, self.lattice, exact=self.exact)
        n = len(self.lattice)
        self._curvature, self._pair = np.zeros((n, 2), np.float32), np.empty((n, 2), np.float32)
        self._gradient, self._roots = np.empty(n, np.float32), np.empty(n, np.float32)

    def run(self, passes: int, proceed: Callable[["Fit", bool], bool]) -> bool:
        """Go through all views `passes` times; stop and return False when `proceed(fit, whole)` says so.

        It is asked after each subset, `whole` where that was the last of a pass.
        """
        n_views = self.data.geometry.n_views
        n = n_subsets(n_views)
        order, every = bit_reversed(n), max(REST, n // A_PASS)
        while self.steps < passes * n:
            turn, k = divmod(self.steps, n)
            views, length = np.arange(order[k], n_views, n), step_length(self.steps / n, passes)
            self.loss = self._step(views, turn == 0 and k % every == 0, length)
            self.steps, self._total = self.steps + 1, (self._total if k else 0.0) + self.loss
            if (k + 1) % every == 0 or k + 1 == n:
                hundreds = (k % every + 1) / n * n_views / 100
                threshold = self.tv * self.curve.water * 2 ** max(min(passes, SETTLED) - 1 - turn, 0)
                self.u = self.lattice.denoise(self.u, threshold * hundreds, SMOOTHING)
            if k + 1 == n:
                self.misfit = self._total / n
            if not proceed(self, k + 1 == n):
                return False
        return True

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that the next step depends on, as arrays that it changes."""
        numbers = np.array([self.steps, self._measured, self.view_updates])
        reals = np.array([self.loss, self.misfit, self._total])
        return {
            "u": self.u,
            "curvature": self._curvature,
            "dual": self.lattice.dual,
            "numbers": numbers,
            "reals": reals,
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a state. Raises KeyError where something is missing, ValueError where it does not fit."""
        self.steps, self._measured, self.view_updates = state["numbers"].tolist()
        self.loss, self.misfit, self._total = state["reals"].tolist()
        for name, own in (("u", self.u), ("curvature", self._curvature), ("dual", self.lattice.dual)):
            if state[name].shape != own.shape:  # NumPy would spread a single value
                raise ValueError(f"{name} has shape {state[name].shape}, expected {own.shape}")
            own[...] = state[name]

    def volume(self) -> Image:
        """Return u on the voxel grid, a mean over each voxel: [z, y, x] in 1/mm."""
        return voxelise(self.lattice.splats(self.u[:, None]), self.data.geometry)[0]

    def _step(self, views: NDArray[np.int64], measure: bool, length: float) -> float:
        """Update `u` by `length` of a step from some views; return their mean |P − p|.

        The curvature is that of all views in which it was measured: it changes little from subset to subset.
        """
        la, lb = self._paths(views)
        p, by_a, by_b = evaluate(self.response, la, lb)
        measured, weights = (self.projector.arranged(a[views]) for a in (self.data.p, self.data.weights))
        dark = weights < 0
        if self.data.scatter:
            primary = np.exp(-p)
            seen = primary + np.float32(self.data.scatter)
            left = np.where(dark, np.float32(1), primary / seen)
            p, by_a, by_b = np.where(dark, p, -np.log(seen)), by_a * left, by_b * left
        weights = np.abs(weights)
        slopes = np.stack([weights * by_a, weights * by_b], 1, dtype=np.float32)
        if measure:
            along = np.asarray(by_a * la + by_b * lb, np.float32)  # J·u: the majoriser's other half
            self._curvature += self._back(slopes, along, views)
            self._measured += len(views)
        lacking = measured - p
        lacking *= weights > 0
        np.maximum(lacking, 0, out=lacking, where=dark)  # a bound is met by all that is darker
        gradient = self.curve.transpose(self.u, self._back(slopes, lacking, views), length, self._gradient)
        curvature = self.curve.transpose(self.u, self._curvature, len(views) / self._measured, self._roots)
        self._move(gradient, curvature, len(views))
        self.view_updates += len(views)
        return float(np.abs(lacking).sum(dtype=np.float64)) / (len(views) * math.prod(self.data.geometry.n_detector))

    def _paths(self, views: NDArray[np.int64]) -> tuple[Image, Image]:
        """Return La and Lb of some views."""
        paths = self.projector.forward(self.curve.densities_of(self.u, self.lattice.unit, self._pair), views)
        return np.ascontiguousarray(paths[:, 0]), np.ascontiguousarray(paths[:, 1])

    def fitted(self, views: NDArray[np.int64]) -> Image:
        """Return P of some views, with the scatter of the data: [view, v, u]."""
        p, _, _ = evaluate(self.response, *self._paths(views))
        if self.data.scatter:
            p = -np.logaddexp(-p, np.float32(math.log(self.data.scatter)))
        return self.projector.pictures(p)

    def shadow(self, views: NDArray[np.int64], above: float) -> Image:
        """Return the line integrals of what is above a value of `u`: [view, v, u]."""
        values = np.where(self.u > above, self.u / np.float32(self.lattice.unit), np.float32(0))
        np.stack([values, values], 1, out=self._pair)  # the projector takes two channels: one is looked at
        return self.projector.pictures(self.projector.forward(self._pair, views)[:, 0])

    def _back(self, slopes: Image, images: Image, views: NDArray[np.int64]) -> Image:
        return self.projector.adjoint(slopes * images[:, None], views, self._pair)

    def _move(self, gradient: Image, curvature: Image, n_views: int) -> None:
        """Step; gradient and curvature are overwritten."""
        water = self.curve.water
        faint, metal = np.float32(FAINT * water), np.float32(METAL * water)
        few = slice(None, None, max(len(self.u) // SAMPLE, 1))
        u, seen = self.u[few], np.maximum(curvature[few], np.float32(step_cpu.LEAST))
        roots = np.sqrt(np.maximum(u, faint) / seen)[u < metal]
        longest = np.float32(LONGEST * np.median(roots)) if roots.size else np.float32(np.inf)
        step_cpu.precondition(self.u, faint, metal, longest, gradient, curvature)
        # a metal's own steps are so large that spread they swamp the tissue
        spread = self.lattice.filter_slices(self.u, metal, gradient, self._ramp(n_views))
        last = np.float32(self.curve.knots[-1])
        step_cpu.move(self.u, metal, last, curvature, gradient, self.lattice.index, spread)

    def _ramp(self, n_views: int) -> Image:
        _, n_y, n_x = self.lattice.support.shape
        p_y, p_x = self.lattice.padded
        cycles = np.hypot((np.fft.fftfreq(p_y) * n_y)[:, None], np.fft.rfftfreq(p_x) * n_x)
        return np.clip(cycles * math.pi / n_views, 1, max(STEEPEST * n_views, 1)).astype(np.float32)


def n_subsets(n_views: int) -> int:
    """Return into how many subsets the views fall, each of which makes a step."""
    return min(max(n_views // SUBSET, LEAST_SUBSETS), n_views)


def step_length(done: float, passes: int) -> float:
    """Return the length of a step after `done` of the passes."""
    return 1 / (1 + max(done - passes + min(SHORTER, max(passes // 2, 1)), 0))


def bit_reversed(n: int) -> list[int]:
    """Return 0 … n − 1 in the order of their reversed bits, which keeps successive subsets far from each other."""
    bits = max(n - 1, 0).bit_length()
    order = (int(f"{k:0{bits}b}"[::-1], 2) if bits else 0 for k in range(1 << bits))
    return [k for k in order if k < n]
