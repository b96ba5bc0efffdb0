"""One picture of a measured scan, which has no truth to compare with: every method's volume in one window."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.scalebar import scale_bar
from ctsim.geometry import Geometry

CELL, LABEL = 2.6, 1.1  # inches
WINDOW = (1.0, 99.5)  # percentiles of the first volume


def window_of(volume: NDArray[Any]) -> tuple[float, float]:
    """Return the window (1/mm) of all volumes of a scan, from the first one: there is no truth to choose it by."""
    low, high = np.percentile(np.nan_to_num(volume), WINDOW)
    return float(low), float(max(high, low + 1e-9))


def draw_bare(title: str, geometry: Geometry, rows: Sequence[tuple[str, NDArray[Any]]]) -> Figure:
    """Draw the slices through the middle of each volume [z, y, x], normal to z and to y, row 0 at the bottom.

    The window is that of the first row, whose percentiles 1 and 99.5 it spans.
    """
    size = (2 * CELL + LABEL, CELL * len(rows) + 0.8)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02))
    grid = figure.subplots(len(rows), 2, squeeze=False)
    low, high = window_of(rows[0][1])
    window = {"vmin": low, "vmax": high}
    image = None
    for i, (axes, (caption, volume)) in enumerate(zip(grid, rows, strict=True)):
        for k, axis in enumerate((0, 1)):
            d_v, d_u = (d for a, d in enumerate(geometry.d_voxel) if a != axis)
            shown = np.take(volume, volume.shape[axis] // 2, axis)
            image = axes[k].imshow(
                shown, cmap="gray", origin="lower", aspect=d_v / d_u, interpolation="nearest", **window
            )
            axes[k].set(xticks=[], yticks=[])
            if i == 0:
                scale_bar(axes[k], shown.shape, d_u)
        axes[0].set_ylabel(pictured(caption), rotation=0, ha="right", va="center", fontsize=8)
    for k, name in enumerate("zy"):
        grid[0, k].set_title(f"slice {geometry.n_voxel[k] // 2} normal to {name}", fontsize=8)
    if image is not None:
        bar = figure.colorbar(image, ax=grid.ravel().tolist(), orientation="horizontal", extend="both", shrink=0.6)
        bar.ax.tick_params(labelsize=7)
        bar.set_label("attenuation (1/mm)", fontsize=8)
    figure.suptitle(pictured(f"{title} · measured, without truth · one window for all"), fontsize=8)
    return figure
