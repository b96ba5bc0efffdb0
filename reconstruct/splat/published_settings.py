"""What the published splat methods are told: R²-Gaussian (Zha et al. 2024) and its polychromatic successor.

"paper" learns two densities a splat, ρ(Ē) = ρa + ρb·Ē⁻³, and the response's r and Ē_th; "r2" one density, no response,
and adds 0.05 TV of a brick. The steps between, as the successor's ablation has them, are a change of `basis` and
`response`: see `docs/explanation/splats.md`.

R2-Gaussian scales scenes to [−1, 1]³. Here lengths stay mm and P stays P, which is not homogeneous once it is
polychromatic, so densities are learned per unit, half the volume's widest side.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, TypedDict, get_args

from ctsim.errors import InputError
from ctsim.reconstruct.beam import Given, detected, refuse_beam
from ctsim.reconstruct.splat import response as responses
from ctsim.reconstruct.splat.densify import Schedule
from ctsim.reconstruct.splat.loss import TV_SHARE
from ctsim.reconstruct.splat.response import Response, make_response

Preset = Literal["paper", "r2"]
Basis = Literal["paper", "klein-nishina", "constant", "photoelectric"]
ResponseName = responses.Name | Literal["flat"]
FLAT = (1.0, 1.0)  # θ of the paper's response that makes all nodes weigh alike
CHANNELS = {"paper": "ab", "klein-nishina": "ab", "constant": "a", "photoelectric": "b"}
START, ALONE = {"a": 0.075, "b": 0.0075}, 0.15  # of the FDK volume's values, of two densities and of one
RATES = {"a": 0.01, "b": 0.1}  # learning rates of the densities
VOXELS_A_SPLAT = 4  # at least, where splats are added


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What a preset says.

    `basis` is how attenuation depends on energy: as in `make_response`, with two densities a splat; "constant", not
    at all; "photoelectric", as Ē⁻³. `response` is one of `make_response`, or "flat": all nodes alike, nothing to learn.
    `theta` starts the response, None its own start; it stays there where `learn_response` is False. `e_max` (keV)
    replaces the scan's. `readout` is the energy in keV at which the volume is read, None for Ē = 1, or "hardened".
    `held_out` views are kept from the fit, which then ends when they have not been met better for `patience` passes,
    and returns what met them best. `checkpoints` is a folder where an unfinished fit is kept, "" for none. `schedule`
    is that of `schedule_steps` steps. Raises InputError for values that make no sense.
    """

    steps: int = 20_000
    schedule_steps: int = 20_000
    seed: int = 0
    seconds: float = math.inf
    response: ResponseName = "paper"
    basis: Basis = "paper"
    nodes: int | None = None
    theta: tuple[float, ...] | None = None
    learn_response: bool = True
    e_max: float | None = None
    tube: Given = None
    detector: Given = None
    readout: float | Literal["hardened"] | None = None
    held_out: int = 0
    patience: int = 5
    checkpoints: str = ""
    n_splats: int = 50_000
    tv_share: float = 0.0
    schedule: Schedule = field(default_factory=Schedule)

    def __post_init__(self) -> None:
        for name in ("steps", "schedule_steps", "n_splats", "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("seconds", "tv_share", "held_out"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} must be at least 0, got {getattr(self, name)}")
        for name, known in (("basis", tuple(CHANNELS)), ("response", (*get_args(responses.Name), "flat"))):
            if getattr(self, name) not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        if self.response == "mono" and self.basis != "constant":
            raise InputError(f"response 'mono' knows one energy: basis must be 'constant', got {self.basis!r}")
        if self.response == "flat" and self.theta is not None:
            raise InputError(f"response 'flat' has no theta, got {self.theta}")
        refuse_beam(self.response, self.tube, self.detector)
        if isinstance(self.readout, str) and self.readout != "hardened":
            raise InputError(f"readout must be 'hardened' or an energy in keV, got {self.readout!r}")
        if isinstance(self.readout, int | float) and not (math.isfinite(self.readout) and self.readout > 0):
            raise InputError(f"readout must be 'hardened' or a positive energy in keV, got {self.readout}")

    @property
    def channels(self) -> str:
        """The path values that splats have a density for."""
        return CHANNELS[self.basis]

    def densification(self, n_voxel: tuple[int, int, int]) -> Schedule:
        """Return the schedule for the number of steps and the grid [z, y, x].

        It begins as published, for until a few hundred steps of Adam have put the densities right, the loss pulls at
        every splat; it ends at the published share of the steps; and below 126³ voxels the cap falls with them.
        """
        last = round(self.schedule.last * self.steps / self.schedule_steps)
        most = min(self.schedule.most, max(self.n_splats, math.prod(n_voxel) // VOXELS_A_SPLAT))
        return dataclasses.replace(self.schedule, last=last, most=most)

    def make_response(self, e_max: float) -> Response:
        """Build the response for a scan of greatest energy `e_max` (keV)."""
        flat, e_max = self.response == "flat", e_max if self.e_max is None else self.e_max
        return make_response(
            "paper" if self.response == "flat" else self.response,
            e_max=e_max,
            basis="klein-nishina" if self.basis == "klein-nishina" else "paper",
            nodes=self.nodes,
            theta=FLAT if flat else self.theta,
            spectrum=detected(self.tube, self.detector, e_max) if self.response == "known" else None,
        )

    @property
    def learns(self) -> bool:
        """Whether the response is learned: where it makes a difference."""
        return self.learn_response and self.response != "flat" and self.basis != "constant"


PRESETS: dict[Preset, Settings] = {
    "paper": Settings(),
    "r2": Settings(steps=30_000, schedule_steps=30_000, response="mono", basis="constant", tv_share=TV_SHARE),
}


class Changes(TypedDict, total=False):
    """What may be changed of a preset, as in `Settings`; None leaves it."""

    response: ResponseName | None
    basis: Basis | None
    nodes: int | None
    theta: tuple[float, ...] | None
    learn_response: bool | None
    e_max: float | None
    tube: Given
    detector: Given
    steps: int | None
    seconds: float | None
    seed: int | None
    readout: float | Literal["hardened"] | None
    held_out: int | None
    patience: int | None
    checkpoints: str | None
    n_splats: int | None


def changed(preset: str, changes: Changes) -> Settings:
    """Return the settings of a preset with changes.

    Raises InputError for another preset, for what is no setting, and for values that make no sense.
    """
    if preset not in PRESETS:
        raise InputError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    for name in changes:
        if name not in Changes.__annotations__:
            raise InputError(f"the preset {preset!r} has no {name!r}: expected {', '.join(Changes.__annotations__)}")
    given: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
    if "theta" in given:
        given["theta"] = tuple(given["theta"])
    return dataclasses.replace(PRESETS[preset], **given)
