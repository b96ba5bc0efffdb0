"""`run-benchmark ablation DATA RESULTS`: what each part of the published splat method is worth.

The rows are those of the paper's tables whose suite is "ablation" (`benchmarks/studies/paper/tables.toml`): ordinary
methods with parameters, so that records, resuming and time limits are those of `run-benchmark`. A run that several rows
share is run once. Steps are a tenth of the published; so the rows compare with each other, not with a full run.
"""

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.engine.process import check_limit
from ctsim.benchmarks.engine.study import listing, measure_all
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.studies.methods import plan, records
from ctsim.benchmarks.studies.methods.records import METAL, Run, RunRecord, RunTask, task_of
from ctsim.benchmarks.studies.methods.study import Flags, Methods
from ctsim.benchmarks.studies.paper.layout import load
from ctsim.benchmarks.studies.paper.tables import ABLATION, text_of
from ctsim.durable import write_synced
from ctsim.errors import InputError
from ctsim.human import human_time
from ctsim.store import list_scans, open_scan

NAME = "ablation.md"
# CPU seconds of a step of each method on this suite, which ends with 65 536 splats, and its share of the warm-up, which
# takes as many steps on 8 views: 0.046 + 0.015 and 0.10 + 0.03, on one core of a busy AMD EPYC.
SECONDS = {"splat-paper": 0.06, "splat-r2": 0.13}


@dataclass(frozen=True)
class Arguments:
    """Take the published splat method apart on the suite `ablation`, and print the paper's tables of it.

    Scans that are missing are made; what RESULTS already holds is not run again.
    """

    data: tyro.conf.Positional[Path]
    """The data folder; scans that are missing are made."""
    results: tyro.conf.Positional[Path]
    """The folder for records, tables and volumes."""
    table: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Only the rows of this table of the paper; may be given several times (default: all)."""
    seconds: float | None = None
    """Time limit of one run, its start included; each run then has a process of its own."""
    workers: int = 1
    """Do so many runs at once, each with its share of the cores: these are too small to gain much by threads."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the rows and what they will cost; run nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One run: scene, method, parameters, the label of its records, and the rows "table: name" that show it."""

    scene: str
    method: str
    params: dict[str, Any]
    label: str
    rows: tuple[str, ...]


