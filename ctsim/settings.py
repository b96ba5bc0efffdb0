"""How a scan is simulated and which ground truth is written with it."""

from typing import Annotated

import msgspec

from ctsim.errors import InputError

Tolerance = Annotated[float, msgspec.Meta(ge=1e-7, le=1e-1)]
Subrays = Annotated[int, msgspec.Meta(ge=1, le=256)]


class Simulation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Accuracy of the simulation."""

    tolerance: Tolerance = 1e-4
    """Largest error of P = −ln(signal/open) from replacing the fine spectrum by Gauss nodes."""
    subrays: Subrays = 34
    """Largest number of rays that first measure a pixel on the edge of a solid; 1: central rays only."""
    edge_tolerance: Annotated[float, msgspec.Meta(ge=1e-3)] = 0.03
    """Estimated error in P above which such a pixel gets up to 16 times as many rays; infinity: never."""
    spot_error: Annotated[float, msgspec.Meta(ge=1e-4, le=0.5)] = 0.02
    """Largest error at an edge, as a share of its step, of a focal spot made of points."""
    scatter_error: Annotated[float, msgspec.Meta(ge=0.002, le=0.5)] = 0.05
    """RMS error of Monte Carlo scatter (level 3) over its mean at which no more photons are followed.

    Fewer are followed if the error falls to 2e-6 of the open field first.
    """
    skip: bool = True
    """Skip what cannot matter. The result is the same within `tolerance` without, only slower."""


class Truth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which ground truth is written in addition to the references.

    The twin has the same noise streams: open pixels are the same to the count, except with the noise model "tigre".
    """

    twin: bool = True
    """The scan without its metal."""
    noise_free: bool = False
    """P without noise, with scatter."""
    scatter_free: bool = False
    """P without noise and scatter."""
    mono_kev: tuple[float, ...] = ()
    """Energies (keV) of noise-free monochromatic line integrals."""
    trace: bool = False
    """The pixels whose rays meet metal."""
    metal_path: bool = False
    """Length of each ray in metal (mm)."""
    paths: bool = False
    """Length of each ray in every material (mm)."""

    def __post_init__(self) -> None:
        if any(not 1.0 <= e <= 800.0 for e in self.mono_kev):
            raise InputError(f"mono_kev must lie within 1…800 keV, got {self.mono_kev}")
        names = [f"{e:g}" for e in self.mono_kev]  # of the files
        if twice := [n for n in names if names.count(n) > 1]:
            raise InputError(f"mono_kev: two energies write mono_{twice[0]}kev.tif; expected energies of unequal names")
