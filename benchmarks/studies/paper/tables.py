"""`run-benchmark paper-tables RESULTS...`: all tables of the paper, its own figures next to what was measured here.

Our figures come from the records of one or several results folders; no score is computed. A record counts if its scene
is the planned one, with any seed; records of other scenes of that name are counted below the table. A cell without a
record is "–"; the command that makes the record is given below.
"""

import functools
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro

from ctsim.benchmarks import suites
from ctsim.benchmarks.engine.record import OK, merged
from ctsim.benchmarks.engine.table import Cell, Column, Table, ranked
from ctsim.benchmarks.methods import FAILED, TABLE
from ctsim.benchmarks.scores.score import VERSION
from ctsim.benchmarks.studies.methods import captions, records, tables
from ctsim.benchmarks.studies.methods.records import METAL, Run, RunRecord, case_of
from ctsim.benchmarks.studies.paper.layout import NONE, PaperTable, Planned, duration, load, printed
from ctsim.errors import InputError

Form = Literal["md", "tex"]
Protocol = Literal["paper", "tissue", "aligned", "aligned_50kev"]
ABLATION = "ablation"
"""The suite that `run-benchmark ablation` makes and runs."""


@dataclass(frozen=True)
class Flags:
    """Print the paper's tables: its figures next to ours, which are read from records."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with records of run-benchmark; if a run is in several, the newest counts."""
    form: Form = "md"
    """Markdown or LaTeX (booktabs)."""
    protocol: Protocol = "paper"
    """The protocol of our scores; `paper` is nearest to what the paper may have done."""
    table: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Only this table of the paper; may be given several times (default: all)."""


def main(arguments: list[str]) -> int:
    """Run the command; return 0. Raises InputError where a folder is not there, or none is given."""
    given = tyro.cli(Flags, prog="run-benchmark paper-tables", args=arguments)
    if not given.results:
        raise InputError("no folder is given, expected one or more with records of run-benchmark")
    for folder in given.results:
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder, expected one with records of run-benchmark")
    found = merged([records.read(folder) for folder in given.results])
    sys.stdout.write(text_of(found, given.form, given.protocol, given.table))
    return 0


def text_of(found: Sequence[RunRecord], form: Form, protocol: Protocol, numbers: tuple[int, ...] = ()) -> str:
    """Return the numbered tables, all where none is named, as text.

    Raises InputError for a table that the paper lacks.
    """
    known = [layout.number for layout in load().table]
    for number in numbers:
        if number not in known:
            raise InputError(f"--table {number}: the paper has tables {known[0]} to {known[-1]}")
    sheets, mark = filled(found, protocol, numbers), "% " if form == "tex" else ""
    parts = [sheet.markdown() if form == "md" else sheet.in_latex() for sheet in sheets]
    head = f"{mark}Columns “paper”: as printed in {load().source}. Columns “here”: records of run-benchmark.\n"
    return "\n".join([head, *parts, *(f"{mark}{text}.\n" for text in records.remarks(found))])


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet(Table):
    """A table of the paper that is filled; `rivals` are the groups of cells (row, column) that compete."""

    number: int
    name: str
    rivals: Sequence[Sequence[tuple[int, int]]] = ()

    def places(self) -> dict[tuple[int, int], str]:
        """Return {(row, column): "best" or "second"} within each group."""
        found: dict[tuple[int, int], str] = {}
        for group in self.rivals:
            places = ranked([self.rows[i][k].number for i, k in group], self.columns[group[0][1]].better)
            found |= {group[n]: place for n, place in places.items()}
        return found

    def in_latex(self) -> str:
        """Return the table in LaTeX, where the caption has to say the name, too."""
        named = replace(self, caption=f"{self.name}. {self.caption}")
        return named.latex(f"tab:paper-{self.number}", footnotes=True)


def filled(found: Sequence[RunRecord], protocol: Protocol, numbers: tuple[int, ...] = ()) -> list[Sheet]:
    """Return the numbered tables, all where none is named, filled from records that are sorted by time."""
    paper = load().table
    measured = Measured.of(found, [p for layout in paper for row in layout.plan() for p in row])
    return [fill(layout, measured, protocol) for layout in paper if not numbers or layout.number in numbers]


def fill(layout: PaperTable, measured: "Measured", protocol: Protocol) -> Sheet:
    """Fill a table from records. Cells compete within their side and metric, those of different scenes never."""
    columns, plan = [Column(stub) for stub in layout.stubs], layout.plan()
    sides = [("paper", "here") if layout.published(k) else ("here",) for k in range(len(layout.columns))]
    for heading, parts in zip(layout.columns, sides, strict=True):
        columns += [Column(heading.title, heading.group, True, heading.shown.better, part) for part in parts]
    rows, rivals = [], dict[tuple[str, str, int, str], list[tuple[int, int]]]()
    for i, (row, planned) in enumerate(zip(layout.rows, plan, strict=True)):
        failed = {FAILED.get(p.label, "") for p in planned} - {""}
        rows.append([Cell(stub) for stub in row.stubs])
        if failed and len({p.label for p in planned}) == 1:
            rows[-1][-1] = Cell(f"{row.stubs[-1]} †{failed.pop()}")
        for k, p in enumerate(planned):
            for side in sides[k]:
                key = (layout.columns[k].metric, p.place, i if layout.rank == "across" else k, side)
                rivals.setdefault(key, []).append((i, len(rows[-1])))
                figure = row.figures[k] if row.figures else ""
                rows[-1].append(printed(figure) if side == "paper" else _cell(layout, k, p, measured, protocol))
    every = {(p.place, p.label): p for row in plan for p in row}
    used = [record for key in every for record in measured.runs.get(key, [])]
    missing = [p for key, p in every.items() if key not in measured.runs]
    return Sheet(
        number=layout.number,
        name=layout.title,
        title=f"Table {layout.number}. {layout.title}",
        caption=caption(layout, used, protocol),
        columns=columns,
        rows=rows,
        notes=[
            *([layout.note] if layout.note else []),
            *_remarks(used, measured),
            *strangers(measured, every.values()),
            *commands(layout, missing),
        ],
        rivals=list(rivals.values()) if layout.rank else [],
    )


def _cell(layout: PaperTable, k: int, planned: Planned, measured: "Measured", protocol: str) -> Cell:
    """Return our cell of column `k`: mean ± standard deviation over seeds; of a failed run its status."""
    metric = layout.columns[k].metric
    bad = [r.status for r in measured.runs.get((planned.place, planned.label), []) if r.status != OK]
    if bad:
        return Cell(bad[-1])
    row = measured.numbers.get((planned.place, planned.label, "cost" if metric == "wall" else protocol, metric))
    if row is None or row["n"] == 0:
        return Cell("identical") if row is not None and row["identical"] else NONE
    values = [row["mean"], row["std"]] if row["n"] > 1 else [row["mean"]]
    texts = [duration(v) if metric == "wall" else f"{v:.{layout.digits(k)}f}" for v in values]
    return Cell(" ± ".join(texts), float(row["mean"]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """The records that count for each planned scene and label, and their means over seeds.

    Scenes are called SUITE/NAME. `replaced` counts by scene the records of data that was made again since; `all` are
    all records, with the scans' names for scenes. `suites` are the suites that plan a scene, by its name.
    """

    runs: dict[tuple[str, str], list[RunRecord]]
    numbers: dict[tuple[str, str, str, str], dict[Any, Any]]
    replaced: Counter[str]
    all: list[RunRecord]
    suites: dict[str, dict[str, None]]

    @classmethod
    def of(cls, found: Sequence[RunRecord], planned: Sequence[Planned]) -> "Measured":
        """Select from records that are sorted by time."""
        named: dict[str, dict[str, None]] = {}
        for p in planned:
            named.setdefault(p.scene, {})[p.suite] = None
        own = [r for r in found if r.run.variant == METAL and r.task.version == VERSION]
        known = [_called(r, place) for r in own if (place := _place(r.run, named))]
        latest = records.latest(known)
        runs: dict[tuple[str, str], list[RunRecord]] = {}
        for record in latest:
            runs.setdefault((record.run.scene, record.label), []).append(record)
        data = {r.task.case: r.task.data for r in latest}
        replaced = Counter(r.run.scene for r in known if r.task.data != data[r.task.case])
        rows: list[dict[Any, Any]] = tables.summary(latest).to_dict("records")
        numbers = {(row["scene"], row["method"], row["protocol"], row["metric"]): row for row in rows}
        return cls(runs=runs, numbers=numbers, replaced=replaced, all=own, suites=named)


def _called(record: RunRecord, scene: str) -> RunRecord:
    """Return a record with another scene name and the same identity."""
    run = msgspec.structs.replace(record.run, scene=scene)
    task = msgspec.structs.replace(record.task, settings=run, case=case_of(run))
    return msgspec.structs.replace(record, task=task)


def _place(run: Run, named: dict[str, dict[str, None]]) -> str:
    """Return the planned scene of a run; "" where only the name is the same."""
    of = (suite for suite in named.get(run.scene, ()) if run.scene_id in identities(suite, run.scene, run.seed))
    return next((f"{suite}/{run.scene}" for suite in of), "")


@functools.cache
def identities(suite: str, name: str, seed: int) -> tuple[str, ...]:
    """Return the identities of a suite's scene with a seed, as itself and as a repetition; none for a bad seed.

    `make-dataset --seeds` hashes a repetition as NAME-sSEED, which records and tables call NAME. The simulator's code
    has no part in it.
    """
    scene = next(scene for scene in _scenes(suite) if scene.name == name)
    try:
        of = [msgspec.structs.replace(scene, name=called, seed=seed) for called in (name, f"{name}-s{seed}")]
        return tuple(map(suites.identity, of))
    except InputError:  # no scene has such a seed
        return ()


_scenes = functools.cache(suites.load)


def strangers(measured: Measured, planned: Iterable[Planned]) -> list[str]:
    """Say how many records have a planned cell's scene name and label, but come from another scene."""
    cells: dict[tuple[str, str], set[str]] = {}
    for p in planned:
        cells.setdefault((p.suite, p.scene), set()).add(p.label)
    places = {"/".join(key) for key in cells}
    left: dict[tuple[str, str], list[Run]] = {}
    for record in measured.all:
        for key in ((suite, record.run.scene) for suite in measured.suites.get(record.run.scene, ())):
            if record.label in cells.get(key, ()) and _place(record.run, measured.suites) not in places:
                left.setdefault(key, []).append(record.run)
    return [_stranger(suite, scene, runs) for (suite, scene), runs in left.items()]


