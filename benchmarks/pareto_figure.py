"""The figure of `run-benchmark pareto`: a row of axes for each scene, error against time, with the Pareto front."""

from collections.abc import Sequence
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.methods import COUNTS_ONLY, METAL_MASK, SPECTRUM
from benchmarks.pareto_front import front, knee
from benchmarks.pareto_records import Point
from benchmarks.pareto_table import curves, groups

DPI, WIDE, HIGH = 150, 9.0, 4.6
MARKERS = {COUNTS_ONLY: "o", METAL_MASK: "^", SPECTRUM: "s"}
FRONT, KNEE = "#202020", "#d00000"
AXES: dict[str, tuple[str, str]] = {
    "simulator": ("s for all views", "relative RMS of P = −ln(signal/open)"),
    "methods": ("s", "RMSE of the tissue (1/mm)"),
}


def draw(every: Sequence[Point]) -> Figure:
    """Draw each group of points that may be compared: time and error on log axes, front, knee and defaults."""
    shown = groups(every)
    figure = Figure(figsize=(WIDE, HIGH * len(shown)), layout="constrained")
    for axes, group in zip(figure.subplots(len(shown), 1, squeeze=False)[:, 0], shown, strict=True):
        _group(axes, group)
    return figure


def _group(axes: Axes, group: Sequence[Point]) -> None:
    part = group[0].setting.part
    colours = colormaps["tab20"].colors  # pyright: ignore[reportAttributeAccessIssue]
    handles: list[Any] = []
    for k, (curve, mine) in enumerate(curves(group).items()):
        handles.append(_curve(axes, curve, mine, colours[(2 * k) % 20 + (2 * k) // 20]))
    pairs = [p.pair for p in group]
    on = [pairs[k] for k in front(pairs)]
    axes.step(*zip(*on, strict=True), where="post", color=FRONT, linewidth=1.0, zorder=1)
    at = knee(pairs)
    if at is not None:
        axes.plot(*pairs[at], "o", markersize=15, markerfacecolor="none", markeredgecolor=KNEE)
    chosen = [p.pair for p in group if p.default]
    if chosen:
        axes.plot(*zip(*chosen, strict=True), "x", color=FRONT, markersize=9)
    handles += [
        Line2D([], [], color=FRONT, linewidth=1.0, label="Pareto front"),
        Line2D([], [], color=KNEE, marker="o", markersize=11, markerfacecolor="none", linestyle="", label="its knee"),
        Line2D([], [], color=FRONT, marker="x", markersize=8, linestyle="", label="defaults"),
    ]
    if part == "methods":
        used = {p.setting.inputs for p in group}
        handles += [
            Line2D([], [], color="#808080", marker=marker, linestyle="", label=f"given: {inputs}")
            for inputs, marker in MARKERS.items()
            if inputs in used
        ]
    x, y = AXES[part]
    setting = group[0].setting
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y, title=f"{setting.part}, {setting.scene}: {setting.group}")
    axes.grid(which="both", alpha=0.2)
    axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)


def _curve(axes: Axes, curve: str, mine: Sequence[Point], colour: Any) -> Any:
    """Draw one method or kind of choice; lines join what one knob changes."""
    marker = MARKERS.get(mine[0].setting.inputs, "o")
    x, y = zip(*(p.pair for p in mine), strict=True)
    (line,) = axes.plot(x, y, marker=marker, markersize=5, linewidth=0.8, color=colour, label=curve)
    return line
