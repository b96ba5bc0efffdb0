"""Reconstruction with total variation: FISTA-TV, ASD-POCS and AwPCSD."""

import math

import numpy as np

from baselines.iterative import (
    Array,
    Course,
    System,
    Weights,
    check_count,
    check_positive,
    finish,
    weighted_dot,
    weighted_norm,
)
from baselines.sart import Passes
from baselines.tv import Denoiser, axis_ratios, descend, total_variation
from ctsim.errors import InputError
from ctsim.types import Scan, Volume

# Sidky and Pan's values
RELAXATION_FALLS = 0.995
TV_FALLS = 0.95
LARGEST_RATIO = 0.95
OPPOSED = -0.99


def fista_tv(
    scan: Scan,
    *,
    device: str = "cpu",
    iterations: int = 50,
    tv: float = 0.002,
    tv_iterations: int = 20,
    weights: Weights = "none",
    positivity: bool = True,
) -> Volume:
    """Minimise ½‖A x − p‖²_W + τ TV(x) by FISTA.

    Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, doi:10.1137/080716542, with their denoiser as proximal map.
    The step is 1/L with a proven bound L of ‖Aᵀ W A‖; τ is `tv` · L · the mean attenuation (of the uniform volume
    that fits best), so a step flattens ripples of about `tv` of that. Details hold step sizes, τ and the TV
    reached. Raises InputError for wrong parameters and another device than the CPU.
    """
    check_count("iterations", iterations)
    check_count("tv_iterations", tv_iterations)
    if not (math.isfinite(tv) and tv >= 0):
        raise InputError(f"tv must not be negative, got {tv!r}")
    system, course = System(scan, device, weights), Course()
    ratios = axis_ratios(scan.geometry)
    largest, mean = _largest_curvature(system)
    denoiser = Denoiser(system.support, ratios, positivity)
    x = ahead = system.empty()
    image = image_ahead = np.zeros_like(system.data)
    t = 1.0
    for _ in range(iterations):
        lacking = (system.data - image_ahead) * system.weights
        moved = system.adjoint(lacking)
        moved *= np.float32(1 / largest)
        moved += ahead
        after = denoiser.run(moved, tv * abs(mean), tv_iterations)
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
    details = {"tau": tv * abs(mean) * largest, "tv": total_variation(x, ratios)}
    return finish(system, course, x, step_sizes=[1 / largest] * len(course.residuals), **details)


def asd_pocs(
    scan: Scan,
    *,
    device: str = "cpu",
    iterations: int = 10,
    tv_steps: int = 20,
    alpha: float = 0.02,
    epsilon: float | None = None,
    weights: Weights = "none",
) -> Volume:
    """Lower TV subject to ‖A x − p‖_W ≤ ε ‖p‖_W and x ≥ 0, by SART passes and steepest descent in turn.

    Adaptive steepest descent, Sidky and Pan, Phys. Med. Biol. 53, 2008, doi:10.1088/0031-9155/53/17/021, with
    SART for ART. `alpha` is the first TV step in units of the first pass's change; steps shrink while TV moves
    the volume more than the data do and the residual is above `epsilon` (None: that of photon noise). Ends early
    where the two moves oppose each other at a residual below. Raises InputError as `fista_tv`.
    """
    system, course, passes = _begin(scan, device, weights, (iterations, tv_steps), alpha)
    aim = _photon_noise(scan, system) if epsilon is None else epsilon
    check_positive("epsilon", aim)
    ratios, x, ones = axis_ratios(scan.geometry), system.empty(), np.ones(system.support.shape, np.float32)
    relaxation, length, steps = 1.0, 0.0, []
    for k in range(iterations if aim < 1 else 0):  # else the empty volume is the answer
        before = x.copy()
        passes.run(x, relaxation, True)
        by_data = x - before
        moved, residual = weighted_norm(by_data, ones), system.residual(x)
        if k == 0:
            length = alpha * moved
        before = x.copy()
        descend(x, length, tv_steps, ratios)
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


