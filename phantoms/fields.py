"""Drawing tools for voxel bodies: a canvas in relative units, smooth noise, branching trees.

Everything random is drawn in the units of the box (half its shortest edge = 1) and with a number of
draws that does not depend on the grid, so one seed is one object at every resolution.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctsim.geometry import Triple
from ctsim.kernels import paint_cpu

Shape = tuple[int, int, int]
Field = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Inside = Callable[[Field, Field, Field], Any]


class Noise:
    """Smooth random field on [−1, 1]³ with unit standard deviation: uniform cubic B-splines.

    `cells` is the number of spline cells along an edge, so features are about 2/cells wide. Evaluates
    on three coordinate axes (any shape that flattens to 1-D) to float32 [z, y, x].
    """

    def __init__(self, rng: np.random.Generator, cells: int) -> None:
        self.cells = cells
        # variance of a cubic B-spline sum with unit coefficients is about (151/315)^3 per volume
        self.coefficients = (rng.standard_normal((cells + 3,) * 3) / (151 / 315) ** 1.5).astype(np.float32)

    def __call__(self, x: Field, y: Field, z: Field) -> Field:
        """Evaluate on the grid spanned by the axes x, y, z; a layer does not depend on which others there are."""
        left, weights = self._taps(z.ravel())
        across, along = self._basis(x.ravel()).T, self._basis(y.ravel())
        out = np.empty((left.size, along.shape[0], across.shape[1]), np.float32)
        planes: dict[int, Field] = {}
        for layer, first, shares in zip(out, left.tolist(), weights, strict=True):
            # plane by plane: BLAS rounds products of another number of layers differently
            old, planes = planes, {}
            for k, share in enumerate(shares, first):
                planes[k] = old[k] if k in old else along @ self.coefficients[k] @ across
                np.multiply(planes[k], share, layer) if k == first else np.add(layer, share * planes[k], layer)
        return out

    def at(self, points: Field) -> Field:
        """Evaluate at points [k, 3] (x, y, z)."""
        out = np.einsum("ka,abc->kbc", self._basis(points[:, 2]), self.coefficients)
        for axis in (1, 0):
            out = np.einsum("ka,ka...->k...", self._basis(points[:, axis]), out)
        return out

    def _taps(self, at: Field) -> tuple[NDArray[np.int_], Field]:
        """Return the first of four coefficients that count at each place, and by how much they do, [place, 4]."""
        t = np.clip((at.astype(np.float64) + 1) / 2, 0, 1) * self.cells
        left = np.minimum(t.astype(int), self.cells - 1)
        f = t - left
        weights = np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3], 1) / 6
        return left, weights.astype(np.float32)

    def _basis(self, at: Field) -> Field:
        left, weights = self._taps(at)
        basis = np.zeros((left.size, self.cells + 3), np.float32)
        np.put_along_axis(basis, left[:, None] + np.arange(4), weights, 1)
        return basis


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelGrid:
    """The voxels of a label volume: how many, their edges in mm, their shift in voxels (z, y, x), and what is drawn.

    The shift moves the grid, not the shapes. `layers` are those that are drawn; the others stay air, for a scan that
    does not see them.
    """

    n: Shape
    d_voxel: Triple
    shift: Triple = (0.0, 0.0, 0.0)
    layers: slice = field(default_factory=lambda: slice(None))

    @property
    def half_box(self) -> float:
        """Half the shortest edge of the grid in mm: the unit that recipes are drawn in."""
        return min(k * d for k, d in zip(self.n, self.d_voxel, strict=True)) / 2

    def centres(self) -> tuple[Field, Field, Field]:
        """Return the centres of all voxels along z, y, x in mm."""
        z, y, x = (
            (np.arange(k) + 0.5 - k / 2 + s) * d for k, d, s in zip(self.n, self.d_voxel, self.shift, strict=True)
        )
        return z, y, x


@dataclass(slots=True)
class Canvas:
    """A label volume that shapes are painted on; later paint covers earlier, unless `over` restricts it.

    Coordinates are relative: x, y, z in units of `shrink` times half the shortest edge of the box. `over` lists the
    labels that may be replaced (None: all). `labels` and the axis z are those of the layers that are drawn, of the
    `whole` volume.
    """

    grid: LabelGrid
    shrink: float = 1.0
    unit: float = field(init=False)
    whole: NDArray[np.uint8] = field(init=False)
    labels: NDArray[np.uint8] = field(init=False)
    axes: tuple[Field, Field, Field] = field(init=False)

    def __post_init__(self) -> None:
        self.unit = self.shrink * self.grid.half_box
        self.whole = np.zeros(self.grid.n, np.uint8)
        self.labels = self.whole[self.grid.layers]
        z, y, x = ((at / self.unit).astype(np.float32) for at in self.grid.centres())
        self.axes = (x, y, z[self.grid.layers])

    @property
    def mesh(self) -> tuple[Field, Field, Field]:
        """The axes x, y, z, shaped so that they broadcast to [z, y, x]."""
        x, y, z = self.axes
        return x[None, None, :], y[None, :, None], z[:, None, None]

    def fill(
        self,
        label: int,
        inside: Inside,
        box: tuple[ArrayLike, ArrayLike] = ((-9, -9, -9), (9, 9, 9)),
        over: tuple[int, ...] | None = None,
    ) -> None:
        """Paint where `inside(x, y, z)` holds within the box (low corner, high corner; x, y, z)."""
        low, high = np.asarray(box[0]), np.asarray(box[1])
        cut = [slice(*np.searchsorted(a, (lo, hi))) for a, lo, hi in zip(self.axes, low, high, strict=True)]
        if any(c.start >= c.stop for c in cut):
            return
        x, y, z = self.axes[0][cut[0]], self.axes[1][cut[1]], self.axes[2][cut[2]]
        mask = inside(x[None, None, :], y[None, :, None], z[:, None, None])
        view = self.labels[cut[2], cut[1], cut[0]]
        if over is not None:
            mask = mask & _flags(over)[view]
        view[np.broadcast_to(mask, view.shape)] = label

    def ellipsoid(
        self,
        label: int,
        centre: ArrayLike,
        radii: ArrayLike,
        frame: NDArray[np.float64] | None = None,
        over: tuple[int, ...] | None = None,
    ) -> None:
        """Paint an ellipsoid; the rows of `frame` are its axes (default x, y, z)."""
        c, r = np.asarray(centre, np.float64), np.asarray(radii, np.float64) * np.ones(3)
        rows = np.ascontiguousarray(np.eye(3) if frame is None else frame, np.float64)  # of one layout, compiled once
        paint_cpu.ellipsoid(self.labels, self.axes, label, c, r, rows, _flags(over))

    def capsule(
        self, label: int, a: ArrayLike, b: ArrayLike, radii: tuple[float, float], over: tuple[int, ...] | None = None
    ) -> None:
        """Paint a round-ended rod from a to b whose radius runs from radii[0] to radii[1]."""
        self.tube(label, np.stack([a, b]), radii, over)

    def tube(self, label: int, points: ArrayLike, radii: ArrayLike, over: tuple[int, ...] | None = None) -> None:
        """Paint a chain of capsules through the points [k, 3]; one radius, or one per point."""
        at = np.asarray(points, np.float64).reshape(-1, 3)
        r = np.asarray(radii, np.float64) * np.ones(len(at))
        paint_cpu.tube(self.labels, self.axes, label, at, r, _flags(over))


@cache
def _flags(over: tuple[int, ...] | None) -> Mask:
    """Flag the labels that may be replaced: a table of all 256."""
    flags = np.full(256, over is None)
    flags[list(over or ())] = True
    return flags


Branch = tuple[NDArray[np.float64], NDArray[np.float64], float, float]
"""Start, end, radius at the start, radius at the end; relative units."""


def supply_tree(
    root: NDArray[np.float64], targets: NDArray[np.float64], radius: float, leaf: float = 0.0
) -> list[Branch]:
    """Grow a tree from `root` that supplies all `targets` [k, 3], as vessels and bronchi do.

    Targets are halved along their longest extent until one is left; a branch to a group ends short
    of its centroid. Radii obey Murray's law (r³ shared among the children), from `radius` at the root,
    never below `leaf`.
    """
    branches: list[Branch] = []
    total = len(targets)
    stack: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = [(np.asarray(root, float), targets)]
    while stack:
        start, group = stack.pop()
        share = max(radius * (len(group) / total) ** (1 / 3), leaf)
        if len(group) == 1:
            branches.append((start, group[0], share, share * 0.6))
            continue
        centre = group.mean(0)
        end = start + 0.45 * (centre - start)
        branches.append((start, end, share, share * 0.88))
        _, _, axes = np.linalg.svd(group - centre, full_matrices=False)
        side = (group - centre) @ axes[0]
        half = side > np.median(side)
        if not half.any():
            half[: len(half) // 2] = True
        stack += [(end, group[half]), (end, group[~half])]
    return branches


def frame_along(axis: ArrayLike, spin: float = 0.0) -> NDArray[np.float64]:
    """Return a right-handed orthonormal frame (rows) whose third row points along `axis`."""
    w = np.asarray(axis, np.float64)
    w = w / np.linalg.norm(w)
    u = np.cross(np.eye(3)[np.argmin(np.abs(w))], w)
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    return np.stack([np.cos(spin) * u + np.sin(spin) * v, np.cos(spin) * v - np.sin(spin) * u, w])
