"""What `run-benchmark` prints at its end: one table that fits a terminal, where the rest is, and what to try next."""

import shlex
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rich import box
from rich.table import Table
from rich.text import Text

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import one_line, ranked
from ctsim.benchmarks.engine.terminal import WIDEST, rendered, width
from ctsim.benchmarks.methods import CONTROLS, daggered
from ctsim.benchmarks.scores.score import MAIN, MAIN_ACROSS, MAIN_MEASURED, NEED_TRUTH, NO_REFERENCE, Metric
from ctsim.benchmarks.studies.methods.captions import across_scanners, measured
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest, remarks
from ctsim.benchmarks.studies.methods.tables import Numbers, numbers


class Number(NamedTuple):
    """One number of a method on a scene: its title, where it is from, the width of its column, and what it is."""

    title: str
    protocol: str
    metric: str
    width: int
    about: str


_BONE = Number("bone", "structure", "false_bone", 5, "% of soft tissue near metal that reads as bone")
_SECONDS = Number("s", "cost", "wall", 5, "seconds of a run")
SHOWN = (
    Number("PSNR", "tissue", "psnr3d", 5, "PSNR3D in dB of the body outside metal (protocol tissue)"),
    Number("lost", "metal_cost", "own_db", 5, "dB against the same method on the metal-free twin"),
    _BONE,
    _SECONDS,
)
ACROSS = (
    Number("HU", "soft", "rmse", 6, "RMSE of soft tissue in HU (protocol soft)"),
    Number("metal", "artefact", "rmse", 6, "RMSE in HU against the same method on the metal-free twin"),
    Number("lost", "metal_cost", "own_hu", 6, "HU of soft tissue RMSE against that twin"),
    SHOWN[0],
    _SECONDS,
)
"""The numbers where scanners are compared, whose dB do not compare."""
MEASURED = (
    Number("streak", NO_REFERENCE, "air_streak", 6, "RMS in HU of the smoothed air around the body"),
    Number("entropy", NO_REFERENCE, "air_entropy", 7, "bits of the histogram of that air"),
    Number("index", NO_REFERENCE, "artefact_index", 6, "artefact index in HU of the body near metal"),
    Number("held out", NO_REFERENCE, "held/outside", 8, "RMSE of P in views that no method saw, outside the trace"),
    _SECONDS,
)
"""The numbers where no scan has a truth."""
Row = tuple[str, str]
"""Inputs and method."""
Values = dict[tuple[str, Row], list[float | None]]
"""Numbers by scene and row, as in `SHOWN` or `ACROSS`."""
MOST_TABLES = 3
"""At most this many tables below each other; scenes that do not fit are averaged."""
MOST_FAILURES = 10
"""At most this many failed or skipped runs are named."""


def text(records: Sequence[RunRecord], results: Path, data: Path) -> str:
    """Return the table, what its numbers are, where the rest is, and what to try next."""
    shown = latest(records)
    told = dict.fromkeys(number for part in _parts(shown) for number in _numbers(part))
    lines = [
        *textwrap.wrap(". ".join(f"{number.title}: {number.about}" for number in told) + ".", WIDEST),
        *_failures(shown),
        *_unmasked(shown),
        *_skipped(shown),
        *remarks(records),
        f"All protocols: {results}/table.md, .csv, .tex; records: {results}/records.jsonl",
    ]
    if any(record.volume for record in shown):
        lines.append(f"Pictures: {results}/panels/")
    folders = f"{shlex.quote(str(results))} {shlex.quote(str(data))}"
    lines += [
        f"Next: run-benchmark report {folders}   (a page with the slices of every volume)",
        "      run-benchmark methods   (all methods and their parameters, for --method and --set)",
    ]
    tables = "\n".join(overview(part) for part in _parts(shown))
    return tables + "\n" + "\n".join(map(one_line, lines)) + "\n"


def _parts(shown: Sequence[RunRecord]) -> list[list[RunRecord]]:
    """Split records into those of scans with a truth and those of measured ones, whose numbers are others."""
    scans = {r.run.scene for r in shown if NO_REFERENCE in r.scores}
    both = [[r for r in shown if (r.run.scene in scans) == known] for known in (False, True)]
    return [part for part in both if part] or [[]]


def _skipped(shown: Sequence[RunRecord]) -> list[str]:
    """Name the protocols that scans without truth are not scored under."""
    scans = list(dict.fromkeys(r.run.scene for r in shown if NO_REFERENCE in r.scores))
    text = f"{', '.join(scans)}: measured, without truth; skipped are the protocols {', '.join(NEED_TRUTH)}"
    return textwrap.wrap(text, WIDEST) if scans else []


def _failures(shown: Sequence[RunRecord]) -> list[str]:
    """Name the first runs that did not end well, with reasons, and the number of the others."""
    bad = [f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason}" for r in shown if r.status != OK]
    more = len(bad) - MOST_FAILURES
    return [*bad[:MOST_FAILURES], *([f"{more} more runs failed or were skipped, see table.md"] if more > 0 else [])]


