"""`run-benchmark ablation DATA RESULTS`: what each part of the published splat method contributes.

The rows are those of the paper's tables whose suite is "ablation" (`benchmarks/studies/paper/tables.toml`): ordinary
methods with parameters, so records, resuming and time limits work as in `run-benchmark`. A run that several rows share
is run once. Steps are a tenth of the published number, so rows compare with each other, not with a full run.
"""

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.engine.host import check_workers
from ctsim.benchmarks.engine.process import check_limit
from ctsim.benchmarks.engine.study import listing, measure_all
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.studies.methods import plan, records
from ctsim.benchmarks.studies.methods.records import METAL, Run, RunRecord, RunTask, task_of
from ctsim.benchmarks.studies.methods.study import Flags as RunFlags
from ctsim.benchmarks.studies.methods.study import Methods
from ctsim.benchmarks.studies.paper.layout import Planned, load
from ctsim.benchmarks.studies.paper.tables import ABLATION, text_of
from ctsim.dataset.durable import write_synced
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.human import human_time

NAME = "ablation.md"
# CPU seconds per step of each method on this suite, which ends with 65 536 splats. They include the warm-up, which
# takes the same number of steps on 8 views: 0.046 + 0.015 and 0.10 + 0.03, on one core of a busy AMD EPYC.
SECONDS = {"splat-paper": 0.06, "splat-r2": 0.13}


@dataclass(frozen=True)
class Flags:
    """Run the paper's ablations of its splat method on the suite `ablation`, and print the paper's tables of them.

    Missing scans are made; runs that RESULTS already holds are not repeated.
    """

    data: tyro.conf.Positional[Path]
    """The data folder; missing scans are made."""
    results: tyro.conf.Positional[Path]
    """The folder for records, tables and volumes."""
    table: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Only the rows of this table of the paper; may be given several times (default: all)."""
    seconds: float | None = None
    """Time limit of one run, its start included; each run then has a process of its own."""
    workers: int = 1
    """Number of runs at once, each with its share of the cores: runs this small gain little from threads."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the rows and what they will cost; run nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant(Planned):
    """One run, and the rows "table: name" that show it."""

    rows: tuple[str, ...]


