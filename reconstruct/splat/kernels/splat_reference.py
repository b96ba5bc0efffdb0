"""Projections of Gaussians in float64, written to be read; the oracle of `splat_cpu` and `gradient_cpu`.

A ray source + t·v meets exp(−½(x − p)ᵀΣ⁻¹(x − p)). With c = p − source the exponent is a parabola in t,

    vᵀΣ⁻¹v t² − 2 vᵀΣ⁻¹c t + cᵀΣ⁻¹c = A (t − t₀)² + Q/D,        A = vᵀΣ⁻¹v,

so that the integral over t, times |v|, is |v| √(2π/A) exp(−Q/2D). Q is the square of the pixel's distance from the
centre's shadow in units of the shadow's covariance S = JΣJᵀ, J the derivative of the shadow's place (in pixels) by p,
and D is A over its value on the ray through the centre; EWA takes D = 1 and that ray's |v|. A pixel that is a box has
variance 1/12: S grows by it, and the peak falls so that the sum over all pixels stays.

Shapes and cameras are those of `splat_cpu`; images are [view, channel · v, u + WIDTH], the last WIDTH columns unused.
"""

import numpy as np
from numpy.typing import NDArray

from ctsim.kernels.lanes import WIDTH

Array = NDArray[np.floating]


def forward_views(shapes: Array, values: Array, cameras: Array, images: Array) -> None:
    """Add values [splat, channel] times line integrals (mm) to images."""
    for camera, image in zip(cameras, images, strict=True):
        by_channel = image.reshape(values.shape[1], -1, image.shape[1])
        w = weights(shapes, camera, *_detector(by_channel))
        by_channel[:, :, :-WIDTH] += np.einsum("ic,ivu->cvu", values, w)


def backward_views(shapes: Array, cameras: Array, images: Array, sums: Array) -> None:
    """Add images times line integrals (mm), summed over views and pixels, to sums [splat, channel]."""
    for camera, image in zip(cameras, images, strict=True):
        by_channel = image.reshape(sums.shape[1], -1, image.shape[1])
        w = weights(shapes, camera, *_detector(by_channel))
        sums += np.einsum("cvu,ivu->ic", by_channel[:, :, :-WIDTH], w)


def weights(shapes: Array, camera: Array, n_v: int, n_u: int) -> Array:
    """Return the integral (mm) of every Gaussian along every ray, [splat, v, u]; zero beyond the cutoff.

    The exact form, or EWA where the camera's tolerance is infinite.
    """
    _, across, e_u, e_v = camera[:12].reshape(4, 3)
    cutoff, tolerance = camera[12:14]
    centre, _, ray, tau = shadow(shapes, camera)
    _, boxed = spreads(shapes, camera)
    v, u = np.meshgrid(np.arange(n_v), np.arange(n_u), indexing="ij")
    to_pixel = across + u[..., None] * e_u + v[..., None] * e_v
    delta = np.stack([u, v], -1) - centre[:, None, None]
    q = np.einsum("ivua,iab,ivub->ivu", delta, np.linalg.inv(boxed), delta)
    d, longer = np.ones_like(q), np.ones_like(q)
    if np.isfinite(tolerance):
        precision = np.linalg.inv(covariances(shapes)[0])
        alpha = np.einsum("ia,iab,ib->i", ray, precision, ray)[:, None, None]
        d = np.einsum("vua,iab,vub->ivu", to_pixel, precision, to_pixel) / alpha
        longer = (to_pixel**2).sum(-1) / (ray**2).sum(-1)[:, None, None]
    w = peaks(shapes, camera)[:, None, None] * np.sqrt(longer / d) * np.exp(-0.5 * q / d)
    return np.where((q <= cutoff**2) & (tau > 0)[:, None, None], w, 0.0)


def separable_weights(shapes: Array, camera: Array, n_v: int, n_u: int) -> Array:
    """Return [splat, v, u] (mm) of the mass of EWA's shadow, but a product of Gaussians along u and v; no cutoff.

    The oracle of `separable_cpu`.
    """
    centre, _, _, _ = shadow(shapes, camera)
    _, boxed = spreads(shapes, camera)
    s_u, s_v = boxed[:, 0, 0], boxed[:, 1, 1]
    along_u = np.exp(-0.5 * (np.arange(n_u) - centre[:, :1]) ** 2 / s_u[:, None])
    along_v = np.exp(-0.5 * (np.arange(n_v) - centre[:, 1:]) ** 2 / s_v[:, None])
    peak = peaks(shapes, camera) * np.sqrt(np.linalg.det(boxed) / (s_u * s_v))
    return peak[:, None, None] * along_v[:, :, None] * along_u[:, None]


