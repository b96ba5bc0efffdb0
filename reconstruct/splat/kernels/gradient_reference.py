"""Gradients of a loss in the splats in float64, matrix by matrix; the oracle of `gradient_cpu`."""

import numpy as np
from numpy.typing import NDArray

from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.kernels.splat_reference import rotation_matrices, shadow, spreads, weights

Array = NDArray[np.floating]


def pack(positions: Array, scales: Array, quaternions: Array) -> Array:
    """Return the shapes [15, splat] of positions [splat, 3], scales [splat, 3] and quaternions [splat, 4]."""
    return np.concatenate([positions.T, scales.T, rotation_matrices(quaternions).reshape(-1, 9).T])


def gradient(
    positions: Array, scales: Array, quaternions: Array, densities: Array, camera: Array, image: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the derivatives of Σ image·L by densities, positions, log scales, quaternions and places (u, v).

    The camera's tolerance must be infinite, image is [channel, v, u + WIDTH]. The cutoff is taken as given.
    """
    shapes = pack(positions, scales, quaternions)
    n_v, n_u = image.shape[1], image.shape[2] - WIDTH
    w = weights(shapes, camera, n_v, n_u)
    by_density = np.einsum("cvu,ivu->ic", image[:, :, :-WIDTH], w)
    loss = w * np.einsum("cvu,ic->ivu", image[:, :, :-WIDTH], densities)
    centre, jacobian, ray, tau = shadow(shapes, camera)
    v, u = np.meshgrid(np.arange(n_v), np.arange(n_u), indexing="ij")
    delta = np.stack([u, v], -1) - centre[:, None, None]
    m0, m1 = loss.sum((1, 2)), np.einsum("ivu,ivua->ia", loss, delta)
    m2 = np.einsum("ivu,ivua,ivub->iab", loss, delta, delta)
    conic = np.linalg.inv(spreads(shapes, camera)[1])
    # log w = log|c| − 3 log τ + Σ log s + ½ log det C − ½ δᵀCδ
    by_place = np.einsum("iab,ib->ia", conic, m1)
    by_spread = 0.5 * (conic @ m2 @ conic - m0[:, None, None] * conic)
    rotation = rotation_matrices(quaternions)
    covariance = (rotation * scales[:, None] ** 2) @ rotation.transpose(0, 2, 1)
    by_covariance = jacobian.transpose(0, 2, 1) @ by_spread @ jacobian
    by_jacobian = 2 * by_spread @ jacobian @ covariance
    by_scale = 2 * scales**2 * np.einsum("iak,iab,ibk->ik", rotation, by_covariance, rotation) + m0[:, None]
    by_rotation = 2 * by_covariance @ rotation * scales[:, None] ** 2
    by_quaternion = np.einsum("iab,ikab->ik", by_rotation, rotation_derivatives(quaternions))
    c = positions - camera[:3]
    depth = np.cross(camera[6:9], camera[9:12])
    depth = depth / (camera[3:6] @ depth)
    by_position = np.einsum("ia,iab->ib", by_place, jacobian)
    by_position += m0[:, None] * (c / (c**2).sum(1, keepdims=True) - 3 * depth / tau[:, None])
    # J = (F − (F c/τ) hᵀ)/τ with F the dual of the pixel's steps and τ = h·c, so that F = τJ + (F c/τ) hᵀ
    dual = np.linalg.pinv(camera[6:12].reshape(2, 3).T)
    along = np.einsum("iab,b->ia", by_jacobian, depth)
    by_tau = 2 * np.einsum("ia,ia->i", along, ray @ dual.T) - np.einsum("iab,ab->i", by_jacobian, dual)
    by_position += (by_tau[:, None] * depth - along @ dual) / tau[:, None] ** 2
    return by_density, by_position, by_scale, by_quaternion, by_place


def rotation_derivatives(quaternions: Array) -> Array:
    """Return dR/dq [splat, 4, 3, 3]; R = N/|q|² with N = (w² − |v|²) 1 + 2 vvᵀ + 2w [v]×."""
    q, eye = np.asarray(quaternions, np.float64), np.eye(3)
    levi = np.stack([np.cross(e, -eye) for e in eye])  # [k]: the matrix that crosses e_k with a vector
    w, v = q[:, 0, None, None], q[:, 1:]
    by_w = 2 * w * eye + 2 * np.einsum("ik,kab->iab", v, levi)
    by_v = [
        -2 * v[:, k, None, None] * eye + 2 * (eye[k][:, None] * v[:, None] + v[:, :, None] * eye[k]) + 2 * w * levi[k]
        for k in range(3)
    ]
    turned = rotation_matrices(q)[:, None] * 2 * q[:, :, None, None]
    return (np.stack([by_w, *by_v], 1) - turned) / (q**2).sum(1)[:, None, None, None]
