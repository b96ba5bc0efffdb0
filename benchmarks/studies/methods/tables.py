"""Tables from records: Markdown, CSV and LaTeX, one table a protocol, ranked within an input class.

No score is computed here. A cell is the mean ± standard deviation over noise seeds; a failed run shows its status in
place of numbers, and its reason below the tables. The numbers are made once for all tables of a command. A large table
has a million of them: they are plain tuples, which the garbage collector need not follow.
"""

import csv
import functools
import io
import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ctsim.benchmarks.engine.record import OK, uncollected
from ctsim.benchmarks.engine.table import Cell, Column, Table, escape, harmless, tex_comment
from ctsim.benchmarks.methods import CONTROLS, daggered
from ctsim.benchmarks.scores.score import (
    COLUMNS,
    COMPARED,
    KERMA,
    Metric,
    SeedValue,
    derived,
    harm,
)
from ctsim.benchmarks.studies.methods.captions import caption, declared, main_caption, main_columns
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord, latest, outdated, remarks
from ctsim.dataset.durable import write_synced
from ctsim.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Format = Literal["md", "tex"]

STUBS = (Column("inputs"), Column("method"))
MAIN_TABLE = "main"
ALL = (MAIN_TABLE, *COLUMNS)
"""What a page of results shows: the main table, then one for each protocol."""

Key = tuple[str, str, str, str, str, str]
"""Scene, variant, method, inputs, protocol and metric; a run without any number has protocol and metric ""."""

Place = tuple[str, tuple[str, str], str]
"""Scene, row and metric; a row is its inputs and its method."""

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
            value = record.kerma if metric == KERMA else getattr(cost, metric)
            add((*who, "cost", metric), None if value is None else float(value), status)
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
        same = identical and metric.rpartition("/")[2].startswith("psnr3d")
        return Cell("identical", float("inf")) if same else Cell("–")
    mean *= column.scale
    text = f"{mean:.{column.digits}f}"
    if std is not None:
        text += f" ± {std * column.scale:.{column.digits}f}"
    return Cell(text, mean)


def tables(records: Sequence[RunRecord], protocols: Collection[str] = ALL) -> list[Table]:
    """Return the protocols' tables of the records that count; a protocol without any number has none."""
    shown = latest(records)
    return _tables(shown, numbers(shown), protocols)


def _tables(shown: Sequence[RunRecord], found: Numbers, protocols: Collection[str] = ALL) -> list[Table]:
    own = [r for r in shown if r.run.variant == METAL]
    chosen: dict[str, dict[Place, Number]] = {}
    for (scene, variant, method, inputs, protocol, metric), number in found.items():
        if variant == METAL:
            chosen.setdefault(protocol, {})[scene, (inputs, method), metric] = number
    made = _main(shown, chosen, own) if MAIN_TABLE in protocols else []
    for protocol in (p for p in protocols if p in chosen):
        columns, rows = _grid(chosen[protocol], protocol, own)
        if len(columns) > len(STUBS):
            text, notes = caption(shown, protocol), declared(shown, protocol)
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


def _main(shown: Sequence[RunRecord], chosen: dict[str, dict[Place, Number]], own: Sequence[RunRecord]) -> list[Table]:
    """Return the main tables: one for each scene, and their mean, of what matters most from several protocols."""
    there = {(protocol, metric) for protocol, group in chosen.items() for _, _, metric in group}
    metrics = {f"{p}/{m}": how for (p, m), how in main_columns(shown).items() if (p, m) in there}
    picked = {
        (scene, row, f"{protocol}/{metric}"): number
        for protocol, group in chosen.items()
        for (scene, row, metric), number in group.items()
        if f"{protocol}/{metric}" in metrics
    }
    if not metrics:
        return []
    columns, rows = _grid_of(picked, metrics, own)
    heads = [column._replace(group="") for column in columns]
    titles = list(dict.fromkeys(column.group for column in columns[len(STUBS) :]))
    made = []
    for k, title in enumerate(titles):
        here = slice(len(STUBS) + k * len(metrics), len(STUBS) + (k + 1) * len(metrics))
        made.append(
            Table(
                title=f"{MAIN_TABLE}: {title}",
                columns=[*STUBS, *heads[here]],
                rows=[[*row[: len(STUBS)], *row[here]] for row in rows],
                caption=main_caption(shown) if k == 0 else "",
                rank_within=0,
                unranked=CONTROLS,
            )
        )
    return made


def _grid(
    chosen: dict[Place, Number], protocol: str, own: Sequence[RunRecord]
) -> tuple[list[Column], list[list[Cell]]]:
    """Return the columns and rows of a protocol's table; `chosen` are its numbers by scene, row and metric."""
    there = {metric for _, _, metric in chosen}
    return _grid_of(chosen, {m: how for m, how in COLUMNS[protocol].items() if m in there}, own, protocol)


def _grid_of(
    chosen: dict[Place, Number],
    metrics: dict[str, Metric],
    own: Sequence[RunRecord],
    protocol: str = MAIN_TABLE,
) -> tuple[list[Column], list[list[Cell]]]:
    """Return columns and rows of a table with all scenes side by side, then their mean.

    What has fewer seeds than another row says so and has no rank: other noise and other bodies do not compare.
    """
    scenes = list(dict.fromkeys(r.run.scene for r in own))
    groups = [*scenes, *["mean"] * (len(scenes) > 1), *["harm rate"] * (protocol == "anchored")]
    failed = {(r.run.scene, (r.inputs, r.label)): r.status for r in own if r.status != OK}
    seeds: dict[tuple[str, str], int] = defaultdict(int)
    for (scene, _, metric), number in chosen.items():
        seeds[scene, metric] = max(seeds[scene, metric], number[2])
    rows = []
    for row in dict.fromkeys((r.inputs, r.label) for r in own):
        cells = []
        for scene in scenes:
            for metric, how in metrics.items():
                number = chosen.get((scene, row, metric))
                cell = _cell(number, metric, how)
                if number is not None and 0 < number[2] < seeds[scene, metric]:
                    cell = Cell(f"{cell.text} ({number[2]}/{seeds[scene, metric]} seeds)")
                if (scene, row) in failed:
                    status = failed[scene, row]
                    cell = Cell(status if cell.number is None or protocol == "cost" else f"{cell.text} ({status})")
                cells.append(cell)
        more: list[Cell] = []
        if len(scenes) > 1:
            more += [_over_scenes(cells, k, len(metrics), how) for k, how in enumerate(metrics.values())]
        if protocol == "anchored":
            shares = (harm([c.number for c in cells[k :: len(metrics)]]) for k in range(len(metrics)))
            more += [Cell(text, share) for share, text in shares]
        rows.append([Cell(row[0]), Cell(daggered(row[1])), *cells, *more])
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


def render(records: Sequence[RunRecord], form: Format, protocols: Collection[str] = ALL) -> str:
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
