"""Projections of splats and their transpose: path values per channel, and sums per splat."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from reconstruct.projector import Views, view_indices
from reconstruct.splat.kernels import splat_cpu as kernels
from reconstruct.splat.kernels.lanes import WIDTH

CUTOFF = 3.5
"""Mahalanobis radius beyond which a splat is zero."""
TOLERANCE = 1e-3
"""A splat is projected exactly where EWA would leave out more than this share of its peak: 0 always, inf never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Projector:
    """Projects splats along the rays of `geometry`, any pose or detector offset.

    With `box` a pixel measures the mean over its area (to second order), as detectors do; without, the ray through its
    centre. Images hold eight columns more than the detector; they mean nothing.
    """

    geometry: Geometry
    cutoff: float = CUTOFF
    tolerance: float = TOLERANCE
    box: bool = True
    cameras: NDArray[np.float64] = field(init=False)
    _scratch: dict[int, NDArray[np.float32]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        cameras = kernels.camera_vectors(self.geometry.pose_array(), self.geometry.n_detector)
        cameras[:, kernels.CUTOFF], cameras[:, kernels.TOLERANCE] = self.cutoff, self.tolerance
        cameras[:, kernels.BOX] = 1 / 12 if self.box else 0.0
        object.__setattr__(self, "cameras", cameras)

    def forward(
        self, shapes: NDArray[np.float32], values: NDArray[np.float32], views: Views = None
    ) -> NDArray[np.float32]:
        """Sum values [splat, channel] times line integrals (mm) over the splats: float32 [view, channel, v, u + 8]."""
        chosen = view_indices(self.geometry, views)
        n_v, n_u = self.geometry.n_detector
        n_c = values.shape[1]
        images = np.zeros((len(chosen), n_c * n_v, n_u + WIDTH), np.float32)
        if len(chosen) >= kernels.CHUNKS:
            kernels.forward_views(shapes, values, self.cameras[chosen], images)
        else:
            if n_c not in self._scratch:
                self._scratch[n_c] = np.zeros((kernels.CHUNKS, n_c * n_v, n_u + WIDTH), np.float32)
            scratch = self._scratch[n_c]
            for k, view in enumerate(chosen):
                kernels.forward_view(shapes, values, self.cameras[view], scratch, images[k])
        return images.reshape(len(chosen), n_c, n_v, n_u + WIDTH)

    def adjoint(
        self, shapes: NDArray[np.float32], images: NDArray[np.float32], views: Views = None
    ) -> NDArray[np.float32]:
        """Sum images [view, channel, v, u + 8] times line integrals (mm) over the pixels: float32 [splat, channel]."""
        chosen = view_indices(self.geometry, views)
        n_c = images.shape[1]
        sums = np.zeros((shapes.shape[1], n_c), np.float32)
        stack = images.reshape(len(chosen), -1, images.shape[3])
        kernels.backward_views(shapes, self.cameras[chosen], stack, sums)
        return sums
