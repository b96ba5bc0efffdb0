"""Pictures of a scan before any reconstruction: its views, and where source, detector and volume are.

Both functions return a figure to save or to show in a notebook. With a backend that has windows, `plot_projections`
makes a window with a slider over the views.
"""

import reprlib
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.backends.registry import BackendFilter, backend_registry
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon
from matplotlib.widgets import Slider
from numpy.typing import NDArray

from ctsim.benchmarks.scalebar import scale_bar
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError, check_kind
from ctsim.geometry import Geometry, Pair, few_views
from ctsim.reconstruct.log import line_integrals
from ctsim.types import Scan

SHOWN, COLUMNS = 6, 3  # views of a still picture, in a row
WINDOW = (0.5, 99.5)  # percentiles of the views that are looked at
NOTEBOOK = ("ipympl", "widget")  # backends with sliders that matplotlib does not list
BLUE, RED, GREY = "#1f5fa8", "#c0392b", "#666666"


def plot_projections(
    scan: ScanWithTruth | Scan | NDArray[Any],
    views: Sequence[int] | NDArray[np.integer] = (),
    *,
    slider: bool | None = None,
) -> Figure:
    """Draw views of a scan, −ln(signal/open), or of a stack [view, v, u] of any kind; row 0 is at the bottom.

    A still picture shows `views`, by default six from the first to the last, in one window. With `slider` (default:
    where the backend is interactive) it is one view and a slider over all; the first of `views` is where it starts.
    Views of a scan have a scale bar, in mm at the detector.

    Raises
    ------
    InputError
        For an array that is no stack of real numbers, for `views` that are no whole numbers, and for a view that does
        not exist.
    """
    n, view_of, pixel = _stack(scan)
    chosen = _views(views, n) or tuple(int(k) for k in few_views(n, SHOWN))
    if slider is None:
        slider = is_interactive()
    if slider:
        window = _window([view_of(int(k)) for k in few_views(n, SHOWN)])
        return _with_slider(n, view_of, chosen[0], window, pixel)
    return _still(chosen, [view_of(k) for k in chosen], pixel)


def _views(views: Sequence[int] | NDArray[np.integer], n: int) -> tuple[int, ...]:
    """Return the views that are asked for, of `n`."""
    try:
        found = np.asarray(views)
    except ValueError:  # rows of unequal lengths
        found = np.array(None)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise InputError(f"views: expected whole numbers such as (0, 5), got {' '.join(reprlib.repr(views).split())}")
    for k in (chosen := tuple(found.tolist())):
        if not 0 <= k < n:
            raise InputError(f"view must be within 0 to {n - 1}, got {k}")
    return chosen


def is_interactive() -> bool:
    """Whether matplotlib's backend shows figures that a user can change."""
    return matplotlib.get_backend().lower() in (*backend_registry.list_builtin(BackendFilter.INTERACTIVE), *NOTEBOOK)


def _stack(scan: ScanWithTruth | Scan | NDArray[Any]) -> tuple[int, Callable[[int], NDArray[Any]], Pair | None]:
    """Return how many views there are, what gives one as an image [v, u], and its pixels (v, u) in mm if known."""
    if isinstance(scan, ScanWithTruth):
        scan = scan.scan
    if isinstance(scan, Scan):
        readings = scan
        geometry = readings.geometry
        return geometry.n_views, lambda k: line_integrals(readings, k)[0].numpy(), geometry.d_detector
    stack = np.asarray(scan)
    if stack.ndim != 3 or 0 in stack.shape or stack.dtype.kind not in "biuf":
        raise InputError(f"expected a scan or real numbers [view, v, u], got {stack.dtype} of shape {stack.shape}")
    return len(stack), lambda k: stack[k], None


def _window(images: list[NDArray[Any]]) -> tuple[float, float]:
    """Return the window that images share, from their percentiles; never empty."""
    values = np.concatenate([image[np.isfinite(image)].ravel() for image in images])
    low, high = (float(v) for v in np.percentile(values, WINDOW)) if values.size else (0.0, 1.0)
    return low, high if high > low else low + 1.0


def _image(axes: Axes, image: NDArray[Any], window: Pair, pixel: Pair | None) -> AxesImage:
    d_v, d_u = pixel or (1.0, 1.0)
    return axes.imshow(
        image, cmap="gray", vmin=window[0], vmax=window[1], origin="lower", interpolation="nearest", aspect=d_v / d_u
    )


def _bar(axes: Axes, image: NDArray[Any], pixel: Pair | None) -> None:
    if pixel is not None:
        scale_bar(axes, image.shape, pixel[1], where="at the detector")


