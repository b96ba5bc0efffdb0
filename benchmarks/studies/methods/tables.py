"""Tables from records: Markdown, CSV and LaTeX, one table a protocol, ranked within an input class.

Nothing is computed anew. A cell is the mean ± standard deviation over noise seeds; a run that failed
shows its status in place of numbers, and its reason below the tables.
"""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from ctsim.benchmarks.engine import latex
from ctsim.benchmarks.engine.collector import uncollected
from ctsim.benchmarks.engine.texts import escape, ranked
from ctsim.benchmarks.scores.columns import COLUMNS, Column
from ctsim.benchmarks.scores.compare import NMAR, harm, row_of
from ctsim.benchmarks.scores.protocol import AS_RETURNED
from ctsim.benchmarks.studies.methods.records import OK, Record, latest, outdated, remarks
from ctsim.benchmarks.studies.methods.summary import Number, Numbers, csv_text, numbers, summary
from ctsim.durable import write_synced
from ctsim.errors import InputError

__all__ = ["caption", "merged", "render", "summary", "write"]

Format = Literal["md", "tex"]


class Cell(NamedTuple):
    """The number to rank by, None where it has no place, and the text."""

    number: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A method: what it needs, its label, and a cell for each column."""

    inputs: str
    method: str
    cells: list[Cell]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A protocol's table: columns (scene, metric), rows, and what stands around it.

    `places` says which cells (row, column) are "best" or "second" among the methods of the same inputs.
    """

    protocol: str
    columns: list[tuple[str, str]]
    rows: list[Row]
    places: dict[tuple[int, int], str]
    caption: str
    notes: list[str]

    def column(self, k: int) -> Column:
        """Return how column `k` is shown."""
        return COLUMNS[self.protocol][self.columns[k][1]]


def _cell(number: Number | None, metric: str, column: Column) -> Cell:
    """Return one cell."""
    if number is None:
        return Cell(None, "–")
    mean, std, _, _, _, identical = number
    if mean is None:
        same = identical and metric.startswith("psnr3d")
        return Cell(float("inf"), "identical") if same else Cell(None, "–")
    mean *= column.scale
    text = f"{mean:.{column.digits}f}"
    if std is not None:
        text += f" ± {std * column.scale:.{column.digits}f}"
    return Cell(mean, text)


def sheets(shown: list[Record], found: Numbers, protocols: Iterable[str] = tuple(COLUMNS)) -> list[Sheet]:
    """Return the protocols' tables of the records that count and of their numbers; a protocol without any has none."""
    own = [r for r in shown if r.run.variant == "metal"]
    chosen: dict[str, dict[tuple[str, str, str], Number]] = {}
    for (scene, variant, method, _, protocol, metric), number in found.items():
        if variant == "metal":
            chosen.setdefault(protocol, {})[scene, method, metric] = number
    grids = ((protocol, _grid(chosen.get(protocol, {}), protocol, own)) for protocol in protocols)
    return [
        Sheet(
            protocol=protocol,
            columns=columns,
            rows=rows,
            places=_places(rows, [COLUMNS[protocol][metric].better for _, metric in columns]),
            caption=caption(shown, protocol),
            notes=_notes(shown, protocol),
        )
        for protocol, (columns, rows) in grids
        if columns
    ]


def _grid(
    chosen: dict[tuple[str, str, str], Number], protocol: str, own: list[Record]
) -> tuple[list[tuple[str, str]], list[Row]]:
    """Return the columns and rows of a protocol's table; `chosen` are its numbers by scene, method and metric."""
    there = {metric for _, _, metric in chosen}
    metrics = [m for m in COLUMNS[protocol] if m in there]
    scenes = list(dict.fromkeys(r.run.scene for r in own))
    columns = [(s, m) for s in scenes for m in metrics]
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    rows = []
    for inputs, method in dict.fromkeys((r.inputs, r.label) for r in own):
        cells = []
        for scene, metric in columns:
            cell = _cell(chosen.get((scene, method, metric)), metric, COLUMNS[protocol][metric])
            if (scene, method) in failed:
                status = failed[scene, method]
                cell = Cell(None, status if cell.number is None or protocol == "cost" else f"{cell.text} ({status})")
            cells.append(cell)
        more: list[Cell] = []
        if len(scenes) > 1:
            more += [_mean(cells, k, len(metrics), COLUMNS[protocol][m]) for k, m in enumerate(metrics)]
        if protocol == "anchored":
            more += [Cell(*harm([c.number for c in cells[k :: len(metrics)]])) for k in range(len(metrics))]
        rows.append(Row(inputs=inputs, method=method, cells=cells + more))
    if len(scenes) > 1:
        columns += [("mean", m) for m in metrics]
    if protocol == "anchored":
        columns += [("harm rate", m) for m in metrics]
    rows.sort(key=lambda row: row.inputs)
    return columns, rows


