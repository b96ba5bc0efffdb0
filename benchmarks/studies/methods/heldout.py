"""The simulated held-out views of scans, kept in a results folder: with scatter they take as long as a scan.

A file is named after its scan and holds the arrays of `HeldOut`, in the way of a run's intermediates. Its identity is
that of the scan's data, of the simulator's code and of the protocols, so that others are simulated again.
"""

import hashlib
from pathlib import Path

import numpy as np

from ctsim.benchmarks.scores.projection import REGIONS, TARGETS, HeldOut, half_way
from ctsim.benchmarks.scores.score import VERSION
from ctsim.benchmarks.studies.methods.volumes import read_intermediates, write_intermediates
from ctsim.dataset.sources import source_hash
from ctsim.dataset.store import StoredScan
from ctsim.errors import InputError

NOTES = ("reference", "note")


def path_of(stored: StoredScan, results: Path) -> Path:
    """Return the path of a scan's held-out views."""
    return results / "held_out" / f"{stored.name}.npz"


def keep(views: HeldOut, stored: StoredScan, results: Path) -> None:
    """Write held-out views, whole or not at all."""
    arrays = {f"truth/{name}": views.truths[name] for name in TARGETS}
    arrays |= {f"region/{name}": views.regions[name] for name in REGIONS}
    arrays |= {name: np.array(getattr(views, name)) for name in NOTES}
    write_intermediates(path_of(stored, results), arrays, _identity(stored))


def kept(stored: StoredScan, results: Path) -> HeldOut | None:
    """Return the held-out views of this scan; None where the file is missing, damaged, or of other data or code."""
    geometry = half_way(stored.geometry)
    if isinstance(geometry, str):
        return None
    try:
        found = read_intermediates(path_of(stored, results), _identity(stored))
        truths = {name: found[f"truth/{name}"] for name in TARGETS}
        regions = {name: found[f"region/{name}"] for name in REGIONS}
        notes = {name: str(found[name]) for name in NOTES}
    except (InputError, KeyError):
        return None
    shapes = {array.shape for array in (*truths.values(), *regions.values())}
    if shapes != {geometry.shape} or any(mask.dtype != np.bool_ for mask in regions.values()):
        return None
    return HeldOut(geometry=geometry, truths=truths, regions=regions, **notes)


def _identity(stored: StoredScan) -> str:
    return hashlib.sha256(f"{stored.content_hash} {source_hash()} {VERSION}".encode()).hexdigest()
