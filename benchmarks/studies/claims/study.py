"""`run-benchmark reproduce DATA RESULTS`: make the records behind the claims about FDK, LIMAR and NMAR, and check them.

Makes the suite's scans with three seeds, runs the methods on them and on their metal-free twins, and prints for each
claim the finding and whether it holds. With `--neural` the claims are that neural and learned methods work
(`claims/neural.py`). All of it resumes; `--table` only judges existing records.
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.claims import neural
from ctsim.benchmarks.studies.methods import records, study, tables
from ctsim.benchmarks.studies.methods.plan import Costs
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord
from ctsim.benchmarks.suites import identity, load, select
from ctsim.dataset.folder import is_complete
from ctsim.errors import InputError
from ctsim.human import human_time

PASSES = 10
"""Of OS-SART: more than its default, so that the claim says that it goes on well."""
OS_SART = f"os-sart[iterations={PASSES}]"
METHODS = ("fdk", "limar", "nmar", OS_SART)
SCENE, SHARE = "lung-Fe", 0.6
SLOWEST = {"limar": 2.5, "nmar": 5.0}
NAME = "reproduce.md"

Runs = dict[tuple[str, int, str], RunRecord]


@dataclass(frozen=True)
class Flags:
    """Make the records behind the claims about FDK, LIMAR, NMAR and OS-SART, and check the claims.

    Claims about time need an idle machine.
    """

    data: tyro.conf.Positional[Path]
    """The data folder; missing scans are made."""
    results: tyro.conf.Positional[Path]
    """The folder for records, tables, volumes and pictures."""
    neural: tyro.conf.FlagCreatePairsOff[bool] = False
    """Judge whether neural and learned methods work, on the suite neural, by five rules."""
    suite: str = ""
    """A suite with the scene lung-Fe (default: core); with --neural any (default: neural)."""
    seeds: tuple[int, ...] = ()
    """Repetitions of each scene (default: 1 2 3; with --neural those that the suite states)."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only judge existing records; run nothing."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the scans to make, the runs to do and what they will cost; write nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim, the finding, and whether the claim holds; None where records are missing."""

    text: str
    found: str
    holds: bool | None


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every claim holds, 1 if one does not or cannot be judged."""
    asked = tyro.cli(Flags, prog="run-benchmark reproduce", args=arguments)
    usual = (neural.SUITE, ()) if asked.neural else ("core", (1, 2, 3))
    given = dataclasses.replace(asked, suite=asked.suite or usual[0], seeds=asked.seeds or usual[1])
    if given.neural:
        return _judge_neural(given)
    if not given.table:
        chosen = [f"--method={name.partition('[')[0]}" for name in METHODS]
        code = _compute(given, [*chosen, f"--set=os-sart.iterations={PASSES}"])
        if given.dry_run or code not in (0, 1):  # a method's failure is shown below
            return code
    found = records.latest(records.read(given.results))
    if not found:
        raise InputError(f"{given.results}: there are no records; run without --table first")
    claims = judged(found)
    shown = tables.render([r for r in found if r.label in METHODS], "md", ("against", "anchored"))
    text = f"{table(claims).markdown()}\n{shown}"
    (given.results / NAME).write_text(text, encoding="utf-8")
    sys.stdout.write(f"\n{text}\nWritten: {given.results / NAME}\n")
    return 0 if all(claim.holds for claim in claims) else 1


def _judge_neural(given: Flags) -> int:
    """Make scans, records and courses of the fits, and print what they show of each rule; return the exit code."""
    if not given.table:
        for chosen in neural.chosen():
            code = _compute(given, chosen)
            if code not in (0, 1):
                return code
        if given.dry_run:
            return 0
    from ctsim.benchmarks.studies.claims.courses import courses  # loads torch

    fitted = courses(given.data, given.results, () if given.table else _there(given))
    found = neural.judged(records.latest(records.read(given.results)), fitted)
    text = neural.table(found).markdown()
    (given.results / neural.NAME).write_text(text, encoding="utf-8")
    sys.stdout.write(f"\n{text}\nWritten: {given.results / neural.NAME}\n")
    return 0 if neural.works(found) else 1


def _there(given: Flags) -> list[str]:
    """Return the scenes that the data folder holds."""
    scenes = select(load(given.suite), (), given.seeds)
    return [scene.name for scene in scenes if is_complete(given.data, scene.name, identity(scene))]


