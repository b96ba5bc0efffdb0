"""How a scan is simulated and which ground truth is written beside it."""

from typing import Annotated

import msgspec

from ctsim.errors import InputError


class Simulation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Accuracy of the simulation.

    `tolerance` bounds the error of P = −ln(signal/open) made by replacing the fine spectrum with Gauss
    nodes. `subrays` is the largest number of rays that first measure a pixel on the edge of a solid (1: central
    rays only). Where the error in P estimated from their spread exceeds `edge_tolerance`, up to 16 times as many
    follow (infinity: none follow). With `skip` off everything is computed even where it cannot matter: the
    result is the same within `tolerance`, only slower.
    """

    tolerance: Annotated[float, msgspec.Meta(ge=1e-7, le=1e-1)] = 1e-4
    subrays: Annotated[int, msgspec.Meta(ge=1, le=256)] = 34
    edge_tolerance: Annotated[float, msgspec.Meta(ge=1e-3)] = 0.03
    skip: bool = True


class Truth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which ground truth is written beside the counts; each costs nothing unless asked for.

    `twin` is the scan without its metal inserts and with the same noise streams, so that open pixels are the same to
    the count (but for the noise model "tigre", which normalises each scan by its own largest P); `mono_kev` lists
    energies (keV) of noise-free monochromatic line integrals; `trace` marks the pixels whose rays meet
    metal, `metal_path` is their length in metal (mm), `paths` the length in every material (mm).
    """

    twin: bool = True
    noise_free: bool = False
    scatter_free: bool = False
    mono_kev: tuple[float, ...] = ()
    trace: bool = False
    metal_path: bool = False
    paths: bool = False

    def __post_init__(self) -> None:
        if any(not 1.0 <= e <= 800.0 for e in self.mono_kev):
            raise InputError(f"mono_kev must lie within 1…800 keV, got {self.mono_kev}")
        names = [f"{e:g}" for e in self.mono_kev]  # of the files
        if twice := [n for n in names if names.count(n) > 1]:
            raise InputError(f"mono_kev: two energies write mono_{twice[0]}kev.tif; expected energies of unequal names")
