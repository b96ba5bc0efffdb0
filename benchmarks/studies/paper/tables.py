"""`run-benchmark paper-tables RESULTS...`: all tables of the paper, its own figures beside what was measured here.

Ours come from the records of one or several results folders; nothing is computed. A record counts where it is of the
very scene, of any seed, that the table plans; those of others of its name are counted below the table. A cell without a
record is "–", and the command that makes it stands there, too.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro

from ctsim.benchmarks.engine.record import OK, merged
from ctsim.benchmarks.methods import TABLE
from ctsim.benchmarks.scores.protocol import VERSION
from ctsim.benchmarks.studies.methods import records, tables
from ctsim.benchmarks.studies.methods.records import RunRecord, case_of
from ctsim.benchmarks.studies.paper.layout import (
    Cell,
    Form,
    Paper,
    Planned,
    Sheet,
    Table,
    duration,
    load,
    printed,
    render,
)
from ctsim.benchmarks.studies.paper.scenes import Scenes, strangers, title
from ctsim.errors import InputError

Protocol = Literal["paper", "tissue", "aligned", "aligned_50kev"]
ABLATION = "ablation"
"""The suite that `run-benchmark ablation` makes and runs."""


@dataclass(frozen=True)
class Arguments:
    """Print the paper's tables, its own figures beside ours from records, computing nothing."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with records of run-benchmark; of a run that is in several the newest counts."""
    form: Form = "md"
    """Markdown or LaTeX (booktabs)."""
    protocol: Protocol = "paper"
    """What ours are scored under; `paper` is nearest to what the paper may have done."""
    table: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Only this table of the paper; may be given several times (default: all)."""


def main(arguments: list[str]) -> int:
    """Run the command; return 0."""
    given = tyro.cli(Arguments, prog="run-benchmark paper-tables", args=arguments)
    sys.stdout.write(text_of(read(given.results), given.form, given.protocol, given.table))
    return 0


def read(folders: tuple[Path, ...]) -> "list[RunRecord]":
    """Read the records of all folders, oldest first. Raises InputError where a folder or all are missing."""
    if not folders:
        raise InputError("no folder is given, expected one or more with records of run-benchmark")
    found: list[list[RunRecord]] = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder, expected one with records of run-benchmark")
        found.append(records.read(folder))
    return merged(found)


def text_of(found: "list[RunRecord]", form: Form, protocol: Protocol, numbers: tuple[int, ...] = ()) -> str:
    """Return the numbered tables, all where none is named, as text.

    Raises InputError for a table that the paper lacks.
    """
    paper = load()
    measured = Measured.of(found, paper)
    parts = [render(fill(t, measured, protocol), form) for t in chosen(paper, numbers)]
    said = records.remarks(found)
    mark = "" if form == "md" else "% "
    head = f"{mark}Columns “paper”: as printed in {paper.source}. Columns “here”: records of run-benchmark.\n"
    return "\n".join([head, *parts, *(f"{mark}{text}.\n" for text in said)])


def chosen(paper: Paper, numbers: tuple[int, ...]) -> list[Table]:
    """Return the tables of these numbers, all where none is given."""
    known = [table.number for table in paper.table]
    for number in numbers:
        if number not in known:
            raise InputError(f"--table {number}: the paper has tables {known[0]} to {known[-1]}")
    return [table for table in paper.table if not numbers or table.number in numbers]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What the tables take from records: those that count of each planned scene and label, and their means over seeds.

    Scenes are called SUITE/NAME. `replaced` counts by scene the records of data that were made anew since; `all` are
    the records before, whose scenes have the names of the scans.
    """

    runs: "dict[tuple[str, str], list[RunRecord]]"
    numbers: dict[tuple[str, str, str, str], dict[Any, Any]]
    replaced: dict[str, int]
    all: "list[RunRecord]"
    scenes: Scenes

    @classmethod
    def of(cls, found: "list[RunRecord]", paper: Paper) -> "Measured":
        """Keep what counts of records that are sorted by time."""
        from ctsim.benchmarks.studies.methods import records, tables

        scenes = Scenes((p.suite, p.scene) for table in paper.table for row in table.plan() for p in row)
        own = [r for r in found if r.run.variant == "metal" and r.task.version == VERSION]
        known = [_called(r, title(key)) for r in own if (key := scenes.of(r.run)) is not None]
        latest = records.latest(known)
        runs: dict[tuple[str, str], list[RunRecord]] = {}
        for record in latest:
            runs.setdefault((record.run.scene, record.label), []).append(record)
        data = {(r.run.scene, r.run.seed): r.task.data for r in latest}
        replaced: dict[str, int] = {}
        for record in known:
            if record.task.data != data[record.run.scene, record.run.seed]:
                replaced[record.run.scene] = replaced.get(record.run.scene, 0) + 1
        rows: list[dict[Any, Any]] = tables.summary(latest).to_dict("records")
        numbers = {(row["scene"], row["method"], row["protocol"], row["metric"]): row for row in rows}
        return cls(runs=runs, numbers=numbers, replaced=replaced, all=own, scenes=scenes)


