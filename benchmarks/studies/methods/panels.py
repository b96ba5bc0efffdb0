"""One picture per scene: every method's volume in one window, its signed error on one scale, its intermediates.

Rows are the reference and the methods. Columns are a slice normal to z and one normal to y, their errors against the
effective-spectrum reference, and, where a method attached them (`.volumes`), the projection that
it backprojected with the metal's trace, and its prior.
"""

import hashlib
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from PIL import Image

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.scalebar import scale_bar
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.benchmarks.scores.protocol import Truth, truth_of
from ctsim.benchmarks.scores.score import NO_REFERENCE
from ctsim.benchmarks.studies.methods.bare import draw_bare
from ctsim.benchmarks.studies.methods.records import RunRecord, latest
from ctsim.benchmarks.studies.methods.volumes import (
    Intermediates,
    identity_of,
    intermediates_of,
    map_volume,
    read_intermediates,
)
from ctsim.dataset.durable import replacing, sync
from ctsim.dataset.store import StoredScan
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.projector import forward_columns

PLANES = ((0, "z"), (1, "y"))
TOP, ERROR = 2.5, 1.0
"""Windows in medians of the body: volumes end at 2.5, errors at ± 1; for soft tissue 1500 and ± 1000 HU."""

METAL, UNJUDGED = "#ffb000", "#8c8c8c"
KEY = "ctsim shows"  # of the digest in a picture
CELL, LABEL, DPI = 1.75, 1.1, 150  # inches, inches, dots per inch


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelRow:
    """The row of one method: its name and scores, its volume [z, y, x] in 1/mm, and its intermediates."""

    caption: str
    volume: NDArray[Any]
    shown: Intermediates = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """The windows that all rows share, in 1/mm (−ln for `projection`); `water` is μ of water, to print HU."""

    top: float
    error: float
    projection: float
    water: float | None