def awpcsd(
    scan: Scan,
    *,
    device: str = "cpu",
    iterations: int = 10,
    tv_steps: int = 20,
    alpha: float = 0.02,
    delta: float = 0.25,
    weights: Weights = "none",
) -> Volume:
    """Lower adaptive-weighted TV with steps that follow the data residual, between SART passes.

    Projection-controlled steepest descent, Lohvithee, Biguri and Soleimani, Phys. Med. Biol. 62, 2017,
    doi:10.1088/1361-6560/aa93d3: the TV step is `alpha` · the first pass's change, times the residual before a
    pass over that after the first; passes stop while the residual is below photon noise. `delta`, in units of
    the mean attenuation, is the difference between voxels above which an edge is spared. Raises InputError as
    `fista_tv`.
    """
    check_positive("delta", delta)
    system, course, passes = _begin(scan, device, weights, (iterations, tv_steps), alpha)
    aim, ratios, x = _photon_noise(scan, system), axis_ratios(scan.geometry), system.empty()
    edge = delta * max(abs(_mean_attenuation(system)), 1e-30)
    ones = np.ones_like(x)
    relaxation, first_residual, first_step, steps = 1.0, 1.0, 0.0, []
    residual = 1.0
    for k in range(iterations if aim < 1 else 0):  # else the empty volume is the answer
        before, updates = x.copy(), 0
        if residual > aim:
            passes.run(x, relaxation, True)
            updates = scan.geometry.n_views
        if k == 0:
            first_residual, first_step = system.residual(x), alpha * weighted_norm(x - before, ones)
        length = first_step * (1.0 if k == 0 else residual / max(first_residual, 1e-30))
        by_data, before = x - before, x.copy()
        descend(x, length, tv_steps, ratios, edge)
        x *= system.support
        np.maximum(x, 0, out=x)
        residual = system.residual(x)
        steps.append(length)
        if not course.note(x, updates, residual):
            break
        if residual <= aim and _cosine(by_data, x - before) < OPPOSED:
            break
        relaxation *= RELAXATION_FALLS
    return finish(system, course, x, step_sizes=steps, epsilon=aim, tv=total_variation(x, ratios))


def _begin(
    scan: Scan, device: str, weights: Weights, counts: tuple[int, int], alpha: float
) -> tuple[System, Course, Passes]:
    check_count("iterations", counts[0])
    check_count("tv_steps", counts[1])
    check_positive("alpha", alpha)
    system, course = System(scan, device, weights), Course()
    return system, course, Passes(system, scan.geometry.n_views)


def _largest_curvature(system: System, steps: int = 3) -> tuple[float, float]:
    """Return a bound from above of the largest eigenvalue of B = Aᵀ W A, and the mean attenuation.

    B has no negative entry, so max (B v)_i / v_i bounds it for every positive v (Collatz and Wielandt); power
    iteration sharpens the bound. The first v is uniform and so gives the mean attenuation as well.
    """
    v, bound, mean = system.support.astype(np.float32), math.inf, 0.0
    for k in range(steps):
        image = system.forward(v)
        if k == 0:
            mean = _fitted(system, image)
        image *= system.weights
        after = system.adjoint(image)
        positive = v > 0
        if not positive.any() or not after.max() > 0:
            return 1.0, mean
        bound = min(bound, float((after[positive].astype(np.float64) / v[positive]).max()))
        v = after / after.max()
    return bound * (1 + 1e-5), mean


def _mean_attenuation(system: System) -> float:
    return _fitted(system, system.forward(system.support.astype(np.float32)))


def _fitted(system: System, image: Array) -> float:
    """Return the attenuation of the uniform volume that fits the data best; `image` is that of value 1."""
    square = weighted_dot(image, image, system.weights)
    return weighted_dot(image, system.data, system.weights) / square if square > 0 else 0.0


def _photon_noise(scan: Scan, system: System) -> float:
    """Return the relative residual that photon noise leaves: the variance of p is exp(p)/i0."""
    variance = (np.exp(np.maximum(system.data, 0)) / np.float32(scan.i0)).astype(np.float32)
    return math.sqrt(weighted_dot(variance, np.ones_like(system.data), system.weights)) / system.scale


def _cosine(a: Array, b: Array) -> float:
    ones = np.ones_like(a)
    norms = weighted_norm(a, ones) * weighted_norm(b, ones)
    return weighted_dot(a, b, ones) / norms if norms > 0 else 0.0
