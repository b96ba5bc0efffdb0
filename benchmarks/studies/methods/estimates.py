"""What a method that has never run will about take: so many times FDK's time, which is measured on a small scan."""

import functools
import math
import time

import msgspec
import torch

from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.studies.methods.plan import Job
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.splat.course import PASSES, affordable
from ctsim.reconstruct.splat.fast import finer
from ctsim.types import Scan

FDKS = {
    "fdk": 1.0,
    "limar": 2.0,
    "nmar": 4.4,
    "bhc-poly": 6.8,
    "water-precorrection": 1.7,
    "ibhc": 2.7,
    "sart": 3.0,
    "os-sart": 2.3,
    "sirt": 1.5,
    "cgls": 1.3,
    "fista-tv": 1.5,
    "asd-pocs": 2.3,
    "awpcsd": 3.7,
    "splat": 2.9,
    "splat-paper": 0.49,
    "splat-r2": 1.27,
}
"""Cost in FDKs, of an iteration or a step where a method has those, as measured on lung-Fe of `quick`.

That of `splat` is of a pass over a grid of as many voxels, on `core`.
"""
UNKNOWN = 5.0  # for a method that is not in the table
AMOUNTS = ("iterations", "steps")
PIXEL = 30  # voxels whose backprojection takes as long as the logarithm and the filter of a pixel
SMALL = 64  # voxels along an axis and views, at most, of the scan on which FDK is timed


def in_fdks(method: Method, geometry: Geometry) -> float | None:
    """Return about how many times FDK's time a run takes, None for a method or a count that is not known here."""
    name, params = method.name, method.params
    try:
        if name == "splat":
            fine = finer(geometry, params["fineness"])
            coarse, finest = params["passes"] or (PASSES[0], min(PASSES[1], affordable(fine)))
            passes = finest + coarse / 15  # Σ 16⁻ⁿ: a coarser grid has an eighth of the voxels and half of the views
            return FDKS[name] * passes * math.prod(fine.n_voxel) / math.prod(geometry.n_voxel)
        told = next((params[key] for key in AMOUNTS if params.get(key) is not None), 1.0)
        return FDKS[name] * float(told)
    except (KeyError, IndexError, TypeError, ValueError):  # what is wrong with a parameter the method says better
        return None


@functools.cache
def fdk_seconds(geometry: Geometry) -> float:
    """Return about what FDK takes, from a blank scan of fewer voxels and views, after a run that compiles."""
    small = msgspec.structs.replace(
        geometry,
        n_voxel=tuple(min(n, SMALL) for n in geometry.n_voxel),
        n_views=min(geometry.n_views, SMALL),
        angles_deg=None,
        poses=None,  # FDK takes none; dso and dsd are enough
    )
    blank = Scan(geometry=small, counts=torch.ones(small.shape), flat=torch.ones(small.n_detector))
    fdk(blank)
    start = time.perf_counter()
    fdk(blank)
    seconds = time.perf_counter() - start
    return seconds * _work(geometry) / _work(small)


def _work(geometry: Geometry) -> int:
    return geometry.n_views * (math.prod(geometry.n_voxel) + PIXEL * math.prod(geometry.n_detector))


def estimated(job: Job) -> float | None:
    """Guess the seconds of a run from FDK's time on this machine, None for a method of the user's own."""
    geometry = job.stored.geometry
    fdks = in_fdks(job.method, geometry)
    told = job.method.params.get("seconds")
    limit = told if isinstance(told, int | float) else math.inf
    return None if fdks is None else min(fdks * fdk_seconds(geometry), limit)
