"""A slice viewer for notebooks: one slice, window and level for several methods and their errors.

`images(case, state)` returns the images; `viewer(case)` adds sliders and needs the extra `notebook`.
"""

import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctsim.benchmarks.engine.table import pictured
from ctsim.benchmarks.scalebar import scale_bar
from ctsim.errors import InputError
from ctsim.reports.kept import Case

if TYPE_CHECKING:
    import ipywidgets  # pyright: ignore[reportMissingImports]

AXES: tuple[str, ...] = ("z", "y", "x")
COLUMNS = 4
REFERENCE = "reference"


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """The state of a viewer: slice `index` normal to `axis`, level and width of the window, the errors' scale.

    `level`, `width` and `error` are in the case's unit (`unit`). `methods` are labels, in the order shown.
    """

    axis: str = "z"
    index: int
    level: float
    width: float
    error: float
    methods: tuple[str, ...]
    errors: bool = True

    def __post_init__(self) -> None:
        if self.axis not in AXES:
            raise InputError(f"axis must be one of {', '.join(AXES)}, got {self.axis!r}")
        if not (self.width > 0 and self.error > 0):
            raise InputError(f"width and error must be above 0, got {self.width:g} and {self.error:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """One image [row, column] in the case's unit, row 0 at the bottom, with its window, colours and metal."""

    title: str
    values: NDArray[Any]
    low: float
    high: float
    colours: str
    metal: NDArray[np.bool_]


def unit(case: Case) -> str:
    """Return the unit of windows: HU where the scan's water is known, else 1/mm."""
    return "1/mm" if case.look.water is None else "HU"


def first_state(case: Case) -> State:
    """Return the first state: all methods, the slice through the most metal, the windows of the panels."""
    low, high = (_in_unit(case, np.array(edge)).item() for edge in (0.0, case.look.top))
    return State(
        index=case.at[0],
        level=(low + high) / 2,
        width=high - low,
        error=_scale(case) * case.look.error,
        methods=tuple(kept.record.label for kept in case.kept),
    )


def images(case: Case, state: State) -> list[Shown]:
    """Return the images of a state: the reference and the methods in one window, then the errors on one scale.

    Errors are volume minus effective-spectrum reference. Raises InputError for an unknown slice or method.
    """
    axis = AXES.index(state.axis)
    length = case.reference.shape[axis]
    if not 0 <= state.index < length:
        raise InputError(f"slice must be within 0 … {length - 1} along {state.axis}, got {state.index}")
    volumes = {kept.record.label: kept.values for kept in case.kept}
    for label in state.methods:
        if label not in volumes:
            raise InputError(f"there is no volume of {label!r}: expected {', '.join(volumes)}")
    cuts = {label: np.take(volumes[label], state.index, axis) for label in state.methods}
    reference, metal = (np.take(v, state.index, axis) for v in (case.reference, case.truth.metal))
    window = {"low": state.level - state.width / 2, "high": state.level + state.width / 2, "colours": "gray"}
    shown = [
        Shown(title=title, values=_in_unit(case, values), metal=metal, **window)
        for title, values in {REFERENCE: reference, **cuts}.items()
    ]
    if state.errors:
        scale = {"low": -state.error, "high": state.error, "colours": "RdBu_r"}
        shown += [
            Shown(title=f"{label}: error", values=_scale(case) * (values - reference), metal=metal, **scale)
            for label, values in cuts.items()
        ]
    return shown


def _scale(case: Case) -> float:
    """Return the factor from a difference in 1/mm to the case's unit."""
    return 1.0 if case.look.water is None else 1000 / case.look.water


def _in_unit(case: Case, values: NDArray[Any]) -> NDArray[Any]:
    return values if case.look.water is None else _scale(case) * values - 1000


def figure(case: Case, state: State) -> Figure:
    """Draw the images of a state: rows of volumes, then rows of errors; metal outlined."""
    shown = images(case, state)
    n = len(state.methods)
    groups = [shown[: n + 1], shown[n + 1 :]] if len(shown) > n + 1 else [shown]
    rows = [group[k : k + COLUMNS] for group in groups for k in range(0, len(group), COLUMNS)]
    columns = max(map(len, rows))
    drawing = Figure(figsize=(2.5 * columns, 2.7 * len(rows)), layout="constrained")
    grid = drawing.subplots(len(rows), columns, squeeze=False)
    d_v, d_u = (d for name, d in zip(AXES, case.truth.d_voxel, strict=True) if name != state.axis)
    for axes, row in zip(grid, rows, strict=True):
        for cell in axes:
            cell.axis("off")
        for cell, image in zip(axes, row, strict=False):
            colours = {"cmap": image.colours, "vmin": image.low, "vmax": image.high}
            cell.imshow(image.values, origin="lower", aspect=d_v / d_u, interpolation="nearest", **colours)
            if image.metal.any() and not image.metal.all() and min(image.metal.shape) > 1:
                cell.contour(image.metal, levels=[0.5], colors="#ffb000", linewidths=0.7)
            cell.set_title(pictured(image.title), fontsize=8)
    scale_bar(grid[0, 0], shown[0].values.shape, d_u)
    low, high = state.level - state.width / 2, state.level + state.width / 2
    said = f"window {low:.4g} … {high:.4g} {unit(case)}"
    if state.errors:
        said += f", errors ± {state.error:.4g} {unit(case)}"
    title = f"{case.stored.name}, slice {state.index} normal to {state.axis}; {said}"
    drawing.suptitle(pictured(title), fontsize=8)
    return drawing


def viewer(case: Case) -> "ipywidgets.VBox":
    """Return the viewer for a notebook cell; its sliders move all images.

    Raises InputError where ipywidgets is not installed.
    """
    try:
        import ipywidgets as w  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the viewer needs ipywidgets; install the extra: pip install 'ctsim[notebook]'") from None
    state, length = first_state(case), dict(zip(AXES, case.reference.shape, strict=True))
    wide, digits = 4 * state.width, max(0, 2 - math.floor(math.log10(state.width)))
    lazy: dict[str, Any] = {"continuous_update": False, "readout_format": f".{digits}f"}
    controls: dict[str, Any] = {
        "axis": w.ToggleButtons(options=AXES, value=state.axis, description="normal to"),
        "index": w.IntSlider(state.index, 0, length[state.axis] - 1, description="slice", continuous_update=False),
        "level": w.FloatSlider(
            state.level,
            min=state.level - wide / 2,
            max=state.level + wide / 2,
            step=wide / 400,
            description="level",
            **lazy,
        ),
        "width": w.FloatSlider(
            state.width, min=wide / 400, max=wide, step=wide / 400, description=f"width ({unit(case)})", **lazy
        ),
        "error": w.FloatSlider(state.error, min=wide / 400, max=wide, step=wide / 400, description="errors ±", **lazy),
        "methods": w.SelectMultiple(options=state.methods, value=state.methods, description="methods"),
        "errors": w.Checkbox(value=True, description="show errors"),
    }
    screen = w.Image(format="png")

    def draw(_: Any = None) -> None:
        values = {name: control.value for name, control in controls.items()}
        screen.value = png(figure(case, State(**values)))

    def turn(change: Any) -> None:
        # the slice is set before the axis's own redraw, so that it always exists
        controls["index"].max = length[change["new"]] - 1

    controls["axis"].observe(turn, "value")
    for control in controls.values():
        control.observe(draw, "value")
    draw()
    return w.VBox([*controls.values(), screen])


def png(drawing: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