def _called(record: "RunRecord", scene: str) -> "RunRecord":
    """Return a record whose scene has this name; the identity stays that of the run as it was."""
    run = msgspec.structs.replace(record.run, scene=scene)
    task = msgspec.structs.replace(record.task, settings=run, case=case_of(run))
    return msgspec.structs.replace(record, task=task)


def fill(table: Table, measured: Measured, protocol: str) -> Sheet:
    """Fill a table from records."""
    planned = table.plan()
    here = [[_cell(table, k, p, measured, protocol) for k, p in enumerate(row)] for row in planned]
    paper = [[printed(text) for text in row.figures or ("",) * len(table.columns)] for row in table.rows]
    every = {(p.place, p.label): p for row in planned for p in row}
    strange = strangers(measured.all, measured.scenes, [(p.suite, p.scene, p.label) for p in every.values()])
    used = [record for key in every for record in measured.runs.get(key, [])]
    missing = [p for key, p in every.items() if key not in measured.runs]
    sheet = Sheet(
        table=table,
        caption=caption(table, used, protocol),
        cells={"paper": paper, "here": here},
        notes=[*([table.note] if table.note else []), *_remarks(used, measured), *strange, *commands(table, missing)],
    )
    return sheet.ranked()


def _cell(table: Table, k: int, planned: Planned, measured: Measured, protocol: str) -> Cell:
    """Return our cell of column `k`: mean ± standard deviation over seeds; of a failed run its status."""
    metric = table.columns[k].metric
    runs = measured.runs.get((planned.place, planned.label), [])
    bad = [r.status for r in runs if r.status != OK]
    if bad:
        return Cell(text=bad[-1])
    row = measured.numbers.get((planned.place, planned.label, "cost" if metric == "wall" else protocol, metric))
    if row is None or row["n"] == 0:
        return Cell(text="identical") if row is not None and row["identical"] else Cell()
    if metric == "wall":
        texts = [duration(row[part]) for part in ("mean", "std") if row["n"] > 1 or part == "mean"]
    else:
        texts = [f"{row[part]:.{table.digits(k)}f}" for part in ("mean", "std") if row["n"] > 1 or part == "mean"]
    return Cell(number=float(row["mean"]), text=" ± ".join(texts))


def caption(table: Table, used: "list[RunRecord]", protocol: str) -> str:
    """State protocol, region, reference, range, seeds, inputs and metal insertion of our columns, and what compares."""
    timed = all(column.metric == "wall" for column in table.columns)
    parts = [f"The paper's Table {table.number} and what was measured here."]
    if not timed:
        parts.append("The paper states neither the region, nor the energy of the reference, nor the peak of PSNR3D.")
    parts.append(f"Here: {tables.caption(used, 'cost' if timed else protocol)}")
    steps = sorted({p.params["steps"] for row in table.plan() for p in row if "steps" in p.params})
    if steps:
        parts.append(f"A run has {' or '.join(map(str, steps))} steps here, a tenth of the published.")
    if used:
        parts += _circumstances(used, timed)
    else:
        parts.append("There is no record yet.")
    parts.append("The phantoms differ from the paper's: orders and gains compare, values do not.")
    if table.rank:
        where = {"down": "column", "across": "row"}[table.rank]
        parts.append(f"The best of a {where} is bold on either side, the second underlined, whatever its inputs.")
    return " ".join(parts)