def peaks(shapes: Array, camera: Array) -> Array:
    """Return the integral (mm) along the ray through the centre, a box's mean where the camera has one: [splat]."""
    _, _, ray, _ = shadow(shapes, camera)
    alpha = np.einsum("ia,iab,ib->i", ray, np.linalg.inv(covariances(shapes)[0]), ray)
    s, boxed = spreads(shapes, camera)
    kept = np.linalg.det(s) / np.linalg.det(boxed)
    return np.sqrt(2 * np.pi / alpha * (ray**2).sum(-1) * kept)


def spreads(shapes: Array, camera: Array) -> tuple[Array, Array]:
    """Return the shadow's covariance in pixels, [splat, 2, 2], without and with the pixel's own."""
    _, jacobian, _, _ = shadow(shapes, camera)
    s = jacobian @ covariances(shapes)[0] @ jacobian.transpose(0, 2, 1)
    return s, s + camera[14] * np.eye(2)


def voxelise(shapes: Array, values: Array, grid: Array, size: tuple[int, int, int]) -> Array:
    """Sum values [splat, channel] times the Gaussians on a grid: [channel, z, y, x]; `grid` is that of the kernel.

    A voxel that is a box has variance d²/12 in each axis: Σ grows by it, and the peak falls so that the mass stays.
    """
    spacing, first, (cutoff, box) = grid[:3], grid[3:6], grid[6:]
    covariance, _, _ = covariances(shapes)
    boxed = covariance + np.diag(box * spacing[::-1] ** 2)
    peaks = np.sqrt(np.linalg.det(covariance) / np.linalg.det(boxed))
    indices = np.meshgrid(*(np.arange(n) for n in size), indexing="ij")
    points = np.stack([o + i * d for o, i, d in zip(first, indices, spacing, strict=True)][::-1], -1)
    x = points - np.asarray(shapes[:3], np.float64).T[:, None, None, None]
    square = np.einsum("izyxa,iab,izyxb->izyx", x, np.linalg.inv(boxed), x)
    blobs = np.where(square <= cutoff**2, np.exp(-0.5 * square) * peaks[:, None, None, None], 0.0)
    return np.einsum("ic,izyx->czyx", values, blobs)


def covariances(shapes: Array) -> tuple[Array, Array, Array]:
    """Return Σ [splat, 3, 3] in mm², the scales [splat, 3] and the axes [splat, 3, 3], one a column."""
    shapes = np.asarray(shapes, np.float64)
    scales = np.broadcast_to(shapes[3:4] if len(shapes) == 4 else shapes[3:6], (3, shapes.shape[1])).T
    axes = np.eye(3) + np.zeros((shapes.shape[1], 1, 1))
    if len(shapes) == 15:
        axes = shapes[6:].T.reshape(-1, 3, 3)
    return (axes * scales[:, None] ** 2) @ axes.transpose(0, 2, 1), scales, axes


def shadow(shapes: Array, camera: Array) -> tuple[Array, Array, Array, Array]:
    """Return where the centres are seen, [splat, 2] (u, v) in pixels, and how: J, v_c and τ.

    J [splat, 2, 3] is the derivative of that place by the position (1/mm), v_c [splat, 3] the ray through the
    centre, ending on the detector, and τ [splat] the centre's depth as a share of the detector's.
    """
    source, across, e_u, e_v = camera[:12].reshape(4, 3)
    dual = np.linalg.pinv(np.stack([e_u, e_v], 1))  # [2, 3]: takes a point of the plane to (u, v)
    normal = np.cross(e_u, e_v)
    depth = normal / (across @ normal)
    c = np.asarray(shapes[:3], np.float64).T - source
    tau = c @ depth
    ray = c / tau[:, None]
    jacobian = (dual - (ray @ dual.T)[:, :, None] * depth) / tau[:, None, None]
    return (ray - across) @ dual.T, jacobian, ray, tau


def rotation_matrices(quaternions: Array) -> Array:
    """Turn quaternions (w, x, y, z) of any length but zero into rotation matrices [splat, 3, 3]."""
    q = np.asarray(quaternions, np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _detector(by_channel: Array) -> tuple[int, int]:
    return by_channel.shape[1], by_channel.shape[2] - WIDTH
