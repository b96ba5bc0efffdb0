"""What the published splat methods learn and how: bounded parameters and Adam (R²-Gaussian, Zha et al. 2024).

A unit is half the volume's widest side, in which the published rates and thresholds take the volume to be [−1, 1]³.
There lengths and P are both divided by the unit, so a density keeps its value in 1/mm: it is learned in 1/mm here.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.kernels import adam_cpu as kernels
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Gradient

Array = NDArray[np.float32]
Parameters = Mapping[str, Array]
"""Positions [splat, 3], scales, rotations [splat, 4] and densities [splat, channel], before activation."""

RATES = {"positions": 2e-4, "scales": 5e-3, "rotations": 1e-3, "densities": 0.01}
"""Learning rates at the start, per unit of length for positions."""
DECAY = 0.1  # of a rate over the whole run
ROWS = 256  # splats that a thread steps at once
SCALES = (0.0005, 0.5)  # shares of the volume's widest side, R2-Gaussian's bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class Activation:
    """Turns what is learned into splats: ρ = softplus(x) in 1/mm, s = low + (high − low)·sigmoid(x), and q as it is.

    `bounds` are the least and the greatest scale in mm.
    """

    bounds: tuple[float, float]

    def splats(self, parameters: Parameters) -> Splats:
        """Return the splats that `parameters` stand for."""
        scales, densities = np.empty_like(parameters["scales"]), np.empty_like(parameters["densities"])
        kernels.activate(parameters["scales"], parameters["densities"], self._numbers(), scales, densities)
        return Splats(
            positions=parameters["positions"], scales=scales, densities=densities, rotations=parameters["rotations"]
        )

    def parameters(self, splats: Splats) -> dict[str, Array]:
        """Return the parameters that stand for `splats`; scales are moved within the bounds, by 1e-4 of them.

        Raises InputError for round splats and densities that are not positive.
        """
        if splats.rotations is None:
            raise InputError("the published methods learn rotations; expected splats that have some")
        if not np.all(splats.densities > 0):
            raise InputError(f"densities must be positive to be a softplus, got {splats.densities.min()}")
        low, high = self.bounds
        share = np.clip((splats.scales.astype(np.float64) - low) / (high - low), 1e-4, 1 - 1e-4)
        density = splats.densities.astype(np.float64)
        return {
            "positions": splats.positions,
            "scales": np.log(share / (1 - share)).astype(np.float32),
            "rotations": splats.rotations,
            "densities": (density + np.log(-np.expm1(-density))).astype(np.float32),
        }

    def gradient(self, parameters: Parameters, splats: Splats, by_splats: Gradient) -> dict[str, Array]:
        """Take a gradient by `splats` to their `parameters`."""
        if by_splats.rotations is None:
            raise InputError("the published methods learn rotations; expected a gradient in them")
        scales, densities = np.empty_like(parameters["scales"]), np.empty_like(parameters["densities"])
        given = (splats.scales, parameters["densities"], by_splats.log_scales, by_splats.densities)
        kernels.through(given, self._numbers(), scales, densities)
        return {
            "positions": by_splats.positions,
            "scales": scales,
            "rotations": by_splats.rotations,
            "densities": densities,
        }

    def _numbers(self) -> tuple[np.float32, np.float32]:
        """Return the least scale and the range of scales."""
        low, high = self.bounds
        return np.float32(low), np.float32(high - low)


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Adam's running means of the gradient and of its square, by name, after `steps` steps."""

    first: Mapping[str, Array]
    second: Mapping[str, Array]
    steps: int = 0


def unit_length(geometry: Geometry) -> float:
    """Return half the widest side of the volume in mm."""
    return max(geometry.s_voxel) / 2


def activation(geometry: Geometry) -> Activation:
    """Return R2-Gaussian's activations in the volume of `geometry`."""
    side = max(geometry.s_voxel)
    return Activation(bounds=(SCALES[0] * side, SCALES[1] * side))


def no_moments(parameters: Parameters) -> Moments:
    """Return the moments before the first step."""
    first, second = ({name: np.zeros_like(value) for name, value in parameters.items()} for _ in range(2))
    return Moments(first=first, second=second)


def rate(start: float | Array, step: int, steps: int) -> float | Array:
    """Return the learning rate at `step` of `steps`, which falls from `start` to a tenth of it."""
    return start * DECAY ** (min(step, steps) / steps)


def step(parameters: Parameters, gradient: Parameters, moments: Moments, rates: Mapping[str, float | Array]) -> Moments:
    """Take one step of Adam (Kingma and Ba 2015): parameters and moments change in place; return them counted on.

    `rates` are numbers, or one a channel (the last axis).
    """
    count = moments.steps + 1
    corrections = np.float32(1 / (1 - kernels.FIRST**count)), np.float32(1 / (1 - kernels.SECOND**count))
    for name, value in parameters.items():
        changed = value, moments.first[name], moments.second[name]
        assert all(array.flags.c_contiguous for array in changed)  # else reshaping would copy
        x, first, second = (array.reshape(-1) for array in changed)
        of_channel = np.full(value.shape[-1], rates[name], np.float32)
        kernels.step(x, gradient[name].reshape(-1), first, second, np.tile(of_channel, ROWS), corrections)
    return dataclasses.replace(moments, steps=count)
