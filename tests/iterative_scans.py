"""Scans of a sphere and of a few voxels, all iterative methods, and their matrix, for the tests of both."""

import numba
import numpy as np
import pytest
import torch

from ctsim.baselines.krylov import cgls
from ctsim.baselines.sart import os_sart, sart, sirt
from ctsim.baselines.tv_methods import asd_pocs, awpcsd, fista_tv
from ctsim.geometry import Geometry
from ctsim.reconstruct.projector import forward
from ctsim.types import Scan

MU, RADIUS, CENTRE = 0.02, 10.0, np.array([1.0, -2.0, 0.5])  # 1/mm, mm, x y z
GEOMETRY = Geometry(
    dso=300.0,
    dsd=600.0,
    n_voxel=(28, 29, 31),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(36, 38),
    d_detector=(2.0, 2.0),
    n_views=40,
)
TINY = Geometry(
    dso=30.0,
    dsd=60.0,
    n_voxel=(3, 4, 5),
    d_voxel=(1.2, 1.0, 0.8),
    n_detector=(6, 9),
    d_detector=(1.6, 1.6),
    n_views=12,
)
METHODS = {"sart": sart, "os-sart": os_sart, "sirt": sirt, "cgls": cgls}
METHODS |= {"fista-tv": fista_tv, "asd-pocs": asd_pocs, "awpcsd": awpcsd}


@pytest.fixture(autouse=True)
def one_thread():
    """Grids as small as these spend more on waiting for threads than on work; no bit depends on their number."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


def scan_of(p, geometry, i0=1e9):
    counts = i0 * torch.exp(-p.double())
    return Scan(geometry=geometry, counts=counts.float(), flat=torch.full(geometry.n_detector, i0), i0=i0)


def sphere(geometry=GEOMETRY):
    """A scan without noise of a sphere, from its chords."""
    pose, (n_v, n_u) = geometry.pose_array()[:, None, None], geometry.n_detector
    v = (np.arange(n_v) - (n_v - 1) / 2)[None, :, None, None]
    u = (np.arange(n_u) - (n_u - 1) / 2)[None, None, :, None]
    ray = pose[..., 3:6] + u * pose[..., 6:9] + v * pose[..., 9:12] - pose[..., :3]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    to = CENTRE - pose[..., :3]
    miss = (to**2).sum(-1) - (to * ray).sum(-1) ** 2
    return scan_of(torch.from_numpy(MU * 2 * np.sqrt(np.maximum(RADIUS**2 - miss, 0))), geometry)


def tiny(geometry=TINY):
    """A scan without noise of random voxels, so that an exact solution exists."""
    truth = torch.from_numpy(np.random.default_rng(4).random(geometry.n_voxel).astype(np.float32))
    return scan_of(forward(truth, geometry), geometry)


def distance(geometry=GEOMETRY):
    z, y, x = geometry.voxel_centres()
    square = (z - CENTRE[2])[:, None, None] ** 2 + (y - CENTRE[1])[:, None] ** 2 + (x - CENTRE[0]) ** 2
    return np.sqrt(square)


def matrix(geometry):
    columns = []
    for k in range(int(np.prod(geometry.n_voxel))):
        unit = torch.zeros(geometry.n_voxel)
        unit.view(-1)[k] = 1
        columns.append(forward(unit, geometry).numpy().ravel().astype(float))
    return np.stack(columns, 1)