def _unmasked(shown: Sequence[RunRecord]) -> list[str]:
    """Name the first runs that found no metal mask to rely on."""
    said = [
        f"{r.run.scene}, {r.label}: its metal mask is doubtful and was not used: {reason}"
        for r in shown
        if r.run.variant == METAL and (reason := r.details.get("mask_reason"))
    ]
    more = len(said) - MOST_FAILURES
    return [*said[:MOST_FAILURES], *([f"{more} more runs used no mask, see records.jsonl"] if more > 0 else [])]


def overview(shown: Sequence[RunRecord]) -> str:
    """Return `SHOWN` or `ACROSS` of every method on every scene, fitting the terminal.

    Scenes are columns, in two tables where one is too narrow; if two are, the mean over all scenes is shown.
    Numbers are means over noise seeds.
    """
    own = [record for record in shown if record.run.variant == METAL]
    what, found, scenes = _numbers(shown), numbers(shown), list(dict.fromkeys(record.run.scene for record in own))
    rows = sorted(dict.fromkeys((record.inputs, record.label) for record in own), key=lambda row: row[0])
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    values = {(scene, row): _values(found, scene, row, what) for scene in scenes for row in rows}
    stubs = [("inputs", "method"), *((inputs, daggered(label)) for inputs, label in rows)]
    wide_stubs = sum(max(map(len, column)) + 2 for column in zip(*stubs, strict=True))
    wide = max([len(_head(what)), *map(len, scenes)]) + 2
    fit = max((width() - wide_stubs) // wide, 1)
    if len(scenes) > fit * MOST_TABLES:
        title = f"mean of {len(scenes)} scenes"
        values |= {(title, row): _mean([values[scene, row] for scene in scenes]) for row in rows}
        scenes = [title]
    return "\n".join(_table(what, rows, scenes[n : n + fit], values, failed) for n in range(0, len(scenes), fit))


def _numbers(shown: Sequence[RunRecord]) -> tuple[Number, ...]:
    if measured(shown):
        return MEASURED
    return ACROSS if across_scanners(shown) else SHOWN


def _head(what: Sequence[Number]) -> str:
    return "  ".join(f"{number.title:>{number.width}}" for number in what)


def _table(
    what: Sequence[Number],
    rows: Sequence[Row],
    columns: Sequence[str],
    values: Values,
    failed: dict[tuple[str, str], str],
) -> str:
    """Return a table with a column for each scene; `failed` says how a run of a scene and method ended."""
    table = Table(box=box.SIMPLE_HEAD if _unicode() else box.ASCII2, pad_edge=False, show_edge=False)
    table.add_column("\ninputs", no_wrap=True)
    table.add_column("\nmethod", overflow="fold")
    for column in columns:
        table.add_column(f"{one_line(column)}\n{_head(what)}", no_wrap=True)
    ranked = range(len(what) - 1)  # all but the seconds
    best = {(column, k): _best(rows, column, k, values, what[k]) for column in columns for k in ranked}
    for number, row in enumerate(rows):
        first = not number or rows[number - 1][0] != row[0]
        cells = [
            _cell(what, values[column, row], failed.get((column, row[1]), ""), [row in best[column, k] for k in ranked])
            for column in columns
        ]
        table.add_row(row[0] if first else "", Text(one_line(daggered(row[1]))), *cells)
    return rendered(table)


def _values(found: Numbers, scene: str, row: Row, what: Sequence[Number]) -> list[float | None]:
    inputs, label = row
    numbers = (found.get((scene, METAL, label, inputs, each.protocol, each.metric)) for each in what)
    return [None if number is None else number[0] for number in numbers]


def _mean(scenes: Sequence[list[float | None]]) -> list[float | None]:
    """Average over scenes; a method that lacks one has no mean, since it would not compare."""
    out: list[float | None] = []
    for column in zip(*scenes, strict=True):
        known = [value for value in column if value is not None]
        out.append(sum(known) / len(known) if len(known) == len(column) else None)
    return out


def _best(rows: Sequence[Row], column: str, k: int, values: Values, number: Number) -> set[Row]:
    """Return the rows that are best of their inputs in a number."""
    found: set[Row] = set()
    for inputs in dict.fromkeys(row[0] for row in rows if row[0] not in CONTROLS):
        group = [row for row in rows if row[0] == inputs]
        places = ranked([values[column, row][k] for row in group], _column(number).better)
        found |= {group[n] for n, place in places.items() if place == "best"}
    return found


def _column(number: Number) -> Metric:
    return (MAIN | MAIN_ACROSS | MAIN_MEASURED)[number.protocol, number.metric]


def _cell(what: Sequence[Number], values: Sequence[float | None], failed: str, best: Sequence[bool]) -> Text:
    """Return the numbers of a method on a scene; how a run ended that has none."""
    if failed and values[0] is None:
        return Text(failed.rjust(len(_head(what))), "red")
    out = Text()
    for k, (value, number) in enumerate(zip(values, what, strict=True)):
        text = ("–" if _unicode() else "-") if value is None else _text(value, number)
        out.append("  " if k else "").append(text.rjust(number.width), "bold" if k < len(best) and best[k] else "")
    return out


def _text(value: float, number: Number) -> str:
    if number.metric == "wall":
        return f"{value:.2g}" if value < 10 else f"{value:.0f}"
    column = _column(number)
    return f"{value * column.scale:.{column.digits}f}"


def _unicode() -> bool:
    return (getattr(sys.stdout, "encoding", None) or "").lower().startswith("utf")
