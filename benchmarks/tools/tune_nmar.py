"""How well NMAR chooses its prior, and what the trace's margin is worth.

    python -m ctsim.benchmarks.tools.tune_nmar DATA OUT [SCENE …]

DATA is a dataset of scenes that no table shows (`make-dataset tune DATA`), each with its metal-free twin. For
every scene and dilation a line of OUT/nmar.csv holds the error of LIMAR and of NMAR with either prior (RMS difference
from FDK of the twin in the tissue, HU), the misfits that `auto` judges by, its choice, and the regret: what the
choice costs over the better prior. `nmar_twin` has a prior from the twin, as good as there can be. `mended` is FDK
with the twin's readings in the trace: what the trace misses.
"""

import csv
import dataclasses
import functools
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from ctsim.baselines import nmar
from ctsim.baselines.limar import interpolated
from ctsim.baselines.metal import Metal, Trace, find_metal
from ctsim.baselines.prior import Choice, better, choose_prior
from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import ramp as fdk
from ctsim.reconstruct.filters import RAMP

DILATIONS = (0, None, 1)
PRIORS = ("fdk", "limar")


def main(arguments: list[str]) -> int:
    """Write the table, a scene at a time; return 0."""
    if len(arguments) < 2:
        raise InputError("expected DATA and OUT, and then names of scenes if not all are meant")
    out = Path(arguments[1])
    out.mkdir(parents=True, exist_ok=True)
    with (out / "nmar.csv").open("w", encoding="utf-8", newline="") as file:
        writer = None
        for folder in _chosen(list_scans(Path(arguments[0])), arguments[2:]):
            for row in rows(open_scan(folder)):
                writer = writer or csv.DictWriter(file, list(row))
                if not file.tell():
                    writer.writeheader()
                writer.writerow(row)
                file.flush()
                sys.stdout.write(", ".join(f"{k} {v}" for k, v in row.items()) + "\n")
    return 0


def _chosen(folders: Iterable[Path], names: list[str]) -> list[Path]:
    folders = list(folders)
    missing = set(names) - {folder.name for folder in folders}
    if missing:
        raise InputError(f"there is no scene {', '.join(sorted(missing))}")
    return [folder for folder in folders if not names or folder.name in names]


def rows(stored: StoredScan) -> list[dict[str, object]]:
    """Measure a scene with every dilation."""
    water, free = effective_attenuation(stored), stored.metal_free
    if free is None or water is None:
        raise InputError(f"{stored.name}: expected a scene with its spectrum and its metal-free twin")
    mask, bare = np.asarray(stored.metal) > 0, free.scan
    scan = dataclasses.replace(stored.scan, metal=torch.from_numpy(mask))
    first, twin = fdk(scan).values, fdk(bare).values
    tissue = truth_of(stored).tissue
    metal = find_metal(scan, first.numpy(), "oracle")

    def error(values: torch.Tensor) -> float:
        off = (values - twin).numpy()[tissue].astype(np.float64)
        return round(1000 / water * float(np.sqrt(np.mean(off**2))), 1)

    found: list[dict[str, object]] = []
    for dilation in DILATIONS:
        trace = Trace(metal, scan, dilation)
        mended = dataclasses.replace(scan, counts=torch.where(_held(trace), bare.counts, scan.counts))
        values, misfit = by_prior(trace, metal, first)
        errors = {name: error(v) for name, v in values.items()}
        best = choose_prior(trace, metal, twin, RAMP, "fdk")  # FDK, of the twin
        chosen = better(misfit)
        found.append({
            "scene": stored.name, "dilation": "rule" if dilation is None else dilation,
            "fdk": error(first),
            "mended": error(fdk(mended).values), "limar": error(interpolated(trace, first, "rows", RAMP)[0]),
            **{f"nmar_{name}": e for name, e in errors.items()},
            "nmar_twin": None if best is None else error(nmar_with(trace, first, best)),
            "misfit_ratio": round(misfit["limar"] / misfit["fdk"], 3), "chosen": chosen,
            "regret": round(errors[chosen] - min(errors.values()), 1),
        })  # fmt: skip
    return found


def by_prior(trace: Trace, metal: Metal, first: torch.Tensor) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Return NMAR's volume with either prior, and its misfit on the ring."""
    values, misfit = {}, {}
    for name in PRIORS:
        choice = choose_prior(trace, metal, first, RAMP, name)
        if choice is None:
            raise InputError("nothing stands out from air: there is no prior to choose")
        values[name] = nmar_with(trace, first, choice)
        misfit[name] = choice.misfit[name]
    return values, misfit


def nmar_with(trace: Trace, first: torch.Tensor, choice: Choice) -> torch.Tensor:
    """Return NMAR's volume with a prior, metal not put back."""
    bridge = functools.partial(nmar.Normalise().fill, largest=choice.largest, how="rows")
    return nmar.normalised(trace, first, choice.columns, bridge, RAMP)[0]


def _held(trace: Trace) -> torch.Tensor:
    return torch.from_numpy(np.stack([trace.view(k) for k in range(trace.geometry.n_views)]))


if __name__ == "__main__":
    sys.exit(guarded("tune_nmar", "ctsim.benchmarks.tools.tune_nmar", sys.argv[1:], resumes=False))
