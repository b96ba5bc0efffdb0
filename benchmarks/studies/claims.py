"""`run-benchmark reproduce DATA RESULTS`: from nothing to the records behind what is claimed of FDK, LIMAR and NMAR.

Makes the suite's scans with three seeds, runs the methods on them and on their metal-free twins, and says of each
claim what was found and whether it holds. All of it resumes; `--table` judges the records that are there.
"""

import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.studies.methods import records, study, tables
from ctsim.benchmarks.studies.methods.plan import Costs
from ctsim.benchmarks.studies.methods.records import RunRecord
from ctsim.benchmarks.suites import load, select
from ctsim.errors import InputError
from ctsim.folder import is_complete
from ctsim.human import human_time
from ctsim.phantoms.scene import Scene, scene_id

METHODS = ("fdk", "limar", "nmar", "os-sart")
SCENE, SHARE = "lung-Fe", 0.6
SLOWEST = {"limar": 2.5, "nmar": 5.0}
PASSES = 10
NAME = "reproduce.md"


@dataclass(frozen=True)
class Arguments:
    """Make the records behind the claims about FDK, LIMAR, NMAR and OS-SART, and check the claims.

    The times are worth something on an idle machine only.
    """

    data: tyro.conf.Positional[Path]
    """The data folder; scans that are missing are made."""
    results: tyro.conf.Positional[Path]
    """The folder for records, tables, volumes and pictures."""
    suite: str = "core"
    """A suite with the scene lung-Fe."""
    seeds: tuple[int, ...] = (1, 2, 3)
    """Repetitions of each scene."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only judge the records that are there, computing nothing."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the scans to make, the runs to do and what they will cost; write nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """What is claimed, what was found, and whether it holds; None where records are missing."""

    text: str
    found: str
    holds: bool | None


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every claim holds, 1 if one does not or cannot be judged."""
    given = tyro.cli(Arguments, prog="run-benchmark reproduce", args=arguments)
    if given.dry_run:
        return _dry_run(given)
    if not given.table and (code := _compute(given)) not in (0, 1):  # a method's failure is shown below
        return code
    found = records.latest(records.read(given.results))
    if not found:
        raise InputError(f"{given.results}: there are no records; run without --table first")
    claims = judged(found)
    shown = [r for r in found if r.label in METHODS]
    text = f"{markdown(claims)}\n{tables.render(shown, 'md', ('against', 'anchored'))}"
    (given.results / NAME).write_text(text, encoding="utf-8")
    sys.stdout.write(f"\n{text}\nWritten: {given.results / NAME}\n")
    return 0 if all(claim.holds for claim in claims) else 1


def _compute(given: Arguments) -> int:
    """Make the scans that are missing, then run what has no record."""
    code = make_dataset.main(_scans_of(given))
    return code or study.main(_runs_of(given, [scene.name for scene in _scenes(given)]))


def _scans_of(given: Arguments) -> list[str]:
    """Return the words of make-dataset."""
    return [given.suite, str(given.data), "--seeds", *map(str, given.seeds)]


def _runs_of(given: Arguments, scenes: list[str]) -> list[str]:
    """Return the words of run-benchmark on these scenes."""
    methods = [word for name in METHODS for word in ("--method", name)]
    return [str(given.data), str(given.results), *methods, *(word for name in scenes for word in ("--scene", name))]


def _scenes(given: Arguments) -> tuple[Scene, ...]:
    return select(load(given.suite), (), given.seeds)


def _dry_run(given: Arguments) -> int:
    """Print the plans of scans to make, the runs on those that are there, and what runs on the others will take."""
    if code := make_dataset.main([*_scans_of(given), "--dry-run"]):
        return code
    scenes = _scenes(given)
    there = [scene.name for scene in scenes if is_complete(given.data, scene.name, scene_id(scene))]
    if there and (code := study.main([*_runs_of(given, there), "--dry-run"])):
        return code
    if later := len(scenes) - len(there):
        known = Costs(records.read(given.results))
        usual = {method: known.method(method) for method in METHODS}
        seconds = sum(2 * later * s for s in usual.values() if s is not None)
        sys.stdout.write(f"on {later} scans to be made and their twins: {human_time(seconds)}, by the records' medians")
        unknown = [method for method, s in usual.items() if s is None]
        sys.stdout.write(f"; never measured: {', '.join(unknown)}\n" if unknown else "\n")
    return 0


