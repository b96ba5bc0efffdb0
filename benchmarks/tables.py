"""Tables from records: Markdown, CSV and LaTeX, one table a protocol, ranked within an input class.

Nothing is computed anew. A cell is the mean ± standard deviation over noise seeds; a run that failed
shows its status in place of numbers, and its reason below the tables.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from benchmarks.records import OK, Record, latest
from benchmarks.texts import escape, ranked
from ctsim.errors import InputError

Format = Literal["md", "tex"]


@dataclass(frozen=True, slots=True)
class Column:
    """How a metric is shown: title, decimals, which way is better ("max", "min", "one" = nearest 1), and a factor."""

    title: str
    digits: int
    better: str = ""
    scale: float = 1.0


COLUMNS: dict[str, dict[str, Column]] = {
    "tissue": {"psnr3d": Column("PSNR3D (dB)", 2, "max"), "ssim3d": Column("SSIM3D", 3, "max")},
    "aligned": {
        "psnr3d": Column("PSNR3D (dB)", 2, "max"),
        "ssim3d": Column("SSIM3D", 3, "max"),
        "gain": Column("gain", 3),
    },
    "aligned_50kev": {
        "psnr3d": Column("PSNR3D (dB)", 2, "max"),
        "ssim3d": Column("SSIM3D", 3, "max"),
        "gain": Column("gain", 3),
    },
    "paper": {
        "psnr3d": Column("PSNR3D (dB)", 2, "max"),
        "ssim3d": Column("SSIM3D", 3, "max"),
        "psnr3d_full_gtmax": Column("psnr3d_full_gtmax", 2, "max"),
        "psnr3d_r2": Column("psnr3d_r2", 2, "max"),
        "ssim3d_r2": Column("ssim3d_r2", 3, "max"),
        "ssim3d_naf": Column("ssim3d_naf", 3, "max"),
    },
    "metal": {
        "core_ratio": Column("core ratio", 3, "one"),
        "dice": Column("Dice", 3, "max"),
        "boundary_rms": Column("boundary RMS (mm)", 3, "min"),
    },
    "against": {
        "over_fdk": Column("over FDK (dB)", 2, "max"),
        "over_nmar": Column("over NMAR (dB)", 2, "max"),
        "anchored": Column("anchored score", 3, "min"),
        "harm": Column("harm rate", 2, "min"),
    },
    "cost": {
        "wall": Column("wall (s)", 2, "min"),
        "cpu": Column("CPU (s)", 2, "min"),
        "peak_bytes": Column("peak (MiB)", 0, "min", 1 / 2**20),
        "view_updates": Column("view updates", 0),
        "warm_up": Column("warm-up (s)", 2),
    },
}


def tidy(records: list[Record]) -> pd.DataFrame:
    """Return one row a number: scene, seed, variant, method, inputs, protocol, metric, value, status, identical."""
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
        numbers = [(p, m, v, s.identical) for p, s in record.scores.items() for m, v in s.values.items()]
        if record.cost is not None:
            numbers += [("cost", m, float(getattr(record.cost, m)), False) for m in COLUMNS["cost"]]
        rows += [{**base, "protocol": p, "metric": m, "value": v, "identical": i} for p, m, v, i in numbers]
        if not numbers:
            rows.append({**base, "protocol": "", "metric": "", "value": None, "identical": False})
    frame = pd.DataFrame(
        rows,
        columns=["scene", "seed", "variant", "method", "inputs", "protocol", "metric", "value", "status", "identical"],
    )
    frame["value"] = pd.to_numeric(frame["value"])
    return pd.concat([frame, _against(frame)], ignore_index=True) if len(frame) else frame


def _against(frame: pd.DataFrame) -> pd.DataFrame:
    """Derive gains over FDK and NMAR (tissue PSNR3D, dB), the anchored score (tissue RMSE) and harm, per run."""
    scored: list[dict[Any, Any]] = [
        row for row in _rows(frame) if row["protocol"] == "tissue" and row["status"] == OK and pd.notna(row["value"])
    ]

    def series(variant: str, method: str, metric: str) -> dict[Any, float]:
        wanted = (variant, method, metric)
        chosen = [row for row in scored if (row["variant"], row["method"], row["metric"]) == wanted]
        return {(row["scene"], row["seed"]): row["value"] for row in chosen}

    fdk, nmar = series("metal", "fdk", "psnr3d"), series("metal", "nmar", "psnr3d")
    worst, best = series("metal", "fdk", "rmse"), series("metal_free", "fdk", "rmse")
    rows = []
    for row in scored:
        key = (row["scene"], row["seed"])
        found: dict[str, float] = {}
        if row["variant"] != "metal":
            continue
        if row["metric"] == "psnr3d":
            found = {n: row["value"] - base[key] for n, base in (("over_fdk", fdk), ("over_nmar", nmar)) if key in base}
        elif row["metric"] == "rmse" and key in worst and key in best and worst[key] != best[key]:
            score = (row["value"] - best[key]) / (worst[key] - best[key])
            found = {"anchored": score, "harm": float(score > 1)}
        rows += [{**row, "protocol": "against", "metric": m, "value": v} for m, v in found.items()]
    return pd.DataFrame(rows, columns=frame.columns).astype(frame.dtypes.to_dict())


def _rows(frame: pd.DataFrame) -> list[dict[Any, Any]]:
    return frame.to_dict("records")


def summary(records: list[Record]) -> pd.DataFrame:
    """Return mean, std (over seeds, ddof 1) and n of every number, as table.csv holds it."""
    frame = tidy(records)
    keys = ["scene", "variant", "method", "inputs", "protocol", "metric"]
    if frame.empty:
        return pd.DataFrame(columns=[*keys, "mean", "std", "n", "status", "identical"])
    grouped = frame.groupby(keys, sort=False, dropna=False)
    table = grouped["value"].agg(mean="mean", std="std", n="count")
    table["status"] = grouped["status"].agg(lambda s: ", ".join(dict.fromkeys(s)))
    table["identical"] = grouped["identical"].all()
    return table.reset_index()


def _cell(row: dict[Any, Any] | None, column: Column) -> tuple[float | None, str]:
    """Return the number to rank by and the text of one cell."""
    if row is None:
        return None, "–"
    if row["n"] == 0:
        return (float("inf"), "identical") if row["identical"] else (None, "–")
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
        if len(scenes) > 1:
            cells += [_mean(cells, k, len(metrics), COLUMNS[protocol][m]) for k, m in enumerate(metrics)]
        rows.append([inputs, method, cells])
    if len(scenes) > 1:
        columns += [("mean", m) for m in metrics]
    rows.sort(key=lambda row: row[0])
    return columns, rows


def _mean(cells: list[tuple[float | None, str]], k: int, step: int, column: Column) -> tuple[float | None, str]:
    """Average a metric over scenes; a method that lacks one has no mean, since it would not compare."""
    numbers = [number for number, _ in cells[k::step]]
    if any(n is None or n == float("inf") for n in numbers):
        return None, "–"
    mean = sum(n for n in numbers if n is not None) / len(numbers)
    return mean, f"{mean:.{column.digits}f}"


def caption(records: list[Record], protocol: str) -> str:
    """State protocol, region, reference, alignment and data range of a table."""
    if protocol == "cost":
        return "Protocol cost: seconds and peak resident memory of a run; compilation and first call stand apart."
    if protocol == "against":
        return (
            "Protocol tissue, compared: gain in PSNR3D over no correction (FDK) and over NMAR; anchored score of the "
            "RMSE (0: as FDK without the metal, 1: as uncorrected FDK); harm rate: share of runs with a score above 1."
        )
    found = [(r.run.scene, r.scores[protocol]) for r in records if protocol in r.scores and r.run.variant == "metal"]
    if not found:
        return f"Protocol {protocol}."
    score = found[0][1]
    references = dict.fromkeys(s.reference for _, s in found)
    alignment = "one least-squares gain on the body" if protocol.startswith("aligned") else score.alignment
    ranges = {scene: s.data_range for scene, s in found if s.data_range is not None}
    text = f"Protocol {protocol}: region {score.region}; reference {' / '.join(references)}; alignment {alignment}"
    if ranges:
        text += "; data range " + ", ".join(f"{v:.4g} ({s})" for s, v in ranges.items()) + " 1/mm"
    return text + "."


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


def render(records: list[Record], form: Format) -> str:
    """Render all tables as Markdown or LaTeX (booktabs); failures and skips follow with their reasons."""
    records = latest(records)
    table = summary(records)
    parts = []
    for protocol in COLUMNS:
        columns, rows = _grid(table, protocol, records)
        if not columns:
            continue
        lines = _lines(columns, rows, protocol, form)
        text = escape(caption(records, protocol), form)
        if form == "md":
            head = ["| " + " | ".join(lines[0]) + " |", "|---|---|" + "---:|" * len(columns)]
            body = head + ["| " + " | ".join(line) + " |" for line in lines[1:]]
            parts.append(f"## {protocol}\n\n{text}\n\n" + "\n".join(body) + "\n")
        else:
            body = [" & ".join(line) + r" \\" for line in lines]
            spec = "ll" + "r" * len(columns)
            parts.append(
                "\\begin{table}\n\\centering\n\\caption{" + text + "}\n\\begin{tabular}{" + spec + "}\n\\toprule\n"
                f"{body[0]}\n\\midrule\n" + "\n".join(body[1:]) + "\n\\bottomrule\n\\end{tabular}\n\\end{table}\n"
            )
    parts.append(_failures(records, form))
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
    return "\n".join("% " + line for line in lines) + "\n"


def write(records: list[Record], results: Path) -> None:
    """Write table.md, table.csv and table.tex into the results folder.

    Raises InputError where there is no record to show.
    """
    if not records:
        raise InputError(f"{results}: there are no records to tabulate; run a method first")
    for form in ("md", "tex"):
        (results / f"table.{form}").write_text(render(records, form), encoding="utf-8")
    summary(records).to_csv(results / "table.csv", index=False)
