"""The parameters of a field's network, and the steps of Adam that train them.

Adam is that of Kingma and Ba, ICLR 2015, arXiv:1412.6980.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray

from ctsim.reconstruct.field.encoding import Encoding

FIRST = 1e-4  # greatest first entry of a table (Müller et al. 2022)
BETAS, EPSILON = (0.9, 0.99), 1e-15  # of Adam, as Müller et al. train tables
TABLE_RATE = 2.0  # of a table, times the learning rate
Parameters = dict[str, torch.Tensor]


def first_parameters(encoding: Encoding, features: int, width: int, outputs: int, seed: int) -> Parameters:
    """Draw the parameters to start from: tables next to 0, so that all points start at squareplus(0) = 1."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(greatest: float, *shape: int) -> torch.Tensor:
        return (torch.rand(shape, generator=generator, dtype=torch.float32) * 2 - 1) * greatest

    inputs = features * len(encoding.resolutions)
    return {
        "table": drawn(FIRST, encoding.entries, features),
        "w1": drawn(1 / math.sqrt(inputs), inputs, width),
        "b1": drawn(1 / math.sqrt(inputs), width),
        "w2": drawn(1 / math.sqrt(width), width, outputs),
        "b2": torch.zeros(outputs, dtype=torch.float32),
    }


@dataclass(slots=True, kw_only=True)
class Adam:
    """Parameters on their way down, their moments, and the steps taken; `rate` is the learning rate of the network."""

    parameters: Parameters
    rate: float
    steps: int = 0
    _first: Parameters = field(init=False)
    _second: Parameters = field(init=False)

    def __post_init__(self) -> None:
        self._first = {name: torch.zeros_like(p) for name, p in self.parameters.items()}
        self._second = {name: torch.zeros_like(p) for name, p in self.parameters.items()}

    def step(self, gradients: Mapping[str, torch.Tensor], share: float) -> None:
        """Take a step with a `share` of the learning rate."""
        self.steps += 1
        one, two = (1 - beta**self.steps for beta in BETAS)
        for name, gradient in gradients.items():
            rate = self.rate * share * (TABLE_RATE if name == "table" else 1.0)
            m, v = self._first[name], self._second[name]
            m.lerp_(gradient, 1 - BETAS[0])
            v.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
            self.parameters[name].addcdiv_(m, (v / two).sqrt_().add_(EPSILON), value=-rate / one)

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that the next step depends on but the number of steps, as arrays that it changes."""
        groups = {"parameter": self.parameters, "first": self._first, "second": self._second}
        return {f"{kind}.{name}": p.numpy() for kind, group in groups.items() for name, p in group.items()}

    def restore(self, state: Mapping[str, NDArray[Any]], steps: int) -> None:
        """Go on from a state. Raises KeyError where something is missing, ValueError where it does not fit."""
        for name, own in self.state().items():
            if state[name].shape != own.shape:
                raise ValueError(f"{name} has shape {state[name].shape}, expected {own.shape}")
            own[...] = state[name]
        self.steps = steps


def rate_share(done: float) -> float:
    """Return the share of the learning rate after a share `done` of all steps: 1 up to half of them, 0.1 at the end."""
    return 10.0 ** (-2 * max(done - 0.5, 0.0))
