"""The tables and the figure of `run-benchmark pareto`: fronts, where the defaults lie, and every point."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import TABLEAU_COLORS
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from ctsim.benchmarks.engine.record import Record
from ctsim.benchmarks.engine.table import Table, pictured, simple
from ctsim.benchmarks.studies.pareto.finding import (
    LOWER,
    NEAR,
    Part,
    Point,
    TimedRun,
    enough,
    faster,
    front,
    groups,
    knee,
    parted,
    points,
    recommended,
    rivals,
)
from ctsim.dataset.durable import replacing

HEADS: dict[Part, dict[str, str]] = {
    "simulator": {"rms": "relative RMS of P", "worst": "worst |ΔP|", "off_edges": "worst |ΔP| off the edges"},
    "methods": {"rmse": "RMSE (1/mm)", "psnr3d": "PSNR3D (dB)", "aligned": "aligned (dB)"},
}
FORMS = {"rmse": ".3e", "psnr3d": ".2f", "aligned": ".2f"}  # of values; else .1e
ABOUT: dict[Part, str] = {
    "simulator": "P = −ln(signal/open) without noise, against up to 2¹⁴ exact rays a pixel and the whole spectrum",
    "methods": "protocol `tissue`: effective spectrum, inside the body dilated by 4, outside the metal dilated by 2",
}
NUMBERS = ("s", "slowest", *(name for heads in HEADS.values() for name in heads.values()))


def summary(records: Sequence[Record[TimedRun]]) -> list[Table]:
    """Return tables of the front and the curves of each group, and of the runs that failed or were skipped."""
    tables = [table for group in groups(points(records)) for table in (_front(group), _curves(group))]
    bad = [(r.task.settings["curve"], r.task.settings["label"], r.found[0]) for r in records if not r.finished]
    rows = [(curve, label, run.status, run.reason) for curve, label, run in bad]
    return tables + [simple(("not measured", "setting", "status", "reason"), rows)] * bool(rows)


def every_point(records: Sequence[Record[TimedRun]]) -> list[Table]:
    """Return a table of all points of each group, with the errors in which each point is on the front."""
    tables = []
    for group in groups(points(records)):
        heads = _heads(group)
        fronts = {heads[error]: front(group, error) for error in LOWER[group[0].part]}
        rows = [
            (
                *(p.curve, _named(p), _s(p), f"{max(p.seconds):.3g}", *_values(p, heads)),
                ", ".join(head for head, on in fronts.items() if p in on),
            )
            for p in group
        ]
        columns = ("curve", "setting", "s", "slowest", *heads.values(), "on the front in")
        tables.append(simple(columns, rows, numbers=NUMBERS, title=f"{_title(group)}: every point"))
    return tables


def _title(group: Sequence[Point]) -> str:
    task = group[0].task
    where = f" ({task.data})" if task.part == "simulator" else ""
    return f"{task.part}, {task.case}: {group[0].group}{where}"


def _heads(group: Sequence[Point]) -> dict[str, str]:
    """Return the titles of the values; `aligned` only where it was asked for."""
    scored = {name for p in group for name in p.values}
    return {name: head for name, head in HEADS[group[0].part].items() if name != "aligned" or name in scored}


def _front(group: Sequence[Point]) -> Table:
    """Return the table of the group's front in its main error, with notes on the recommendation and the defaults."""
    part, heads, corner = group[0].part, _heads(group), knee(group)
    rounds = sorted({len(p.seconds) for p in group})
    of = "–".join(map(str, dict.fromkeys((rounds[0], rounds[-1]))))
    seconds = f"medians of {of} interleaved runs" if rounds[-1] > 1 else "those of one run"
    return simple(
        ("curve", "setting", "s", *heads.values(), ""),
        [(p.curve, _named(p), _s(p), *_values(p, heads), "knee" if p is corner else "") for p in front(group)],
        numbers=NUMBERS,
        title=_title(group),
        caption=f"On {group[0].task.machine}. Seconds are {seconds}. Error: {ABOUT[part]}. "
        f"The front, in {heads[LOWER[part][0]]}:",
        notes=[f"Recommended: {_short(recommended(group))}.", *(_defaults(group) if len(LOWER[part]) > 1 else ())],
    )


def _defaults(group: Sequence[Point]) -> Iterator[str]:
    """Yield a line per default: whether it is on the front in the main error, and in all errors at once."""
    part = group[0].part
    errors = LOWER[part]
    for p in (p for p in group if p.default):
        alone, joint = (_verdict(group, p, of) for of in (errors[:1], errors))
        yield f"Default {_short(p)}: in {HEADS[part][errors[0]]} {alone}; in all errors at once {joint}."


