"""What the detector writes: photon noise, electronic noise, fixed pattern, ADC, flat field."""

from typing import Annotated, Literal

import msgspec

from ctsim.errors import InputError


class Noise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How photons become counts.

    `electronic` is the standard deviation of the electronic noise in photons that reach an open pixel.
    The ADC's open field lies at `adc_fill` and its pedestal at `pedestal`, both fractions of full
    scale; `adc_bits = None` writes float32 photons without pedestal, and so do "tigre" and "none".
    `n_flats` flats are averaged (0: a perfect flat). `fixed_pattern` is the relative standard deviation of
    the pixels' gains, `dead_fraction` the share of pixels that always read the pedestal.
    """

    model: Literal["compound", "tigre", "none"] = "compound"
    electronic: Annotated[float, msgspec.Meta(ge=0)] = 5.0
    adc_bits: Annotated[int, msgspec.Meta(ge=4, le=16)] | None = 16
    adc_fill: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.8
    pedestal: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.02
    n_flats: Annotated[int, msgspec.Meta(ge=0, le=10_000)] = 64
    fixed_pattern: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.0
    dead_fraction: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0

    def __post_init__(self) -> None:
        if self.model not in ("compound", "tigre", "none"):
            raise InputError(f"noise.model must be 'compound', 'tigre' or 'none', got {self.model!r}")
        if not 0 <= self.electronic <= 1e6:
            raise InputError(f"noise.electronic must be within [0, 1e6] photons, got {self.electronic}")
        if self.adc_bits is not None and not 4 <= self.adc_bits <= 16:
            raise InputError(f"noise.adc_bits must be within 4..16 or left out, got {self.adc_bits}")
        if not 0 <= self.pedestal < self.adc_fill <= 1:
            raise InputError(
                f"expected 0 <= noise.pedestal < noise.adc_fill <= 1, got {self.pedestal} and {self.adc_fill}"
            )
        if not 0 <= self.n_flats <= 10_000:
            raise InputError(f"noise.n_flats must be within 0..10000, got {self.n_flats}")
        if not 0 <= self.fixed_pattern <= 0.3:
            raise InputError(f"noise.fixed_pattern must be within [0, 0.3], got {self.fixed_pattern}")
        if not 0 <= self.dead_fraction < 1:
            raise InputError(f"noise.dead_fraction must be within [0, 1), got {self.dead_fraction}")