def _stranger(suite: str, scene: str, runs: list[Run]) -> str:
    count = "1 record is" if len(runs) == 1 else f"{len(runs)} records are"
    known = ((" or ".join(identities(suite, scene, run.seed)) or "none", run.seed) for run in runs)
    expected = _some(f"{ids} (seed {seed})" for ids, seed in known)
    return (
        f"{suite}/{scene}: {count} left out, of another scene of this name (scene_id "
        f"{_some(run.scene_id for run in runs)}); expected {expected}, which `make-dataset {suite}` makes"
    )


def _some(texts: Iterable[str], most: int = 3) -> str:
    """Join the first few of the texts that differ."""
    known = list(dict.fromkeys(texts))
    return ", ".join(known[:most]) + (f" and {len(known) - most} more" if len(known) > most else "")


def caption(layout: PaperTable, used: list[RunRecord], protocol: str) -> str:
    """State protocol, region, reference, range, seeds, inputs and metal insertion of our columns, and what compares."""
    timed = all(column.metric == "wall" for column in layout.columns)
    parts = [f"The paper's Table {layout.number} and what was measured here."]
    if not timed:
        parts.append("The paper states neither the region, nor the energy of the reference, nor the peak of PSNR3D.")
    parts.append(f"Here: {captions.caption(used, 'cost' if timed else protocol)}")
    steps = sorted({p.params["steps"] for row in layout.plan() for p in row if "steps" in p.params})
    if steps:
        parts.append(f"A run has {' or '.join(map(str, steps))} steps here, a tenth of the published.")
    parts += _circumstances(used, timed) if used else ["There is no record yet."]
    parts.append("The phantoms differ from the paper's: orders and gains compare, values do not.")
    if layout.rank:
        where = {"down": "column", "across": "row"}[layout.rank]
        parts.append(f"The best of a {where} is bold on either side, the second underlined, for all inputs alike.")
    return " ".join(parts)