def cut(metal: NDArray[np.bool_], body: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Choose the slices to show: through the most metal along each axis, else through the most body."""
    mask = metal if metal.any() else body
    counts = [mask.sum(axis=tuple(a for a in range(3) if a != axis)) for axis in range(3)]
    z, y, x = (int(np.argmax(c)) for c in counts)
    return z, y, x


def write_panels(records: Sequence[RunRecord], scans: list[StoredScan], results: Path) -> list[Path]:
    """Draw panels/SCENE.png for every scan that has kept volumes; return what was written.

    A picture holds a digest of the runs and files that it shows (`_digest`); where they are the same it stays.
    """
    mine: dict[str, list[RunRecord]] = {}
    for record in latest(records):
        if record.volume and record.scores.keys() & {"tissue", NO_REFERENCE} and record.run.variant == "metal":
            mine.setdefault(record.task.data, []).append(record)
    written = []
    for stored in scans:
        kept = [(r, results / str(r.volume)) for r in mine.get(stored.content_hash, [])]
        kept = [(record, path) for record, path in kept if identity_of(path) == record.identity]
        picture, digest = results / "panels" / f"{stored.name}.png", _digest(stored, kept)
        if kept and _held(picture) != digest:
            picture.parent.mkdir(parents=True, exist_ok=True)
            rows = [_row(*pair) for pair in kept]
            if stored.has_truth:
                figure = draw(stored, truth_of(stored), rows)
            else:
                figure = draw_bare(stored.name, stored.geometry, [(row.caption, row.volume) for row in rows])
            with replacing(picture) as new:
                figure.savefig(new, format="png", dpi=DPI, metadata={KEY: digest})
                sync(new)  # a picture with its digest counts as whole
            written.append(picture)
    return written


def _row(record: RunRecord, path: Path) -> PanelRow:
    shown = read_intermediates(intermediates_of(path), record.identity)
    return PanelRow(caption=_caption(record), volume=map_volume(path), shown=shown)


def _digest(stored: StoredScan, kept: list[tuple[RunRecord, Path]]) -> str:
    """Hash what a picture depends on: the scan, the runs with their scores, their files, and how it is drawn.

    A file counts by its size and time: a run that is done again has the same identity.
    """
    rows = [
        (record.identity, _caption(record), [_stamp(file) for file in (path, intermediates_of(path))])
        for record, path in kept
    ]
    what = (stored.name, stored.content_hash, rows, matplotlib.__version__, Path(__file__).read_text(encoding="utf-8"))
    return hashlib.sha256(json.dumps(what).encode()).hexdigest()


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_size, found.st_mtime_ns


def _held(picture: Path) -> str | None:
    """Return the digest that a picture holds; None where there is none, or no picture."""
    try:
        with Image.open(picture) as image:
            return image.info.get(KEY)
    except (OSError, SyntaxError, ValueError):  # what Pillow raises for a damaged one
        return None


def _caption(record: RunRecord) -> str:
    """Name the method and its scores under `tissue`, as they stand in the tables."""
    lines = textwrap.wrap(record.label, 22, break_long_words=False)
    if "tissue" not in record.scores:
        return "\n".join(lines + ([record.status] if record.status != OK else []))
    values = record.scores["tissue"].values
    psnr, ssim = values["psnr3d"], values["ssim3d"]
    lines += ["identical" if psnr is None else f"PSNR3D {psnr:.2f} dB", f"SSIM3D {ssim:.3f}"]
    return "\n".join(lines + ([record.status] if record.status != OK else []))


def look_of(truth: Truth, measured: NDArray[Any] | None, shadow: NDArray[np.bool_], water: float | None) -> Look:
    """Choose the windows from the truth and one measured view [v, u] outside the metal's shadow, not from a method."""
    reference, tissue = truth.references["effective"], truth.body & ~truth.near_metal
    middle = float(np.median(reference[tissue])) if tissue.any() else float(reference.max())
    middle = middle if middle > 0 else float(reference.max())
    clear = measured[~shadow] if measured is not None and not shadow.all() else measured
    highest = float(np.max(clear)) if clear is not None else 1.0
    return Look(top=TOP * middle, error=ERROR * middle, projection=max(highest, 1e-3), water=water)


def draw(stored: StoredScan, truth: Truth, rows: list[PanelRow]) -> Figure:
    """Draw the reference and each row: volumes in one window, errors on one scale, colourbars below."""
    worked = any(r.shown for r in rows)
    view = next((int(r.shown["view"]) for r in rows if "view" in r.shown), None)
    measured, shadow = (None, np.zeros(0, bool)) if view is None else _measured(stored, view)
    look = look_of(truth, measured, shadow, effective_attenuation(stored))
    at = cut(truth.metal, truth.body)
    n_columns, n_rows = 2 * len(PLANES) + 2 * worked, 1 + len(rows)
    size = (CELL * n_columns + LABEL, CELL * n_rows + 1.1)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01))
    plan = figure.add_gridspec(n_rows + 1, n_columns, height_ratios=[1] * n_rows + [0.07])
    grid = np.array([[figure.add_subplot(plan[i, k]) for k in range(n_columns)] for i in range(n_rows)])
    reference = PanelRow(caption="reference\neffective\nspectrum", volume=truth.references["effective"])
    for i, row in enumerate([reference, *rows]):
        _slices(grid[i], row.volume, truth, at, look)
        grid[i, 0].set_ylabel(pictured(row.caption), rotation=0, ha="right", va="center", fontsize=8)
        if i:
            _errors(grid[i, len(PLANES) :], row.volume, truth, at, look)
        else:
            _scale_bars(grid[i], truth)
        if i and worked:
            _worked(grid[i, -2:], row.shown, truth, at, look)
    if view is not None and measured is not None:
        _projection(grid[0, -2], measured, shadow, look)
        scale_bar(grid[0, -2], measured.shape, stored.geometry.d_detector[1], where="at the detector")
        grid[0, -2].set_title(f"measured, view {view}", fontsize=8)
        grid[0, -2].set_xlabel("as backprojected", fontsize=8)
    _heads(grid, at, worked)
    _bars(figure, plan, grid, look)
    figure.suptitle(pictured(_title(stored, truth, look, worked)), fontsize=8)
    return figure


def _measured(stored: StoredScan, view: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return −ln(counts/open) of a view, and where the true metal's shadow lies (Joseph's rule), both [v, u]."""
    metal = np.ascontiguousarray((np.asarray(stored.metal) > 0).transpose(1, 2, 0), np.float32)
    return line_integrals(stored.scan, view)[0].numpy(), forward_columns(metal, stored.geometry, [view])[0] > 0


def _slices(axes: NDArray[Any], volume: NDArray[Any], truth: Truth, at: tuple[int, int, int], look: Look) -> None:
    for k, (axis, _) in enumerate(PLANES):
        _slice(axes[k], np.take(volume, at[axis], axis), truth, axis, at, cmap="gray", vmin=0.0, vmax=look.top)


def _scale_bars(axes: NDArray[Any], truth: Truth) -> None:
    """Draw the scale into the slices of a row; those below have the same."""
    for k, (axis, _) in enumerate(PLANES):
        shape = tuple(n for a, n in enumerate(truth.metal.shape) if a != axis)
        scale_bar(axes[k], shape, truth.d_voxel[2])


def _errors(axes: NDArray[Any], volume: NDArray[Any], truth: Truth, at: tuple[int, int, int], look: Look) -> None:
    """Show a volume minus the reference; the metal is not judged, and grey."""
    for k, (axis, _) in enumerate(PLANES):
        image, reference, metal = (
            np.take(v, at[axis], axis) for v in (volume, truth.references["effective"], truth.metal)
        )
        error = np.ma.masked_where(metal, image - reference)
        _slice(axes[k], error, truth, axis, at, cmap="RdBu_r", vmin=-look.error, vmax=look.error)


def _slice(axes: Axes, image: NDArray[Any], truth: Truth, axis: int, at: tuple[int, int, int], **window: Any) -> None:
    """Show one slice at true proportions, the metal's outline over it; row 0 is at the bottom."""
    d_v, d_u = (d for a, d in enumerate(truth.d_voxel) if a != axis)
    axes.imshow(image, origin="lower", aspect=d_v / d_u, interpolation="nearest", **window)
    axes.set_facecolor(UNJUDGED)
    _outline(axes, np.take(truth.metal, at[axis], axis))
    axes.set(xticks=[], yticks=[])


