"""What a results folder keeps of one scan: the truth if it has one, the display windows, and a volume per method.

Arrays are memory-mapped and read on access.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.protocol import Truth, truth_of
from ctsim.benchmarks.studies.methods.bare import window_of
from ctsim.benchmarks.studies.methods.panels import Look, cut, look_of
from ctsim.benchmarks.studies.methods.plan import repetition
from ctsim.benchmarks.studies.methods.records import RunRecord, latest, read
from ctsim.benchmarks.studies.methods.volumes import identity_of, map_volume, own_at_50kev
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """One method's record and its volume [z, y, x] in 1/mm, and its volume at 50 keV if the method knows energies."""

    record: RunRecord
    values: NDArray[Any]
    at_50kev: NDArray[Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A simulated scan and the methods' volumes of it. `look` holds the window's top and the error scale in 1/mm."""

    stored: StoredScan
    scene: str
    seed: int
    truth: Truth
    look: Look
    kept: tuple[Kept, ...]

    @property
    def reference(self) -> NDArray[np.float32]:
        """The effective-spectrum reference, [z, y, x] in 1/mm."""
        return self.truth.references["effective"]

    @property
    def at(self) -> tuple[int, int, int]:
        """The slices (z, y, x) through the most metal."""
        return cut(self.truth.metal, self.truth.body)

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """What is shown (z, y, x): the judged body."""
        judged = self.truth.judged
        spans = (np.flatnonzero(judged.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3))
        z, y, x = (slice(int(span[0]), int(span[-1]) + 1) for span in spans)
        return z, y, x

    @property
    def low(self) -> float:
        """The window's lower end in 1/mm."""
        return 0.0

    @property
    def top(self) -> float:
        """The window's upper end in 1/mm."""
        return self.look.top

    def hounsfield(self, value: float) -> float | None:
        """Return an attenuation (1/mm) in HU of the scan's water; None where its spectrum is not known."""
        water = self.look.water
        return None if water is None else 1000 * (value / water - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A measured scan, which has no truth, and the methods' volumes of it in the window `low` to `top` (1/mm)."""

    stored: StoredScan
    scene: str
    kept: tuple[Kept, ...]
    low: float
    top: float

    @property
    def at(self) -> tuple[int, int, int]:
        """The middle slices (z, y, x)."""
        z, y, x = (n // 2 for n in self.stored.geometry.n_voxel)
        return z, y, x

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """What is shown (z, y, x): everything."""
        z, y, x = (slice(0, n) for n in self.stored.geometry.n_voxel)
        return z, y, x


def case_of(stored: StoredScan, records: Sequence[RunRecord], results: Path) -> Case:
    """Collect what `results` keeps of a scan; volumes of other data, parameters or code are left out."""
    scene, seed = repetition(stored)
    truth = truth_of(stored)
    look = look_of(truth, None, np.zeros(0, np.bool_), effective_attenuation(stored))
    kept = _kept_of(stored, records, results)
    return Case(stored=stored, scene=scene, seed=seed, truth=truth, look=look, kept=kept)


def _kept_of(stored: StoredScan, records: Sequence[RunRecord], results: Path) -> tuple[Kept, ...]:
    kept = []
    for record in latest(records):
        path = results / record.volume if record.volume else None
        mine = record.task.data == stored.content_hash and record.run.variant == "metal" and record.scores
        if mine and path is not None and identity_of(path) == record.identity:
            own = own_at_50kev(path, record.identity)
            at_50kev = None if own is None else map_volume(own)
            kept.append(Kept(record=record, values=map_volume(path), at_50kev=at_50kev))
    return tuple(kept)


def _measured(stored: StoredScan, records: Sequence[RunRecord], results: Path) -> Measured | None:
    """Collect what `results` keeps of a measured scan; None where it keeps nothing, which leaves no window."""
    if not (kept := _kept_of(stored, records, results)):
        return None
    low, top = window_of(kept[0].values)
    return Measured(stored=stored, scene=repetition(stored)[0], kept=kept, low=low, top=top)


def first_cases(data: Path, records: Sequence[RunRecord], results: Path) -> Iterator[Case | Measured]:
    """Yield one case per scene: the first repetition with a kept volume; scenes without one are left out.

    Raises InputError where `data` holds none of the scans that `results` measured.
    """
    folders = list_scans(data)
    known = {record.task.data for record in latest(records)}
    seen: set[str] = set()
    met = False
    for stored in map(open_scan, folders):
        met |= stored.content_hash in known
        if stored.content_hash not in known or repetition(stored)[0] in seen:
            continue
        case = (case_of if stored.has_truth else _measured)(stored, records, results)
        if case is not None and case.kept:
            seen.add(case.scene)
            yield case
    if not met:
        raise InputError(f"{data}: none of its {len(folders)} scans is one that {results} has records of")


def open_case(data: Path, results: Path, scene: str | None = None) -> Case:
    """Open one scan by its name (None: the first with a kept volume).

    Raises InputError where there is no such scan or no volume of it is kept.
    """
    records = read(results)
    names = []
    for stored in map(open_scan, list_scans(data)):
        names.append(stored.name)
        if scene == stored.name and not stored.has_truth:
            raise InputError(f"{data}: {scene} is a measured scan without truth, which is not shown here")
        if stored.has_truth and scene in (None, stored.name) and (case := case_of(stored, records, results)).kept:
            return case
    if scene is not None and scene not in names:
        raise InputError(f"{data}: there is no scan {scene!r}; expected {', '.join(names) or 'a dataset with scans'}")
    raise InputError(f"{results}: no volume of {scene or 'any scan of ' + str(data)} is kept; run a method first")
