"""The figure of a group of `run-benchmark validate`: differences over their tolerances, and curves."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.studies.validate.finding import Check, Curves
from ctsim.dataset.durable import replacing

DPI = 110
FARTHEST = 5.0  # tolerances; larger differences are drawn at the edge, with their number


def save_figure(checks: Sequence[Check], group: str, path: Path) -> None:
    """Draw the checks that have a tolerance and all curves, and write the picture."""
    drawn = figure(checks, group)
    with replacing(path) as new:
        drawn.savefig(new, format="png", dpi=DPI)


def figure(checks: Sequence[Check], group: str) -> Figure:
    """Return the figure: a dot for each check on the left, a panel for each set of curves on the right."""
    judged = [c for c in checks if c.tolerance and c.difference is not None]
    curves = _merged([one for c in checks for one in c.curves])
    height = max(2.5, 0.9 + 0.22 * len(judged))
    picture = Figure(figsize=(8 + 4 * len(curves), height), layout="constrained")
    panels = picture.subplots(1, 1 + len(curves), squeeze=False, width_ratios=[1.6] + [1] * len(curves))[0]
    picture.suptitle(pictured(group))
    _dots(panels[0], judged)
    for panel, one in zip(panels[1:], curves, strict=True):
        for name, values in one.lines.items():
            panel.plot(one.x, values, label=pictured(name), linewidth=1)
        panel.set_title(pictured(one.title), fontsize="small")
        panel.set_xlabel(pictured(one.across))
        panel.set_ylabel(pictured(one.up))
        panel.legend(fontsize="x-small")
    return picture


def _merged(curves: Sequence[Curves]) -> list[Curves]:
    """Return the curves with those of one title and one axis in one panel."""
    panels: dict[tuple[object, ...], Curves] = {}
    for one in curves:
        key = one.title, one.across, one.up, one.x
        before = panels[key].lines if key in panels else {}
        panels[key] = msgspec.structs.replace(one, lines=before | one.lines)
    return list(panels.values())


def _dots(panel: Axes, judged: Sequence[Check]) -> None:
    """Draw difference over tolerance, one row for each check; the band is what is allowed."""
    panel.axvspan(-1, 1, color="0.9")
    panel.axvline(0, color="0.6", linewidth=0.8)
    for row, one in enumerate(judged):
        share = (one.difference or 0.0) / (one.tolerance or 1.0)
        at = min(max(share, -FARTHEST), FARTHEST)
        panel.plot(at, row, "o", color="tab:blue" if abs(share) <= 1 else "tab:red", markersize=4)
        if at != share:
            panel.annotate(f"{share:.3g}", (at, row), fontsize="x-small", ha="right" if at > 0 else "left", va="bottom")
    panel.set_yticks(range(len(judged)), [pictured(c.quantity) for c in judged], fontsize="x-small")
    panel.invert_yaxis()
    panel.set_xlim(-FARTHEST - 0.3, FARTHEST + 0.3)
    panel.set_xlabel("difference / tolerance")
