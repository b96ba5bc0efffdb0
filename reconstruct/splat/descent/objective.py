"""The loss of one view that the published splat methods go down, and its gradient.

The images that it compares are P over `unit`, half the volume's widest side in mm: the P of R2-Gaussian's scenes of
[−1, 1]³, which its weight and range of SSIM (1) and its threshold of densification are for. Where the publications
leave it open: clamped pixels are 0 in both images, and TV pulls at densities only, not at places and shapes.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.splat import response as responses
from ctsim.reconstruct.splat.descent import adam
from ctsim.reconstruct.splat.descent.adam import Activation, Array
from ctsim.reconstruct.splat.descent.loss import brick, l1_ssim, total_variation
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.published_settings import Settings
from ctsim.reconstruct.splat.response import Response
from ctsim.reconstruct.splat.volume import voxelise, voxelise_adjoint
from ctsim.types import Scan

SSIM_RANGE = 1.0  # of P over the unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """A view's loss, its gradients by what is learned and by θ [T], and by the centres' places in pixels [splat]."""

    loss: float
    parameters: dict[str, Array]
    theta: NDArray[np.float64]
    centres: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
    """The loss of one view: line integrals `p`, 0 where they do not count, and which do, `valid`, [view, v, u].

    `unit` is half the volume's widest side in mm, `greatest` the greatest P that counts.
    """

    settings: Settings
    projector: Projector
    activation: Activation
    p: NDArray[np.float32]
    valid: NDArray[np.bool_]
    greatest: float
    unit: float

    @classmethod
    def of(cls, scan: Scan, settings: Settings) -> "Objective":
        """Take the logarithm of a scan."""
        p, clamped = line_integrals(scan, slice(None))
        valid = ~clamped.numpy()
        counted = np.where(valid, p.numpy(), np.float32(0))
        return cls(
            settings=settings,
            projector=Projector(geometry=scan.geometry, tolerance=np.inf, box=False),
            activation=adam.activation(scan.geometry),
            p=counted,
            valid=valid,
            greatest=max(float(counted.max(initial=0.0)), 1e-6),
            unit=adam.unit_length(scan.geometry),
        )

    def __call__(self, parameters: Mapping[str, Array], response: Response, view: int, step: int) -> Terms:
        """Return the loss and gradients of `view`; `step` chooses the brick of TV."""
        splats = self.activation.splats(parameters)
        paths = self.paths(splats, view)
        p, slopes = self.line_integrals(paths, response)
        valid, n_u = self.valid[view], self.p.shape[2]
        share = np.float32(1 / self.unit)
        value, by_p = l1_ssim(np.where(valid, p[:, :n_u] * share, np.float32(0)), self.p[view] * share, SSIM_RANGE)
        pull = np.zeros_like(p)
        pull[:, :n_u] = by_p * valid * share
        by_theta = np.zeros(0)
        if self.settings.learns and response.trainable:
            by_theta = responses.theta_gradient(response, *self._both(paths), pull)
        images = np.stack([pull * slope for slope in slopes])
        by_splats = self.projector.gradient(splats, images, view)
        if self.settings.tv_share:
            tv, by_densities = self._tv(splats, step)
            value += self.settings.tv_share * tv
            by_splats = dataclasses.replace(by_splats, densities=by_splats.densities + by_densities)
        return Terms(
            loss=value,
            parameters=self.activation.gradient(parameters, splats, by_splats),
            theta=by_theta,
            centres=by_splats.centres,
        )

    def paths(self, splats: Splats, view: int) -> Array:
        """Return the path values [channel, v, u + WIDTH]."""
        return self.projector.forward(splats.shapes(), splats.densities, [view])[0]

    def line_integrals(self, paths: Array, response: Response) -> tuple[Array, list[Array] | list[np.float32]]:
        """Return P [v, u + WIDTH], and its derivative by each channel's path value."""
        if self.settings.basis == "constant":
            return paths[0], [np.float32(1)]  # for any response, whose shares sum to 1
        p, by_a, by_b = responses.evaluate(response, *self._both(paths))
        return p, [by_b] if self.settings.basis == "photoelectric" else [by_a, by_b]

    def misfit(self, splats: Splats, response: Response, views: list[int]) -> float:
        """Return the mean |P − p| of some views."""
        total, n_u = 0.0, self.p.shape[2]
        for view in views:
            p, _ = self.line_integrals(self.paths(splats, view), response)
            total += float(np.abs(p[:, :n_u] - self.p[view]).sum(where=self.valid[view], dtype=np.float64))
        return total / max(int(self.valid[views].sum()), 1)

    def _both(self, paths: Array) -> tuple[Array, Array]:
        """Return La and Lb [v, u + WIDTH]; a channel without densities is 0."""
        return (np.zeros_like(paths[0]), paths[0]) if len(paths) == 1 else (paths[0], paths[1])

    def _tv(self, splats: Splats, step: int) -> tuple[float, Array]:
        """Return TV of a brick of the volume in 1/mm, and the settings' share of its gradient by densities."""
        part = brick(self.projector.geometry, stream(self.settings), step)
        volume = voxelise(splats, part, splats.densities.sum(1, keepdims=True), mean=False)[0]
        tv, by_volume = total_variation(volume)
        scaled = (by_volume * self.settings.tv_share).astype(np.float32)
        return tv, voxelise_adjoint(splats, part, scaled[None], mean=False)


def stream(settings: Settings) -> str:
    """Return the name that all random numbers of a run hang on."""
    return f"published-{settings.seed}"
