"""Figures of a results folder: each method's score by scene, and its run time.

They are drawn from the records alone. A figure's text and axes are in one colour that `svg` turns into the page's.
"""

import io
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.scores.score import COLUMNS
from ctsim.benchmarks.studies.methods.records import RunRecord
from ctsim.benchmarks.studies.methods.tables import summary

INK = "#4d4d4e"  # used by no other part of a figure
COLOURS = ("#3b82c4", "#d9772b", "#2f9e77", "#b5579c", "#8a8a1f", "#c44e52")
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "ctsim",
}
WIDTH, LINE = 4.6, 0.24  # inches: narrow enough to be read on a phone; a method's line


def scores(records: Sequence[RunRecord], protocol: str, metric: str) -> pd.DataFrame:
    """Return the mean over seeds of a metric, [method, scene]; NaN where a run has no such number."""
    table = summary(records)
    part = table[(table.protocol == protocol) & (table.metric == metric) & (table.variant == "metal")]
    wide = pd.DataFrame(part).pivot_table(index="method", columns="scene", values="mean", sort=False)
    return wide * COLUMNS[protocol][metric].scale


def quality(records: Sequence[RunRecord], protocol: str = "tissue", metric: str = "psnr3d") -> Figure | None:
    """Draw a metric of every method, a dot a scene, best mean on top; None where no run has it."""
    wide = scores(records, protocol, metric)
    if wide.empty:
        return None
    column = COLUMNS[protocol][metric]
    wide = wide.loc[wide.mean(axis=1).sort_values(ascending=column.better != "min").index]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, LINE * len(wide) + 1.1), layout="constrained")
        axes = figure.subplots()
        for line, (_, row) in enumerate(wide.iterrows()):
            known = row.dropna()
            axes.plot([known.min(), known.max()], [line, line], color=INK, lw=0.8, alpha=0.5, zorder=1)
        for k, scene in enumerate(wide.columns):
            axes.scatter(wide[scene], range(len(wide)), s=26, color=COLOURS[k % len(COLOURS)], label=pictured(scene))
        axes.set_yticks(range(len(wide)), labels=[pictured(name) for name in wide.index])
        axes.set_ylim(-0.6, len(wide) - 0.4)
        axes.set_xlabel(f"{column.title}, protocol {protocol}")
        axes.grid(axis="x", color=INK, alpha=0.18, lw=0.6)
        axes.tick_params(axis="y", length=0)
        figure.legend(loc="outside upper center", ncols=3, frameon=False, handletextpad=0.1)
    return figure


def worth(records: Sequence[RunRecord]) -> Figure | None:
    """Draw PSNR3D of the tissue against wall time, means over the scenes of methods that have all of them.

    None where there is no such method.
    """
    psnr, wall = scores(records, "tissue", "psnr3d"), scores(records, "cost", "wall")
    both = pd.DataFrame({"wall": wall.mean(axis=1), "psnr": psnr.dropna().mean(axis=1)}).dropna()
    if both.empty:
        return None
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
        axes = figure.subplots()
        axes.scatter(both.wall, both.psnr, s=26, color=COLOURS[0])
        labels = [
            axes.annotate(pictured(name), (row.wall, row.psnr), xytext=(4, 3), textcoords="offset points", fontsize=8)
            for name, row in both.sort_values("psnr", ascending=False).iterrows()
        ]
        axes.set(xscale="log", xlabel="wall time a scan (s), warm", ylabel="mean PSNR3D (dB), protocol tissue")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.18, y=0.1)
        axes.grid(color=INK, alpha=0.18, lw=0.6)
        _part(figure, labels)
    return figure


def _part(figure: Figure, labels: list[Annotation]) -> None:
    """Move labels down, the upper ones first, until none lies on one before it."""
    figure.draw_without_rendering()
    placed: list[Bbox] = []
    for label in labels:
        box, down = label.get_window_extent(), 0.0
        while any(box.translated(0, -down).overlaps(other) for other in placed):
            down += 2.0
        placed.append(box.translated(0, -down))
        x, y = label.xyann
        label.xyann = (x, y - down * 72 / figure.dpi)


def svg(figure: Figure, label: str) -> str:
    """Return a figure as inline SVG that takes the page's text colour, with `label` for screen readers."""
    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = buffer.getvalue()
    drawing = drawing[drawing.index("<svg") :].replace(INK, "currentColor")
    return drawing.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)


def drawn(records: Sequence[RunRecord]) -> Iterator[tuple[str, Figure]]:
    """Yield (title, figure) for each figure that the records allow."""
    found = (
        ("PSNR3D of the tissue, a dot a scene", quality(records)),
        ("SSIM3D of the tissue, a dot a scene", quality(records, metric="ssim3d")),
        ("PSNR3D against wall time", worth(records)),
    )
    yield from ((label, figure) for label, figure in found if figure is not None)
