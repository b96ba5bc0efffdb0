"""What `run-benchmark` prints at its end: one table that fits a terminal, where the rest is, and what to try next."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import one_line, ranked
from ctsim.benchmarks.engine.terminal import rendered, width
from ctsim.benchmarks.methods import CONTROLS
from ctsim.benchmarks.scores.score import MAIN
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest, remarks
from ctsim.benchmarks.studies.methods.tables import Numbers, numbers

PROTOCOL = "tissue"
SHOWN = (
    ("PSNR", PROTOCOL, "psnr3d", 5),
    ("lost", "metal_cost", "own_db", 5),
    ("bone", "structure", "false_bone", 5),
    ("s", "cost", "wall", 5),
)
"""Title, protocol, metric and width of the numbers of a scene."""
RANKED = range(3)
"""Those of them whose best is bold."""
HEAD = "  ".join(f"{title:>{width}}" for title, _, _, width in SHOWN)
Row = tuple[str, str]
"""Inputs and method."""
Values = dict[tuple[str, Row], list[float | None]]
"""Numbers by scene and row, as in `SHOWN`."""
MOST_TABLES = 3
"""At most this many tables below each other; scenes that do not fit are averaged."""
MOST_FAILURES = 10
"""At most this many failed or skipped runs are named."""


def text(records: Sequence[RunRecord], results: Path, data: Path) -> str:
    """Return the table, what its numbers are, where the rest is, and what to try next."""
    shown = latest(records)
    lines = [
        f"PSNR: PSNR3D in dB of the body outside metal (protocol {PROTOCOL}). Lost: dB against the same method on the",
        "metal-free twin. Bone: % of soft tissue near metal that reads as bone. s: seconds of a run.",
        *_failures(shown),
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
    return overview(shown) + "\n" + "\n".join(map(one_line, lines)) + "\n"


def _failures(shown: Sequence[RunRecord]) -> list[str]:
    """Name the first runs that did not end well, with reasons, and the number of the others."""
    bad = [f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason}" for r in shown if r.status != OK]
    more = len(bad) - MOST_FAILURES
    return [*bad[:MOST_FAILURES], *([f"{more} more runs failed or were skipped, see table.md"] if more > 0 else [])]


def overview(shown: Sequence[RunRecord]) -> str:
    """Return PSNR3D, cost of metal, false bone and seconds of every method on every scene, fitting the terminal.

    Scenes are columns, in two tables where one is too narrow; if two are, the mean over all scenes is shown.
    Numbers are means over noise seeds.
    """
    own = [record for record in shown if record.run.variant == METAL]
    found, scenes = numbers(shown), list(dict.fromkeys(record.run.scene for record in own))
    rows = sorted(dict.fromkeys((record.inputs, record.label) for record in own), key=lambda row: row[0])
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    values = {(scene, row): _values(found, scene, row) for scene in scenes for row in rows}
    stubs = sum(max(map(len, column)) + 2 for column in zip(("inputs", "method"), *rows, strict=True))
    wide = max([len(HEAD), *map(len, scenes)]) + 2
    fit = max((width() - stubs) // wide, 1)
    if len(scenes) > fit * MOST_TABLES:
        title = f"mean of {len(scenes)} scenes"
        values |= {(title, row): _mean([values[scene, row] for scene in scenes]) for row in rows}
        scenes = [title]
    return "\n".join(_table(rows, scenes[n : n + fit], values, failed) for n in range(0, len(scenes), fit))


def _table(rows: Sequence[Row], columns: Sequence[str], values: Values, failed: dict[tuple[str, str], str]) -> str:
    """Return a table with a column for each scene; `failed` says how a run of a scene and method ended."""
    table = Table(box=box.SIMPLE_HEAD if _unicode() else box.ASCII2, pad_edge=False, show_edge=False)
    table.add_column("\ninputs", no_wrap=True)
    table.add_column("\nmethod", overflow="fold")
    for column in columns:
        table.add_column(f"{one_line(column)}\n{HEAD}", no_wrap=True)
    best = {(column, k): _best(rows, column, k, values) for column in columns for k in RANKED}
    for number, row in enumerate(rows):
        first = not number or rows[number - 1][0] != row[0]
        cells = [
            _cell(values[column, row], failed.get((column, row[1]), ""), [row in best[column, k] for k in RANKED])
            for column in columns
        ]
        table.add_row(row[0] if first else "", Text(one_line(row[1])), *cells)
    return rendered(table)


def _values(found: Numbers, scene: str, row: Row) -> list[float | None]:
    inputs, label = row
    numbers = (found.get((scene, METAL, label, inputs, protocol, metric)) for _, protocol, metric, _ in SHOWN)
    return [None if number is None else number[0] for number in numbers]


def _mean(scenes: Sequence[list[float | None]]) -> list[float | None]:
    """Average over scenes; a method that lacks one has no mean, since it would not compare."""
    out: list[float | None] = []
    for column in zip(*scenes, strict=True):
        known = [value for value in column if value is not None]
        out.append(sum(known) / len(known) if len(known) == len(column) else None)
    return out


def _best(rows: Sequence[Row], column: str, k: int, values: Values) -> set[Row]:
    """Return the rows that are best of their inputs in a number."""
    found: set[Row] = set()
    _, protocol, metric, _ = SHOWN[k]
    for inputs in dict.fromkeys(row[0] for row in rows if row[0] not in CONTROLS):
        group = [row for row in rows if row[0] == inputs]
        places = ranked([values[column, row][k] for row in group], MAIN[protocol, metric].better)
        found |= {group[n] for n, place in places.items() if place == "best"}
    return found


def _cell(values: Sequence[float | None], failed: str, best: Sequence[bool]) -> Text:
    """Return the numbers of a method on a scene; how a run ended that has none."""
    if failed and values[0] is None:
        return Text(failed.rjust(len(HEAD)), "red")
    out = Text()
    for k, (value, (_, protocol, metric, size)) in enumerate(zip(values, SHOWN, strict=True)):
        column = MAIN[protocol, metric]
        text = ("–" if _unicode() else "-") if value is None else _text(value * column.scale, metric, column.digits)
        out.append("  " if k else "").append(text.rjust(size), "bold" if k < len(best) and best[k] else "")
    return out


def _text(value: float, metric: str, digits: int) -> str:
    if metric == "wall":
        return f"{value:.2g}" if value < 10 else f"{value:.0f}"
    return f"{value:.{digits}f}"


def _unicode() -> bool:
    return (getattr(sys.stdout, "encoding", None) or "").lower().startswith("utf")