def _still(views: tuple[int, ...], images: list[NDArray[Any]], pixel: Pair | None) -> Figure:
    """Draw views next to each other."""
    columns = min(COLUMNS, len(views))
    rows = -(-len(views) // columns)
    figure = Figure(figsize=(2.5 * columns + 0.6, 2.6 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    window = _window(images)
    for axes in grid.flat[len(views) :]:
        axes.axis("off")
    for axes, k, image in zip(grid.flat, views, images, strict=False):
        shown = _image(axes, image, window, pixel)
        axes.set_title(f"view {k}", fontsize=9)
        axes.set(xticks=[], yticks=[])
        figure.colorbar(shown, ax=list(grid.flat), fraction=0.03) if k == views[-1] else None
    _bar(grid[0, 0], images[0], pixel)
    return figure


def _with_slider(
    n: int, view_of: Callable[[int], NDArray[Any]], first: int, window: Pair, pixel: Pair | None
) -> Figure:
    """Open a window with one view and a slider over all."""
    figure, axes = pyplot.subplots()
    figure.subplots_adjust(bottom=0.18)
    image = view_of(first)
    shown = _image(axes, image, window, pixel)
    _bar(axes, image, pixel)
    axes.set(xlabel="u (pixels)", ylabel="v (pixels)")
    figure.colorbar(shown, ax=axes)
    bar = Slider(figure.add_axes((0.15, 0.04, 0.7, 0.04)), "view", 0, max(n - 1, 1), valinit=first, valstep=range(n))

    def turn(view: float) -> None:
        shown.set_data(view_of(int(view)))
        figure.canvas.draw_idle()

    bar.on_changed(turn)
    vars(figure)["slider"] = bar  # matplotlib holds widgets by weak references only
    return figure


def plot_geometry(scan: ScanWithTruth | Scan | Geometry) -> Figure:
    """Draw source, detector and volume of the first view: seen from +z, and from the side; all in mm.

    The dots are the sources of all views. In the view from the side, "out" is the direction from the axis to the
    source. Raises InputError for what is neither a scan nor a geometry.
    """
    check_kind("scan", scan, (Geometry, ScanWithTruth, Scan), "a scan or a Geometry")
    geometry = scan if isinstance(scan, Geometry) else scan.geometry
    poses = geometry.pose_array()
    source, centre, du, dv = (poses[0, k : k + 3] for k in (0, 3, 6, 9))
    v, u = (n / 2 for n in geometry.n_detector)
    panel = np.stack([centre + i * u * du + j * v * dv for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    z, y, x = (np.array([-0.5, 0.5]) * s + o for s, o in zip(geometry.s_voxel, geometry.off_origin, strict=True))
    box = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    out = source * (1, 1, 0) if np.any(source[:2]) else np.array([1.0, 0.0, 0.0])
    out = out / np.linalg.norm(out)
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    above, side = figure.subplots(1, 2)
    for axes, across, up, title in (
        (above, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), "seen from +z"),
        (side, out, np.array([0, 0, 1.0]), "from the side, view 0"),
    ):
        plane = np.stack([across, up], 1)
        _plan(axes, *(points @ plane for points in (poses[:, :3], panel, box)))
        axes.set_title(title, fontsize=10)
    above.set(xlabel="x (mm)", ylabel="y (mm)")
    side.set(xlabel="out (mm)", ylabel="z (mm)")
    figure.suptitle(_said(geometry), fontsize=9)
    return figure


def _plan(axes: Axes, sources: NDArray[np.float64], panel: NDArray[np.float64], box: NDArray[np.float64]) -> None:
    """Draw the sources, the detector's corners and the volume's corners, all [point, 2] in mm."""
    axes.plot(*sources.T, ".", color=RED, ms=2, alpha=0.5)
    axes.plot(*sources[0], "o", color=RED, label="source")
    low, high = box.min(0), box.max(0)
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    axes.add_patch(Polygon(corners, fill=False, ec="black", label="volume"))
    axes.add_patch(Polygon(panel, fc="none", ec=BLUE, lw=2.5, label="detector"))
    for corner in panel:
        axes.plot(*np.stack([sources[0], corner]).T, color=GREY, lw=0.5)
    axes.plot(0, 0, "+", color="black", ms=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=7, frameon=False, loc="best")


def _said(geometry: Geometry) -> str:
    """Return what a picture cannot show in numbers."""
    orbit = f"over {geometry.arc_deg:g}°" if geometry.angles_deg is None else "at listed angles"
    orbit = "by poses" if geometry.poses is not None else orbit
    pixels, voxels = (" × ".join(map(str, n)) for n in (geometry.n_detector, geometry.n_voxel))
    return (
        f"{geometry.n_views} views {orbit}; dso {geometry.dso:g} mm, dsd {geometry.dsd:g} mm\n"
        f"detector {pixels} (v × u), volume {voxels} (z × y × x)"
    )
