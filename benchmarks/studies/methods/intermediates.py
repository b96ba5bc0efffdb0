"""What a method worked with, for the pictures: a metal trace, bridged projections, a prior. No score reads it.

A method attaches them to its volume, `Volume(..., details={"intermediates": {"view": 15, "trace": ...}})`; they are
kept beside the volume as NAME.npz and stand in no record. A method that attaches none is drawn without.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.arrayfile import read_arrays
from ctsim.durable import replacing
from ctsim.errors import InputError
from ctsim.geometry import Geometry

KEY = "intermediates"
NAMES = ("view", "trace", "projection", "prior")
_RUN = "run"

Intermediates = dict[str, NDArray[Any]]


def taken(details: Mapping[str, Any], geometry: Geometry) -> Intermediates:
    """Return what a method attached, checked; {} where it attached nothing.

    `view` is an index, `trace` (not 0 in the metal's shadow) and `projection` (what was backprojected, −ln) are
    that view's [v, u], `prior` is [z, y, x] in 1/mm. Raises InputError for other names, shapes and views.
    """
    given = details.get(KEY, {})
    shapes = {"view": (), "trace": geometry.n_detector, "projection": geometry.n_detector, "prior": geometry.n_voxel}
    found = {}
    for name, value in given.items():
        if name not in shapes:
            raise InputError(f"details[{KEY!r}] has no entry {name!r}: expected {', '.join(NAMES)}")
        array = np.asarray(value)
        if array.shape != shapes[name]:
            raise InputError(f"details[{KEY!r}][{name!r}] has shape {array.shape}, expected {shapes[name]}")
        kinds = {"view": np.int64, "trace": np.bool_}
        found[name] = np.array(array != 0 if name == "trace" else array, kinds.get(name, np.float32))
    if found.keys() & {"trace", "projection"} and "view" not in found:
        raise InputError(f"details[{KEY!r}]: a trace or a projection needs its 'view'")
    if "view" in found and not 0 <= found["view"] < geometry.n_views:
        raise InputError(f"details[{KEY!r}]['view'] is {found['view']}, expected 0 … {geometry.n_views - 1}")
    return found


def path_of(volume: Path) -> Path:
    """Return where the intermediates of a kept volume lie."""
    return volume.with_suffix(".npz")


def write(path: Path, found: Intermediates, identity: str) -> None:
    """Write intermediates with the identity of their run, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {**found, _RUN: np.array(identity)}
    with replacing(path) as new, new.open("wb") as file:
        np.savez(file, **arrays)


def read(path: Path, identity: str) -> Intermediates:
    """Read the intermediates of a run; {} where it left none, or the file is another run's.

    Raises InputError where the file is damaged.
    """
    try:
        found = read_arrays(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); delete it or run the method again with --force") from None
    return found if str(found.pop(_RUN, "")) == identity else {}