def _circumstances(used: list[RunRecord], timed: bool) -> list[str]:
    """Say under which circumstances the records came about."""
    seeds = sorted({r.run.seed for r in used})
    counts = Counter(key for key, _ in {((r.run.scene, r.label), r.run.seed) for r in used})
    alike = "" if set(counts.values()) == {len(seeds)} else ", not all of them in each cell"
    parts = [f"Seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}{alike}."]
    voxels = {r.run.scene: r.scores["paper"].n_voxels for r in used if "paper" in r.scores}
    if voxels:
        sizes = {n: ", ".join(s for s, m in voxels.items() if m == n) for n in sorted(voxels.values())}
        parts.append(f"Grid: {'; '.join(f'{n} voxels ({scenes})' for n, scenes in sizes.items())}.")
    if timed:
        machines = (f"{r.host.cpu}, {r.host.threads} threads, device {r.cost.device}" for r in used if r.cost)
        hosts = "; ".join(dict.fromkeys(machines))
        return [*parts, f"Measured on {hosts}."] if hosts else parts
    inputs = _by(used, lambda r: r.inputs if r.run.mask == "none" else f"{r.inputs}, {r.run.mask}")
    metal = _by(used, lambda r: str(r.run.params.get("insert", "reconstructed like the rest")))
    return [*parts, f"Inputs: {inputs}.", f"Metal insertion: {metal}."]


