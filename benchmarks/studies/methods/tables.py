"""Tables from records: Markdown, CSV and LaTeX, one table a protocol, ranked within an input class.

No score is computed here. A cell is the mean ± standard deviation over noise seeds; a failed run shows its status in
place of numbers, and its reason below the tables. The numbers are made once for all tables of a command. A large table
has a million of them: they are plain tuples, which the garbage collector need not follow.
"""

import csv
import functools
import io
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ctsim.benchmarks.engine.record import OK, uncollected
from ctsim.benchmarks.engine.table import Cell, Column, Table, escape, harmless, tex_comment
from ctsim.benchmarks.methods import CONTROLS
from ctsim.benchmarks.scores.score import (
    AS_RETURNED,
    COLUMNS,
    COMPARED,
    KERMA,
    NMAR,
    Metric,
    SeedValue,
    derived,
    harm,
    row_of,
)
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest, outdated, remarks
from ctsim.dataset.durable import write_synced
from ctsim.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Format = Literal["md", "tex"]

STUBS = (Column("inputs"), Column("method"))

Key = tuple[str, str, str, str, str, str]
"""Scene, variant, method, inputs, protocol and metric; a run without any number has protocol and metric ""."""

Number = tuple[float | None, float | None, int, str, str, bool]
"""Mean, std (ddof 1, of two seeds and more) and n over the seeds that have the metric; status; which of the method's
volumes was scored; whether no seed has it because the volumes are the reference itself."""

NAMES = (
    *("scene", "variant", "method", "inputs", "protocol", "metric"),
    *("mean", "std", "n", "status", "volume", "identical"),
)

Numbers = dict[Key, Number]


def numbers(shown: Sequence[RunRecord]) -> Numbers:
    """Return the numbers of records that `records.latest` kept, in their order, those derived from them last."""
    seeds: dict[Key, list[Number]] = defaultdict(list)
    compared: list[SeedValue] = []

    def add(key: Key, value: float | None, status: str, volume: str = "", identical: bool = False) -> None:
        seeds[key].append((value, None, 0 if value is None else 1, status, volume, identical))

    for record in shown:
        run, status = record.run, record.status
        who = run.scene, run.variant, record.label, record.inputs
        for protocol, score in record.scores.items():
            wanted, said = COMPARED.get(protocol, ()), (status, score.volume, score.identical)
            for metric, value in score.values.items():
                add((*who, protocol, metric), value, *said)
                if metric in wanted:
                    compared.append(SeedValue(who[0], run.seed, *who[1:], protocol, metric, value, *said))
        cost = record.cost
        for metric in COLUMNS["cost"] if cost is not None else ():
            value = record.kerma if metric == KERMA else float(getattr(cost, metric))
            add((*who, "cost", metric), value, status)
        if cost is None and not any(score.values for score in record.scores.values()):
            add((*who, "", ""), None, status)
    for row in derived(compared):
        key = (row.scene, row.variant, row.method, row.inputs, row.protocol, row.metric)
        add(key, row.value, row.status, row.volume, row.identical)
    return {key: group[0] if len(group) == 1 else _over(group) for key, group in seeds.items()}


def _over(seeds: list[Number]) -> Number:
    """Return the number over seeds of those of each."""
    values = [value for value, *_ in seeds if value is not None]
    _, _, _, status, volume, identical = zip(*seeds, strict=True)
    return (
        _mean(values) if values else None,
        _std(values) if len(values) > 1 else None,
        len(values),
        ", ".join(dict.fromkeys(status)),
        ", ".join(dict.fromkeys(volume)),
        all(identical),
    )


def _mean(values: list[float]) -> float:
    """Return the mean; the others are summed before the first is added, as in pandas, down to the last bit."""
    total = 0.0
    for value in values[1:]:
        total += value
    mean = (values[0] + total) / len(values)
    return mean if math.isfinite(mean) else math.fsum(v / len(values) for v in values)


def _std(values: list[float]) -> float:
    """Return the standard deviation by Welford's recurrence; infinite where the squares are."""
    mean, squares = 0.0, 0.0
    for n, value in enumerate(values, 1):
        before = mean
        mean += (value - before) / n
        squares += (value - mean) * (value - before)
    return math.sqrt(squares / (len(values) - 1)) if 0 <= squares < math.inf else math.inf


