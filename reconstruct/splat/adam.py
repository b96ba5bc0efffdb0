"""What the published splat methods learn and how: bounded parameters and Adam (R²-Gaussian, Zha et al. 2024).

A unit is half the volume's widest side, so that the volume is [−1, 1]³; rates and thresholds were published for that.
Positions stay mm, and P stays P: densities are learned per unit and divided by its length.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from reconstruct.splat.model import Splats
from reconstruct.splat.project import Gradient

Array = NDArray[np.float32]
Parameters = Mapping[str, Array]
"""Positions [splat, 3], scales, rotations [splat, 4] and densities [splat, channel], before activation."""

RATES = {"positions": 2e-4, "scales": 5e-3, "rotations": 1e-3, "densities": 0.01}
"""Learning rates at the start, per unit of length for positions."""
DECAY = 0.1  # of a rate over the whole run
FIRST, SECOND, EPS = 0.9, 0.999, 1e-15
SCALES = (0.0005, 0.5)  # units, R2-Gaussian's bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class Activation:
    """Turns what is learned into splats: ρ = softplus(x)/unit, s = low + (high − low)·sigmoid(x), and q as it is.

    `unit` is mm a unit; `bounds` are the least and the greatest scale in mm.
    """

    unit: float
    bounds: tuple[float, float]

    def splats(self, parameters: Parameters) -> Splats:
        """Return the splats that `parameters` stand for."""
        low, high = self.bounds
        scales = low + (high - low) * expit(parameters["scales"])
        return Splats(
            positions=parameters["positions"],
            scales=scales.astype(np.float32),
            densities=(np.logaddexp(0, parameters["densities"]) / self.unit).astype(np.float32),
            rotations=parameters["rotations"],
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
        density = splats.densities.astype(np.float64) * self.unit
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
        low, high = self.bounds
        share = (splats.scales - low) / (high - low)
        inner = share * (1 - share) * (high - low) / splats.scales  # d log s/dx
        return {
            "positions": by_splats.positions,
            "scales": (by_splats.log_scales * inner).astype(np.float32),
            "rotations": by_splats.rotations,
            "densities": (by_splats.densities * expit(parameters["densities"]) / self.unit).astype(np.float32),
        }


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
    unit = unit_length(geometry)
    return Activation(unit=unit, bounds=(SCALES[0] * unit, SCALES[1] * unit))


def no_moments(parameters: Parameters) -> Moments:
    """Return the moments before the first step."""
    zeros = {name: np.zeros_like(value) for name, value in parameters.items()}
    return Moments(first=zeros, second=zeros)


def rate(start: float | Array, step: int, steps: int) -> float | Array:
    """Return the learning rate at `step` of `steps`, which falls from `start` to a tenth of it."""
    return start * DECAY ** (min(step, steps) / steps)


def step(
    parameters: Parameters, gradient: Parameters, moments: Moments, rates: Mapping[str, float | Array]
) -> tuple[dict[str, Array], Moments]:
    """Take one step of Adam (Kingma and Ba 2015) and return the new parameters and moments.

    `rates` are numbers, or arrays that broadcast, such as one rate a channel.
    """
    count, out, first, second = moments.steps + 1, {}, {}, {}
    for name, value in parameters.items():
        g = gradient[name]
        first[name] = FIRST * moments.first[name] + (1 - FIRST) * g
        second[name] = SECOND * moments.second[name] + (1 - SECOND) * g * g
        root = np.sqrt(second[name] / np.float32(1 - SECOND**count)) + np.float32(EPS)
        change = rates[name] / (1 - FIRST**count) * (first[name] / root)
        out[name] = (value - change).astype(np.float32)
    return out, Moments(first=first, second=second, steps=count)
