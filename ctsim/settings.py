"""How a simulation is carried out: the settings that trade error against time."""

from typing import Annotated, Literal

import msgspec

from ctsim.errors import InputError


class Simulation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the simulator.

    `tolerance` bounds the error of P that the energy quadrature may make; `subrays` is the number of
    rays a side of a pixel on an insert's edge ("auto" lets the plan choose); `skip = false` forces
    every step on, which must change nothing but the time.
    """

    tolerance: Annotated[float, msgspec.Meta(gt=0, le=1)] = 1e-4
    subrays: Annotated[int, msgspec.Meta(ge=1, le=64)] | Literal["auto"] = "auto"
    skip: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.tolerance <= 1:
            raise InputError(f"tolerance must be within (0, 1], got {self.tolerance}")
        if self.subrays != "auto" and not 1 <= self.subrays <= 64:
            raise InputError(f"subrays must be 'auto' or 1 to 64, got {self.subrays}")
