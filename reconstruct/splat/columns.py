"""Projections of a lattice of splats: by upright columns where the scanner allows it, else splat by splat."""

import math

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.kernels import separable_cpu as kernels
from ctsim.reconstruct.splat.kernels.splat_cpu import DEPTH, DUAL_U, DUAL_V
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.project import Projector

LEVEL = 1e-9  # share of a vector that may point along z, or across
Image = NDArray[np.float32]


class LatticeProjector:
    """Projects the splats of `lattice`, in its order, along the rays of `geometry`, in two channels.

    Images lie as the kernels want them, [view, channel, u, v + WIDTH] or as `Projector` has them: `arranged` puts
    pictures [view, v, u] into that form, and `pictures` takes them out of it. Splats are projected by EWA unless
    `exact`, which has no columns: those of half a voxel span so small an angle that EWA is off by a thousandth of the
    peak at most.
    """

    def __init__(self, geometry: Geometry, lattice: Lattice, *, exact: bool = False) -> None:
        self._projector = Projector(geometry=geometry, tolerance=0 if exact else math.inf)
        self._n_detector, self._scale, self._n_splats = geometry.n_detector, lattice.scale, len(lattice)
        self.by_columns = not exact and _upright(self._projector.cameras)
        if self.by_columns:
            places, starts = lattice.runs()
            z = np.pad(lattice.heights[None], [(0, 0), (0, WIDTH)])
            self._runs = (places, starts, z, int(np.diff(starts).max(initial=0)))
        else:
            self._shapes = lattice.splats(np.zeros((len(lattice), 1), np.float32)).shapes()

    def forward(self, values: Image, views: NDArray[np.int64]) -> Image:
        """Sum values [splat, 2] times line integrals (mm) over the splats; scratch columns may hold anything finite."""
        if not self.by_columns:
            return self._projector.forward(self._shapes, values, views)
        n_v, n_u = self._n_detector
        images = np.zeros((len(views), 2 * n_u, n_v + WIDTH), np.float32)
        kernels.forward(self._runs, values, self._scale, self._projector.cameras[views], images)
        return images.reshape(len(views), 2, n_u, n_v + WIDTH)

    def adjoint(self, images: Image, views: NDArray[np.int64], out: Image | None = None) -> Image:
        """Sum images, zero in their scratch columns, times line integrals (mm) over the pixels: [splat, 2].

        By columns the result is in `out` where that is given.
        """
        if not self.by_columns:
            return self._projector.adjoint(self._shapes, images, views)
        stack = images.reshape(len(views), 2 * self._n_detector[1], images.shape[-1])
        sums = np.empty((self._n_splats, 2), np.float32) if out is None else out
        kernels.backward(self._runs, self._scale, self._projector.cameras[views], stack, sums)
        return sums

    def arranged(self, pictures: Image) -> Image:
        """Put pictures [..., v, u] into the form of an image's channel, scratch columns zero."""
        n_v, n_u = self._n_detector
        if not self.by_columns:
            return np.pad(pictures, [(0, 0)] * (pictures.ndim - 1) + [(0, WIDTH)])
        out = np.zeros((*pictures.shape[:-2], n_u, n_v + WIDTH), np.float32)
        self.pictures(out)[...] = pictures
        return out

    def pictures(self, images: Image) -> Image:
        """View the detector's part of images as [..., v, u]."""
        return self.turned(images[..., :-WIDTH])

    def turned(self, inner: Image) -> Image:
        """View images without scratch as [..., v, u]."""
        return inner.swapaxes(-1, -2) if self.by_columns else inner


def _upright(cameras: NDArray[np.float64]) -> bool:
    """Say whether depth and u do not depend on z in any view, and v on z alone."""
    depth, dual_u, dual_v = (cameras[:, at : at + 3] for at in (DEPTH, DUAL_U, DUAL_V))
    level = all(np.all(np.abs(a[:, 2]) <= LEVEL * np.linalg.norm(a, axis=1)) for a in (depth, dual_u))
    return level and bool(np.all(np.abs(dual_v[:, :2]).max(1) <= LEVEL * np.abs(dual_v[:, 2])))
