"""What `run-benchmark score` does: read a volume, check that it fits its scan, score and record it."""

import hashlib
import re
import sys
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from ctsim.benchmarks.engine.process import check_limit
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.study import record_of
from ctsim.benchmarks.methods import EXTERNAL, TABLE, Method
from ctsim.benchmarks.scores import placement
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.studies.methods import study
from ctsim.benchmarks.studies.methods.attempt import Outcome
from ctsim.benchmarks.studies.methods.plan import Job, jobs_on
from ctsim.benchmarks.studies.methods.records import METAL, STATED, SUBMITTED, TWIN, Cost, RunRecord
from ctsim.benchmarks.studies.methods.run import Runner
from ctsim.benchmarks.submit import Flags
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.human import human_choice
from ctsim.io.volumes.formats import open_volume
from ctsim.io.volumes.frame import SKEW
from ctsim.io.volumes.volumefile import VolumeFile

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.+-]{0,59}")
INPUTS = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ,;:()/_.+-]{0,59}")
MOST_CITED = 300


def main(argv: list[str]) -> int:
    """Run the command; return 0."""
    given: Any = tyro.cli(Flags, prog="run-benchmark score", args=argv)
    records = submit(given)
    methods = study.Methods()
    options = study.Flags(data=given.data, results=given.results)
    methods.store(options).append(records)
    sys.stdout.write(methods.write(methods.store(options).read(), options))
    return 0


def submit(given: Flags) -> list[RunRecord]:
    """Score the volumes that the flags name; return their records, the twin's first.

    Raises InputError for a wrong name, scan or number, and for a volume that cannot be read or does not fit the scan.
    """
    _check(given)
    place, stored = _scan(given)
    paths = {METAL: given.volume} | ({} if given.twin is None else {TWIN: given.twin})
    if given.twin is not None and stored.metal_free is None:
        raise InputError(f"--twin: the scan {stored.name!r} has no metal-free twin")
    files = {variant: open_volume(path) for variant, path in paths.items()}
    values = _checked(files, stored, given)
    method = _method(given, files)
    options = study.Flags(data=given.data, results=given.results, anchor=given.twin is not None)
    runner, records = Runner(options), []
    for job in jobs_on(stored, [v for v in (TWIN, METAL) if v in paths], [(method, (place, len(TABLE)))]):
        outcome = _outcome(job, values[job.variant], files[job.variant], given)
        records.append(record_of(study.Methods(), job.task, [runner.finish(job, outcome)]))
    return records


def _check(given: Flags) -> None:
    if given.results.exists() and not given.results.is_dir():
        raise InputError(f"RESULTS: {given.results} is a file, expected a folder; the volume is named after it")
    if not NAME.fullmatch(given.name):
        raise InputError(f"--name {given.name!r}: expected up to 60 letters, digits, spaces and _.+-")
    if given.name in TABLE or given.name in EXTERNAL:
        raise InputError(f"--name {given.name}: is a method of ctsim, expected another name")
    if not INPUTS.fullmatch(given.inputs):
        raise InputError(
            f"--inputs {given.inputs!r}: expected a text such as 'counts only' or 'metal mask', of up to 60 letters, "
            "digits, spaces and ,;:()/_.+-"
        )
    if not given.cite.isprintable() or len(given.cite) > MOST_CITED:
        raise InputError(f"--cite {given.cite[:60]!r}: expected one line of up to {MOST_CITED} characters")
    check_limit(given.seconds)


def _scan(given: Flags) -> tuple[int, StoredScan]:
    """Return the scan's place in its dataset, and the scan."""
    folders = {folder.name: folder for folder in list_scans(given.data)}
    if given.scene not in folders:
        raise InputError(
            f"--scene {given.scene!r}: {given.data} has {human_choice(dict.fromkeys(folders), given.scene)}"
        )
    return list(folders).index(given.scene), open_scan(folders[given.scene])


def _checked(files: dict[str, VolumeFile], stored: StoredScan, given: Flags) -> dict[str, NDArray[np.float32]]:
    """Return the volumes in 1/mm, float32 [z, y, x]; refuse what does not fit the scan."""
    reference, water = placement.reference_of(stored), effective_attenuation(stored)
    found = {}
    for variant, file in files.items():
        stated, grid = file.spacing, stored.geometry.d_voxel
        if stated is not None and not np.allclose(stated, grid, rtol=SKEW, atol=0):
            raise InputError(f"{file.path} has voxels of {_mm(stated)} mm (z × y × x), the scan's grid {_mm(grid)} mm")
        values = file.values()
        if file.rescale is not None:
            values = values * np.float64(file.rescale[0]) + file.rescale[1]
        placement.check(str(file.path), values, reference, given.unit, water, "--unit")
        found[variant] = placement.to_attenuation(values, given.unit, water)
    return found


def _mm(sizes: tuple[float, ...]) -> str:
    return " × ".join(f"{size:g}" for size in sizes)


def _method(given: Flags, files: dict[str, VolumeFile]) -> Method:
    """Return the submission as a method: its parameters are what was stated of it, its code the volumes' digest."""
    digest = hashlib.sha256("".join(file.digest() for file in files.values()).encode()).hexdigest()
    stated = {"unit": given.unit, "seconds": given.seconds, "inputs": given.inputs, "cite": given.cite}
    return Method(
        name=f"{given.name} ({SUBMITTED})", target=SUBMITTED, inputs=given.inputs, params=stated, code=digest[:16]
    )


def _outcome(job: Job, values: NDArray[np.float32], file: VolumeFile, given: Flags) -> Outcome:
    """Return a volume as the outcome of a run; the seconds stated are those of the scan itself."""
    timed = given.seconds is not None and job.variant == METAL
    return Outcome(
        status=OK,
        values=np.ascontiguousarray(values),
        cost=Cost(wall=given.seconds, device=STATED) if timed and given.seconds is not None else None,
        details={SUBMITTED: {"file": file.path.name, "cite": given.cite, "unit": given.unit}},
    )
