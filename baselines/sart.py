"""Algebraic reconstruction by blocks of views: SART (one view), OS-SART (a subset), SIRT (all views).

x ← x + λ D_s A_sᵀ W M (p_s − A_s x), with M the inverse row sums of A and D_s the inverse of A_sᵀ W 1: each voxel
moves by the weighted mean of what its rays lack per mm. Converges for 0 < λ < 2. Andersen and Kak, Ultrason.
Imaging 6, 1984, doi:10.1177/016173468400600107; ordered subsets: Hudson and Larkin, IEEE Trans. Med. Imaging 13,
1994, doi:10.1109/42.363108; SIRT: Gregor and Benson, IEEE Trans. Med. Imaging 27, 2008, doi:10.1109/TMI.2008.923696.
"""

import math
from typing import Annotated

import numpy as np

from ctsim.baselines.iterative import (
    Array,
    Count,
    Course,
    Iterations,
    System,
    finish,
    visiting_order,
    weighted_dot,
)
from ctsim.baselines.kernels.sart_cpu import move
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import about, keywords
from ctsim.types import Scan, Volume

Relaxation = Annotated[
    float, about("share of the rays' residuals that a step corrects; converges below 2", gt=0, le=10)
]
Positivity = Annotated[bool, about("cut negative values to zero")]
CACHE_BYTES = 1 << 30  # voxel sums of the subsets are kept up to this size, else computed on each visit


class Sart(Iterations, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`iterations` are passes over all views."""

    iterations: Count = 2
    relaxation: Relaxation = 0.5
    positivity: Positivity = True


class OsSart(Sart, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Sart`, with the views in interleaved subsets."""

    iterations: Count = 4
    relaxation: Relaxation = 1.0
    subsets: Annotated[int, about("subsets of the views, at most one per view", ge=1, le=100_000)] = 20


class Sirt(Sart, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Sart`."""

    iterations: Count = 43
    relaxation: Relaxation = 1.9


@keywords(Sart)
@primary
def sart(scan: Scan, settings: Sart) -> Volume:
    """Reconstruct by SART, one view at a time; keywords are those of `Sart`.

    Details hold view updates, residuals (by pass, each view's taken before its update, and that of the result) and
    step sizes, and as limitation where the object goes on beyond the grid or the detector.
    """
    return _run(scan, settings, scan.geometry.n_views)


@keywords(OsSart)
@primary
def os_sart(scan: Scan, settings: OsSart) -> Volume:
    """Reconstruct by OS-SART: as `sart`, a subset of the views at a time; keywords are those of `OsSart`."""
    return _run(scan, settings, min(settings.subsets, scan.geometry.n_views))


@keywords(Sirt)
@primary
def sirt(scan: Scan, settings: Sirt) -> Volume:
    """Reconstruct by SIRT: as `sart`, with all views at once; the residual in the norm W M falls in each iteration."""
    return _run(scan, settings, 1)


def _run(scan: Scan, settings: Sart, subsets: int) -> Volume:
    system, course = System(scan, settings.weights), Course()
    passes, x = Passes(system, subsets), system.empty()
    for _ in range(settings.iterations):
        residual = passes.run(x, settings.relaxation, settings.positivity)
        if not course.note(x, scan.geometry.n_views, residual):
            break
    return finish(system, course, x, subsets=subsets, step_sizes=[settings.relaxation] * len(course.residuals))


class Passes:
    """Passes over all subsets of a system's views."""

    def __init__(self, system: System, subsets: int) -> None:
        self.system = system
        n_views = system.geometry.n_views
        self.subsets = [np.arange(first, n_views, subsets) for first in visiting_order(subsets)]
        sums = system.lengths
        # A ray that meets less than half a voxel says next to nothing of it, and would be divided by little.
        met = sums > 0.5 * min(system.geometry.d_voxel)
        self.weights = system.weights * met
        self.share = np.divide(self.weights, sums, out=np.zeros_like(sums), where=met)
        size = 4 * system.support.size * subsets
        self._kept: list[Array] | None = [self._sums(views) for views in self.subsets] if size <= CACHE_BYTES else None

    def run(self, x: Array, relaxation: float, positivity: bool) -> float:
        """Update `x` with every subset once; return the residual, each subset's before its update."""
        system, square = self.system, 0.0
        for k, views in enumerate(self.subsets):
            lacking = system.data[views] - system.forward(x, views)
            square += weighted_dot(lacking, lacking, system.weights[views])
            lacking *= self.share[views]
            sums = self._kept[k] if self._kept is not None else self._sums(views)
            move(x, system.adjoint(lacking, views), sums, np.float32(relaxation), positivity)
        return math.sqrt(square) / system.scale

    def _sums(self, views: np.ndarray) -> Array:
        return self.system.adjoint(self.weights[views], views)