def csv_text(found: Numbers) -> str:
    """Return the numbers as CSV in which no text is a formula to a spreadsheet."""
    out, cell = io.StringIO(), functools.cache(harmless)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(NAMES)
    for key, (mean, std, n, status, volume, identical) in found.items():
        writer.writerow([*map(cell, key), mean, std, n, cell(status), cell(volume), identical])
    return out.getvalue()


def summary(records: Sequence[RunRecord]) -> "pd.DataFrame":
    """Return the numbers of the latest records as table.csv holds them, a row each."""
    import pandas as pd  # half a second that writing tables does without

    found = numbers(latest(records))
    frame = pd.DataFrame([(*key, *number) for key, number in found.items()], columns=pd.Index(NAMES))
    return frame.assign(mean=pd.to_numeric(frame["mean"]), std=pd.to_numeric(frame["std"]))


def _cell(number: Number | None, metric: str, column: Metric) -> Cell:
    """Return one cell."""
    if number is None:
        return Cell("–")
    mean, std, _, _, _, identical = number
    if mean is None:
        same = identical and metric.startswith("psnr3d")
        return Cell("identical", float("inf")) if same else Cell("–")
    mean *= column.scale
    text = f"{mean:.{column.digits}f}"
    if std is not None:
        text += f" ± {std * column.scale:.{column.digits}f}"
    return Cell(text, mean)


def tables(records: Sequence[RunRecord], protocols: Iterable[str] = tuple(COLUMNS)) -> list[Table]:
    """Return the protocols' tables of the records that count; a protocol without any number has none."""
    shown = latest(records)
    return _tables(shown, numbers(shown), protocols)


def _tables(shown: Sequence[RunRecord], found: Numbers, protocols: Iterable[str] = tuple(COLUMNS)) -> list[Table]:
    own = [r for r in shown if r.run.variant == METAL]
    chosen: dict[str, dict[tuple[str, str, str], Number]] = {}
    for (scene, variant, method, _, protocol, metric), number in found.items():
        if variant == METAL:
            chosen.setdefault(protocol, {})[scene, method, metric] = number
    made = []
    for protocol in (p for p in protocols if p in chosen):
        columns, rows = _grid(chosen[protocol], protocol, own)
        if len(columns) > len(STUBS):
            text, notes = caption(shown, protocol), _notes(shown, protocol)
            made.append(
                Table(
                    title=protocol,
                    columns=columns,
                    rows=rows,
                    caption=text,
                    notes=notes,
                    rank_within=0,
                    unranked=CONTROLS,
                )
            )
    return made


def _grid(
    chosen: dict[tuple[str, str, str], Number], protocol: str, own: Sequence[RunRecord]
) -> tuple[list[Column], list[list[Cell]]]:
    """Return the columns and rows of a protocol's table; `chosen` are its numbers by scene, method and metric."""
    there = {metric for _, _, metric in chosen}
    metrics = {m: how for m, how in COLUMNS[protocol].items() if m in there}
    scenes = list(dict.fromkeys(r.run.scene for r in own))
    groups = [*scenes, *["mean"] * (len(scenes) > 1), *["harm rate"] * (protocol == "anchored")]
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    rows = []
    for inputs, method in dict.fromkeys((r.inputs, r.label) for r in own):
        cells = []
        for scene in scenes:
            for metric, how in metrics.items():
                cell = _cell(chosen.get((scene, method, metric)), metric, how)
                if (scene, method) in failed:
                    status = failed[scene, method]
                    cell = Cell(status if cell.number is None or protocol == "cost" else f"{cell.text} ({status})")
                cells.append(cell)
        more: list[Cell] = []
        if len(scenes) > 1:
            more += [_over_scenes(cells, k, len(metrics), how) for k, how in enumerate(metrics.values())]
        if protocol == "anchored":
            shares = (harm([c.number for c in cells[k :: len(metrics)]]) for k in range(len(metrics)))
            more += [Cell(text, share) for share, text in shares]
        rows.append([Cell(inputs), Cell(method), *cells, *more])
    rows.sort(key=lambda row: row[0].text)
    heads = [Column(how.title, group, True, how.better) for group in groups for how in metrics.values()]
    return [*STUBS, *heads], rows


def _over_scenes(cells: list[Cell], k: int, step: int, column: Metric) -> Cell:
    """Average a metric over scenes; a method that lacks one has no mean, since it would not compare."""
    known = [cell.number for cell in cells[k::step]]
    if any(n is None or n == float("inf") for n in known):
        return Cell("–")
    mean = sum(n for n in known if n is not None) / len(known)
    return Cell(f"{mean:.{column.digits}f}", mean)


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


