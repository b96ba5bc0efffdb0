"""What the published splat methods are told: R²-Gaussian (Zha et al. 2024) and its polychromatic successor.

The successor, `splat-paper`, learns two densities a splat, ρ(Ē) = ρa + ρb·Ē⁻³, and the response's r and Ē_th; the
baseline, `splat-r2`, one density, no response, and adds 0.05 TV of a brick. The steps between, as the successor's
ablation has them, are a change of `basis` and `response`: see `docs/explanation/splats.md`.

R2-Gaussian scales scenes to [−1, 1]³ and P with them, so that densities keep their value in 1/mm. Here lengths stay mm,
for a polychromatic P does not scale with them; the loss divides it by half the volume's widest side.
"""

import math
from typing import Annotated, Literal

import msgspec

from ctsim.errors import InputError
from ctsim.reconstruct.beam import detected, known_detector, refuse_beam
from ctsim.reconstruct.settings import about
from ctsim.reconstruct.splat import response as responses
from ctsim.reconstruct.splat.common import Common, Energy
from ctsim.reconstruct.splat.descent.densify import Schedule
from ctsim.reconstruct.splat.descent.loss import TV_SHARE
from ctsim.reconstruct.splat.response import MOST_NODES, SOFTEST, Response, make_response

Basis = Literal["paper", "klein-nishina", "constant", "photoelectric"]
ResponseName = Literal[responses.Name, "flat"]
FLAT = (1.0, 1.0)  # θ of the paper's response that makes all nodes weigh alike
CHANNELS = {"paper": "ab", "klein-nishina": "ab", "constant": "a", "photoelectric": "b"}
START, ALONE = {"a": 0.075, "b": 0.0075}, 0.15  # of the FDK volume's values, of two densities and of one
RATES = {"a": 0.01, "b": 0.1}  # learning rates of the densities
VOXELS_A_SPLAT = 4  # at least, where splats are added
MANY = 100_000_000
Steps = Annotated[int, about("steps of Adam, one view each", ge=1, le=MANY)]
ScheduleSteps = Annotated[int, about("steps that the schedule is for", ge=1, le=MANY)]
FormOfResponse = Annotated[ResponseName, about("form of the scanner's response")]
EnergyBasis = Annotated[Basis, about("how attenuation depends on energy")]
TvShare = Annotated[float, about("share of a brick's total variation in the loss", ge=0, le=1e6)]
Greatest = Annotated[float, about("", "keV", gt=SOFTEST, le=1000)]
Nodes = Annotated[int, msgspec.Meta(ge=1, le=MOST_NODES)]


class Settings(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the polychromatic method fits, as published.

    `basis` is how attenuation depends on energy: as in `make_response`, with two densities a splat; "constant", not
    at all; "photoelectric", as Ē⁻³. `response` is one of `make_response`, or "flat": all nodes alike, nothing to learn.
    `theta` starts the response, null its own start; it stays there where `learn_response` is off. `readout` null is
    Ē = 1. `held_out` views are kept from the fit, which then ends when they have not been met better for `patience`
    passes, and returns what met them best. `schedule` is that of `schedule_steps` steps.
    """

    steps: Steps = 20_000
    schedule_steps: ScheduleSteps = 20_000
    seed: Annotated[int, about("of the order of views and of the first splats", ge=0, le=2**63 - 1)] = 0
    response: FormOfResponse = "paper"
    basis: EnergyBasis = "paper"
    nodes: Annotated[Nodes | None, about("number of energies of the response; null: the form's default")] = None
    theta: Annotated[
        tuple[float, ...] | None, about("start of the response's parameters; null: the form's default")
    ] = None
    learn_response: Annotated[bool, about("learn the response's parameters")] = True
    e_max: Annotated[Greatest | None, about("greatest energy; null: the scan's", "keV")] = None
    readout: Annotated[
        Energy | Literal["hardened"] | None, about("energy at which the volume is read; null: at Ē = 1")
    ] = None
    held_out: Annotated[int, about("views that the fit does not use", ge=0, le=MANY)] = 0
    patience: Annotated[
        int, about("passes without gain on the held-out views after which the fit ends", ge=1, le=MANY)
    ] = 5
    n_splats: Annotated[int, about("splats to start with, at most", ge=1, le=MANY)] = 50_000
    tv_share: TvShare = 0.0
    schedule: Annotated[Schedule, about("when and where splats are added, and how many at most")] = Schedule()

    def __post_init__(self) -> None:
        Common.__post_init__(self)
        if self.response == "mono" and self.basis != "constant":
            raise InputError(f"basis: expected constant with response mono, which has one energy, got {self.basis!r}")
        if self.response == "flat" and self.theta is not None:
            raise InputError(f"theta: expected null with response flat, which has none, got {self.theta}")
        refuse_beam(self.response, self.tube, self.detector)
        if self.basis == "constant":
            for name, given in (("theta", self.theta), ("readout", self.readout)):
                if given is not None:
                    raise InputError(
                        f"{name}: expected null with basis constant, whose splats know no energy, got {given!r}"
                    )

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
        return msgspec.structs.replace(self.schedule, last=last, most=most)

    def make_response(self, e_max: float) -> Response:
        """Build the response for a scan of greatest energy `e_max` (keV)."""
        flat, e_max = self.response == "flat", e_max if self.e_max is None else self.e_max
        sees = known_detector(self.detector) if self.response == "tube" and self.detector is not None else None
        return make_response(
            "paper" if self.response == "flat" else self.response,
            e_max=e_max,
            basis="klein-nishina" if self.basis == "klein-nishina" else "paper",
            nodes=self.nodes,
            theta=FLAT if flat else self.theta,
            spectrum=detected(self.tube, self.detector, e_max) if self.response == "known" else None,
            detector=sees,
        )

    @property
    def learns(self) -> bool:
        """Whether the response is learned: where it makes a difference."""
        return self.learn_response and self.response != "flat" and self.basis != "constant"


class Baseline(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the baseline fits, as published."""

    steps: Steps = 30_000
    schedule_steps: ScheduleSteps = 30_000
    response: FormOfResponse = "mono"
    basis: EnergyBasis = "constant"
    tv_share: TvShare = TV_SHARE
