"""Which window and cutoff the methods that end in filtered backprojection are best with.

    python -m ctsim.benchmarks.tools.tune_filter DATA OUT METHOD …

DATA is a dataset of scenes that no table shows (`make-dataset tune DATA`). A line of OUT/filter.csv is a method with
one filter on one scene, and its PSNR3D under protocol `tissue` (dB). It prints the filter with the greatest mean over
all scenes, for each method and, as the last line, over all of them: all methods share one filter, so that LIMAR and
NMAR without metal are FDK to the last bit.
"""

import csv
import itertools
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import torch

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.scores.metrics import psnr3d
from ctsim.benchmarks.scores.protocol import tissue_range, truth_of
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.records import METAL
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.filters import RAMP, WINDOWS

CUTOFFS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)
FILTERS = tuple(itertools.product(WINDOWS, CUTOFFS))
NAMES = ("scene", "method", "window", "cutoff", "psnr3d")
Row = tuple[str, str, str, float, float]
T = TypeVar("T", bound=tuple[object, ...])


def main(arguments: list[str]) -> int:
    """Write the table, a scene at a time, and print the best filter of each method; return 0."""
    if len(arguments) < 3:
        raise InputError("expected DATA, OUT and the names of methods")
    stored = (open_scan(folder) for folder in list_scans(Path(arguments[0])))
    found = written(Path(arguments[1]) / "filter.csv", NAMES, (row for s in stored for row in rows(s, arguments[2:])))
    for group in [*([method] for method in arguments[2:]), arguments[2:]]:
        means = mean_scores(found, group)
        best = max(means, key=lambda filter: means[filter])
        plain = means[RAMP.window, RAMP.cutoff]
        who = ", ".join(group)
        sys.stdout.write(f"{who}: {best[0]} {best[1]:g}, {means[best]:.2f} dB; plain ramp {plain:.2f} dB\n")
    return 0


def written(path: Path, names: Sequence[str], rows: Iterable[T]) -> list[T]:
    """Write a CSV file, each row as soon as it is there, and return the rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    found = list[T]()
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for row in rows:
            found.append(row)
            writer.writerow(row)
            file.flush()
    return found


def rows(stored: StoredScan, methods: Sequence[str]) -> Iterator[Row]:
    """Yield the score of each method with each filter on a scene."""
    score = scoring(stored)
    for name, (window, cutoff) in itertools.product(methods, FILTERS):
        method = find(name, {"window": window, "cutoff": cutoff})
        yield stored.name, name, window, cutoff, score(method.reconstruct(scan_for(method, stored, METAL)).values)


def scoring(stored: StoredScan) -> Callable[[torch.Tensor], float]:
    """Return the score of a volume of a scene: PSNR3D under protocol `tissue`, dB."""
    truth = truth_of(stored)
    largest = tissue_range(truth, "effective")

    def score(volume: torch.Tensor) -> float:
        found = psnr3d(volume.numpy(), truth.references["effective"], data_range=largest, region=truth.tissue)
        if found is None:
            raise InputError(f"{stored.name}: the volume is the reference itself")
        return round(found, 3)

    return score


def mean_scores(found: Sequence[Row], methods: Sequence[str]) -> dict[tuple[str, float], float]:
    """Return the mean score of methods over all scenes, by window and cutoff."""
    by: dict[tuple[str, float], list[float]] = {}
    for _, name, window, cutoff, score in found:
        if name in methods:
            by.setdefault((window, cutoff), []).append(score)
    return {filter: statistics.fmean(scores) for filter, scores in by.items()}


if __name__ == "__main__":
    sys.exit(guarded("tune_filter", "ctsim.benchmarks.tools.tune_filter", sys.argv[1:], resumes=False))
