"""One picture a scene: reference and every method in one window, and their errors, with the metal's outline."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.protocol import Stored, Truth, tissue_range, truth_of
from benchmarks.records import Record, latest

AXES = ("z", "y", "x")
ERROR_SHARE = 0.25
"""Error maps span ± this share of the tissue data range."""


def cut(metal: NDArray[np.bool_], body: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Choose the slices to show: through the most metal along each axis, else through the most body."""
    mask = metal if metal.any() else body
    counts = [mask.sum(axis=tuple(a for a in range(3) if a != axis)) for axis in range(3)]
    z, y, x = (int(np.argmax(c)) for c in counts)
    return z, y, x


def write_panels(records: list[Record], scans: list[Stored], results: Path) -> list[Path]:
    """Draw panels/SCENE.png for every scan that has kept volumes; return what was written."""
    import tifffile

    written = []
    for stored in scans:
        volumes: dict[str, NDArray[np.float32]] = {}
        for record in latest(records):
            run = record.run
            path = results / record.volume if record.volume else None
            mine = run.scan == stored.content_hash and run.variant == "metal" and record.scores
            if mine and path is not None and path.exists():
                volumes[_title(record)] = tifffile.memmap(path, mode="r")
        if volumes:
            path = results / "panels" / f"{stored.name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            draw(stored.name, truth_of(stored), volumes).savefig(path, dpi=110)
            written.append(path)
    return written


def _title(record: Record) -> str:
    values = record.scores["tissue"].values
    psnr, ssim = values["psnr3d"], values["ssim3d"]
    return f"{record.label}\n{'identical' if psnr is None else f'{psnr:.2f} dB'}, SSIM3D {ssim:.3f}"


def draw(name: str, truth: Truth, volumes: dict[str, NDArray[Any]]) -> Figure:
    """Draw slices along z, y and x (columns) of the reference, each volume and its error (rows)."""
    reference = truth.references["effective"]
    data_range = tissue_range(truth, "effective")
    at = cut(truth.metal, truth.body)
    rows: list[tuple[str, NDArray[Any], float, float, str]] = [
        ("reference\neffective spectrum", reference, 0.0, 1.2 * data_range, "gray")
    ]
    limit = ERROR_SHARE * data_range
    for title, volume in volumes.items():
        rows.append((title, volume, 0.0, 1.2 * data_range, "gray"))
        rows.append((f"{title.splitlines()[0]}\n− reference", volume - reference, -limit, limit, "RdBu_r"))
    figure = Figure(figsize=(10, 3.1 * len(rows) + 0.8), layout="constrained")
    grid = figure.subplots(len(rows), 3, squeeze=False)
    for i, (title, volume, low, high, colours) in enumerate(rows):
        for axis in range(3):
            _slice(grid[i, axis], volume, truth, axis, at[axis], (low, high, colours))
        grid[i, 0].set_ylabel(title)
        bar = figure.colorbar(grid[i, 2].images[0], ax=list(grid[i]), fraction=0.03, pad=0.01)
        bar.set_label("1/mm")
    for axis in range(3):
        grid[0, axis].set_title(f"slice normal to {AXES[axis]}, {at[axis]}")
    figure.suptitle(
        f"{name} · protocol tissue, data range {data_range:.4g} 1/mm, one window for all · metal outlined", fontsize=10
    )
    return figure


def _slice(
    axes: Any, volume: NDArray[Any], truth: Truth, axis: int, index: int, look: tuple[float, float, str]
) -> None:
    """Show one slice at true proportions, the metal's outline over it; row 0 is at the bottom."""
    low, high, colours = look
    d_v, d_u = (d for a, d in enumerate(truth.d_voxel) if a != axis)
    image = np.take(volume, index, axis)
    axes.imshow(image, cmap=colours, vmin=low, vmax=high, origin="lower", aspect=d_v / d_u, interpolation="nearest")
    metal = np.take(truth.metal, index, axis)
    if metal.any() and not metal.all() and min(metal.shape) >= 2:
        axes.contour(metal, levels=[0.5], colors="#ffb000", linewidths=0.7)
    axes.set_xticks([])
    axes.set_yticks([])