def _mean(cells: list[Cell], k: int, step: int, column: Column) -> Cell:
    """Average a metric over scenes; a method that lacks one has no mean, since it would not compare."""
    known = [cell.number for cell in cells[k::step]]
    if any(n is None or n == float("inf") for n in known):
        return Cell(None, "–")
    mean = sum(n for n in known if n is not None) / len(known)
    return Cell(mean, f"{mean:.{column.digits}f}")


def merged(texts: Iterable[str]) -> str:
    """Join texts that differ in numbers only into one with their ranges, others with " / "."""
    kinds: dict[tuple[str, ...], list[list[str]]] = {}
    for text in texts:
        kinds.setdefault(tuple(_NUMBER.split(text)), []).append(_NUMBER.findall(text))
    out = []
    for pieces, found in kinds.items():
        ranges = [sorted(set(column), key=float) for column in zip(*found, strict=True)]
        shown = [r[0] if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in ranges]
        out.append("".join(a + b for a, b in zip(pieces, [*shown, ""], strict=True)))
    return " / ".join(out)


_NUMBER = re.compile(r"\d+\.\d+")


def caption(records: list[Record], protocol: str) -> str:
    """State protocol, region, reference, alignment and data range of a table."""
    if protocol == "cost":
        return "Protocol cost: seconds and peak resident memory of a run; compilation and first call stand apart."
    if protocol == "against":
        nmar = row_of(NMAR, (r.label for r in records if r.status == OK and r.run.variant == "metal"))
        return (
            "Protocol tissue, compared: gain in PSNR3D (dB) over no correction (FDK) and over NMAR"
            f"{'' if nmar is None else f' (the row {nmar})'}, scene by scene and seed by seed."
        )
    if protocol == "anchored":
        return (
            "Anchored scores s = (e − e_ref)/(e_FDK − e_ref), e_ref from the metal-free scan reconstructed by FDK: "
            "0 as if the metal had never been there, 1 uncorrected. Harm rate: share of scenes with s > 1, "
            "and how many of how many scenes that have a score."
        )
    found = [(r.run.scene, r.scores[protocol]) for r in records if protocol in r.scores and r.run.variant == "metal"]
    if not found:
        return f"Protocol {protocol}."
    score = found[0][1]
    references = dict.fromkeys(s.reference for _, s in found)
    alignment = "one least-squares gain on the body" if protocol.startswith("aligned") else score.alignment
    ranges: dict[str, list[float]] = {}
    for scene, s in found:
        if s.data_range is not None:
            ranges.setdefault(scene, []).append(s.data_range)
    text = f"Protocol {protocol}: region {score.region}; reference {merged(references)}; alignment {alignment}"
    if ranges:
        text += "; data range " + ", ".join(f"{_span(v)} ({s})" for s, v in ranges.items()) + " 1/mm"
    read: dict[str, list[str]] = {}
    for r in (r for r in records if protocol in r.scores and r.run.variant == "metal"):
        read.setdefault(r.scores[protocol].volume, []).append(r.label)
    others = [f"{', '.join(dict.fromkeys(who))} {how}" for how, who in read.items() if how != AS_RETURNED]
    return text + "".join(f"; {other}" for other in others) + "."


def _span(numbers: list[float]) -> str:
    """Write numbers as one, or as the least and the greatest where seeds differ."""
    low, high = f"{min(numbers):.4g}", f"{max(numbers):.4g}"
    return low if low == high else f"{low} to {high}"


def _notes(records: list[Record], protocol: str) -> list[str]:
    """Return what the scores of a protocol declare: once for a scene and seed where its methods agree."""
    labels: dict[tuple[str, int, str], list[str]] = {}
    for record in records:
        if record.run.variant == "metal" and protocol in record.scores and record.scores[protocol].note:
            key = (record.run.scene, record.run.seed, record.scores[protocol].note)
            labels.setdefault(key, []).append(record.label)
    said = Counter((scene, seed) for scene, seed, _ in labels)
    return [
        f"{scene} (seed {seed}{'' if said[scene, seed] == 1 else ', ' + ', '.join(methods)}): {note}"
        for (scene, seed, note), methods in labels.items()
    ]