def _compute(given: Flags, chosen: Sequence[str]) -> int:
    """Make missing scans and run what has no record, or print both plans; return the exit code."""
    plan, seeds = ["--dry-run"] if given.dry_run else [], ["--seeds", *map(str, given.seeds)] if given.seeds else []
    if code := make_dataset.main([given.suite, str(given.data), *seeds, *plan]):
        return code
    there = _there(given)
    flags = [*chosen, *(f"--scene={name}" for name in there), *plan]
    code = study.main([str(given.data), str(given.results), *flags]) if there else 0
    later = len(select(load(given.suite), (), given.seeds)) - len(there)
    if given.dry_run and not code and later and not given.neural:
        _guess(later, Costs(records.read(given.results)))
    return code


def _guess(later: int, known: Costs) -> None:
    """Print the expected time of runs on scans that are still to be made."""
    usual = {method: known.method(method) for method in METHODS}
    seconds = sum(2 * later * s for s in usual.values() if s is not None)
    sys.stdout.write(f"on {later} scans to be made and their twins: {human_time(seconds)}, by the records' medians")
    unknown = [method for method, s in usual.items() if s is None]
    sys.stdout.write(f"; never measured: {', '.join(unknown)}\n" if unknown else "\n")


def judged(found: Sequence[RunRecord]) -> list[Claim]:
    """Judge every claim by the newest records of the scans with metal."""
    runs = {(r.run.scene, r.run.seed, r.label): r for r in found if r.run.variant == METAL}
    return [_ordering(runs), *(_time(runs, method) for method in SLOWEST), _passes(runs)]


def _ordering(runs: Runs) -> Claim:
    """Compare the tissue's RMSE against the metal-free twin, seed by seed."""
    text = f"{SCENE}: RMSE of the tissue against the metal-free twin, NMAR < LIMAR < {SHARE:g} FDK, for every seed"
    errors: dict[int, dict[str, float]] = {}
    for (scene, seed, label), record in runs.items():
        score = record.scores.get("artefact")
        value = score.values.get("rmse") if score and scene == SCENE else None
        if value is not None:
            errors.setdefault(seed, {})[label] = value
    known = [e for _, e in sorted(errors.items()) if {"fdk", "limar", "nmar"} <= e.keys()]
    if not known:
        return Claim(text=text, found="no seed has all three", holds=None)
    shown = ", ".join(f"{m} {spread([e[m] for e in known])}" for m in ("fdk", "limar", "nmar"))
    holds = all(e["nmar"] < e["limar"] < SHARE * e["fdk"] for e in known)
    return Claim(text=text, found=f"{shown} HU ({len(known)} seeds)", holds=holds)


def _time(runs: Runs, method: str) -> Claim:
    """Compare a method's wall time with FDK's on the same scan."""
    text = f"{method.upper()} takes at most {SLOWEST[method]:g} times FDK's time, in the median over the scans"
    ratios = []
    for (scene, seed, label), record in runs.items():
        base = runs.get((scene, seed, "fdk"))
        if label == method and record.status == OK and record.cost and base is not None and base.cost:
            ratios.append(record.cost.wall / base.cost.wall)
    if not ratios:
        return Claim(text=text, found="no scan has both", holds=None)
    middle = statistics.median(ratios)
    found = f"{middle:.2f} ({min(ratios):.2f} to {max(ratios):.2f}, {len(ratios)} scans)"
    return Claim(text=text, found=found, holds=middle <= SLOWEST[method])


def _passes(runs: Runs) -> Claim:
    """Say what OS-SART's passes took; every run must have ended well."""
    text = f"OS-SART ends well after {PASSES} passes on every scan"
    mine = [record for (_, _, label), record in runs.items() if label == OS_SART]
    if not mine:
        return Claim(text=text, found="no run", holds=None)
    costs = [r.cost for r in mine if r.cost is not None]
    updates = ", ".join(map(str, sorted({cost.view_updates or 0 for cost in costs})))
    took = f"{spread([cost.wall for cost in costs])} s" if costs else "no time"
    holds = all(r.status == OK for r in mine)
    return Claim(text=text, found=f"{took} for {updates} view updates", holds=holds)


def spread(values: Sequence[float]) -> str:
    """Return mean ± standard deviation; the mean alone of a single value."""
    text = f"{statistics.fmean(values):.1f}"
    return text + (f" ± {statistics.stdev(values):.1f}" if len(values) > 1 else "")


def table(claims: Sequence[Claim]) -> Table:
    """Return the claims as a table."""
    words = {True: "yes", False: "**no**", None: "not measured"}
    rows = [[claim.text, claim.found, words[claim.holds]] for claim in claims]
    return simple(("claim", "found", "holds"), rows, title="Claims")
