"""Score learned rows next to FDK, LIMAR and NMAR on scans that they were not trained on.

    python -m ctsim.benchmarks.tools.score_learned DATA OUT [METHOD …]

Of a dataset with splits only the split "test" is scored. A line of OUT/learned.csv is a method on a scene: PSNR3D and
SSIM3D under protocol `tissue`, RMSE of `artefact` (HU), and PSNR3D on the twin without metal. It prints means over
scenes of one metal as a Markdown table.
"""

import statistics
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.methods import TABLE, TRAINED, TRAINED_MASK, find
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.records import METAL, TWIN
from ctsim.benchmarks.tools.tune_filter import written
from ctsim.dataset.manifest import read_index
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.errors import InputError

USUAL = ("fdk", "limar", "nmar", *(name for name, (_, kind) in TABLE.items() if kind in (TRAINED, TRAINED_MASK)))
NAMES = ("scene", "metal", "method", "psnr3d", "ssim3d", "artefact_hu", "twin_psnr3d")
TITLES = ("PSNR3D", "SSIM3D", "artefact", "twin")
DIGITS = (2, 3, 0, 2)
Row = tuple[str, str, str, float, float, float, float]


def main(arguments: list[str]) -> int:
    """Score, scan by scan, and print the table; return 0."""
    if len(arguments) < 2:
        raise InputError("expected DATA, OUT and the names of methods, if not the usual ones")
    data, methods = Path(arguments[0]), arguments[2:] or list(USUAL)
    found = written(Path(arguments[1]) / "learned.csv", NAMES, (row for s in scans(data) for row in rows(s, methods)))
    sys.stdout.write(table(found) + "\n")
    return 0


def scans(data: Path) -> Iterator[StoredScan]:
    """Yield the scans of the split "test", or all of a dataset without splits."""
    lines = list(read_index(data).values())
    splits = {line.name: line.about.split if line.about else "" for line in lines}
    for name, split in splits.items():
        if split == "test" or not any(splits.values()):
            yield open_scan(data / name)


def rows(stored: StoredScan, methods: Sequence[str]) -> Iterator[Row]:
    """Yield the scores of each method on a scan. Raises InputError where there is no metal or no twin."""
    if stored.metal_free is None or not stored.info.metal:
        raise InputError(f"{stored.name}: expected a scan with metal and its twin without")
    judge, empty = Judge.of(stored, "no view was simulated"), float("nan")
    for name in methods:
        method = find(name)
        twin, volume = (
            method.reconstruct(scan_for(method, stored, variant)).values.numpy() for variant in (TWIN, METAL)
        )
        found = judge.scores(volume, METAL, Twin(values=twin))
        alone = judge.scores(twin, TWIN, Twin())["tissue"].values["psnr3d"]
        tissue, artefact = found["tissue"].values, found["artefact"].values["rmse"]
        values = (tissue["psnr3d"], tissue["ssim3d"], artefact, alone)
        a, b, c, d = (empty if value is None else round(value, 4) for value in values)
        yield stored.name, ", ".join(stored.info.metal), name, a, b, c, d


def table(found: Sequence[Row]) -> str:
    """Return the means over the scenes of each metal as Markdown."""
    metals = dict.fromkeys(sorted(row[1] for row in found))
    counts = {metal: len({row[0] for row in found if row[1] == metal}) for metal in metals}
    head = ["method", *(f"{metal} ({counts[metal]}) {title}" for metal in metals for title in TITLES)]
    lines = ["| " + " | ".join(head) + " |", "|---" + "|--:" * (len(head) - 1) + "|"]
    for method in dict.fromkeys(row[2] for row in found):
        cells = [f"`{method}`"]
        for metal in metals:
            chosen = [row[3:] for row in found if row[1:3] == (metal, method)]
            cells += [f"{statistics.fmean(v):.{n}f}" for v, n in zip(zip(*chosen, strict=True), DIGITS, strict=True)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(guarded("score_learned", "ctsim.benchmarks.tools.score_learned", sys.argv[1:], resumes=False))
