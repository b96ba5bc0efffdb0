"""What scan.json says of a scan: its geometry and the numbers that counts are read with."""

import math
import numbers
from pathlib import Path
from typing import Annotated, Any

import msgspec

from ctsim.errors import InputError
from ctsim.geometry import Geometry

TWIN = "metal_free/"
"""Prefix of the names of what the twin without metal has for itself."""


class LabelGrid(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The grid that a phantom's body was drawn on: voxels (z, y, x), their size and the middle of the grid in mm."""

    n_voxel: tuple[int, int, int]
    d_voxel: tuple[float, float, float]
    off_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


class ScanInfo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What scan.json holds; lengths mm, energies keV.

    `dark` is the pedestal and `gain` the open signal above it, in counts; `i0` the photons per open pixel and view;
    `l0` the median water-equivalent path. `scatter_fraction` is the scattered signal over that of the open field,
    averaged over all pixels and views; older scans with scatter by Monte Carlo say 0. `view_kerma` and `scan_kerma`
    are the air kerma (mGy) at the isocentre, without the object, of a view and of the scan (None: an older scan).
    `materials` name the labels, `metal` those of them that are inserts. `notes` say what a user of the scan should
    know, such as that no view shows the metal. `seed` is that of a scan without scene.toml. `label_grid` is where the
    phantom's voxels lie (None: a phantom of exact solids, or an older scan). `held` are the views of held.tif, which a
    measured scan keeps from the methods.
    """

    geometry: Geometry
    dark: float
    i0: float
    e_max: float
    l0: Annotated[float, msgspec.Meta(ge=0)]
    gain: float | None = None
    mean_detected_kev: float | None = None
    scatter_fraction: float = 0.0
    view_kerma: Annotated[float, msgspec.Meta(gt=0)] | None = None
    scan_kerma: Annotated[float, msgspec.Meta(gt=0)] | None = None
    materials: tuple[str, ...] = ()
    metal: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    label_grid: LabelGrid | None = None
    held: Geometry | None = None

    def __post_init__(self) -> None:
        check_readings(self.dark, self.i0, self.e_max)
        if not math.isfinite(self.l0):
            raise InputError(f"l0 must be finite (mm), got {self.l0}")


def read_info(path: Path) -> ScanInfo:
    """Read scan.json.

    Raises
    ------
    InputError
        When it is missing or damaged, or says what cannot be (naming the key).
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=ScanInfo)
    except FileNotFoundError:
        raise InputError(f"{path}: missing") from None
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: damaged ({error})") from None


def check_readings(dark: Any, i0: Any, e_max: Any) -> None:
    """Raise InputError unless the pedestal is finite, and photons and energy are finite and positive."""
    if not is_number(dark):
        raise InputError(f"dark must be a finite number of counts, got {dark!r}")
    if not (is_number(i0) and i0 > 0):
        raise InputError(f"i0 must be positive and finite (photons per open pixel and view), got {i0!r}")
    if not (is_number(e_max) and e_max > 0):
        raise InputError(f"e_max must be positive and finite (keV), got {e_max!r}")


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
