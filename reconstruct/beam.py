"""A tube and a detector that the user knows, whole or in part."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import full_rule
from ctsim.beam.spectrum import Tube, spectrum
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.materials import E_MIN
from ctsim.reconstruct.settings import about

ROUNDED = 1e-6  # keV
Given = Mapping[str, Any] | None
TubeTable = Annotated[
    dict[str, Any] | None,
    about("tube as in a scene file; missing keys: the simulator's defaults, kvp: the scan's highest energy"),
]
DetectorTable = Annotated[
    dict[str, Any] | None, about("detector as in a scene file; missing keys: the simulator's defaults")
]
AssumedDetector = Annotated[
    dict[str, Any] | None,
    about(
        'detector as in a scene file, for the responses "known" and "tube"; missing keys: the simulator\'s defaults; '
        'null with "tube": 0.2 mm of GOS'
    ),
]
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


def check_tables(tube: Given, detector: Given) -> None:
    """Raise InputError, as `known_tube` and `known_detector` do, for tables that are wrong for every scan."""
    if tube is not None:
        known_tube(tube, Tube().kvp)
    if detector is not None:
        known_detector(detector)


def detected(
    tube: Given | Tube, detector: Given | Detector, e_max: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the energies (keV) of a tube's spectrum and the share of the detected signal at each.

    Raises InputError as `known_tube` and `known_detector` do.
    """
    seen = full_rule(spectrum(known_tube(tube, e_max)), known_detector(detector))
    # a kVp found for e_max is rounded, which may leave its highest bin above it in the seventh decimal
    return np.where(np.abs(seen.energies - e_max) < ROUNDED, e_max, seen.energies), seen.w1


def refuse_beam(response: str | None, tube: Given | Tube, detector: Given | Detector) -> None:
    """Raise InputError for a tube or a detector that comes with a response which does not read it."""
    for name, table, readers in (("tube", tube, ("known",)), ("detector", detector, ("known", "tube"))):
        if response not in readers and table is not None:
            expected = " or ".join(map(repr, readers))
            raise InputError(f"{name}: only for response {expected}, got it with response {response!r}")


def refuse_filtration(response: str | None, filtration: float | None) -> None:
    """Raise InputError for a filtration (mm) that comes with the response "known", whose tube states its filters."""
    if response == "known" and filtration is not None:
        raise InputError("filtration: only for response 'tube', got it with response 'known'; the tube's filters count")


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
