"""Tables from records: Markdown, CSV and LaTeX, one table a protocol, ranked within an input class.

Nothing is computed anew. A cell is the mean ± standard deviation over noise seeds; a run that failed
shows its status in place of numbers, and its reason below the tables.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from benchmarks import latex
from benchmarks.columns import COLUMNS, Column
from benchmarks.compare import NMAR, derived, harm, row_of
from benchmarks.protocol import AS_RETURNED
from benchmarks.records import OK, Record, latest, outdated
from benchmarks.texts import escape, ranked
from ctsim.durable import write_synced
from ctsim.errors import InputError

Format = Literal["md", "tex"]


def tidy(records: list[Record]) -> pd.DataFrame:
    """Return one row a number, with its scene, seed, variant, method, inputs, protocol, metric, and the run's status.

    `identical` and `volume` are those of the score.
    """
    rows: list[dict[str, Any]] = []
    for record in latest(records):
        base = {
            "scene": record.run.scene,
            "seed": record.run.seed,
            "variant": record.run.variant,
            "method": record.label,
            "inputs": record.inputs,
            "status": record.status,
        }
        numbers = [(p, m, v, s.identical, s.volume) for p, s in record.scores.items() for m, v in s.values.items()]
        if record.cost is not None:
            numbers += [("cost", m, float(getattr(record.cost, m)), False, "") for m in COLUMNS["cost"]]
        names = ("protocol", "metric", "value", "identical", "volume")
        rows += [base | dict(zip(names, row, strict=True)) for row in numbers or [("", "", None, False, "")]]
    columns = ["scene", "seed", "variant", "method", "inputs", "protocol", "metric", "value", "status"]
    frame = pd.DataFrame(rows + derived(rows), columns=pd.Index([*columns, "identical", "volume"]))
    frame["value"] = pd.to_numeric(frame["value"])
    return frame


def _rows(frame: pd.DataFrame) -> list[dict[Any, Any]]:
    return frame.to_dict("records")


def summary(records: list[Record]) -> pd.DataFrame:
    """Return mean, std (over seeds, ddof 1) and n of every number, as table.csv holds it.

    `volume` says which of the method's volumes was scored.
    """
    frame = tidy(records)
    keys = ["scene", "variant", "method", "inputs", "protocol", "metric"]
    if frame.empty:
        return pd.DataFrame(columns=[*keys, "mean", "std", "n", "status", "identical", "volume"])
    grouped = frame.groupby(keys, sort=False, dropna=False)
    table = grouped["value"].agg(mean="mean", std="std", n="count")
    for name in ("status", "volume"):
        table[name] = grouped[name].agg(lambda s: ", ".join(dict.fromkeys(s)))
    table["identical"] = grouped["identical"].all()
    return table.reset_index()


def _cell(row: dict[Any, Any] | None, column: Column) -> tuple[float | None, str]:
    """Return the number to rank by and the text of one cell."""
    if row is None:
        return None, "–"
    if row["n"] == 0:
        same = row["identical"] and row["metric"].startswith("psnr3d")
        return (float("inf"), "identical") if same else (None, "–")
    mean = row["mean"] * column.scale
    text = f"{mean:.{column.digits}f}"
    if row["n"] > 1:
        text += f" ± {row['std'] * column.scale:.{column.digits}f}"
    return float(mean), text


def _grid(table: pd.DataFrame, protocol: str, records: list[Record]) -> tuple[list[tuple[str, str]], list[list[Any]]]:
    """Return the columns (scene, metric) and rows [inputs, method, cells] of a protocol's table."""
    part = table[(table.protocol == protocol) & (table.variant == "metal")]
    metrics = [m for m in COLUMNS[protocol] if (part.metric == m).any()]
    own = [r for r in records if r.run.variant == "metal"]
    scenes = list(dict.fromkeys(r.run.scene for r in own))
    columns = [(s, m) for s in scenes for m in metrics]
    failed = {(r.run.scene, r.label): r.status for r in own if r.status != OK}
    chosen = {(row["scene"], row["method"], row["metric"]): row for row in _rows(pd.DataFrame(part))}
    rows = []
    for inputs, method in dict.fromkeys((r.inputs, r.label) for r in own):
        cells = []
        for scene, metric in columns:
            number, text = _cell(chosen.get((scene, method, metric)), COLUMNS[protocol][metric])
            if (scene, method) in failed:
                status = failed[scene, method]
                number, text = None, status if number is None or protocol == "cost" else f"{text} ({status})"
            cells.append((number, text))
        more = []
        if len(scenes) > 1:
            more += [_mean(cells, k, len(metrics), COLUMNS[protocol][m]) for k, m in enumerate(metrics)]
        if protocol == "anchored":
            more += [harm([number for number, _ in cells[k :: len(metrics)]]) for k in range(len(metrics))]
        rows.append([inputs, method, cells + more])
    if len(scenes) > 1:
        columns += [("mean", m) for m in metrics]
    if protocol == "anchored":
        columns += [("harm rate", m) for m in metrics]
    rows.sort(key=lambda row: row[0])
    return columns, rows


