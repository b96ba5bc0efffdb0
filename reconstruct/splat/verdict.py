"""How a fit of splats ended, and what its values do not show: status, reason, and sentences of the limitation."""

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry, few_views
from ctsim.reconstruct.log import finite_or_not
from ctsim.reconstruct.splat.curve import DENSEST, STRONGEST
from ctsim.reconstruct.splat.level import VIEWS, Data, never_read, rays_met
from ctsim.reconstruct.splat.ordered import Fit
from ctsim.reconstruct.weights import DARK
from ctsim.types import Status

AT_THE_END, FEW, FEWEST, MANY = 0.9, 1e-4, 10, 0.01
"""Share of the curve's last attenuation, which no metal has; the share of the splats, or how many, that may have it;
and the share with which a fit has diverged."""
UNEXPLAINED, DARK_SHARE = 0.2, 1e-4
"""The root mean square that a fit misses dark readings by before it is said to, and their least share. Right metal has
0.05 to 0.13, wire of which a third is there 0.25; but 0.05 has the hip, too, whose core no reading shows whole."""
LEAST_SHARE = 0.25  # of a usual ray's weight that a dark one has, before it is said: a pelvis failed with 0.17
UNREAD = 0.05  # share of the metal that no reading crosses before it is said
OBLONG = 1.5
"""Ratio of a voxel's sides from which on splats are too round: a sum of them then varies by 20 % from one to the next,
by 4 % on cubes."""

Image = NDArray[np.float32]


def verdict(fit: Fit, values: Image) -> tuple[Status, str]:
    """Say how a fit ended, and why if not well."""
    status, reason = finite_or_not(values)
    if status is not Status.OK:
        return status, reason
    runaway, of = _runaway(fit)
    if runaway <= max(MANY * of, FEWEST):
        return Status.OK, ""
    return Status.DIVERGED, (
        f"{runaway:.0f} of {of:.0f} splats went to {AT_THE_END * STRONGEST:g} times the attenuation of iron: "
        "readings are darker than any metal makes them; are the scan's dark and open field right?"
    )


def _runaway(fit: Fit) -> tuple[float, float]:
    """Return how many splats stand where no metal does, and of how many."""
    return fit.many_above(AT_THE_END * float(fit.curve.knots[-1]))


def dark_misfit(fit: Fit) -> float | None:
    """Return the root mean square of p − P over dark readings of a few views, None where there are hardly any."""
    views = np.asarray(few_views(fit.data.geometry.n_views, VIEWS))
    p, weights = fit.data.p[views], fit.data.weights[views]
    dark = (weights > 0) & (p > DARK)
    if dark.sum() <= DARK_SHARE * dark.size:
        return None
    return float(np.sqrt(np.mean(np.square((p - fit.fitted(views))[dark], dtype=np.float64))))


def unexplained(fit: Fit, missed: float | None) -> str:
    """Say that metal does not explain its shadow, `missed` by its dark readings, or nothing."""
    if missed is not None and missed > UNEXPLAINED:
        return (
            f"readings of P > {DARK:g} are missed by {missed:.2g} (root mean square): metal is thinner than the grid "
            "or denser than its readings show, so its values, and tissue next to it, may be wrong"
        )
    runaway, of = _runaway(fit)
    if runaway > max(FEW * of, FEWEST):
        return f"metal reaches {AT_THE_END * STRONGEST:g} times iron, where the assumed materials end"
    return ""


def metal_unread(fit: Fit, values: Image, geometry: Geometry) -> float | None:
    """Return the share of dense metal through which there are no readings, None where there is no such metal.

    `values` [z, y, x] are the unknown on a grid, the attenuation behind the object's own water.
    """
    metal = values > DENSEST * fit.curve.water
    return float(never_read(fit.data, geometry)[metal].mean()) if metal.any() else None


def bounded(unread: float | None) -> str:
    """Say that a share of the metal is known from below alone, or nothing."""
    if unread is None or unread <= UNREAD:
        return ""
    return (
        f"{unread:.0%} of the metal lies where rays lose all photons that noise lets count, so it is known from below "
        "alone: it may attenuate several times as much"
    )


def flat(finest: Geometry) -> str:
    """Say that splats are too round for the voxels of the finest grid, or nothing."""
    if (ratio := max(finest.d_voxel) / min(finest.d_voxel)) < OBLONG:
        return ""
    return f"voxels are {ratio:.2g} times as long as wide and splats are round: values may be wrong by a fifth and more"


def uneven(data: Data) -> str:
    """Say that dark rays hardly count, or nothing."""
    rays = rays_met(data)
    if (share := (rays.usual + data.error) / (rays.dark + data.error)) >= LEAST_SHARE:
        return ""
    return (
        f"a tenth of the rays off all edges, those of the longest paths, have {max(share, 0.01):.0%} or less of the "
        "usual weight: what they show alone may be smeared along them"
    )
