"""Polychromatic reconstruction with Gaussian splats, from counts, geometry and the greatest energy alone.

Coarse to fine: the object is carved from its shadows, fitted on a grid of half the resolution from a start of plain
water, and refined. No mask, no spectrum (unless one is given) and no FDK enter.
"""

import math
from typing import Any

import numpy as np
import torch

from ctsim.errors import InputError
from ctsim.types import Scan, Status, Volume
from reconstruct.log import line_integrals
from reconstruct.splat.curve import MaterialCurve
from reconstruct.splat.lattice import Lattice
from reconstruct.splat.level import Data, carve, coarser, padded, refined
from reconstruct.splat.ordered import Clock, Fit
from reconstruct.splat.project import Projector
from reconstruct.splat.response import Response, evaluate, make_response, tangent
from reconstruct.splat.volume import voxelise

OPEN = 5.0  # standard deviations of an open pixel below which a ray met nothing
LEAST_OPEN = 0.01
EMPTY = 0.05  # times water: a voxel of the coarse volume below that holds no splat
VIEWS, SHORTEST = 12, 0.5  # views that the read-out's water is measured in, and its least path in voxels
DENSEST = 15.0  # times water, that is no metal: enamel 9, titanium 43
SMALLEST = 24  # voxels along an axis below which there is no coarse level


def reconstruct(
    scan: Scan,
    *,
    device: str = "cpu",
    passes: tuple[int, int] = (2, 2),
    tv: float = 0.03,
    filtration: float = 1.0,
    seconds: float = math.inf,
) -> Volume:
    """Reconstruct `scan` by the preset "fast"; the volume is the attenuation in the hardened beam, 1/mm.

    `passes` over all views are those at half resolution and at full; `tv` is the threshold of denoising in units of
    water a pass, `filtration` the tube's equivalent aluminium in mm, `seconds` the time after which it returns
    what there is. Raises InputError for another device than the CPU and for values that make no sense.
    """
    if torch.device(device).type != "cpu":
        raise InputError(f"splat runs on device 'cpu' only, got {device!r}")
    if not (len(passes) == 2 and min(passes) >= 0 and max(passes) > 0):
        raise InputError(f"passes must be two counts, not both 0, got {passes}")
    for name, value in (("tv", tv), ("seconds", seconds)):
        if not value >= 0:
            raise InputError(f"{name} must be at least 0, got {value}")
    clock = Clock(seconds=seconds)
    p, clamped = line_integrals(scan, slice(None))
    data = padded(scan.geometry, p.numpy(), ~clamped.numpy())
    response = make_response("tube", e_max=scan.e_max, basis="klein-nishina", theta=(filtration,))
    fit = _coarse_to_fine(data, response, passes, tv, clock)
    details: dict[str, Any] = {
        "preset": "fast",
        "response": {"name": response.name, "theta": list(response.trainable)},
        "clamped_pixels": int(clamped.sum()),
        "splats": 0 if fit is None else len(fit.lattice),
    }
    if fit is None:
        details["limitation"] = "no ray met anything: the volume is empty"
        return Volume(values=torch.zeros(scan.geometry.n_voxel), details=details)
    length = typical_length(fit)
    by_a, by_b = tangent(response, fit.curve.of_water, length)
    hardened = fit.curve(fit.u)[0] @ np.array([[by_a], [by_b]], np.float32)
    values = voxelise(fit.lattice.splats(hardened), scan.geometry)[0]
    finite = bool(np.isfinite(values).all())
    details |= {
        "read-out": f"hardened by {length:.1f} mm of water",
        "misfit": fit.misfit if math.isfinite(fit.misfit) else None,
        "view_updates": fit.view_updates,
    }
    return Volume(
        values=torch.from_numpy(values),
        status=Status.OK if finite else Status.NONFINITE,
        reason="" if finite else "the reconstruction holds values that are not finite",
        details=details,
    )


def _coarse_to_fine(data: Data, response: Response, passes: tuple[int, int], tv: float, clock: Clock) -> Fit | None:
    """Fit at half the resolution, then at full; None where the scan shows nothing."""
    met = max(OPEN / math.sqrt(_open_photons(data)), LEAST_OPEN)
    curve = MaterialCurve.of(response, _rough_length(data, response, met))
    levels = [coarser(data), data] if min(data.geometry.n_voxel) >= 2 * SMALLEST and passes[0] else [data]
    counts = passes if len(levels) == 2 else (passes[0] + passes[1],)
    fit, done = None, 0
    for level, count in zip(levels, counts, strict=True):
        support = carve(level, met)
        if fit is None:
            start = np.where(support, curve.water, 0).astype(np.float32)
        else:
            start = refined(fit.volume(), level.geometry)
            support &= start > EMPTY * curve.water
        if not support.any():
            return None
        lattice = Lattice(geometry=level.geometry, support=support)
        fit = Fit(data=level, lattice=lattice, response=response, curve=curve, u=lattice.gather(start), tv=tv)
        fit.view_updates = done
        if not fit.run(count, clock.proceed):
            break
        done = fit.view_updates
    return fit


def _open_photons(data: Data) -> float:
    """Estimate the photons of an open pixel from how far p falls below 0, which only noise does: 1/var."""
    n_u = data.geometry.n_detector[1]
    p = data.p[..., :n_u][data.weights[..., :n_u] > 0]
    below = p[p < 0].astype(np.float64)
    return float(1 / max(np.mean(below**2), 1e-12)) if below.size else 1e12


def _rough_length(data: Data, response: Response, met: float) -> float:
    """Return the water path (mm) behind which p is the median of the rays that met something."""
    n_u = data.geometry.n_detector[1]
    p = data.p[..., :n_u][data.weights[..., :n_u] > 0]
    seen = p[p > met]
    if not seen.size:
        return 0.0
    lengths = np.linspace(0, 500, 2001)
    la, lb = ((lengths * density).astype(np.float32) for density in MaterialCurve.of(response, 0.0).of_water)
    found, _, _ = evaluate(response, la, lb)
    return float(np.interp(np.median(seen), found, lengths))


def typical_length(fit: Fit) -> float:
    """Return the median water-equivalent path (mm) through what is no metal, of the rays that meet it."""
    geometry, water = fit.data.geometry, fit.curve.water
    views = np.unique(np.linspace(0, geometry.n_views - 1, min(VIEWS, geometry.n_views)).round().astype(int))
    shares = np.where(fit.u < DENSEST * water, fit.u / water, 0).astype(np.float32)
    splats = fit.lattice.splats(shares[:, None])
    paths = Projector(geometry=geometry).forward(splats.shapes(), splats.densities, views)
    met = paths[paths > SHORTEST * max(geometry.d_voxel)]
    return float(np.median(met)) if met.size else 0.0