def _outline(axes: Axes, mask: NDArray[np.bool_]) -> None:
    if mask.any() and not mask.all() and min(mask.shape) >= 2:
        axes.contour(mask, levels=[0.5], colors=METAL, linewidths=0.6)


def _projection(axes: Axes, image: NDArray[Any], trace: NDArray[np.bool_], look: Look) -> None:
    axes.imshow(image, cmap="gray", vmin=0.0, vmax=look.projection, origin="lower", interpolation="nearest")
    _outline(axes, trace)
    axes.set(xticks=[], yticks=[])


def _worked(axes: NDArray[Any], shown: Intermediates, truth: Truth, at: tuple[int, int, int], look: Look) -> None:
    """Show the projection that a method backprojected, its trace outlined, and its prior; nothing where it has none."""
    if "projection" in shown:
        _projection(axes[0], shown["projection"], shown.get("trace", np.zeros((1, 1), bool)), look)
    else:
        axes[0].axis("off")
    if "prior" in shown:
        _slice(axes[1], np.take(shown["prior"], at[0], 0), truth, 0, at, cmap="gray", vmin=0.0, vmax=look.top)
    else:
        axes[1].axis("off")


def _heads(grid: NDArray[Any], at: tuple[int, int, int], worked: bool) -> None:
    """Head the columns; where the reference has nothing to show, its cell holds the head of what follows below."""
    heads = {len(PLANES) + k: f"error, normal to {name}" for k, (_, name) in enumerate(PLANES)}
    if worked:
        heads |= {} if grid[0, -2].images else {2 * len(PLANES): "as backprojected"}
        heads[2 * len(PLANES) + 1] = f"prior, normal to {PLANES[0][1]}"
    for k, text in heads.items():
        grid[0, k].axis("off")
        grid[0, k].text(0.5, 0.0, text, transform=grid[0, k].transAxes, ha="center", va="bottom", fontsize=8)
    for k, (axis, name) in enumerate(PLANES):
        grid[0, k].set_title(f"slice {at[axis]} normal to {name}", fontsize=8)


def _bars(figure: Figure, plan: Any, grid: NDArray[Any], look: Look) -> None:
    """Draw one colourbar under the volumes, one under the errors and one under the projections."""
    n = len(PLANES)
    spans = [(grid[0, 0], plan[-1, :n], False), (grid[1, n], plan[-1, n : 2 * n], True)]
    for axes, place, signed in spans:
        cell = figure.add_subplot(place)
        bar = figure.colorbar(axes.images[0], cax=cell, orientation="horizontal", extend="both")
        bar.ax.tick_params(labelsize=7)
        bar.set_label(f"{'error' if signed else 'attenuation'} ({'1/mm' if look.water is None else 'HU'})", fontsize=8)
        if look.water is not None:
            water, shift = look.water, 0 if signed else 1000
            step = 500
            low, high = (1000 * edge / water - shift for edge in bar.mappable.get_clim())
            ticks = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
            bar.set_ticks(
                [(t + shift) * water / 1000 for t in ticks],
                labels=[f"{t:+.0f}".replace("-", "−") if t else "0" for t in ticks],
            )
    images = [axes.images[0] for axes in grid[:, 2 * n] if axes.images] if grid.shape[1] > 2 * n else []
    if images:
        bar = figure.colorbar(
            images[0], cax=figure.add_subplot(plan[-1, 2 * n]), orientation="horizontal", extend="max"
        )
        bar.ax.tick_params(labelsize=7)
        bar.set_label("−ln(I/I₀)", fontsize=8)


def _title(stored: StoredScan, truth: Truth, look: Look, worked: bool) -> str:
    water = "" if look.water is None else f" · water {look.water:.4f} 1/mm"
    trace = "; in projections its trace" if worked else ""
    return (
        f"{stored.name} · protocol tissue: reference effective spectrum behind {truth.l0:.1f} mm of water{water}\n"
        f"one window and one error scale for all · metal outlined{trace}; grey in the errors: metal, not judged"
    )
