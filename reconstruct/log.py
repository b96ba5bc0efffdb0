"""Line integrals from counts: the logarithm, its floor, the mask of pixels that hit it, and what all of them mean."""

import math

import numpy as np
import torch
from numpy.typing import NDArray

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
        return p.reshape(counts.shape), clamped.reshape(counts.shape)


def line_integrals(scan: Scan, view: int | slice) -> tuple[torch.Tensor, torch.Tensor]:
    """Return p = −ln(max(counts − dark, floor) / (flat − dark)), float32, and the mask of clamped pixels, bool.

    Shapes are [v, u] for one view and [view, v, u] for a slice. Both images
    contain the pedestal. Readings that are not finite, and pixels whose open field is below the floor,
    count as clamped.
    """
    p, clamped = LineIntegrals(scan).of(view)
    return torch.from_numpy(p), torch.from_numpy(clamped)


def _log_open(open_field: NDArray[np.float32], floor: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    usable = np.isfinite(open_field) & (open_field > floor)
    log_open = np.log(np.where(usable, open_field, floor).astype(np.float64)).astype(np.float32)
    return log_open, ~usable