_MARKS: dict[Format, dict[str, str]] = {
    "md": {"best": "**{}**", "second": "<u>{}</u>"},
    "tex": {"best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"},
}


def _places(rows: list[Row], better: list[str]) -> dict[tuple[int, int], str]:
    """Return {(row, column): "best" or "second"} within each class of inputs; `better` is each column's direction."""
    groups: dict[str, list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault(row.inputs, []).append(i)
    found: dict[tuple[int, int], str] = {}
    for k, direction in enumerate(better):
        for group in groups.values():
            places = ranked([rows[i].cells[k].number for i in group], direction)
            found |= {(group[i], k): place for i, place in places.items()}
    return found


def _lines(sheet: Sheet, form: Format) -> list[list[str]]:
    """Return the table's rows as text, the best and second of each class marked."""
    lines, places = [], sheet.places
    for i, row in enumerate(sheet.rows):
        texts = [escape(cell.text, form) for cell in row.cells]
        texts = [_MARKS[form][places[i, k]].format(t) if (i, k) in places else t for k, t in enumerate(texts)]
        lines.append([escape(row.inputs, form), escape(row.method, form), *texts])
    return lines


def render(records: list[Record], form: Format, protocols: Iterable[str] = tuple(COLUMNS)) -> str:
    """Render the protocols' tables as Markdown or LaTeX (booktabs); failures and skips follow with their reasons."""
    shown = latest(records)
    return _page(sheets(shown, numbers(shown), protocols), form, _failures(shown), remarks(records))


def _page(found: list[Sheet], form: Format, failed: list[str], said: list[str]) -> str:
    """Render sheets, below them the runs that failed and what is to be said of the records (`records.remarks`)."""
    parts = [_markdown(sheet) if form == "md" else _latex(sheet) for sheet in found]
    if form == "md" and failed:
        parts.append("## Failures and skips\n\n" + "\n".join(f"- {escape(line, form)}" for line in failed) + "\n")
    elif failed:
        parts.append("".join(map(latex.comment, failed)))
    parts += [f"{escape(text, form)}.\n" if form == "md" else latex.comment(f"{text}.") for text in said]
    return "\n".join(parts)


def _markdown(sheet: Sheet) -> str:
    titles = [f"{scene}: {sheet.column(k).title}" for k, (scene, _) in enumerate(sheet.columns)]
    head = [escape(title, "md") for title in ("inputs", "method", *titles)]
    first, *rows = ("| " + " | ".join(line) + " |" for line in [head, *_lines(sheet, "md")])
    text = "\n".join([first, "|---|---|" + "---:|" * len(titles), *rows])
    notes = "".join(f"- {escape(note, 'md')}\n" for note in sheet.notes)
    return f"## {sheet.protocol}\n\n{escape(sheet.caption, 'md')}\n\n{text}\n" + (f"\n{notes}" if notes else "")


def _latex(sheet: Sheet) -> str:
    titles = [escape(sheet.column(k).title, "tex") for k in range(len(sheet.columns))]
    head = [*latex.spanning(2, [(scene, 1) for scene, _ in sheet.columns]), latex.row(["inputs", "method", *titles])]
    body = [latex.row(line) for line in _lines(sheet, "tex")]
    text = latex.table(escape(sheet.caption, "tex"), "ll" + "r" * len(sheet.columns), head, body)
    return text + "".join(map(latex.comment, sheet.notes))


def _failures(shown: list[Record]) -> list[str]:
    """Say of each run that did not end well what it was and why."""
    return [
        f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason or 'no reason given'}"
        for r in shown
        if r.status != OK
    ]


@uncollected()
def write(records: list[Record], results: Path) -> None:
    """Write table.md, table.csv and table.tex into the results folder.

    Raises InputError where there is no record to show.
    """
    if not records:
        raise InputError(f"{results}: there are no records to tabulate; run a method first")
    shown = latest(records)
    if not shown:
        raise InputError(f"{results}: {outdated(records)}")
    found = numbers(shown)
    pages, failed = sheets(shown, found), _failures(shown)
    texts = {form: _page(pages, form, failed, remarks(records)) for form in ("md", "tex")} | {"csv": csv_text(found)}
    for form, text in texts.items():
        write_synced(results / f"table.{form}", text.encode())  # one who looks while runs go on sees a whole table
