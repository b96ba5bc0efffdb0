"""The short interface: from a scene to a corrected volume and its scores, without a file.

Everything here is reachable as `ctsim.NAME`. The commands do the same work with records, tables and pictures; scores
are the same numbers.
"""

import dataclasses
import functools
from collections.abc import Collection, Iterable
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.benchmarks.known_beam import with_beam
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.scores import placement
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.projection import held_out, with_floor
from ctsim.benchmarks.scores.score import NOT_ASKED, PROJECTION, PROTOCOLS, Score
from ctsim.benchmarks.studies.methods.attempt import SCORED, Outcome, array_of, check_volume, checked, scan_for
from ctsim.benchmarks.studies.methods.records import METAL, TWIN
from ctsim.benchmarks.suites import load, select
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError, check_kind
from ctsim.human import human_choice
from ctsim.phantoms.scene import Scene, read_scene
from ctsim.simulate import REFERENCE_KEV
from ctsim.types import Scan, Status, Volume


def find_scene(suite: str, name: str, *, seed: int | None = None) -> Scene:
    """Return a scene of a bundled suite, such as "quick", or of a TOML file.

    With `seed` it is another individual with another noise, named NAME-sSEED as by `make-dataset --seeds`. Raises
    InputError for an unknown suite or scene.
    """
    check_kind("suite", suite, str, "the name of a suite or the path of a TOML file, as a text")
    if isinstance(seed, bool) or not isinstance(seed, int | None):
        raise InputError(f"seed: expected a whole number or None, got {seed!r}")
    scenes = load(suite)
    names = [scene.name for scene in scenes]
    if name not in names:
        raise InputError(f"suite {suite!r} has no scene {name!r}, expected one of {human_choice(names, name)}")
    return select(scenes, (name,), () if seed is None else (seed,))[0]


def new_scene(**keys: Any) -> Scene:
    """Return a scene of your own; the keys are those of a scene file, tables are dicts, lists may be arrays.

    `new_scene(name="pins", phantom={"recipe": "walnut", "metal": "Fe"}, scanner={"preset": "dental"})`. As in a file,
    `"tube": {"kvp": 110.0}` in the scanner keeps the preset's filters; a `Tube` would replace them. Raises InputError
    naming a wrong key or value.
    """
    return read_scene(_plain(keys), "scene")


