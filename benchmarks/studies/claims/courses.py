"""The courses of fits: how good a field was at its best moment, and at its end."""

import itertools
import math
import sys
from collections.abc import Iterable
from pathlib import Path

import msgspec
import torch

from ctsim.benchmarks.known_beam import with_beam
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.scores.metrics import mse3d, psnr
from ctsim.benchmarks.scores.protocol import tissue_range, truth_of
from ctsim.benchmarks.studies.claims.neural import COURSES, FIELDS, Course
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.records import METAL
from ctsim.dataset.durable import write_synced
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.reconstruct.watch import watch


def courses(data: Path, results: Path, scenes: Iterable[str]) -> list[Course]:
    """Fit every field once on every scan and score each step that it shows; what is known stays. Return all."""
    path = results / COURSES
    known = msgspec.json.decode(path.read_bytes(), type=list[Course]) if path.exists() else []
    folders = {folder.name: folder for folder in list_scans(data)}
    for scene, name in itertools.product(scenes, FIELDS):
        method = find(name)
        if not any((c.scene, c.method, c.code) == (scene, name, method.code) for c in known):
            known.append(_course(open_scan(folders[scene]), scene, method))
            write_synced(path, msgspec.json.format(msgspec.json.encode(known)))
    return known


def _course(stored: StoredScan, scene: str, method: Method) -> Course:
    """Fit a field and score its volume on the way and at the end."""
    truth, seen = truth_of(stored), list[float]()
    span = tissue_range(truth, "effective")

    def score(values: torch.Tensor) -> float:
        return psnr(mse3d(values.numpy(), truth.references["effective"], truth.tissue), span) or -math.inf

    with watch(lambda _updates, _seconds, values: seen.append(score(values))):
        end = score(with_beam(method, stored).reconstruct(scan_for(method, stored, METAL)).values)
    best = max([*seen, end])
    sys.stderr.write(f"{scene}: {method.name}: {best:.2f} dB at best, {end:.2f} at the end\n")
    return Course(scene=scene, method=method.name, code=method.code, best=best, end=end)
