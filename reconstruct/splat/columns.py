"""Projections of a lattice of splats: by upright columns where the scanner allows it, else splat by splat."""

import math

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from reconstruct.splat.kernels import separable_cpu as kernels
from reconstruct.splat.kernels.lanes import WIDTH
from reconstruct.splat.kernels.splat_cpu import DEPTH, DUAL_U, DUAL_V
from reconstruct.splat.lattice import Lattice
from reconstruct.splat.project import CUTOFF, Projector

LEVEL = 1e-9  # share of a vector that may point along z, or across
Image = NDArray[np.float32]


class LatticeProjector:
    """Projects the splats of `lattice` along the rays of `geometry`, in the order of the lattice.

    Images are [view, channel, v, u + 8], as those of `Projector`.
    """

    def __init__(self, geometry: Geometry, lattice: Lattice) -> None:
        # splats of half a voxel span so small an angle that EWA leaves out about a thousandth of the peak at most
        self._projector = Projector(geometry=geometry, tolerance=math.inf)
        self._n_detector, self._scale = geometry.n_detector, lattice.scale
        self._shapes = lattice.splats(np.zeros((len(lattice), 1), np.float32)).shapes()
        self.by_columns = _upright(self._projector.cameras) and _reach(geometry, lattice) < kernels.WIDEST
        if self.by_columns:
            x, y, z = lattice.positions.T
            self._order = np.lexsort((z, x, y))
            places = lattice.positions[self._order, :2]
            first = np.flatnonzero(np.any(places[1:] != places[:-1], axis=1)) + 1
            self._starts = np.concatenate([[0], first, [len(lattice)]]).astype(np.int64)
            self._xy = places[self._starts[:-1]].astype(np.float64)
            self._z = z[self._order].astype(np.float64)

    def forward(self, values: Image, views: NDArray[np.int64]) -> Image:
        """Sum values [splat, 2] times line integrals (mm) over the splats."""
        if not self.by_columns:
            return self._projector.forward(self._shapes, values, views)
        n_v, n_u = self._n_detector
        images = np.zeros((len(views), 2 * n_u, n_v + 2 * kernels.PAD), np.float32)
        cameras = self._projector.cameras[views]
        kernels.forward(self._xy, self._starts, self._z, values[self._order], self._scale, cameras, images)
        out = np.zeros((len(views), 2, n_v, n_u + WIDTH), np.float32)
        inner = images.reshape(len(views), 2, n_u, -1)[..., kernels.PAD : kernels.PAD + n_v]
        out[..., :n_u] = inner.transpose(0, 1, 3, 2)
        return out

    def adjoint(self, images: Image, views: NDArray[np.int64]) -> Image:
        """Sum images of four channels times line integrals (mm) over the pixels: [splat, 4]."""
        if not self.by_columns:
            return self._projector.adjoint(self._shapes, images, views)
        n_v, n_u = self._n_detector
        turned = np.zeros((len(views), 4, n_u, n_v + 2 * kernels.PAD), np.float32)
        turned[..., kernels.PAD : kernels.PAD + n_v] = images[..., :n_u].transpose(0, 1, 3, 2)
        sums, out = np.zeros((2, len(self._order), 4), np.float32)
        stack, cameras = turned.reshape(len(views), 4 * n_u, -1), self._projector.cameras[views]
        kernels.backward(self._xy, self._starts, self._z, self._scale, cameras, stack, sums)
        out[self._order] = sums
        return out


def _upright(cameras: NDArray[np.float64]) -> bool:
    """Say whether depth and u do not depend on z in any view, and v on z alone."""
    depth, dual_u, dual_v = (cameras[:, at : at + 3] for at in (DEPTH, DUAL_U, DUAL_V))
    level = all(np.all(np.abs(a[:, 2]) <= LEVEL * np.linalg.norm(a, axis=1)) for a in (depth, dual_u))
    return level and bool(np.all(np.abs(dual_v[:, :2]).max(1) <= LEVEL * np.abs(dual_v[:, 2])))


def _reach(geometry: Geometry, lattice: Lattice) -> float:
    """Return the cutoff in pixels of the largest shadow that a splat of the lattice may throw."""
    source = geometry.pose_array()[:, :2]
    away = np.hypot(*source.T).min() - np.hypot(*lattice.positions[:, :2].T).max()
    if away <= 0:
        return math.inf
    pixel = lattice.scale * geometry.dsd / away / min(geometry.d_detector)
    oblique = 1 + (max(geometry.n_detector) * max(geometry.d_detector) / geometry.dsd) ** 2
    return CUTOFF * math.sqrt(pixel**2 * oblique + 1 / 12)
