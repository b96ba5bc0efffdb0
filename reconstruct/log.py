"""Line integrals from counts: the logarithm, its floor, the mask of pixels that hit it, and what all of them mean."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.reconstruct.kernels.log_cpu import look_up, take_log
from ctsim.types import Scan, Status

NO_SIGNAL = "no pixel has signal: every reading is at the floor of the logarithm or not finite"


def count_floor(scan: Scan) -> float:
    """Return the smallest signal, in counts above the pedestal, whose logarithm is taken.

    Where the scan does not say, half a photon's worth (mean open field / (2 i0)), and at least half a count where
    counts are integers: below that a reading says no more than "nothing seen".
    """
    if scan.floor is not None:
        return scan.floor
    half_photon = 0.5 * (float(scan.flat.double().mean()) - scan.dark) / scan.i0
    half_count = 0.0 if scan.counts.is_floating_point() else 0.5
    floor = max(half_photon, half_count)
    return floor if math.isfinite(floor) and floor > 0 else 0.5


def is_blind(scan: Scan, clamped: int) -> bool:
    """Say whether this many clamped pixels are all that a scan has, so that it shows nothing."""
    return clamped >= scan.counts.numel()


def how_it_ended(values: torch.Tensor, scan: Scan, clamped: int) -> tuple[Status, str]:
    """Return the status of a reconstruction and its reason, by its values and by how many pixels were clamped."""
    if is_blind(scan, clamped):
        return Status.ERROR, NO_SIGNAL
    return finite_or_not(values.numpy())


def finite_or_not(values: NDArray[np.floating]) -> tuple[Status, str]:
    """Return the status of a volume and its reason: not OK where it holds values that are not finite."""
    if not np.isfinite(values).all():
        return Status.NONFINITE, "the reconstruction holds values that are not finite"
    return Status.OK, ""


class LineIntegrals:
    """Takes the logarithm of a scan's counts, some views at a time; what all views share is worked out once."""

    def __init__(self, scan: Scan) -> None:
        self.scan, self.floor = scan, count_floor(scan)
        self._log_open, self._dead = _log_open(scan.flat.numpy() - np.float32(scan.dark), self.floor)
        self._filling = Filling.of(self._dead)
        self._table = self._low = None
        if scan.counts.dtype == torch.uint16:
            # 65536 logarithms serve all pixels.
            signal = np.arange(65536) - scan.dark
            self._table, self._low = np.log(np.maximum(signal, self.floor)).astype(np.float32), signal <= self.floor

    def of(self, view: int | slice) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return what `line_integrals` does, as arrays."""
        counts = self.scan.counts[view].numpy()
        stack = counts[None] if counts.ndim == 2 else counts
        p, clamped = np.empty(stack.shape, np.float32), np.empty(stack.shape, np.bool_)
        if self._table is not None:
            look_up(stack, self._table, self._low, self._log_open, self._dead, p, clamped)
        else:
            dark, floor = np.float32(self.scan.dark), np.float32(self.floor)
            take_log(np.asarray(stack, np.float32), dark, floor, self._log_open, self._dead, p, clamped)
        if (filling := self._filling) is not None:
            for image in p:
                filling.fill(image)
        return p.reshape(counts.shape), clamped.reshape(counts.shape)


@dataclass(frozen=True, slots=True)
class Filling:
    """How dead pixels are filled: `dead`, the two pixels that each is interpolated between, and the second's share.

    They are flat indices. The neighbours are the nearest pixels of the row that see something, on either side, or else
    the nearest one at all. Left as they are, dead pixels would read as open air and draw rings.
    """

    dead: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: NDArray[np.float32]

    @classmethod
    def of(cls, dead: NDArray[np.bool_]) -> "Filling | None":
        """Return how the pixels `dead` [v, u] are filled; None where there are none, or no others."""
        if not dead.any() or dead.all():
            return None
        v, u = np.nonzero(dead)
        n_u, columns = dead.shape[1], np.arange(dead.shape[1])
        left = np.maximum.accumulate(np.where(dead, -1, columns), axis=1)[v, u]
        right = np.minimum.accumulate(np.where(dead, n_u, columns)[:, ::-1], axis=1)[:, ::-1][v, u]
        both = (left >= 0) & (right < n_u)
        nearest = ndimage.distance_transform_edt(dead, return_distances=False, return_indices=True)
        at_v, at_u = np.asarray(nearest)[:, v, u]
        share = np.where(both, (u - left) / np.maximum(right - left, 1), 0)
        one, other = (np.where(both, v * n_u + side, at_v * n_u + at_u) for side in (left, right))
        return cls(v * n_u + u, one.astype(np.int64), other.astype(np.int64), share.astype(np.float32))

    def fill(self, image: NDArray[np.float32]) -> None:
        """Fill an image [v, u] in place."""
        flat = image.reshape(-1)
        flat[self.dead] = flat[self.first] + self.share * (flat[self.second] - flat[self.first])


def line_integrals(scan: Scan, view: int | slice) -> tuple[torch.Tensor, torch.Tensor]:
    """Return p = −ln(max(counts − dark, floor) / (flat − dark)), float32, and the mask of clamped pixels, bool.

    Shapes are [v, u] for one view and [view, v, u] for a slice. Both images contain the pedestal. Readings that are not
    finite, and dead pixels, whose open field is not finite or not above the floor, count as clamped; p of the latter is
    interpolated (`Filling`).
    """
    p, clamped = LineIntegrals(scan).of(view)
    return torch.from_numpy(p), torch.from_numpy(clamped)


def _log_open(open_field: NDArray[np.float32], floor: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    usable = np.isfinite(open_field) & (open_field > floor)
    log_open = np.log(np.where(usable, open_field, floor).astype(np.float64)).astype(np.float32)
    return log_open, ~usable
