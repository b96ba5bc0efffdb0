"""Total variation of a volume: its proximal map, and a smoothed gradient to descend along.

TV(x) = Σ |D x| with D the forward differences along y, x and z (zero past the last voxel), each multiplied by the
smallest voxel length over that axis' (`ratios`, ≤ 1), so that a slope counts the same along all axes. Volumes
are float32 [y, x, z], dual fields [3, y, x, z]; sums are bitwise equal for any number of threads.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.geometry import Geometry
from ctsim.reconstruct.kernels import tv_cpu as kernels

SPARSE = 0.25  # of its box that a support fills, up to which boxes around its islands are looked for
MANY = 1000  # islands, from which on they take longer than the memory is worth

Array = NDArray[np.float32]
Box = tuple[slice, ...]


def axis_ratios(geometry: Geometry) -> NDArray[np.float32]:
    """Return the smallest voxel length over that of y, x and z, [3]."""
    d_z, d_y, d_x = geometry.d_voxel
    return (min(geometry.d_voxel) / np.array([d_y, d_x, d_z])).astype(np.float32)


class Denoiser:
    """The proximal map argmin ½‖x − b‖² + τ TV(x) over x zero off `support` and, if asked, not negative.

    Fast gradient projection on the dual, Beck and Teboulle, IEEE Trans. Image Process. 18, 2009,
    doi:10.1109/TIP.2009.2028250. The dual field is kept from call to call, as a start for the next.
    """

    def __init__(
        self,
        support: NDArray[np.bool_],
        ratios: NDArray[np.float32],
        positivity: bool,
        memory: tuple[Array, Array] | None = None,
    ) -> None:
        """Denoise on `support`; `memory` is a dual field of zeros and one to work in, None for new ones."""
        self.support, self.ratios, self.positivity = support, ratios, positivity
        shape = (3, *support.shape)
        if memory is None:
            memory = np.zeros(shape, np.float32), np.empty(shape, np.float32)
        self.dual, self._ahead = memory

    def run(self, b: Array, tau: float, iterations: int) -> Array:
        """Return the minimiser of `b`, [y, x, z], after `iterations` steps."""
        x, ahead = np.empty_like(b), self._ahead
        if tau == 0:
            kernels.primal(b, self.dual, np.float32(0), self.ratios, self.support, self.positivity, x)
            return x
        start, t = self.dual, 1.0
        # ‖D‖² ≤ 4 Σ ratio², Beck and Teboulle's lemma 4.2 with a third axis
        step = np.float32(1 / (4 * float((self.ratios**2).sum()) * tau))
        for _ in range(iterations):
            after = (1 + math.sqrt(1 + 4 * t * t)) / 2
            kernels.primal(b, start, np.float32(tau), self.ratios, self.support, self.positivity, x)
            kernels.ascend(x, start, ahead, self.dual, step, np.float32((t - 1) / after), self.ratios)
            start, t = ahead, after
        kernels.primal(b, self.dual, np.float32(tau), self.ratios, self.support, self.positivity, x)
        return x


class SparseDenoiser:
    """A `Denoiser` that holds boxes around the islands of its support alone, to the same bits.

    A slope reaches from a voxel to those next to it, and the slopes of one voxel to those that touch by an edge:
    islands that do not even touch so do not know of each other, and a margin of one voxel holds all slopes of each.
    The `dual` fields of the boxes lie one after another: [number].
    """

    def __init__(
        self, shape: tuple[int, ...], islands: list[tuple[Box, NDArray[np.bool_]]], ratios: Array, positivity: bool
    ) -> None:
        """Denoise on islands, each a box of the volume's `shape` and the support within it."""
        self._shape = shape
        self.dual = np.zeros(sum(3 * support.size for _, support in islands), np.float32)
        ahead = np.empty(max(3 * support.size for _, support in islands), np.float32)  # used by one after another
        self._parts: list[tuple[Box, Denoiser]] = []
        first = 0
        for box, support in islands:
            field = (3, *support.shape)
            size = 3 * support.size
            memory = self.dual[first : first + size].reshape(field), ahead[:size].reshape(field)
            self._parts.append((box, Denoiser(support, ratios, positivity, memory)))
            first += size

    def run(self, b: Array, tau: float, iterations: int) -> Array:
        """Return the minimiser of `b`, [y, x, z], after `iterations` steps."""
        x = np.zeros(self._shape, np.float32)
        for box, part in self._parts:
            found = part.run(np.ascontiguousarray(b[box]), tau, iterations)
            np.copyto(x[box], found, where=part.support)  # boxes overlap, islands do not
        return x


def denoiser_on(support: NDArray[np.bool_], ratios: NDArray[np.float32], positivity: bool) -> Denoiser | SparseDenoiser:
    """Return a denoiser of as little memory as the support allows: shells of metal fill little of their box."""
    if support.any() and support.mean() <= SPARSE:
        labels, _ = ndimage.label(support, np.ones((3, 3, 3), np.bool_))
        # beyond the last voxel a slice ends by itself
        boxes = [tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in box) for box in ndimage.find_objects(labels)]
        if len(boxes) < MANY and 2 * sum(labels[box].size for box in boxes) <= support.size:
            islands = [(box, labels[box] == k) for k, box in enumerate(boxes, start=1)]
            return SparseDenoiser(support.shape, islands, ratios, positivity)
    return Denoiser(support, ratios, positivity)


def total_variation(x: Array, ratios: NDArray[np.float32]) -> float:
    """Return TV(x), summed in float64."""
    sums = np.zeros(len(x))
    kernels.sum_slopes(x, ratios, sums)
    return float(sums.sum())


def descend(x: Array, length: float, steps: int, ratios: NDArray[np.float32], delta: float = math.inf) -> None:
    """Take `steps` steps of norm `length` down the gradient of TV, in place.

    The root is smoothed at 1e-4 of the largest value, as it has no gradient at zero. With a finite `delta` (1/mm)
    differences D are weighted by exp(−(D/δ)²), held fixed within a step: adaptive-weighted TV, which spares edges
    (Liu, Ma, Fan and Liang, Phys. Med. Biol. 57, 2012, doi:10.1088/0031-9155/57/23/7923).
    """
    field, gradient = np.empty((3, *x.shape), np.float32), np.empty_like(x)
    for _ in range(steps):
        least = np.float32(max(1e-4 * float(np.abs(x).max()), 1e-15))
        kernels.normalised_slopes(x, ratios, np.float32(1 / delta), least, field)
        kernels.transposed(field, ratios, gradient)
        norm = math.sqrt(float(np.einsum("ijk,ijk", gradient, gradient, dtype=np.float64)))
        if norm == 0:
            return
        gradient *= np.float32(length / norm)
        x -= gradient
