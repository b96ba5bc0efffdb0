"""Weighted least squares by ordered subsets, one unknown a splat, edges kept.

Minimises ½ Σ_rays w (P(u) − p)² + TV with w = exp(−p), the share of photons that came through, so that starved rays
count for little and no mask is needed; behind thick bodies weights are evened out, and edges count less still
(`ctsim.reconstruct.weights`). A subset's step is
s·F(s·g), g the gradient, s² the inverse of a separable majoriser of the Hessian (Erdogan and Fessler, Phys. Med. Biol.
44, 1999, doi:10.1088/0031-9155/44/11/311), and F a ramp filter of the transverse frequencies: n views of a subset
overlap only below n/π cycles a field of view; above, one view alone answers for a frequency, and up to n times the step
is stable there. At half resolution one pass with F left a smaller error on a thorax with iron than three without.
In the second half of the passes the surface of metal has finer splats and pixels (`ctsim.reconstruct.splat.metal`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.level import Data
from ctsim.reconstruct.splat.metal import average, split, surface
from ctsim.reconstruct.splat.part import Part
from ctsim.reconstruct.splat.response import Response, evaluate

SUBSET, LEAST_SUBSETS = 10, 8
"""Views in a subset, fewer where there would be too few subsets."""
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

Image = NDArray[np.float32]


@dataclass(slots=True, kw_only=True)
class Fit:
    """The splats of a fit, `parts`, and how they fare: at first one lattice.

    From pass `metal_from` on, never if that is None, a second part holds the surface of dense metal finely: the voxels
    `fine` [z, y, x]. `tv` is the denoiser's threshold a hundred views in units of water. `loss` is the mean |P − p| of
    the last subset, `misfit` that of the last pass.
    """

    data: Data
    parts: list[Part]
    response: Response
    tv: float
    metal_from: int | None = None
    fine: NDArray[np.bool_] | None = None
    loss: float = math.inf
    misfit: float = math.inf
    view_updates: int = 0
    steps: int = 0
    _total: float = 0.0  # of the losses of this pass

    @property
    def curve(self) -> MaterialCurve:
        """What an unknown says about both densities."""
        return self.parts[0].curve

    @property
    def support(self) -> NDArray[np.bool_]:
        """The voxels [z, y, x] of the scan's grid that hold splats."""
        first = self.parts[0].lattice.support
        return first if self.fine is None else first | self.fine

    @property
    def finer(self) -> int:
        """How many of the finest splats lie along a voxel of the scan's grid."""
        return max(part.finer for part in self.parts)

    @property
    def n_splats(self) -> int:
        """How many splats there are."""
        return sum(len(part.lattice) for part in self.parts)

    def many_above(self, limit: float) -> tuple[float, float]:
        """Return how many splats have at least `limit`, and of how many; eight fine ones count as one."""
        above = sum(float((part.u >= limit).sum()) / part.finer**3 for part in self.parts)
        return above, sum(len(part.u) / part.finer**3 for part in self.parts)

    def run(self, passes: int, proceed: Callable[["Fit", bool], bool]) -> bool:
        """Go through all views `passes` times; stop and return False when `proceed(fit, whole)` says so.

        It is asked after each subset, `whole` where that was the last of a pass.
        """
        n_views = self.data.geometry.n_views
        n = n_subsets(n_views)
        order, every = bit_reversed(n), max(REST, n // A_PASS)
        while self.steps < passes * n:
            turn, k = divmod(self.steps, n)
            if turn == self.metal_from and k == 0:
                self._split(surface(self.parts[0]))
            first_new = (turn > 0) if turn in (0, self.metal_from) and k % every == 0 else len(self.parts)
            views, length = np.arange(order[k], n_views, n), step_length(self.steps / n, passes)
            self.loss = self._step(views, self.parts[first_new:], length)
            self.steps, self._total = self.steps + 1, (self._total if k else 0.0) + self.loss
            if (k + 1) % every == 0 or k + 1 == n:
                hundreds = (k % every + 1) / n * n_views / 100
                threshold = self.tv * self.curve.water * 2 ** max(min(passes, SETTLED) - 1 - turn, 0)
                self._denoise(threshold * hundreds)
            if k + 1 == n:
                self.misfit = self._total / n
            if not proceed(self, k + 1 == n):
                return False
        return True

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that the next step depends on, as arrays that it changes."""
        numbers = np.array([self.steps, self.view_updates, *(part.measured for part in self.parts)])
        reals = np.array([self.loss, self.misfit, self._total])
        of_parts = {f"{name}{k}": array for k, part in enumerate(self.parts) for name, array in part.state().items()}
        fine = np.zeros(0, np.uint8) if self.fine is None else np.packbits(self.fine)
        return {**of_parts, "fine": fine, "numbers": numbers, "reals": reals}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a state. Raises KeyError where something is missing, ValueError where it does not fit."""
        if state["fine"].size:
            shape = self.parts[0].lattice.support.shape
            fine = np.unpackbits(state["fine"], count=math.prod(shape)).astype(bool).reshape(shape)
            self._split(fine)
        self.steps, self.view_updates, *measured = state["numbers"].tolist()
        self.loss, self.misfit, self._total = state["reals"].tolist()
        for k, (part, part.measured) in enumerate(zip(self.parts, measured, strict=True)):
            for name, own in part.state().items():
                if state[f"{name}{k}"].shape != own.shape:  # NumPy would spread a single value
                    raise ValueError(f"{name}{k} has shape {state[f'{name}{k}'].shape}, expected {own.shape}")
                own[...] = state[f"{name}{k}"]

    def fitted(self, views: NDArray[np.int64]) -> Image:
        """Return P of some views, with the scatter of the data: [view, v, u]."""
        p, *_ = self._seen([part.paths(views) for part in self.parts])
        if self.data.scatter:
            p = -np.logaddexp(-p, np.float32(math.log(self.data.scatter)))
        return self.parts[0].projector.pictures(p)

    def integrals(self, values: Callable[[Image], Image], views: NDArray[np.int64]) -> Image:
        """Return the line integrals (mm) of a function of the unknowns: [view, v, u]."""
        first, *rest = (part.integrals(values(part.u), views) for part in self.parts)
        return sum(rest, first)

    def densities(self, geometry: Geometry) -> Image:
        """Return ρa and ρb, means over the voxels of a grid: [2, z, y, x]."""
        first, *rest = (part.densities(geometry) for part in self.parts)
        return sum(rest, first)

    def volume(self) -> Image:
        """Return u on the voxel grid, a mean over each voxel: [z, y, x] in 1/mm."""
        first, *rest = (part.volume(self.data.geometry) for part in self.parts)
        return sum(rest, first)

    def _split(self, fine: NDArray[np.bool_]) -> None:
        """Give voxels `fine` finer splats; none, or all that there are, change nothing."""
        if fine.any() and np.any(self.parts[0].lattice.support & ~fine):
            self.parts, self.fine = split(self.parts.pop(), fine), fine

    def _denoise(self, threshold: float) -> None:
        """Denoise all parts: not in `run`, whose loop would still know a part that is split and gone."""
        for part in self.parts:
            part.denoise(threshold, SMOOTHING)

    def _seen(self, paths: list[Image]) -> tuple[Image, list[Image]]:
        """Return P, as an image of the first part, and its derivatives by every part's paths, as these are."""
        coarse, *fine = paths
        rest = np.ascontiguousarray(coarse[:, 0]), np.ascontiguousarray(coarse[:, 1])
        found = evaluate(self.response, *rest)
        slopes = [average(self.response, rest, *given, found) for given in zip(self.parts[1:], fine, strict=True)]
        return found[0], [np.stack(found[1:], 1), *slopes]

    def _step(self, views: NDArray[np.int64], new: list[Part], length: float) -> float:
        """Update the unknowns by `length` of a step from some views; return their mean |P − p|.

        Of the parts `new` the curvature is measured first.
        """
        paths = [part.paths(views) for part in self.parts]
        p, slopes = self._seen(paths)
        coarse = self.parts[0].projector
        measured, weights = (coarse.arranged(a[views]) for a in (self.data.p, self.data.weights))
        dark, left = weights < 0, np.float32(1)
        weights = np.abs(weights)
        if self.data.scatter:
            primary = np.exp(-p)
            seen = primary + np.float32(self.data.scatter)
            left = np.where(dark, np.float32(1), primary / seen)  # how far the reading follows P
            p = np.where(dark, p, -np.log(seen))
        lacking = measured - p
        lacking *= weights > 0
        np.maximum(lacking, 0, out=lacking, where=dark)  # a bound is met by all that is darker
        loss = float(np.abs(lacking).sum(dtype=np.float64)) / (len(views) * math.prod(self.data.geometry.n_detector))
        weights *= left
        if new:
            along = [part.along(own, path) for part, own, path in zip(self.parts, slopes, paths, strict=True)]
            met = weights * left  # times J·u, the majoriser's other half
            met[..., :-WIDTH] *= sum(along[1:], along[0])
            for part, own in zip(self.parts, slopes, strict=True):
                if any(part is one for one in new):
                    part.measure(own, met, views)
        lacking *= weights
        for part, own in zip(self.parts, slopes, strict=True):
            part.move(own, lacking, views, length)
        self.view_updates += len(views)
        return loss


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
