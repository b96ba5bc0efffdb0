"""What the settings of methods are worth, one changed at a time from the defaults.

    python -m ctsim.benchmarks.tools.tune_settings DATA OUT [METHOD …]

DATA is a dataset of scenes that stand in no table (`make-dataset tune DATA`). A line of OUT/settings.csv holds a
method, its settings, the iterations done, and by scene PSNR3D in dB under the protocols `tissue` and `aligned`
(effective spectrum). Iterations need no runs of their own: the volume is scored as it passes each number. The passes of
`splat` are a setting, since the last ones differ from the others.
"""

import csv
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.protocol import Truth, tissue_range, truth_of
from ctsim.errors import InputError
from ctsim.reconstruct.watch import watch
from ctsim.store import StoredScan, list_scans, open_scan

STOPS: dict[str, tuple[int, ...]] = {
    "fista-tv": (25, 50, 100),
    "asd-pocs": (5, 10, 20),
    "awpcsd": (5, 10, 20),
    "splat": (),
}
VALUES: dict[str, dict[str, tuple[Any, ...]]] = {
    "fista-tv": {"tv": (0.0006, 0.0012, 0.005), "tv_iterations": (10, 40)},
    "asd-pocs": {"alpha": (0.005, 0.01, 0.05), "tv_steps": (10, 40)},
    "awpcsd": {"alpha": (0.01, 0.05), "delta": (0.5, 1.0, 4.0), "tv_steps": (10, 40)},
    "splat": {"passes": ((3, 4), (3, 12), (8, 9)), "tv": (0.0, 0.0125, 0.05), "fineness": (1.0, 1.25)},
}
PROTOCOLS = ("tissue", "aligned")


def main(arguments: list[str]) -> int:
    """Write the table, a setting at a time; return 0."""
    if len(arguments) < 2 or not set(arguments[2:]) <= STOPS.keys():
        raise InputError(f"expected DATA and OUT, and then methods among {', '.join(STOPS)} if not all are meant")
    scenes = [open_scan(folder) for folder in list_scans(Path(arguments[0]))]
    truths = [truth_of(stored) for stored in scenes]
    out = Path(arguments[1])
    out.mkdir(parents=True, exist_ok=True)
    names = [f"{stored.name} {protocol}" for stored in scenes for protocol in PROTOCOLS]
    with (out / "settings.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "setting", "iterations", *names])
        for name in arguments[2:] or STOPS:
            for setting in settings(name):
                effort = {"iterations": STOPS[name][-1]} if STOPS[name] else {}
                method = find(name, {**setting, **effort})
                curves = [curve(method, *scene) for scene in zip(scenes, truths, strict=True)]
                words = ", ".join(f"{k}={v}" for k, v in setting.items()) or "defaults"
                for stop in STOPS[name] or (math.inf,):
                    # a method that ended early stays where it was
                    scores = [f"{s:.2f}" for c in curves for s in c[max(k for k in c if k <= stop)]]
                    done = stop if STOPS[name] else ""
                    writer.writerow([name, words, done, *scores])
                    sys.stdout.write(f"{name} {words} {done}: {' '.join(scores)}\n")
                file.flush()
    return 0


def settings(name: str) -> list[dict[str, Any]]:
    """Return the defaults and each change of one of them."""
    return [{}, *({key: value} for key, values in VALUES[name].items() for value in values)]


def curve(method: Method, stored: StoredScan, truth: Truth) -> dict[int, list[float]]:
    """Return PSNR3D under `PROTOCOLS` after the method's first, each stopping, and last iteration."""
    found: dict[int, list[float]] = {}
    done = 0

    def score(_views: int, _seconds: float, volume: torch.Tensor) -> None:
        nonlocal done
        done += 1
        if done == 1 or done in STOPS[method.name]:
            found[done] = psnrs(volume.numpy(), truth)

    with watch(score):
        volume = method.reconstruct(stored.scan)
    found[done] = psnrs(volume.values.numpy(), truth)
    return found


def psnrs(values: np.ndarray, truth: Truth) -> list[float]:
    """Return PSNR3D against the effective spectrum, as it is and after a gain fitted on the body."""
    reference, data_range = truth.references["effective"], tissue_range(truth, "effective")
    gain = metrics.least_squares_gain(values, reference, truth.body & ~truth.near_metal) or 1.0
    both = (metrics.psnr3d(v, reference, data_range=data_range, region=truth.tissue) for v in (values, values * gain))
    return [psnr if psnr is not None else float("inf") for psnr in both]


if __name__ == "__main__":
    sys.exit(guarded("tune_settings", "ctsim.benchmarks.tools.tune_settings", sys.argv[1:], resumes=False))