class Ablation(Methods):
    """The study of methods, on the paper's variants."""

    def __init__(self, listed: "Sequence[Variant]") -> None:
        super().__init__()
        self._listed = {(v.scene, v.label): v for v in listed}
        self.rates = dict(SECONDS)

    def jobs(self, given: Flags) -> list[plan.Job]:
        """List the runs scene by scene; those of scenes that are not in the data folder are left out."""
        chosen = methods_of(list(self._listed.values()))
        folders = {folder.name: folder for folder in list_scans(given.data)} if given.data.is_dir() else {}
        found: list[plan.Job] = []
        for scene in dict.fromkeys(scene for scene, _ in self._listed):
            if scene in folders:
                placed = [(chosen[label], (0, 0)) for where, label in self._listed if where == scene]
                found += plan.jobs_on(open_scan(folders[scene]), (METAL,), placed)
        return found

    def pending(self, tasks: Sequence[RunTask], records: Sequence[RunRecord], given: Flags) -> list[RunTask]:
        """Return the runs that have no record."""
        self.rates = _rates(records)
        return super().pending(tasks, records, given)

    def expected(self, task: RunTask, given: Flags) -> float | None:
        """Return the seconds of a run by the time of a step."""
        variant = self._listed[task.settings.scene, task.subject]
        return self.rates[variant.method] * variant.params["steps"]

    def line(self, task: RunTask) -> tuple[str, str]:
        """Return the run and the rows of the paper's tables that show it."""
        variant = self._listed[task.settings.scene, task.subject]
        return f"{variant.label}  {variant.scene}", "; ".join(variant.rows)

    def to_come(self, given: Flags) -> list[RunTask]:
        """Return the runs on scans that are to be made first, whose data nobody knows yet."""
        there = {job.stored.name for job in self.jobs(given)}
        missing = [v for v in self._listed.values() if v.scene not in there]
        runs = (Run(scene=v.scene, scene_id="", seed=0, method=v.method, params=v.params) for v in missing)
        return [task_of(run, v.label, data="", code="") for run, v in zip(runs, missing, strict=True)]


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every run ended well, 1 if one failed."""
    asked = tyro.cli(Arguments, prog="run-benchmark ablation", args=arguments)
    check_limit(asked.seconds)
    listed = variants(asked.table)
    methods_of(listed)
    study = Ablation(listed)
    given = Flags(data=asked.data, results=asked.results, seconds=asked.seconds, workers=asked.workers, anchor=False)
    scenes = list(dict.fromkeys(v.scene for v in listed))
    if asked.dry_run:
        sys.stdout.write(_planned(study, given))
        return 0
    code = make_dataset.main([ABLATION, str(given.data), "--only", *scenes, "--workers", str(given.workers)])
    if code:
        return code
    failed = measure_all(study, study.tasks(given), records.read(given.results), given)
    found = records.read(given.results)
    study.write(found, given)
    text = text_of(found, "md", "paper", asked.table or ablations())
    write_synced(given.results / NAME, text.encode())
    sys.stdout.write(f"{text}\nWritten: {given.results / NAME}; under all protocols table.md\n")
    return 1 if failed else 0


def _planned(study: Ablation, given: Flags) -> str:
    """Return what --dry-run prints: the runs that are left with the rows that show them, and scans to be made."""
    known, tasks, later = records.read(given.results), study.tasks(given), study.to_come(given)
    left = [*study.pending(tasks, known, given), *later]
    text = listing(study, left, known, given, len(tasks) + len(later))
    if later:
        names = " ".join(dict.fromkeys(task.settings.scene for task in later))
        text += f"scans to be made first: {names} (make-dataset {ABLATION} {given.data} --dry-run --only {names})\n"
    steps = ", ".join(f"{method} {human_time(rate)}" for method, rate in study.rates.items())
    how = "the records" if study.rates != SECONDS else "one core, measured once"
    return f"{text}by the time of a step ({steps}): of {how}\n"


def variants(numbers: tuple[int, ...] = ()) -> list[Variant]:
    """Return the runs of the numbered tables, of all that are ablations where none is named.

    Raises InputError for a table that is none.
    """
    known = ablations()
    for number in numbers:
        if number not in known:
            raise InputError(f"--table {number}: the ablations are tables {', '.join(map(str, known))}")
    found: dict[tuple[str, str], Variant] = {}
    for table in load().table:
        for row in table.rows if table.number in (numbers or known) else ():
            for column in table.columns:
                p = table.planned(row, column)
                name = f"{table.number}: {', '.join(filter(None, (*row.stubs, column.group)))}"
                before = found[p.scene, p.label].rows if (p.scene, p.label) in found else ()
                rows = tuple(dict.fromkeys((*before, name)))
                found[p.scene, p.label] = Variant(
                    scene=p.scene, method=p.method, params=p.params, label=p.label, rows=rows
                )
    return list(found.values())


def ablations() -> tuple[int, ...]:
    """Return the numbers of the paper's tables that are ablations."""
    return tuple(table.number for table in load().table if table.suite == ABLATION)


def methods_of(listed: Sequence[Variant]) -> dict[str, Method]:
    """Return the methods by their labels. Raises InputError for a method or a parameter that does not exist."""
    return {variant.label: find(variant.method, variant.params) for variant in listed}


def _rates(found: Sequence[RunRecord]) -> dict[str, float]:
    """Return the seconds that a step of each method takes, warm-up included: as recorded, else as measured once."""
    known: dict[str, list[float]] = {}
    for record in (r for r in found if r.finished):
        method, steps = record.label.partition("[")[0], record.run.params.get("steps")
        if method in SECONDS and steps and record.cost is not None:
            known.setdefault(method, []).append((record.cost.wall + record.cost.warm_up) / steps)
    return SECONDS | {method: statistics.median(values) for method, values in known.items()}
