"""The figure of `run-benchmark pareto`: a row of axes for each scene, error against time, with the Pareto front."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import TABLEAU_COLORS
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.studies.pareto.finding import Part, Point, front, groups, knee, parted
from ctsim.durable import replacing

DPI, WIDE, HIGH = 150, 9.0, 4.6
MARKERS, STYLES = ("o", "^", "s", "D"), ("-", "--", ":", "-.")  # by group
COLOURS = (*TABLEAU_COLORS.values(), "#aec7e8", "#ffbb78", "#98df8a", "#ff9896", "#c5b0d5", "#c49c94", "#f7b6d2")
FRONT, KNEE = "#202020", "#d00000"
AXES: dict[Part, tuple[str, str]] = {
    "simulator": ("s for all views", "relative RMS of P = −ln(signal/open)"),
    "methods": ("s", "RMSE of the tissue (1/mm)"),
}


def save(every: Sequence[Point], path: Path) -> None:
    """Draw all points into a PNG file, which is replaced at once."""
    with replacing(path) as new:
        draw(every).savefig(new, format="png", dpi=DPI)


def draw(every: Sequence[Point]) -> Figure:
    """Draw each scene's points: time and error on log axes, defaults, and the front and knee of each group."""
    scenes = parted(every, lambda p: (p.part, p.task.case))
    figure = Figure(figsize=(WIDE, HIGH * len(scenes)), layout="constrained")
    for axes, mine in zip(figure.subplots(len(scenes), 1, squeeze=False)[:, 0], scenes.values(), strict=True):
        _scene(axes, mine)
    return figure


def _scene(axes: Axes, every: Sequence[Point]) -> None:
    handles: list[Any] = []
    known = list(dict.fromkeys(p.curve for p in every))
    for k, group in enumerate(groups(every)):
        for curve, mine in parted(group, lambda p: p.curve).items():
            x, y = zip(*sorted(p.pair for p in mine), strict=True)  # a default may stand anywhere on its curve
            look = {"color": COLOURS[known.index(curve) % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
            handles += axes.plot(x, y, markersize=5, linewidth=0.8, label=pictured(curve), **look)
        x, y = zip(*(p.pair for p in front(group)), strict=True)
        style, label = STYLES[k % len(STYLES)], pictured(f"front: {group[0].group}")
        handles += axes.step(x, y, where="post", color=FRONT, linewidth=1.0, linestyle=style, zorder=1, label=label)
        if corner := knee(group):
            axes.plot(*corner.pair, "o", markersize=15, markerfacecolor="none", markeredgecolor=KNEE)
    if chosen := [p.pair for p in every if p.default]:
        axes.plot(*zip(*chosen, strict=True), "x", color=FRONT, markersize=9)
    handles += [
        Line2D([], [], color=KNEE, marker="o", markersize=11, markerfacecolor="none", linestyle="", label="knee"),
        Line2D([], [], color=FRONT, marker="x", markersize=8, linestyle="", label="default"),
    ]
    part, scene = every[0].part, every[0].task.case
    x, y = AXES[part]
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y, title=pictured(f"{part}, {scene}"))
    axes.grid(which="both", alpha=0.2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        axis.set_minor_formatter("{x:g}")
    axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
