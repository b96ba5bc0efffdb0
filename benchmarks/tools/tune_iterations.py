"""After how many iterations the methods are best.

    python -m ctsim.benchmarks.tools.tune_iterations DATA OUT LIMIT METHOD …

DATA is a dataset of scenes that no table shows (`make-dataset tune DATA`). METHOD is a name, or a name with settings:
`sart[relaxation=0.2]`. A method that shows its volume (`ctsim.reconstruct.watch`) runs once for LIMIT iterations and is
scored after each. Any other runs once for each number of iterations. A line of OUT/iterations.csv is a method after
some iterations on one scene, its seconds so far, and its PSNR3D under protocol `tissue` (dB). It prints the number of
iterations with the greatest mean over all scenes and that mean; the least number whose mean is at most `CLOSE` below;
the mean at the default; and the best number on each scene. A method that ends by itself
keeps its last score.
"""

import statistics
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.methods import Method, find, parse_overrides
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.records import METAL
from ctsim.benchmarks.tools.tune_filter import scoring, written
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.watch import watch

CLOSE = 0.05
"""dB below the best mean that fewer iterations may cost."""
NAMES = ("scene", "method", "iterations", "seconds", "psnr3d")
Row = tuple[str, str, int, float, float]


def main(arguments: list[str]) -> int:
    """Write the table, a scene at a time, and print the best number of iterations of each method; return 0."""
    if len(arguments) < 4 or not arguments[2].isdecimal() or not int(arguments[2]):
        raise InputError("expected DATA, OUT, a number of iterations and methods such as sart or sart[relaxation=0.2]")
    limit, methods = int(arguments[2]), {text: settings(text) for text in arguments[3:]}
    stored = (open_scan(folder) for folder in list_scans(Path(arguments[0])))
    rows = (row for scan in stored for text, given in methods.items() for row in course(scan, text, given, limit))
    found = written(Path(arguments[1]) / "iterations.csv", NAMES, rows)
    for text in methods:
        scores = by_scene(found, text, limit)
        mean = [statistics.fmean(after) for after in zip(*scores.values(), strict=True)]
        usual = find(*methods[text]).params["iterations"]
        at_default = f"{mean[usual - 1]:.2f} dB after {usual}" if usual <= limit else f"default {usual}"
        single = ", ".join(f"{scene} {best(values)}" for scene, values in scores.items())
        few = enough(mean)
        means = f"best {best(mean)}, {max(mean):.2f} dB; enough {few}, {mean[few - 1]:.2f} dB; {at_default}"
        sys.stdout.write(f"{text}: {means}; {single}\n")
    return 0


def settings(text: str) -> tuple[str, dict[str, object]]:
    """Split `method[parameter=value,…]` into the name and its parameters.

    Raises InputError for a method without iterations.
    """
    name, _, rest = text.removesuffix("]").partition("[")
    given = parse_overrides(tuple(f"{name}.{part.strip()}" for part in rest.split(",") if part), (name,))[name]
    if "iterations" not in find(name, given).params:
        raise InputError(f"method {name!r} has no parameter iterations")
    return name, given


def course(stored: StoredScan, text: str, given: tuple[str, dict[str, object]], limit: int) -> Iterator[Row]:
    """Yield the score of a method on a scene after each number of iterations up to a limit."""
    name, more = given
    score, seen = scoring(stored), list[tuple[float, float]]()

    def run(method: Method) -> torch.Tensor:
        return method.reconstruct(scan_for(method, stored, METAL)).values

    def look(_view_updates: int, seconds: float, volume: torch.Tensor) -> None:
        seen.append((seconds, score(volume)))

    with watch(look):
        end = run(find(name, more | {"iterations": limit}))
    if seen:  # the method may change its volume after the last iteration, such as cut it at 0
        seen[-1] = seen[-1][0], score(end)
    scores = seen or [(0.0, score(run(find(name, more | {"iterations": k})))) for k in range(1, limit + 1)]
    for k, (seconds, value) in enumerate(scores, 1):
        yield stored.name, text, k, round(seconds, 3), value


def by_scene(found: Sequence[Row], method: str, limit: int) -> dict[str, list[float]]:
    """Return a method's scores by scene after 1, 2, … `limit` iterations, the last repeated where it ended earlier."""
    scores: dict[str, list[float]] = {}
    for scene, name, _, _, score in found:
        if name == method:
            scores.setdefault(scene, []).append(score)
    return {scene: values + values[-1:] * (limit - len(values)) for scene, values in scores.items()}


def best(scores: Sequence[float]) -> int:
    """Return the number of iterations with the greatest score, the first of equals."""
    return max(range(len(scores)), key=scores.__getitem__) + 1


def enough(scores: Sequence[float]) -> int:
    """Return the least number of iterations whose score is at most `CLOSE` below the greatest."""
    return next(k for k, score in enumerate(scores, 1) if score >= max(scores) - CLOSE)


if __name__ == "__main__":
    sys.exit(guarded("tune_iterations", "ctsim.benchmarks.tools.tune_iterations", sys.argv[1:], resumes=False))