class Ablation(Methods):
    """The study of methods, on the paper's variants; `rates` are the seconds of a step by method."""

    def __init__(self, listed: Sequence[Variant], rates: dict[str, float]) -> None:
        super().__init__()
        self._listed = {(v.scene, v.label): v for v in listed}
        self._chosen, self._rates = methods_of(listed), rates

    def jobs(self, given: RunFlags) -> list[plan.Job]:
        """List the runs scene by scene, without scenes that are not in the data folder."""
        folders = {folder.name: folder for folder in list_scans(given.data)} if given.data.is_dir() else {}
        found: list[plan.Job] = []
        for scene in dict.fromkeys(scene for scene, _ in self._listed):
            if scene in folders:
                placed = [(self._chosen[label], (0, 0)) for where, label in self._listed if where == scene]
                found += plan.jobs_on(open_scan(folders[scene]), (METAL,), placed)
        return found

    def expected(self, task: RunTask, given: RunFlags) -> float | None:
        """Return the seconds of a run by the time of a step."""
        variant = self._listed[task.settings.scene, task.subject]
        return self._rates[variant.method] * variant.params["steps"]

    def line(self, task: RunTask) -> tuple[str, str]:
        """Return the run and the rows of the paper's tables that show it."""
        variant = self._listed[task.settings.scene, task.subject]
        return f"{variant.label}  {variant.scene}", "; ".join(variant.rows)


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every run ended well, 1 if one failed."""
    asked = tyro.cli(Flags, prog="run-benchmark ablation", args=arguments)
    check_limit(asked.seconds)
    check_workers(asked.workers, None)
    listed, known = variants(asked.table), records.read(asked.results)
    rates = _rates(known)
    study = Ablation(listed, rates)
    given = RunFlags(data=asked.data, results=asked.results, seconds=asked.seconds, workers=asked.workers, anchor=False)
    if asked.dry_run:
        sys.stdout.write(_planned(study, listed, known, given))
        steps = ", ".join(f"{method} {human_time(rate)}" for method, rate in rates.items())
        how = "the records" if rates != SECONDS else "one core, measured once"
        sys.stdout.write(f"by the time of a step ({steps}): of {how}\n")
        return 0
    scenes = dict.fromkeys(v.scene for v in listed)
    code = make_dataset.main([ABLATION, str(given.data), "--only", *scenes, "--workers", str(given.workers)])
    if code:
        return code
    failed = measure_all(study, study.tasks(given), known, given)
    found = records.read(given.results)
    study.write(found, given)
    text = text_of(found, "md", "paper", asked.table or ablations())
    write_synced(given.results / NAME, text.encode())
    sys.stdout.write(f"{text}\nWritten: {given.results / NAME}; under all protocols table.md\n")
    return 1 if failed else 0


def _planned(study: Ablation, listed: Sequence[Variant], known: Sequence[RunRecord], given: RunFlags) -> str:
    """Return the runs left to do with the rows that show them; runs whose scans are missing come last."""
    tasks = study.tasks(given)
    there = {task.settings.scene for task in tasks}
    missing = [v for v in listed if v.scene not in there]
    runs = [Run(scene=v.scene, scene_id="", seed=0, method=v.method, params=v.params) for v in missing]
    later = [task_of(run, v.label, data="", code="") for run, v in zip(runs, missing, strict=True)]
    text = listing(study, [*study.pending(tasks, known, given), *later], known, given, len(tasks) + len(later))
    if later:
        names = " ".join(dict.fromkeys(v.scene for v in missing))
        text += f"scans to be made first: {names} (make-dataset {ABLATION} {given.data} --dry-run --only {names})\n"
    return text


def variants(numbers: tuple[int, ...] = ()) -> list[Variant]:
    """Return the runs of the numbered tables, by default of all ablations.

    Raises InputError for a table that is not an ablation.
    """
    known = ablations()
    for number in numbers:
        if number not in known:
            raise InputError(f"--table {number}: the ablations are tables {', '.join(map(str, known))}")
    found: dict[tuple[str, str], Planned] = {}
    rows: dict[tuple[str, str], dict[str, None]] = {}
    for layout in (layout for layout in load().table if layout.number in (numbers or known)):
        for row, planned in zip(layout.rows, layout.plan(), strict=True):
            for column, p in zip(layout.columns, planned, strict=True):
                name = f"{layout.number}: {', '.join(filter(None, (*row.stubs, column.group)))}"
                rows.setdefault((p.scene, p.label), {})[name] = None
                found[p.scene, p.label] = p
    return [
        Variant(suite=p.suite, scene=p.scene, method=p.method, params=p.params, rows=tuple(rows[key]))
        for key, p in found.items()
    ]


def ablations() -> tuple[int, ...]:
    """Return the numbers of the paper's tables that are ablations."""
    return tuple(layout.number for layout in load().table if layout.suite == ABLATION)


def methods_of(listed: Sequence[Variant]) -> dict[str, Method]:
    """Return the methods by their labels. Raises InputError for a method or a parameter that does not exist."""
    return {variant.label: find(variant.method, variant.params) for variant in listed}


def _rates(found: Sequence[RunRecord]) -> dict[str, float]:
    """Return the seconds per step of each method, warm-up included: from records, else from `SECONDS`."""
    known: dict[str, list[float]] = {}
    for record in (r for r in found if r.finished):
        method, steps = record.label.partition("[")[0], record.run.params.get("steps")
        if method in SECONDS and steps and record.cost is not None:
            known.setdefault(method, []).append((record.cost.wall + record.cost.warm_up) / steps)
    return SECONDS | {method: statistics.median(values) for method, values in known.items()}
