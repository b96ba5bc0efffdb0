"""Objects whose metal a scan shows: drawn again until it does, or moved so that a single row meets it."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from ctsim.errors import InputError
from ctsim.geometry import Geometry, few_views
from ctsim.notes import metal_share
from ctsim.phantoms.recipe import Recipe
from ctsim.phantoms.recipes import build_recipe
from ctsim.solids import pack
from ctsim.tracer.shadow import primitive_corners
from ctsim.tracer.voxelise import metal_planes
from ctsim.types import Phantom

DRAWS = 20
PLANES, ACROSS = 64, 48  # heights to choose from, voxels along x and y that tell which of them hold metal
LOOKED_AT = 8  # views
NONE = slice(0)  # of the layers: the inserts are where they are without any


def build_in_view(
    params: Recipe, seed: int, geometry: Geometry, layers: Callable[[float], slice] | None = None
) -> Phantom:
    """Build a recipe's phantom so that the ray of a pixel's centre meets metal in a view; one without metal as it is.

    For a detector of one row the phantom is moved along z, so that the row sees a height drawn from those with metal.
    Otherwise it is drawn again, with the same settings and seed. `layers(dz)` are those to draw of a body that is moved
    by `dz` mm, by default all. Raises InputError where `DRAWS` draws show no metal.
    """
    chosen = few_views(geometry.n_views, LOOKED_AT)
    for again in range(DRAWS):
        phantom = build_recipe(params, seed, again, slice(None) if layers is None else NONE)
        dz, metal = 0.0, any(solid.metal for solid in phantom.solids)
        if metal and geometry.n_detector[0] == 1:
            dz = _seen_height(geometry) - _metal_height(phantom, f"{params.recipe}/{seed}/{again}")
        moved = _moved(phantom, dz)
        if not metal or metal_share(moved, geometry, chosen) or metal_share(moved, geometry):
            return moved if layers is None else _moved(build_recipe(params, seed, again, layers(dz)), dz)
    raise InputError(
        f"metal_in_view: none of {DRAWS} draws of recipe {params.recipe!r} with seed {seed} has metal in a view; "
        "expected larger inserts or a larger field of view"
    )


def _moved(phantom: Phantom, dz: float) -> Phantom:
    """Move a phantom along z by `dz` mm."""
    if not dz:
        return phantom
    solids = []
    for solid in phantom.solids:
        pieces = tuple(replace(p, centre=(*p.centre[:2], p.centre[2] + dz)) for p in solid.primitives)
        solids.append(replace(solid, primitives=pieces))
    z, y, x = phantom.off_origin
    return replace(phantom, off_origin=(z + dz, y, x), solids=tuple(solids))


def _seen_height(geometry: Geometry) -> float:
    """Height (mm) at which the detector's centre is seen on the axis, the mean over the views."""
    poses = geometry.pose_array()
    source, centre = poses[:, :3], poses[:, 3:6]
    reach = np.hypot(*source[:, :2].T) / np.hypot(*(centre - source)[:, :2].T)
    return float(np.mean(source[:, 2] + reach * (centre - source)[:, 2]))


def _metal_height(phantom: Phantom, stream: str) -> float:
    """Draw a height (mm) at which the phantom has metal."""
    prims = pack([s for s in phantom.solids if s.metal], phantom.materials)
    corners = primitive_corners(prims).reshape(-1, 3)[:, ::-1]  # z, y, x
    low, high = corners.min(0), corners.max(0)
    n = (PLANES, ACROSS, ACROSS)
    solids = Phantom(
        labels=np.zeros((1, 1, 1), np.uint8), materials=phantom.materials, d_voxel=(1, 1, 1), solids=phantom.solids
    )
    z, y, x = (float(d) for d in (high - low) / n)
    centre_z, centre_y, centre_x = (float(c) for c in (high + low) / 2)
    grid = msgspec.structs.replace(_GRID, n_voxel=n, d_voxel=(z, y, x), off_origin=(centre_z, centre_y, centre_x))
    held = np.flatnonzero(metal_planes(solids, grid))
    if not held.size:  # thinner than half a voxel of that grid everywhere
        return centre_z
    digest = hashlib.sha256(f"{stream}/height".encode()).digest()
    plane = int(held[np.random.default_rng(np.frombuffer(digest, np.uint32)).integers(held.size)])
    return float(low[0] + (plane + 0.5) * z)


_GRID = Geometry(
    dso=1.0, dsd=2.0, n_voxel=(1, 1, 1), d_voxel=(1.0, 1.0, 1.0), n_detector=(1, 1), d_detector=(1.0, 1.0), n_views=1
)