def caption(records: Sequence[RunRecord], protocol: str) -> str:
    """State protocol, region, reference, alignment and data range of a table."""
    if protocol == "cost":
        return (
            "Protocol cost: seconds and peak resident memory of a run; compilation and first call are not included. "
            "Air kerma is that of the whole scan at the isocentre without the object, the same for every method."
        )
    if protocol == "against":
        nmar = row_of(NMAR, (r.label for r in records if r.status == OK and r.run.variant == METAL))
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
    found = [(r, r.scores[protocol]) for r in records if protocol in r.scores and r.run.variant == METAL]
    if not found:
        return f"Protocol {protocol}."
    score = found[0][1]
    references = merged(dict.fromkeys(s.reference for _, s in found))
    alignment = "one least-squares gain on the body" if protocol.startswith("aligned") else score.alignment
    text = f"Protocol {protocol}: region {score.region}; reference {references}; alignment {alignment}"
    ranges: dict[str, list[float]] = {}
    others: dict[str, list[str]] = {}
    for r, s in found:
        if s.data_range is not None:
            ranges.setdefault(r.run.scene, []).append(s.data_range)
        if s.volume != AS_RETURNED:
            others.setdefault(s.volume, []).append(r.label)
    if ranges:
        text += "; data range " + ", ".join(f"{_span(v)} ({s})" for s, v in ranges.items()) + " 1/mm"
    return text + "".join(f"; {', '.join(dict.fromkeys(who))} {how}" for how, who in others.items()) + "."


def _span(numbers: list[float]) -> str:
    """Write numbers as one, or as the least and the greatest where seeds differ."""
    low, high = f"{min(numbers):.4g}", f"{max(numbers):.4g}"
    return low if low == high else f"{low} to {high}"


def _notes(records: Sequence[RunRecord], protocol: str) -> list[str]:
    """Return what the scores of a protocol declare: once for a scene and seed where its methods agree."""
    labels: dict[tuple[str, int, str], list[str]] = {}
    for record in records:
        if record.run.variant == METAL and protocol in record.scores and record.scores[protocol].note:
            key = (record.run.scene, record.run.seed, record.scores[protocol].note)
            labels.setdefault(key, []).append(record.label)
    said = Counter((scene, seed) for scene, seed, _ in labels)
    return [
        f"{scene} (seed {seed}{'' if said[scene, seed] == 1 else ', ' + ', '.join(methods)}): {note}"
        for (scene, seed, note), methods in labels.items()
    ]


def render(records: Sequence[RunRecord], form: Format, protocols: Iterable[str] = tuple(COLUMNS)) -> str:
    """Render the protocols' tables as Markdown or LaTeX (booktabs); failures and skips follow with their reasons."""
    return _page(tables(records, protocols), form, _failures(latest(records)), remarks(records))


def _page(found: Sequence[Table], form: Format, failed: Sequence[str], said: Sequence[str]) -> str:
    """Render tables, below them the runs that failed and what is to be said of the records (`records.remarks`)."""
    parts = [table.markdown() if form == "md" else table.latex() for table in found]
    if form == "md" and failed:
        parts.append("## Failures and skips\n\n" + "\n".join(f"- {escape(line, form)}" for line in failed) + "\n")
    elif failed:
        parts.append("".join(map(tex_comment, failed)))
    parts += [f"{escape(text, form)}.\n" if form == "md" else tex_comment(f"{text}.") for text in said]
    return "\n".join(parts)


def _failures(shown: Sequence[RunRecord]) -> list[str]:
    """Say of each run that did not end well what it was and why."""
    return [
        f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason or 'no reason given'}"
        for r in shown
        if r.status != OK
    ]


@uncollected()
def write(records: Sequence[RunRecord], results: Path) -> None:
    """Write table.md, table.csv and table.tex into the results folder.

    Raises InputError where there is no record to show.
    """
    if not records:
        raise InputError(f"{results}: there are no records to tabulate; run a method first")
    shown = latest(records)
    if not shown:
        raise InputError(f"{results}: {outdated(records)}")
    found = numbers(shown)
    pages, failed = _tables(shown, found), _failures(shown)
    texts = {form: _page(pages, form, failed, remarks(records)) for form in ("md", "tex")} | {"csv": csv_text(found)}
    for form, text in texts.items():
        write_synced(results / f"table.{form}", text.encode())  # who looks while runs go on sees a whole table
