"""`run-benchmark ablation DATA RESULTS`: what each part of the published splat method is worth.

The rows are those of the paper's tables whose suite is "ablation" (`benchmarks/studies/paper/tables.toml`): ordinary
methods with parameters, so that records, resuming and time limits are those of `run-benchmark`. A run that several rows
share is run once. Steps are a tenth of the published; so the rows compare with each other, not with a full run.
"""

import statistics
import sys
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ctsim.benchmarks.studies.paper.layout import load
from ctsim.benchmarks.studies.paper.tables import ABLATION
from ctsim.errors import InputError
from ctsim.human import human_time

if TYPE_CHECKING:
    from ctsim.benchmarks.engine.workers import Pool
    from ctsim.benchmarks.methods import Method
    from ctsim.benchmarks.studies.methods.records import Record
    from ctsim.benchmarks.studies.methods.run import Options, Task

NAME = "ablation.md"
# CPU seconds of a step of each preset on this suite, which ends with 65 536 splats, and its share of the warm-up, which
# takes as many steps on 8 views: 0.046 + 0.015 and 0.10 + 0.03, on one core of a busy AMD EPYC.
SECONDS = {"paper": 0.06, "r2": 0.13}


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


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every run ended well, 1 if one failed."""
    from ctsim.benchmarks.engine.limited import refuse_unless_positive

    given = tyro.cli(Arguments, prog="run-benchmark ablation", args=arguments)
    refuse_unless_positive(given.seconds)
    listed = variants(given.table)
    if given.dry_run:
        sys.stdout.write(estimate(listed, given.data, given.results))
        return 0
    from ctsim.benchmarks import make_dataset
    from ctsim.benchmarks.engine.workers import open_pool
    from ctsim.benchmarks.studies.methods.run import Options

    # what cannot run shows before scans are made
    options, pool = Options(seconds=given.seconds, anchor=False), open_pool(given.workers, None)
    methods_of(listed)
    scenes = list(dict.fromkeys(v.scene for v in listed))
    code = make_dataset.main([ABLATION, str(given.data), "--only", *scenes, "--workers", str(given.workers)])
    return code or _run(given, listed, options, pool)


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


def _run(
    given: Arguments, listed: list[Variant], options: "Options", workers: AbstractContextManager["Pool | None"]
) -> int:
    """Run what has no record, then render tables from all records, also after Ctrl-C."""
    from ctsim.benchmarks.studies.methods import records, run, tables
    from ctsim.benchmarks.studies.methods.study import work
    from ctsim.benchmarks.studies.paper import tables as paper_tables

    given.results.mkdir(parents=True, exist_ok=True)
    records.repair(given.results / records.NAME)
    groups = [(task,) for task in run.pending(tasks(listed, given.data), given.results, force=False)]
    try:
        with workers as pool:
            failed = work(groups, given.results, options, pool)
    finally:
        found, _ = records.read_all(given.results)
        if found:
            tables.write(found, given.results)
    text = paper_tables.text_of(found, "md", "paper", given.table or ablations())
    (given.results / NAME).write_text(text, encoding="utf-8")
    sys.stdout.write(f"{text}\nWritten: {given.results / NAME}; under all protocols table.md\n")
    return 1 if failed else 0


def methods_of(listed: list[Variant]) -> "dict[str, Method]":
    """Return the methods by their labels. Raises InputError for a method or a parameter that does not exist."""
    from ctsim.benchmarks.methods import find

    return {variant.label: find(variant.method, variant.params) for variant in listed}


def tasks(listed: list[Variant], data: Path) -> "list[Task]":
    """Return the runs as tasks, scene by scene; those of scenes that are not in `data` are left out."""
    from ctsim.benchmarks.studies.methods.run import tasks_on
    from ctsim.store import list_scans, open_scan

    methods = methods_of(listed)
    folders = {folder.name: folder for folder in list_scans(data)} if data.is_dir() else {}
    found = []
    for scene in dict.fromkeys(variant.scene for variant in listed):
        if scene in folders:
            stored = open_scan(folders[scene])
            labels = [variant.label for variant in listed if variant.scene == scene]
            found += tasks_on(stored, ("metal",), [(methods[label], (0, 0)) for label in labels])
    return found


def estimate(listed: list[Variant], data: Path, results: Path) -> str:
    """Return what --dry-run prints: the runs, the rows that show them, what is recorded, and what the rest costs."""
    from ctsim.benchmarks.studies.methods import records
    from ctsim.benchmarks.studies.methods.run import pending

    found = [r for r in records.read_all(results)[0] if r.status == records.OK and r.cost is not None]
    there = tasks(listed, data)
    left = {(task.stored.name, task.method.label) for task in pending(there, results, force=False)}
    done = {(task.stored.name, task.method.label) for task in there} - left
    took = {(r.run.scene, r.label): r.cost.wall for r in found if r.cost is not None}
    rates, total = _rates(found), 0.0
    lines = [("run", "scene", "rows", "state", "time")]
    for v in listed:
        key = (v.scene, v.label)
        seconds = took[key] if key in done else rates[v.params["preset"]] * v.params["steps"]
        total += 0 if key in done else seconds
        state = "recorded" if key in done else "to run"
        lines.append((v.label, v.scene, "; ".join(v.rows), state, human_time(seconds)))
    widths = [max(len(line[k]) for line in lines) for k in range(4)]
    text = "".join("  ".join([*(t.ljust(w) for t, w in zip(x, widths, strict=False)), x[4]]) + "\n" for x in lines)
    scenes = dict.fromkeys(v.scene for v in listed if v.scene not in {task.stored.name for task in there})
    if scenes:
        names = " ".join(scenes)
        text += f"scans to be made first: {names} (make-dataset {ABLATION} {data} --dry-run --only {names})\n"
    steps = ", ".join(f"{preset} {human_time(rate)}" for preset, rate in rates.items())
    return (
        f"{text}total: {len(listed) - len(done)} of {len(listed)} runs, {human_time(total)}, by the time of a step "
        f"({steps}): of {'the records' if rates != SECONDS else 'one core, measured once'}\n"
    )


def _rates(found: "list[Record]") -> dict[str, float]:
    """Return the seconds that a step of each preset takes, warm-up included: as recorded, else as measured once."""
    known: dict[str, list[float]] = {}
    for record in found:
        preset, steps = (record.run.params.get(name) for name in ("preset", "steps"))
        if preset in SECONDS and steps and record.cost is not None:
            known.setdefault(preset, []).append((record.cost.wall + record.cost.warm_up) / steps)
    return SECONDS | {preset: statistics.median(values) for preset, values in known.items()}