def judged(found: list[RunRecord]) -> list[Claim]:
    """Judge every claim by the newest records of the scans with metal."""
    runs = {(r.run.scene, r.run.seed, r.label): r for r in found if r.run.variant == "metal"}
    return [_ordering(runs), *(_time(runs, method) for method in SLOWEST), _passes(runs)]


Runs = dict[tuple[str, int, str], RunRecord]


def _ordering(runs: Runs) -> Claim:
    """Compare the tissue's RMSE against the metal-free twin, seed by seed."""
    text = f"{SCENE}: RMSE of the tissue against the metal-free twin, NMAR < LIMAR < {SHARE:g} FDK, for every seed"
    errors = {m: _values(runs, SCENE, m) for m in ("fdk", "limar", "nmar")}
    seeds = set.intersection(*(set(e) for e in errors.values()))
    if not seeds:
        return Claim(text=text, found="no seed has all three", holds=None)
    fdk, limar, nmar = ([errors[m][seed] for seed in sorted(seeds)] for m in errors)
    shown = ", ".join(f"{m} {spread(e, 1)}" for m, e in zip(errors, (fdk, limar, nmar), strict=True))
    holds = all(n < li < SHARE * f for f, li, n in zip(fdk, limar, nmar, strict=True))
    return Claim(text=text, found=f"{shown} HU ({len(seeds)} seeds)", holds=holds)


def _values(runs: Runs, scene: str, method: str) -> dict[int, float]:
    """Return a method's RMSE under `artefact` by seed, where it is known."""
    found = {}
    for (name, seed, label), record in runs.items():
        if (name, label) == (scene, method) and "artefact" in record.scores:
            value = record.scores["artefact"].values.get("rmse")
            if value is not None:
                found[seed] = value
    return found


def _time(runs: Runs, method: str) -> Claim:
    """Compare a method's wall time with FDK's on the same scan."""
    text = f"{method.upper()} takes at most {SLOWEST[method]:g} times FDK's time, in the median over the scans"
    ratios = []
    for (scene, seed, label), record in runs.items():
        base = runs.get((scene, seed, "fdk"))
        if label == method and record.status == "ok" and record.cost and base is not None and base.cost:
            ratios.append(record.cost.wall / base.cost.wall)
    if not ratios:
        return Claim(text=text, found="no scan has both", holds=None)
    middle = statistics.median(ratios)
    found = f"{middle:.2f} ({min(ratios):.2f} to {max(ratios):.2f}, {len(ratios)} scans)"
    return Claim(text=text, found=found, holds=middle <= SLOWEST[method])


def _passes(runs: Runs) -> Claim:
    """Say what OS-SART's passes took; every run must have ended well with that many."""
    text = f"OS-SART ends well after {PASSES} passes on every scan"
    mine = [record for (_, _, label), record in runs.items() if label == "os-sart"]
    if not mine:
        return Claim(text=text, found="no run", holds=None)
    walls = [r.cost.wall for r in mine if r.cost is not None]
    updates = sorted({r.cost.view_updates for r in mine if r.cost is not None})
    holds = all(r.status == "ok" and r.run.params.get("iterations") == PASSES for r in mine)
    took = f"{spread(walls, 1)} s" if walls else "no time"
    return Claim(text=text, found=f"{took} for {', '.join(map(str, updates))} view updates", holds=holds)


def spread(values: list[float], digits: int) -> str:
    """Return mean ± standard deviation; the mean alone of a single value."""
    text = f"{statistics.fmean(values):.{digits}f}"
    return text + (f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else "")


def markdown(claims: list[Claim]) -> str:
    """Return the claims as a table."""
    words = {True: "yes", False: "**no**", None: "not measured"}
    lines = ["| claim | found | holds |", "|---|---|---|"]
    lines += [f"| {c.text} | {c.found} | {words[c.holds]} |" for c in claims]
    return "## Claims\n\n" + "\n".join(lines) + "\n"
