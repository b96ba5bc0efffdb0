"""What `run-benchmark` prints at its end: one table that fits a terminal, where the rest is, and what to try next."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.terminal import WIDEST, rendered
from ctsim.benchmarks.engine.texts import one_line, ranked
from ctsim.benchmarks.scores.score import COLUMNS
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest
from ctsim.benchmarks.studies.methods.tables import Numbers, numbers

PROTOCOL = "tissue"
SHOWN = ((PROTOCOL, "psnr3d", 5), (PROTOCOL, "ssim3d", 5), ("cost", "wall", 6))
"""Protocol, metric and width of the numbers of a scene."""
HEAD = "  ".join(f"{title:>{width}}" for title, (_, _, width) in zip(("PSNR", "SSIM", "s"), SHOWN, strict=True))
MEAN = "mean"
Cells = dict[str, list[float | None]]


def text(records: Sequence[RunRecord], results: Path, data: Path) -> str:
    """Return the table, what its numbers are, where the rest is, and what to try next."""
    shown = latest(records)
    lines = [
        f"PSNR3D in dB and SSIM3D of the body outside metal (protocol {PROTOCOL}); seconds of a run.",
        *(f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason}" for r in shown if r.status != OK),
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


def overview(shown: Sequence[RunRecord]) -> str:
    """Return PSNR3D, SSIM3D and seconds of every method on every scene, as text of at most `WIDEST` columns.

    Where scenes are too many for that, the mean over all scenes stands for them. Numbers are means over noise seeds.
    """
    own = [record for record in shown if record.run.variant == METAL]
    found, scenes = numbers(own), list(dict.fromkeys(record.run.scene for record in own))
    rows = sorted(dict.fromkeys((record.inputs, record.label) for record in own), key=lambda row: row[0])
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    values = {(scene, row): _values(found, scene, row) for scene in scenes for row in rows}
    columns = scenes
    if _width(rows, scenes) > WIDEST:
        values |= {(MEAN, row): _mean([values[scene, row] for scene in scenes]) for row in rows}
        columns = [MEAN]
    table = Table(box=box.SIMPLE_HEAD if _unicode() else box.ASCII2, pad_edge=False, show_edge=False)
    table.add_column("\ninputs", no_wrap=True)
    table.add_column("\nmethod", overflow="fold")
    for column in columns:
        title = column if column in scenes else f"mean of {len(scenes)} scenes"
        table.add_column(f"{one_line(title)}\n{HEAD}", no_wrap=True)
    best = {(column, k): _best(rows, column, k, values) for column in columns for k in range(len(SHOWN))}
    for number, row in enumerate(rows):
        first = not number or rows[number - 1][0] != row[0]
        cells = [
            _cell(values[column, row], failed.get((column, row[1]), ""), [row in best[column, k] for k in (0, 1)])
            for column in columns
        ]
        table.add_row(row[0] if first else "", Text(one_line(row[1])), *cells)
    return rendered(table)


def _width(rows: Sequence[tuple[str, str]], scenes: Sequence[str]) -> int:
    """Return how wide a table with a column for each scene is."""
    stubs = [max(map(len, column)) for column in zip(("inputs", "method"), *rows, strict=True)]
    return sum(width + 2 for width in [*stubs, *(max(len(scene), len(HEAD)) for scene in scenes)])


def _values(found: Numbers, scene: str, row: tuple[str, str]) -> list[float | None]:
    inputs, label = row
    numbers = (found.get((scene, METAL, label, inputs, protocol, metric)) for protocol, metric, _ in SHOWN)
    return [None if number is None else number[0] for number in numbers]


def _mean(scenes: Sequence[list[float | None]]) -> list[float | None]:
    """Average over scenes; a method that lacks one has no mean, since it would not compare."""
    out: list[float | None] = []
    for column in zip(*scenes, strict=True):
        known = [value for value in column if value is not None]
        out.append(sum(known) / len(known) if len(known) == len(column) else None)
    return out


def _best(rows: Sequence[tuple[str, str]], column: str, k: int, values: dict) -> set[tuple[str, str]]:
    """Return the rows that are best of their inputs in a number."""
    found: set[tuple[str, str]] = set()
    protocol, metric, _ = SHOWN[k]
    for inputs in dict.fromkeys(row[0] for row in rows):
        group = [row for row in rows if row[0] == inputs]
        places = ranked([values[column, row][k] for row in group], COLUMNS[protocol][metric].better)
        found |= {group[n] for n, place in places.items() if place == "best"}
    return found


def _cell(values: Sequence[float | None], failed: str, best: Sequence[bool]) -> Text:
    """Return the numbers of a method on a scene; how a run ended that has none."""
    if failed and values[0] is None:
        return Text(failed.rjust(len(HEAD)), "red")
    out = Text()
    for k, (value, (protocol, metric, width)) in enumerate(zip(values, SHOWN, strict=True)):
        form = f".{COLUMNS[protocol][metric].digits}f" if metric != "wall" else ".2g" if (value or 0) < 10 else ".0f"
        text = "–" if value is None else f"{value:{form}}"
        out.append("  " if k else "").append(text.rjust(width), "bold" if k < len(best) and best[k] else "")
    return out


def _unicode() -> bool:
    return (getattr(sys.stdout, "encoding", None) or "").lower().startswith("utf")
