"""Projections of splats and their transpose: path values per channel, and sums per splat."""

from dataclasses import dataclass, field

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.projector import Views, view_indices
from ctsim.reconstruct.splat.kernels import gradient_cpu
from ctsim.reconstruct.splat.kernels import splat_cpu as kernels
from ctsim.reconstruct.splat.model import Splats

CUTOFF = 3.5
"""Mahalanobis radius beyond which a splat is zero."""
TOLERANCE = 1e-3
"""A splat is projected exactly where EWA would leave out more than this share of its peak: 0 always, inf never."""
MANY_VIEWS = 8  # from this many on a thread takes whole views
TASKS = 2  # bands of rows a thread: splats over two bands are begun twice


@dataclass(frozen=True, slots=True, kw_only=True)
class Gradient:
    """How a loss of one view changes with the splats, float32, in the loss's unit; 0 for splats that are left out.

    By `densities` [splat, channel] (1/mm), `positions` [splat, 3] (mm), natural `log_scales` [splat, 1] of round splats
    and [splat, 3] of others, and `rotations` [splat, 4], at right angles to the quaternion (None for round splats).
    `centres` [splat] is the length of the gradient by the centre's place on the detector, in pixels.
    """

    densities: NDArray[np.float32]
    positions: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    rotations: NDArray[np.float32] | None
    centres: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Projector:
    """Projects splats along the rays of `geometry`, any pose or detector offset.

    With `box` a pixel measures the mean over its area (to second order), as detectors do; without, the ray through its
    centre. Images hold `WIDTH` columns more than the detector; they are zero, and count as such if they are finite.
    Splats that lie behind the source, are not finite or have no extent are left out.
    """

    geometry: Geometry
    cutoff: float = CUTOFF
    tolerance: float = TOLERANCE
    box: bool = True
    cameras: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        cameras = kernels.camera_vectors(self.geometry.pose_array(), self.geometry.n_detector)
        cameras[:, kernels.CUTOFF], cameras[:, kernels.TOLERANCE] = self.cutoff, self.tolerance
        cameras[:, kernels.BOX] = 1 / 12 if self.box else 0.0
        object.__setattr__(self, "cameras", cameras)

    def forward(
        self, shapes: NDArray[np.float32], values: NDArray[np.float32], views: Views = None
    ) -> NDArray[np.float32]:
        """Sum values [splat, channel] times line integrals (mm) over the splats: float32 [view, channel, v, u + WIDTH].

        One or two channels. Raises InputError for wrong shapes, and views that do not exist.
        """
        chosen = view_indices(self.geometry, views)
        n_v, n_u = self.geometry.n_detector
        n, n_c = values.shape
        _check("shapes", shapes, [(4, n), (15, n)])
        _check("values", values, [(n, 1), (n, 2)])
        images = np.zeros((len(chosen), n_c * n_v, n_u + WIDTH), np.float32)
        if len(chosen) >= MANY_VIEWS:
            kernels.forward_views(shapes, values, self.cameras[chosen], images)
        else:
            table, reach = np.empty((n, kernels.FOOTPRINT)), np.empty((n, 2), np.int32)
            tasks = TASKS * get_num_threads()
            for view, image in zip(chosen, images, strict=True):
                kernels.forward_view(shapes, values, self.cameras[view], table, reach, image, tasks)
        return images.reshape(len(chosen), n_c, n_v, n_u + WIDTH)

    def adjoint(
        self, shapes: NDArray[np.float32], images: NDArray[np.float32], views: Views = None
    ) -> NDArray[np.float32]:
        """Sum images [view, channel, v, u + WIDTH] times line integrals (mm) over the pixels: float32 [splat, channel].

        One, two or four channels. Raises InputError as `forward` does.
        """
        chosen = view_indices(self.geometry, views)
        n_v, n_u = self.geometry.n_detector
        n, n_c = shapes.shape[1], images.shape[1]
        _check("shapes", shapes, [(4, n), (15, n)])
        _check("images", images, [(len(chosen), k, n_v, n_u + WIDTH) for k in (1, 2, 4)])
        sums = np.zeros((n, n_c), np.float32)
        stack = np.ascontiguousarray(images).reshape(len(chosen), n_c * n_v, n_u + WIDTH)
        kernels.backward_views(shapes, self.cameras[chosen], stack, sums)
        return sums

    def gradient(self, splats: Splats, images: NDArray[np.float32], view: int) -> Gradient:
        """Return the gradient of a loss whose derivative by view `view` is `images` [channel, v, u + WIDTH].

        It is that of the EWA form for every tolerance (a Projector of infinite tolerance has no other), and
        knows no cutoff. One channel a density. Raises InputError for wrong shapes, and a view that does not exist.
        """
        (chosen,), (n_v, n_u) = view_indices(self.geometry, [view]), self.geometry.n_detector
        n, n_c = splats.densities.shape
        _check("images", images, [(n_c, n_v, n_u + WIDTH)])
        camera, out = self.cameras[chosen].copy(), np.zeros((n, gradient_cpu.GRADIENT), np.float32)
        camera[kernels.TOLERANCE] = np.inf
        image = np.ascontiguousarray(images).reshape(n_c * n_v, n_u + WIDTH)
        turns = np.ones((n, 4), np.float32) if splats.rotations is None else splats.rotations
        gradient_cpu.gradient(splats.shapes(), splats.densities, turns, camera, image, out)
        by_scale = out[:, gradient_cpu.SCALE : gradient_cpu.QUATERNION]
        return Gradient(
            densities=out[:, :n_c],
            positions=out[:, gradient_cpu.POSITION : gradient_cpu.SCALE],
            log_scales=by_scale.sum(1, keepdims=True) if splats.rotations is None else by_scale,
            rotations=None if splats.rotations is None else out[:, gradient_cpu.QUATERNION : gradient_cpu.CENTRE],
            centres=out[:, gradient_cpu.CENTRE],
        )


def _check(name: str, array: NDArray[np.float32], shapes: list[tuple[int, ...]]) -> None:
    if array.shape not in shapes or array.dtype != np.float32:
        expected = " or ".join(str(s) for s in shapes)
        raise InputError(f"{name} must be float32 of shape {expected}, got {array.dtype} {array.shape}")
