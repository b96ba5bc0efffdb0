"""The course of a fit from coarse to fine: its levels, how often each is gone through, and its state as arrays."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.level import Data, carve, coarser, refined
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.splat.part import Part
from ctsim.reconstruct.splat.response import Response

EMPTY, AGAIN = 0.05, 0.3
"""Times water: below the first a voxel of the coarser volume is empty; within the shadows it begins at the second."""
SMALLEST, FLATTEST = 24, 8  # voxels along x and y, and along z, below which there is no coarser level
PASSES, ALONE, MOST, SHARE = (20, 9), 12, 9e10, 0.25
"""Passes over each coarser grid and the finest, or over one alone; fewer, at least one, where all of a grid would meet
more voxels, and over a coarser grid where they would meet more than this share of what those over the finest do, two
of them at least.

A pass over half the resolution costs a sixteenth. What dark rays alone tell, as between rods of metal, takes many.
"""
COARSER = 4.0  # times the denoising on a coarser grid


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """The levels of a fit, coarsest first, and the passes over each.

    `met` is how far p of a ray that met something lies above that of open ones; `tv` is the denoising of the finest
    level; `exact` is how splats are projected. A voxel that a coarser fit emptied begins again where no view shows it
    to be empty: streaks of thick metal bite pieces off the object. The few passes of a `trial` do not empty the air
    again, so it goes without. `fine_metal` gives the surface of metal finer splats in the second half of the passes
    over each grid.
    """

    levels: list[Data]
    passes: list[int]
    response: Response
    curve: MaterialCurve
    met: float
    tv: float
    exact: bool
    fine_metal: bool = True
    trial: bool = False

    def go(self, proceed: Callable[[Fit, bool, float], bool], fit: Fit | None = None) -> Fit | None:
        """Fit level by level while `proceed(fit, whole, share of the work)`, from a `fit` on that has begun.

        None where the scan shows nothing.
        """
        first = 0 if fit is None else self._level(fit)
        for k in range(first, len(self.levels)):
            if fit is None or self._level(fit) < k:
                fit = self._begun(k, fit)
            if fit is None or not fit.run(self.passes[k], lambda fit, whole: proceed(fit, whole, self._share(fit))):
                break
        return fit

    def state(self, fit: Fit) -> dict[str, NDArray[Any]]:
        """Return all that the next step depends on, as arrays that it changes."""
        support = np.packbits(fit.support)
        return {**fit.state(), "support": support, "level": np.array(self._level(fit))}

    def restored(self, state: Mapping[str, NDArray[Any]]) -> Fit:
        """Return the fit of a state. Raises KeyError, IndexError, TypeError or ValueError where it is none of it."""
        k = int(state["level"])
        size = self.levels[k].geometry.n_voxel
        bits = np.unpackbits(state["support"], count=math.prod(size))
        fit = self._fit(k, bits.astype(bool).reshape(size), np.zeros(size, np.float32))
        fit.restore(state)
        return fit

    def _begun(self, k: int, before: Fit | None) -> Fit | None:
        """Return the fit of level k after that of the level before, None where there is nothing to fit."""
        level, water = self.levels[k], self.curve.water
        if before is None:
            support = carve(level, self.met)
            thin = np.nextafter(np.float32(water), np.float32(0))  # not on the curve's knot, by rounding on either side
            start = np.where(support, thin, np.float32(0))
        else:
            start = refined(before.volume(), level.geometry)
            support = start > EMPTY * water
            if not self.trial:
                lost = carve(level, self.met, but=support)
                start[lost] = AGAIN * water
                support |= lost
        if not support.any():
            return None
        return self._fit(k, support, start)

    def _fit(self, k: int, support: NDArray[np.bool_], start: NDArray[np.float32]) -> Fit:
        level, finest = self.levels[k], k + 1 == len(self.levels)
        lattice = Lattice(geometry=level.geometry, support=support)
        u = lattice.gather(start)
        part = Part(geometry=level.geometry, lattice=lattice, curve=self.curve, u=u, exact=self.exact)
        return Fit(
            data=level,
            parts=[part],
            response=self.response,
            tv=self.tv * (1 if finest else COARSER),
            metal_from=(self.passes[k] // 2 or None) if self.fine_metal else None,
            view_updates=int(self._updates[:k].sum()),
        )

    def _level(self, fit: Fit) -> int:
        return next(k for k, level in enumerate(self.levels) if level is fit.data)

    @property
    def _updates(self) -> NDArray[np.int64]:
        return np.array([n * level.geometry.n_views for n, level in zip(self.passes, self.levels, strict=True)])

    def _share(self, fit: Fit) -> float:
        """Return the share of the work that is done, counted in voxels times views."""
        k, updates = self._level(fit), self._updates
        voxels = np.array([math.prod(level.geometry.n_voxel) for level in self.levels])
        done = np.append(updates[:k], fit.view_updates - updates[:k].sum())
        return float(done @ voxels[: k + 1] / (updates @ voxels))


def levels_of(data: Data, coarse: bool) -> list[Data]:
    """Return the data at each resolution, the coarsest first; at their own alone unless `coarse`."""
    levels = [data]
    while coarse and not is_coarsest(levels[0].geometry.n_voxel):
        levels.insert(0, coarser(levels[0]))
    return levels


def is_coarsest(n_voxel: tuple[int, int, int]) -> bool:
    """Whether half of these voxels [z, y, x] would be too few."""
    return min(n_voxel[1:]) < 2 * SMALLEST or n_voxel[0] < 2 * FLATTEST


def passes_over(levels: list[Data], given: tuple[int, int] | None) -> list[int]:
    """Return the passes over each level, coarsest first: both numbers of those `given`, or `ALONE`, if there is one."""
    if given is not None:
        return [given[level is levels[-1]] for level in levels] if len(levels) > 1 else [sum(given)]
    finest = min(ALONE if len(levels) == 1 else PASSES[1], affordable(levels[-1].geometry))
    most = min(SHARE * max(finest, 2) * work(levels[-1].geometry), MOST)
    return [*(max(min(PASSES[0], int(most / work(level.geometry))), 1) for level in levels[:-1]), finest]


def in_passes(finest: Geometry, given: tuple[int, int] | None) -> float:
    """Return about how much work a fit is, in passes over its finest grid.

    Σ 16⁻ⁿ: a coarser grid has an eighth of the voxels and half of the views.
    """
    alone = is_coarsest(finest.n_voxel)
    if given is not None:
        return float(sum(given)) if alone else given[1] + given[0] / 15
    if alone:
        return float(min(ALONE, affordable(finest)))
    last = min(PASSES[1], affordable(finest))
    return last + min(PASSES[0], 16 * SHARE * max(last, 2)) / 15


def affordable(geometry: Geometry) -> int:
    """Return how many passes over the views of a grid stay below the most that is spent on one."""
    return max(int(MOST / work(geometry)), 1)


def work(geometry: Geometry) -> int:
    """Return how many voxels a pass over all views meets."""
    return geometry.n_views * math.prod(geometry.n_voxel)
