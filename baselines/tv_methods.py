"""Reconstruction with total variation: FISTA-TV, ASD-POCS and AwPCSD."""

import math
from typing import Annotated

import msgspec
import numpy as np

from ctsim.baselines.iterative import (
    Array,
    Count,
    Course,
    Iterations,
    System,
    Weights,
    as_volume,
    finish,
    weighted_dot,
    weighted_norm,
)
from ctsim.baselines.metal import water_value
from ctsim.baselines.sart import Passes, Positivity
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import about, keywords
from ctsim.reconstruct.tv import Denoiser, axis_ratios, descend, total_variation
from ctsim.types import Scan, Volume

# Sidky and Pan's values
RELAXATION_FALLS = 0.995
TV_FALLS = 0.95
LARGEST_RATIO = 0.95
OPPOSED = -0.99
SUBSETS = 20
Share = Annotated[float, msgspec.Meta(gt=0, le=10)]


class FistaTv(Iterations, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Iterations`, and how each denoises."""

    iterations: Count = 50
    tv: Annotated[float, about("size of ripples that a step flattens", "of the scan's water", ge=0, le=1000)] = 0.0024
    tv_iterations: Annotated[int, about("iterations of each denoising", ge=1, le=10_000)] = 20
    positivity: Positivity = True


class Descent(Iterations, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SART passes in turn with steps down TV."""

    tv_steps: Annotated[int, about("steps down the gradient of total variation after a pass", ge=1, le=10_000)] = 20
    alpha: Annotated[
        float, about("first step down the gradient of total variation", "of the first pass's change", gt=0, le=1000)
    ] = 0.02


class AsdPocs(Descent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Descent`."""

    iterations: Count = 3
    epsilon: Annotated[Share | None, about("relative residual to reach; null: that of photon noise")] = None


class AwPcsd(Descent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Descent`."""

    iterations: Count = 2
    delta: Annotated[
        float, about("difference between voxels above which an edge is kept", "of the scan's water", gt=0, le=1e6)
    ] = 2.0


@keywords(FistaTv)
@primary
def fista_tv(scan: Scan, settings: FistaTv) -> Volume:
    """Minimise ½‖A x − p‖²_W + τ TV(x) by FISTA; keywords are those of `FistaTv`.

    Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, doi:10.1137/080716542, with their denoiser as proximal map.
    The step is 1/L with a proven bound L of ‖Aᵀ W A‖; τ is `tv` · L · the water of a pass of OS-SART, so a step
    flattens ripples of about `tv` of that. Details hold step sizes, τ, water and the TV reached.
    """
    system, course = System(scan, settings.weights), Course()
    ratios = axis_ratios(scan.geometry)
    largest, water = _largest_curvature(system), _water(system)
    denoiser = Denoiser(system.support, ratios, settings.positivity)
    x = ahead = system.empty()
    image = image_ahead = np.zeros_like(system.data)
    t = 1.0
    for _ in range(settings.iterations):
        lacking = (system.data - image_ahead) * system.weights
        moved = system.adjoint(lacking)
        moved *= np.float32(1 / largest)
        moved += ahead
        after = denoiser.run(moved, settings.tv * water, settings.tv_iterations)
        # A is linear, so the image of the point ahead needs no projection of its own.
        image_after = system.forward(after)
        t, t_before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        momentum = np.float32((t_before - 1) / t)
        ahead = after + momentum * (after - x)
        image_ahead = image_after + momentum * (image_after - image)
        x, image = after, image_after
        residual = weighted_norm(image - system.data, system.weights) / system.scale
        if not course.note(x, scan.geometry.n_views, residual):
            break
    details = {"tau": settings.tv * water * largest, "water_per_mm": water, "tv": total_variation(x, ratios)}
    return finish(system, course, x, step_sizes=[1 / largest] * len(course.residuals), **details)


@keywords(AsdPocs)
@primary
def asd_pocs(scan: Scan, settings: AsdPocs) -> Volume:
    """Lower TV subject to ‖A x − p‖_W ≤ ε ‖p‖_W and x ≥ 0, by SART passes and steepest descent in turn.

    Adaptive steepest descent, Sidky and Pan, Phys. Med. Biol. 53, 2008, doi:10.1088/0031-9155/53/17/021, with
    SART for ART. TV steps shrink while TV moves the volume more than the data do and the residual is above ε. Ends
    early where the two moves oppose each other at a residual below. Keywords are those of `AsdPocs`.
    """
    system, course, passes = _begin(scan, settings.weights)
    aim = _photon_noise(scan, system) if settings.epsilon is None else settings.epsilon
    ratios, x, ones = axis_ratios(scan.geometry), system.empty(), np.ones(system.support.shape, np.float32)
    relaxation, length, steps = 1.0, 0.0, []
    for k in range(settings.iterations if aim < 1 else 0):  # else the empty volume is the answer
        before = x.copy()
        passes.run(x, relaxation, True)
        by_data = x - before
        moved, residual = weighted_norm(by_data, ones), system.residual(x)
        if k == 0:
            length = settings.alpha * moved
        before = x.copy()
        descend(x, length, settings.tv_steps, ratios)
        x *= system.support
        steps.append(length)
        if not course.note(x, scan.geometry.n_views, residual):
            break
        by_tv = x - before
        moved_by_tv = weighted_norm(by_tv, ones)
        if residual <= aim and _cosine(by_data, by_tv) < OPPOSED:
            break
        if moved_by_tv > LARGEST_RATIO * moved and residual > aim:
            length *= TV_FALLS
        relaxation *= RELAXATION_FALLS
    np.maximum(x, 0, out=x)
    return finish(system, course, x, step_sizes=steps, epsilon=aim, tv=total_variation(x, ratios))


@keywords(AwPcsd)
@primary
def awpcsd(scan: Scan, settings: AwPcsd) -> Volume:
    """Lower adaptive-weighted TV with steps that follow the data residual, between SART passes.

    Projection-controlled steepest descent, Lohvithee, Biguri and Soleimani, Phys. Med. Biol. 62, 2017,
    doi:10.1088/1361-6560/aa93d3: the TV step is `alpha` · the first pass's change, times the residual before a
    pass over that after the first; passes stop while the residual is below photon noise. Keywords are those of
    `AwPcsd`.
    """
    system, course, passes = _begin(scan, settings.weights)
    aim, ratios, x = _photon_noise(scan, system), axis_ratios(scan.geometry), system.empty()
    water = _water(system)
    edge = settings.delta * max(water, 1e-30)
    ones = np.ones_like(x)
    relaxation, first_residual, first_step, steps = 1.0, 1.0, 0.0, []
    residual = 1.0
    for k in range(settings.iterations if aim < 1 else 0):  # else the empty volume is the answer
        before, updates = x.copy(), 0
        if residual > aim:
            passes.run(x, relaxation, True)
            updates = scan.geometry.n_views
        if k == 0:
            first_residual, first_step = system.residual(x), settings.alpha * weighted_norm(x - before, ones)
        length = first_step * (1.0 if k == 0 else residual / max(first_residual, 1e-30))
        by_data, before = x - before, x.copy()
        descend(x, length, settings.tv_steps, ratios, edge)
        x *= system.support
        np.maximum(x, 0, out=x)
        residual = system.residual(x)
        steps.append(length)
        if not course.note(x, updates, residual):
            break
        if residual <= aim and _cosine(by_data, x - before) < OPPOSED:
            break
        relaxation *= RELAXATION_FALLS
    details = {"epsilon": aim, "water_per_mm": water, "tv": total_variation(x, ratios)}
    return finish(system, course, x, step_sizes=steps, **details)


def _begin(scan: Scan, weights: Weights) -> tuple[System, Course, Passes]:
    system, course = System(scan, weights), Course()
    return system, course, Passes(system, scan.geometry.n_views)


def _largest_curvature(system: System, steps: int = 3) -> float:
    """Return a bound from above of the largest eigenvalue of B = Aᵀ W A.

    B has no negative entry, so max (B v)_i / v_i bounds it for every positive v (Collatz and Wielandt); power
    iteration sharpens the bound.
    """
    v, bound = system.support.astype(np.float32), math.inf
    for _ in range(steps):
        after = system.adjoint(system.forward(v) * system.weights)
        positive = v > 0
        if not positive.any() or not after.max() > 0:
            return 1.0
        bound = min(bound, float((after[positive].astype(np.float64) / v[positive]).max()))
        v = after / after.max()
    return bound * (1 + 1e-5)


def _water(system: System) -> float:
    """Return the value of water-like tissue after a pass of OS-SART, in 1/mm; 0 where nothing stands out from air.

    It is within 1 % of FDK's on the `tune` suite at 64³; fewer subsets leave the volume too smooth to tell.
    """
    x = system.empty()
    Passes(system, min(SUBSETS, system.geometry.n_views)).run(x, 1.0, False)
    return water_value(as_volume(x))


def _photon_noise(scan: Scan, system: System) -> float:
    """Return the relative residual that photon noise leaves: the variance of p is exp(p)/i0."""
    variance = (np.exp(np.maximum(system.data, 0)) / np.float32(scan.i0)).astype(np.float32)
    return math.sqrt(weighted_dot(variance, np.ones_like(system.data), system.weights)) / system.scale


def _cosine(a: Array, b: Array) -> float:
    ones = np.ones_like(a)
    norms = weighted_norm(a, ones) * weighted_norm(b, ones)
    return weighted_dot(a, b, ones) / norms if norms > 0 else 0.0
