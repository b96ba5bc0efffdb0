"""Filling a trace in a projection from what surrounds it. Images [v, u]."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from ctsim.baselines.kernels.fill_cpu import fill_rows
from ctsim.errors import InputError
from ctsim.reconstruct.settings import about, names_of

Interpolation = Annotated[
    Literal["rows", "harmonic"], about("how the trace is bridged: along detector rows, or by Laplace's equation")
]
FILLS = names_of(Interpolation)


@dataclass(slots=True, kw_only=True)
class Filled:
    """What was filled: pixels, rows, gaps that touch the detector's edge, rows without any pixel left, and views.

    Of view `shown` the filled `projection` is kept.
    """

    pixels: int = 0
    rows: int = 0
    edge_gaps: int = 0
    full_rows: int = 0
    views: int = 0
    shown: int = 0
    projection: NDArray[np.float32] | None = None

    def keep(self, p: NDArray[np.float32], views: slice) -> None:
        """Keep view `shown` of filled projections [view, v, u], which pictures show."""
        if views.start <= self.shown < views.stop:
            self.projection = p[self.shown - views.start].copy()

    def intermediates(self, trace: NDArray[np.bool_]) -> dict[str, object]:
        """Return what pictures show: the view, its trace [v, u] and its projection as filled."""
        return {"view": self.shown, "trace": trace, "projection": self.projection}

    def details(self) -> dict[str, int]:
        """Return the counts for a result's details."""
        return {
            "filled_pixels": self.pixels,
            "filled_rows": self.rows,
            "edge_gaps": self.edge_gaps,
            "full_rows": self.full_rows,
            "filled_views": self.views,
        }


def fill(image: NDArray[np.float32], trace: NDArray[np.bool_], how: str, filled: Filled) -> None:
    """Fill the pixels of `trace` in one view, in place, and count what was done.

    "rows" interpolates linearly along every detector row and holds the last value where a gap touches the
    detector's edge; rows with no pixel left are filled harmonically from the rows around them. "harmonic" solves
    Laplace's equation over the whole trace. A view without any pixel left stays as it is, its rows counted.

    Raises
    ------
    InputError
        When `how` is something else.
    """
    if how not in FILLS:
        raise InputError(f"fill must be one of {', '.join(FILLS)}, got {how!r}")
    if not trace.any():
        return
    rows = np.flatnonzero(trace.any(1))
    full: NDArray[np.bool_] = np.all(trace, axis=1)
    filled.views += 1
    filled.rows += len(rows)
    filled.pixels += int(trace.sum())
    filled.full_rows += int(full.sum())
    filled.edge_gaps += int(trace[~full, 0].sum() + trace[~full, -1].sum())
    if how == "harmonic":
        harmonic(image, trace)
        return
    fill_rows(image, trace, rows)
    if full.any():
        harmonic(image, np.repeat(full[:, None], image.shape[1], 1))


def harmonic(image: NDArray[np.float32], unknown: NDArray[np.bool_]) -> None:
    """Replace the unknown pixels by the solution of Laplace's equation, in place.

    Known neighbours are Dirichlet values, the image's edge is a Neumann boundary. Nothing is done if nothing is known.
    """
    if unknown.all() or not unknown.any():
        return
    n_v, n_u = image.shape
    number = np.full(image.shape, -1, np.int64)
    number[unknown] = np.arange(unknown.sum())
    v, u = np.nonzero(unknown)
    degree, right = np.zeros(len(v)), np.zeros(len(v))
    rows, columns = [], []
    for dv, du in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        inside = (v + dv >= 0) & (v + dv < n_v) & (u + du >= 0) & (u + du < n_u)
        to_v, to_u = v[inside] + dv, u[inside] + du
        me, other = np.flatnonzero(inside), number[to_v, to_u]
        degree += inside
        known = other < 0
        np.add.at(right, me[known], image[to_v[known], to_u[known]].astype(np.float64))
        rows.append(me[~known])
        columns.append(other[~known])
    i, j = np.concatenate(rows), np.concatenate(columns)
    matrix = scipy.sparse.coo_array((-np.ones(len(i)), (i, j)), (len(v), len(v))) + scipy.sparse.diags_array(degree)
    image[unknown] = np.asarray(scipy.sparse.linalg.spsolve(matrix.tocsc(), right), np.float32)