def _mean(cells: list[tuple[float | None, str]], k: int, step: int, column: Column) -> tuple[float | None, str]:
    """Average a metric over scenes; a method that lacks one has no mean, since it would not compare."""
    numbers = [number for number, _ in cells[k::step]]
    if any(n is None or n == float("inf") for n in numbers):
        return None, "–"
    mean = sum(n for n in numbers if n is not None) / len(numbers)
    return mean, f"{mean:.{column.digits}f}"


def merged(texts: Iterable[str]) -> str:
    """Join texts that differ in numbers only into one with their ranges, others with " / "."""
    kinds: dict[str, list[list[str]]] = {}
    for text in texts:
        kinds.setdefault(_NUMBER.sub("#", text), []).append(_NUMBER.findall(text))
    out = []
    for kind, found in kinds.items():
        pieces = kind.split("#")
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
    scenes = [(scene, seed) for scene, seed, _ in labels]
    return [
        f"{scene} (seed {seed}{'' if scenes.count((scene, seed)) == 1 else ', ' + ', '.join(methods)}): {note}"
        for (scene, seed, note), methods in labels.items()
    ]


def _lines(columns: list[tuple[str, str]], rows: list[list[Any]], protocol: str, form: Format) -> list[list[str]]:
    """Return the table's cells as text, header first, the best and second of each class marked."""
    titles = [f"{scene}: {COLUMNS[protocol][metric].title}" for scene, metric in columns]
    lines = [[escape(t, form) for t in ("inputs", "method", *titles)]]
    marked: dict[tuple[int, int], str] = {}
    for k, (_, metric) in enumerate(columns):
        for inputs in dict.fromkeys(row[0] for row in rows):
            group = [i for i, row in enumerate(rows) if row[0] == inputs]
            places = ranked([rows[i][2][k][0] for i in group], COLUMNS[protocol][metric].better)
            marked |= {(group[i], k): mark for i, mark in places.items()}
    wrap = {
        "md": {"best": "**{}**", "second": "<u>{}</u>"},
        "tex": {"best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"},
    }[form]
    for i, (inputs, method, cells) in enumerate(rows):
        texts = [escape(text, form) for _, text in cells]
        texts = [wrap[marked[i, k]].format(t) if (i, k) in marked else t for k, t in enumerate(texts)]
        lines.append([escape(inputs, form), escape(method, form), *texts])
    return lines


def render(records: list[Record], form: Format, protocols: Iterable[str] = tuple(COLUMNS)) -> str:
    """Render the protocols' tables as Markdown or LaTeX (booktabs); failures and skips follow with their reasons."""
    left_out, records = outdated(records), latest(records)
    table = summary(records)
    parts = []
    for protocol in protocols:
        columns, rows = _grid(table, protocol, records)
        if not columns:
            continue
        lines = _lines(columns, rows, protocol, form)
        text, declared = escape(caption(records, protocol), form), _notes(records, protocol)
        if form == "md":
            head = ["| " + " | ".join(lines[0]) + " |", "|---|---|" + "---:|" * len(columns)]
            body = head + ["| " + " | ".join(line) + " |" for line in lines[1:]]
            notes = "".join(f"- {escape(note, form)}\n" for note in declared)
            parts.append(f"## {protocol}\n\n{text}\n\n" + "\n".join(body) + "\n" + (f"\n{notes}" if notes else ""))
        else:
            titles = [escape(COLUMNS[protocol][metric].title, form) for _, metric in columns]
            head = [*latex.spanning(2, [(scene, 1) for scene, _ in columns]), latex.row([*lines[0][:2], *titles])]
            body = [latex.row(line) for line in lines[1:]]
            comments = "".join(f"% {note}\n" for note in declared)
            parts.append(latex.table(text, "ll" + "r" * len(columns), head, body) + comments)
    parts += [_failures(records, form), f"{'' if form == 'md' else '% '}{left_out}.\n" if left_out else ""]
    return "\n".join(p for p in parts if p)


def _failures(records: list[Record], form: Format) -> str:
    """List the runs that did not end well, with their reasons."""
    failed = [r for r in records if r.status != OK]
    if not failed:
        return ""
    lines = [
        f"{r.run.scene} ({r.run.variant}), {r.label}: {r.status} – {r.reason or 'no reason given'}" for r in failed
    ]
    if form == "md":
        return "## Failures and skips\n\n" + "\n".join(f"- {escape(line, form)}" for line in lines) + "\n"
    return "\n".join("% " + " ".join(line.split()) for line in lines) + "\n"


def write(records: list[Record], results: Path) -> None:
    """Write table.md, table.csv and table.tex into the results folder.

    Raises InputError where there is no record to show.
    """
    if not records:
        raise InputError(f"{results}: there are no records to tabulate; run a method first")
    if not latest(records):
        raise InputError(f"{results}: {outdated(records)}")
    texts = {"md": render(records, "md"), "tex": render(records, "tex"), "csv": summary(records).to_csv(index=False)}
    for form, text in texts.items():
        write_synced(results / f"table.{form}", text.encode())  # one who looks while runs go on sees a whole table
