"""A tube and a detector that the user knows, whole or in part."""

import math
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from ctsim.detector import Detector
from ctsim.errors import InputError
from ctsim.materials import E_MIN
from ctsim.spectrum import Tube

Given = Mapping[str, Any] | None
Kind = TypeVar("Kind", Tube, Detector)


def known_tube(given: Given | Tube, e_max: float) -> Tube:
    """Return a tube from a scene file's table; what it leaves out is the default, kVp that of `e_max` (keV).

    Raises InputError for keys and values that Tube refuses, and for a bow-tie, behind which every pixel has a spectrum
    of its own.
    """
    tube = _of("tube", given, Tube, {"kvp": _kvp(e_max)})
    if tube.bowtie is not None:
        raise InputError("tube: one table serves all pixels only without a bow-tie, got tube.bowtie")
    return tube


def known_detector(given: Given | Detector) -> Detector:
    """Return a detector from a scene file's table; raises InputError for keys and values that Detector refuses."""
    return _of("detector", given, Detector, {})


def _of(name: str, given: "Given | Kind", kind: type[Kind], defaults: dict[str, Any]) -> Kind:
    given = {} if given is None else given
    if isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise InputError(f"{name}: expected a table such as {defaults or {'kind': 'gos'}}, got {given!r}")
    try:
        return msgspec.convert({**defaults, **given}, kind)
    except (msgspec.ValidationError, InputError) as error:
        raise InputError(f"{name}: {error}") from None


def _kvp(e_max: float) -> float:
    """Return the kVp whose highest bin, of at most 0.25 keV to 100 kVp, is centred on `e_max`."""
    kvp = e_max
    for _ in range(3):
        n = math.ceil((kvp - E_MIN) / max(0.25, kvp / 400))
        kvp = e_max + (kvp - E_MIN) / n / 2
    return round(kvp, 6)  # 19.9999999 would be outside the table that begins at 20
