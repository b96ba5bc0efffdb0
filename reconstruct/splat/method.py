"""Polychromatic reconstruction with Gaussian splats: the presets "fast" (ours), "paper" and "r2" (as published)."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch

from ctsim.errors import InputError
from ctsim.reconstruct.settings import keywords
from ctsim.reconstruct.splat import fast, published
from ctsim.types import Scan, Volume

PRESETS = ("fast", "paper", "r2")


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What any preset may be told; None leaves what the preset says.

    Those down to `detector` are of `ctsim.reconstruct.splat.fast.Settings`, those from `basis` on of
    `published_settings.Settings`; `seconds`, `checkpoints`, `response`, `readout`, `tube` and `detector` are of both.
    """

    preset: str = "fast"
    seconds: float = math.inf
    checkpoints: str | None = None
    response: str | None = None
    readout: float | Literal["hardened"] | None = None
    passes: tuple[int, int] | None = None
    tv: float | None = None
    fineness: float | None = None
    exact: bool | None = None
    filtration: float | None = None
    scatter: float | None = None
    tube: Mapping[str, Any] | None = None
    detector: Mapping[str, Any] | None = None
    basis: str | None = None
    nodes: int | None = None
    theta: tuple[float, ...] | None = None
    learn_response: bool | None = None
    e_max: float | None = None
    steps: int | None = None
    seed: int | None = None
    held_out: int | None = None
    patience: int | None = None
    n_splats: int | None = None

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise InputError(f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}")


@keywords(Options)
def reconstruct(scan: Scan, options: Options, device: str) -> Volume:
    """Reconstruct `scan` with splats, attenuation in 1/mm; keywords are those of `Options`.

    Details hold the volumes of ρa and ρb under "densities" and the response with its θ. Raises InputError for another
    device than the CPU, for options that the preset does not know, and for values that make no sense.
    """
    if torch.device(device).type != "cpu":
        raise InputError(f"splat runs on device 'cpu' only, got {device!r}")
    given = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    given = {name: value for name, value in given.items() if value is not None and name != "preset"}
    if options.preset != "fast":
        volume = published.reconstruct(scan, preset=options.preset, **given)
    else:
        known = [f.name for f in dataclasses.fields(fast.Settings)]
        if unknown := sorted(set(given) - set(known)):
            raise InputError(f"the preset 'fast' has no {unknown[0]!r}: expected {', '.join(known)}")
        volume = fast.reconstruct(scan, fast.Settings(**given))
    return dataclasses.replace(volume, details={"preset": options.preset, **volume.details})