def _by(used: list[RunRecord], what: Callable[[RunRecord], str]) -> str:
    """Group the methods of records by what they have in common: "metal mask, oracle (limar, nmar)"."""
    groups: dict[str, dict[str, None]] = {}
    for record in used:
        groups.setdefault(what(record), {})[record.label.partition("[")[0]] = None
    return "; ".join(f"{text} ({', '.join(names)})" for text, names in groups.items())


def _remarks(used: list[RunRecord], measured: Measured) -> list[str]:
    """Say which runs failed and why, and how many records of older data are left out."""
    failed = [f"{r.run.scene}, {r.label}: {r.status} – {r.reason or 'no reason given'}" for r in used if r.status != OK]
    old = [s for s in dict.fromkeys(r.run.scene for r in used) if s in measured.replaced]
    left = "records of older data are left out; the scan was made again"
    doubtful = records.doubtful(used)
    return failed + [doubtful] * bool(doubtful) + [f"{scene}: {measured.replaced[scene]} {left}" for scene in old]


def commands(layout: PaperTable, missing: list[Planned]) -> list[str]:
    """Name the commands that make the cells without a record."""
    strange = dict.fromkeys(p.method for p in missing if p.method not in TABLE)
    notes = [f"–: there is no method {', '.join(strange)} in `benchmarks/methods.py`"] if strange else []
    missing = [p for p in missing if p.method in TABLE]
    if any(p.suite == ABLATION for p in missing):
        notes.append(f"–: `run-benchmark ablation data/ results/ --table {layout.number}`")
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