def _circumstances(used: "list[RunRecord]", timed: bool) -> list[str]:
    """Say under which circumstances the records came about."""
    seeds = sorted({r.run.seed for r in used})
    counts = {len({r.run.seed for r in used if (r.run.scene, r.label) == (s.run.scene, s.label)}) for s in used}
    alike = "" if counts == {len(seeds)} else ", not all of them in each cell"
    parts = [f"Seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}{alike}."]
    voxels = {r.run.scene: r.scores["paper"].n_voxels for r in used if "paper" in r.scores}
    if voxels:
        sizes = {n: _joined(s for s, m in voxels.items() if m == n) for n in sorted(voxels.values())}
        parts.append(f"Grid: {'; '.join(f'{n} voxels ({scenes})' for n, scenes in sizes.items())}.")
    if timed:
        hosts = dict.fromkeys(
            f"{r.host.cpu}, {r.host.threads} threads, device {r.cost.device}" for r in used if r.host and r.cost
        )
        return [*parts, f"Measured on {_joined(hosts, '; ')}."] if hosts else parts
    inputs = _by(used, lambda r: r.inputs if r.run.mask == "none" else f"{r.inputs}, {r.run.mask}")
    metal = _by(used, lambda r: str(r.run.params.get("insert", "reconstructed like the rest")))
    return [*parts, f"Inputs: {inputs}.", f"Metal insertion: {metal}."]


def _by(used: "list[RunRecord]", what: "Callable[[RunRecord], str]") -> str:
    """Group the methods of records by what they have in common: "metal mask, oracle (limar, nmar)"."""
    groups: dict[str, dict[str, None]] = {}
    for record in used:
        groups.setdefault(what(record), {})[record.label.partition("[")[0]] = None
    return "; ".join(f"{text} ({_joined(names)})" for text, names in groups.items())


def _joined(texts: Iterable[str], by: str = ", ") -> str:
    return by.join(dict.fromkeys(texts))


def _remarks(used: "list[RunRecord]", measured: Measured) -> list[str]:
    """Say which runs failed and why, and how many records older data have left behind."""
    failed = [f"{r.run.scene}, {r.label}: {r.status} – {r.reason or 'no reason given'}" for r in used if r.status != OK]
    scenes = dict.fromkeys(r.run.scene for r in used)
    old = [
        f"{s}: {measured.replaced[s]} records of older data are left out; the scan was made anew"
        for s in scenes
        if s in measured.replaced
    ]
    return failed + old


def commands(table: Table, missing: list[Planned]) -> list[str]:
    """Name the commands that make the cells without a record."""
    strange = dict.fromkeys(p.method for p in missing if p.method not in TABLE)
    notes = [f"–: there is no method {', '.join(strange)} in `benchmarks/methods.py`"] if strange else []
    missing = [p for p in missing if p.method in TABLE]
    if any(p.suite == ABLATION for p in missing):
        notes.append(f"–: `run-benchmark ablation data/ results/ --table {table.number}`")
    scenes: dict[tuple[str, str, str], list[str]] = {}
    for p in missing:
        if p.suite != ABLATION:
            scenes.setdefault((p.suite, p.method, p.flags), []).append(p.scene)
    batches: dict[tuple[str, tuple[str, ...]], list[dict[str, str]]] = {}
    for (suite, method, flags), names in scenes.items():
        batch = batches.setdefault((suite, tuple(names)), [{}])
        if method in batch[-1]:  # a command has one set of parameters for a method
            batch.append({})
        batch[-1][method] = flags
    for (suite, names), batch in batches.items():
        where = "".join(f" --scene {name}" for name in names)
        runs = [f"`run-benchmark data/ results/{where} {' '.join(flags.values())}`" for flags in batch]
        notes.append(f"–: `make-dataset {suite} data/`, then {', '.join(runs)}")
    return notes