def _plain(value: Any) -> Any:
    """Return a table's value with NumPy's numbers and arrays as those of a file."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def reconstruct_scan(scan: ScanWithTruth | Scan, method: str = "fdk", **parameters: Any) -> Volume:
    """Reconstruct a scan by a method's name or "module:function", with its parameters.

    A method with mask "oracle" gets the true metal mask, which a `Scan` without truth must hold in `metal`. A method
    that is told the spectrum gets the tube and the detector of the scan's scene, unless it is given one of them; of a
    `Scan` they are not known, so that the simulator's are assumed and the volume has a limitation. Give
    `scan.metal_free` to reconstruct the twin.

    Raises
    ------
    InputError
        For an unknown method, parameter or value, where the method skips this scan, and where it returns no volume.
    """
    check_kind("scan", scan, (Scan, ScanWithTruth), "a scan, such as of open_scan or simulate_scene")
    check_kind("method", method, str, "the name of a method or module:function")
    found = with_beam(find(method, parameters), scan if isinstance(scan, ScanWithTruth) else None)
    given = _readings(found, scan)
    if (reason := found.skip(given)) is not None:
        raise InputError(f"{found.label} skips this scan: {reason}")
    volume = found.reconstruct(given)
    check_volume(volume)
    return volume


def _readings(method: Method, scan: ScanWithTruth | Scan) -> Scan:
    """Return what a method gets of a scan: the truth only as far as it declares to be told."""
    if isinstance(scan, Scan):
        if method.told_twin:
            raise InputError(f"{method.name} is told the metal-free twin: expected a simulated scan, got a Scan")
        return scan
    if not scan.is_twin:
        measured = not scan.has_truth and method.mask == "oracle" and not method.program
        return (
            scan.scan if measured else scan_for(method, scan, METAL)
        )  # the method says what it needs instead of truth
    readings = scan.scan
    if method.mask != "oracle":
        return readings
    return dataclasses.replace(readings, metal=torch.zeros(scan.geometry.n_voxel, dtype=torch.bool))


def score_volume(
    volume: Volume | NDArray[Any],
    scan: ScanWithTruth,
    *,
    twin: Volume | NDArray[Any] | None = None,
    variant: Literal["metal", "metal_free"] = "metal",
    protocols: str | Iterable[str] = PROTOCOLS,
) -> dict[str, Score]:
    """Score a volume under those `protocols` that apply: name -> `Score`, the same numbers as `run-benchmark`.

    `twin` is the same method's volume of `scan.metal_free`, which the protocol `artefact` compares with. To score that
    volume itself, name the `variant` "metal_free". An array is [z, y, x] in 1/mm; one that is flipped, transposed, in
    another unit or the same everywhere is refused, as by `run-benchmark score`. A `Volume`, such as a method's, is
    scored as it is: `ctsim.Volume(values=torch.from_numpy(array))` makes one of an array that is meant to be so. The
    truth of the last scan is kept for the next call. Most of the work is to simulate views for the protocol
    `projection`: without it scores take seconds.

    Raises
    ------
    InputError
        Where a volume is not finite or not on the scan's grid, where an array is in another unit or orientation, where
        a method ended with neither "ok" nor "diverged", where `scan` is a twin or was measured, and for an unknown
        protocol or variant.
    """
    check_kind("scan", scan, ScanWithTruth, "a scan with its truth, such as of open_scan or simulate_scene")
    if not scan.has_truth:
        raise InputError(f"{scan.place}: is a measured scan, which has no truth to score a volume with")
    check_kind("protocols", protocols, Iterable, "names of protocols")
    protocols = {protocols} if isinstance(protocols, str) else set(protocols)
    if unknown := sorted(protocols - set(PROTOCOLS)):
        raise InputError(f"protocols: expected names among {', '.join(PROTOCOLS)}, got {unknown[0]!r}")
    if variant not in (METAL, TWIN):
        raise InputError(f"variant: expected {METAL!r} or {TWIN!r}, got {variant!r}")
    if scan.is_twin:
        raise InputError('expected the scan with metal: score its twin\'s volume with variant="metal_free"')
    values, at_50kev = _arrays(volume, scan)
    pair = Twin(reason=NOT_ASKED) if scan.metal_free is not None else Twin()
    if twin is not None:
        pair = Twin(values=_arrays(twin, scan, (str(Status.OK),), "the twin's volume")[0])
    judge = _judge_with_views(scan) if variant == METAL and PROJECTION in protocols else _judge(scan)
    return judge.scores(values, variant, pair, at_50kev, protocols)


@functools.lru_cache(maxsize=1)
def _judge(scan: ScanWithTruth) -> Judge:
    """Load what a scan's volumes are scored with, but for the views that no method saw."""
    return Judge.of(scan, "no view was simulated")


@functools.lru_cache(maxsize=1)
def _judge_with_views(scan: ScanWithTruth) -> Judge:
    judge = _judge(scan)
    return dataclasses.replace(judge, views=with_floor(held_out(scan), judge.truth))


def _arrays(
    volume: Volume | NDArray[Any], scan: ScanWithTruth, ends: Collection[str] = SCORED, name: str = "the volume"
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return a volume's values, and those at 50 keV of a method that knows energies; it must have one of the `ends`.

    An array, which may come from anywhere, must look like the scan.
    """
    if isinstance(volume, Volume):
        check_volume(volume)
        if str(volume.status) not in ends:
            raise InputError(f"the volume's status is {volume.status}, which is not scored: {volume.reason}")
        values, own = array_of(volume.values), volume.at_energy
        at_50kev = None if own is None else array_of(own(REFERENCE_KEV))
    else:
        values, at_50kev = np.asarray(volume), None
        if values.dtype.kind not in "fiu":
            raise InputError(f"{name} must be real numbers in 1/mm, got {values.dtype}")
        values = values.astype(np.float32)
        reference = placement.tissue_of(_judge(scan).truth)
        placement.check(name, values, reference, "1/mm", effective_attenuation(scan))
    outcome = checked(Outcome(status="ok", values=values, at_50kev=at_50kev), scan.geometry.n_voxel)
    if outcome.status != "ok":
        raise InputError(outcome.reason)
    return values, at_50kev