def _verdict(group: Sequence[Point], p: Point, errors: Sequence[str]) -> str:
    better = rivals(group, p, errors)
    if not better:
        return "on the front"
    # faster by more than the spread of the rounds, or with a clearly smaller error
    clear = [q for q in better if faster(q.seconds, p.seconds) or any(_far(q, p, error) for error in errors)]
    best = min(clear or better, key=lambda q: q.pair)
    where = "off the front" if clear else "on the front within the spread of the rounds"
    less = [f"{best.values[e] / p.values[e]:.2f} of the {HEADS[p.part][e]}" for e in errors if _far(best, p, e)]
    return f"{where} ({_short(best)} has {' and '.join([f'{best.pair[0] / p.pair[0]:.2f} of the time', *less])})"


def _far(q: Point, p: Point, error: str) -> bool:
    """Whether an error of `q` is below that of `p` by more than `NEAR`."""
    return q.values[error] * (1 + NEAR) < p.values[error]


def _curves(group: Sequence[Point]) -> Table:
    """Return the table of curves: default, knee, and the fastest point near the least error."""
    name = HEADS[group[0].part][LOWER[group[0].part][0]]
    rows = []
    for curve, mine in parted(group, lambda p: p.curve).items():
        default = next((p for p in mine if p.default), None)
        rows.append((curve, *_cells(default), _rival(group, default), *_cells(knee(mine)), *_cells(enough(mine))))
    near = f"within {NEAR:.0%} of its least error"
    columns = ("curve", "default", "s", name, "beaten by", "knee", "s", name, near, "s", name)
    return simple(columns, rows, numbers=NUMBERS)


def _rival(group: Sequence[Point], p: Point | None) -> str:
    """Name the fastest point that dominates `p` in the main error."""
    better = [] if p is None else rivals(group, p, LOWER[p.part][:1])
    if p is None or not better:
        return "–"
    best = min(better, key=lambda q: q.pair)
    return f"{_short(best)}, in {best.pair[0] / p.pair[0]:.2f} of the time"


def _cells(p: Point | None) -> tuple[str, str, str]:
    return ("–", "–", "–") if p is None else (p.label, _s(p), f"{p.pair[1]:.2e}")


def _named(p: Point) -> str:
    return f"{p.label} (default)" if p.default else p.label


def _short(p: Point) -> str:
    return f"{p.curve}, {p.label}"


def _s(p: Point) -> str:
    return f"{p.pair[0]:.3g}"


def _values(p: Point, names: Iterable[str]) -> list[str]:
    return [f"{p.values[name]:{FORMS.get(name, '.1e')}}" if name in p.values else "–" for name in names]


# --- the figure ---------------------------------------------------------------------------------------

DPI, WIDE, HIGH, LONG = 150, 11.0, 4.6, 16  # LONG: entries of a legend, from which on it has two columns
MARKERS = ("o", "^", "s", "D", "P", "v", "*")  # by group, in which colours begin again
STYLES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1, 1, 1)))
COLOURS = (*TABLEAU_COLORS.values(), "#aec7e8", "#ffbb78", "#98df8a", "#ff9896", "#c5b0d5", "#c49c94", "#f7b6d2")
FRONT, KNEE = "#202020", "#d00000"
AXES: dict[Part, tuple[str, str]] = {
    "simulator": ("s for all views", "relative RMS of P = −ln(signal/open)"),
    "methods": ("s", "RMSE of the tissue (1/mm)"),
}


def save_figure(every: Sequence[Point], path: Path) -> None:
    """Draw all points into a PNG file, replaced atomically."""
    with replacing(path) as new:
        figure(every).savefig(new, format="png", dpi=DPI)


def figure(every: Sequence[Point]) -> Figure:
    """Draw each scene's points: time and error on log axes, defaults, and the front and knee of each group."""
    scenes = parted(every, lambda p: (p.part, p.task.case))
    drawn = Figure(figsize=(WIDE, HIGH * len(scenes)), layout="constrained")
    for axes, mine in zip(drawn.subplots(len(scenes), 1, squeeze=False)[:, 0], scenes.values(), strict=True):
        _scene(axes, mine)
    return drawn


def _scene(axes: Axes, every: Sequence[Point]) -> None:
    handles: list[Any] = []
    for k, group in enumerate(groups(every)):
        for c, (curve, mine) in enumerate(parted(group, lambda p: p.curve).items()):
            x, y = zip(*sorted(p.pair for p in mine), strict=True)  # a default may stand anywhere on its curve
            look = {"color": COLOURS[c % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
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
    columns = 1 if len(handles) < LONG else 2
    axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False, ncol=columns)
