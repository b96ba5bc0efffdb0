"""Conjugate gradients on the weighted normal equations Aᵀ W A x = Aᵀ W p (CGLS)."""

import math

import numpy as np

from ctsim.baselines.iterative import Count, Course, Iterations, System, finish, weighted_dot, weighted_norm
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import keywords
from ctsim.types import Scan, Volume


class Cgls(Iterations, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Iterations`."""

    iterations: Count = 10


@keywords(Cgls)
@primary
def cgls(scan: Scan, settings: Cgls) -> Volume:
    """Reconstruct by CGLS; stopping early is the only regularisation, and values may be negative.

    Hestenes and Stiefel, J. Res. Natl. Bur. Stand. 49, 1952, doi:10.6028/jres.049.044. Ends before `iterations` where
    rounding lets the residual fall no more. Keywords are those of `Cgls`.
    """
    system, course = System(scan, settings.weights), Course()
    x, lacking, steps = system.empty(), system.data.copy(), []
    ones = np.ones_like(x)
    gradient = system.adjoint(lacking * system.weights)
    square, direction = weighted_dot(gradient, gradient, ones), gradient.copy()
    last = weighted_norm(lacking, system.weights)
    for _ in range(settings.iterations):
        image = system.forward(direction)
        length = weighted_dot(image, image, system.weights)
        if not length > 0 or not math.isfinite(length):
            break
        step = square / length
        image *= np.float32(step)
        lacking -= image
        norm = weighted_norm(lacking, system.weights)
        if norm >= last:
            break
        last = norm
        x += np.float32(step) * direction
        steps.append(step)
        if not course.note(x, scan.geometry.n_views, norm / system.scale):
            break
        gradient = system.adjoint(lacking * system.weights)
        before, square = square, weighted_dot(gradient, gradient, ones)
        direction *= np.float32(square / before)
        direction += gradient
    return finish(system, course, x, step_sizes=steps, iterations_done=len(steps))
