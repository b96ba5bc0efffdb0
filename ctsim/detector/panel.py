"""What a panel does to the signal of the photons that it stopped: their light spreads, and some of it comes late.

Both act after the photons are drawn, so that noise is correlated from pixel to pixel and from view to view, and before
the electronics add noise of their own.

Light starts in the middle of a pixel and is collected by whole pixels. This widens a blurred edge by another pixel's
width: the variance of the kernel is that of the Gaussians plus a twelfth of a square pixel. A blur much narrower than
a pixel does nothing. Light that would leave the panel is reflected, so that the open field stays as it is.
"""

import math
from collections import deque
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from ctsim.errors import InputError
from ctsim.geometry import Pair

WIDEST = 50.0  # mm
CUT = 1e-6  # share of a Gaussian's light, along an axis, beyond the kernel's end
LATE = 1e-4  # share of the signal that may come some views too early
SLOWEST = 0.98
_FWHM = 2 * math.sqrt(2 * math.log(2))


class Blur(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the light of one photon spreads over the panel: a Gaussian, or the sum of a narrow and a wide one."""

    fwhm: float
    """Full width at half maximum in mm, above 0 and at most 50."""
    tail: float = 0.0
    """Share of the light in a second Gaussian, 0 to 1."""
    tail_fwhm: float | None = None
    """Full width at half maximum of the second one in mm."""

    def __post_init__(self) -> None:
        for name in ("fwhm", "tail_fwhm"):
            width = getattr(self, name)
            if width is not None and not 0 < width <= WIDEST:
                raise InputError(f"blur: {name} must be within (0, {WIDEST:g}] mm, got {width}")
        if not 0 <= self.tail <= 1:
            raise InputError(f"blur: tail must be a share within [0, 1], got {self.tail}")
        if (self.tail > 0) != (self.tail_fwhm is not None):
            raise InputError(f"blur: tail and tail_fwhm need each other, got {self.tail} and {self.tail_fwhm}")


class Lag(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of the signal that comes in later views: in the nth of them share·(1 − decay)·decay^(n − 1).

    After a long exposure the first dark view thus reads the share. Before the first view the panel has seen nothing,
    and flats are taken when the signal has become steady.
    """

    share: float
    """How much of a view's signal comes later; all parts together below 1. In a scene, 0 leaves out the preset's."""
    decay: float
    """How much of what is left stays from one view to the next, 0 to 0.98."""

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InputError(f"lag: share must be within [0, 1), got {self.share}")
        if not 0 <= self.decay <= SLOWEST:
            raise InputError(f"lag: decay must be within [0, {SLOWEST}], got {self.decay}")


def check_lag(parts: Sequence[Lag]) -> None:
    """Refuse parts that hold all of the signal."""
    if (total := sum(part.share for part in parts)) >= 1:
        raise InputError(f"lag: the shares must add up to less than 1, got {total:g}")


def taps(fwhm: float, pixel: float) -> NDArray[np.float64]:
    """Return which share of a pixel's light each pixel along an axis collects: [2·reach + 1], sum 1."""
    sigma = fwhm / _FWHM / pixel
    reach = max(0, math.ceil(-float(ndtri(CUT / 2)) * sigma - 0.5))
    half = np.diff(ndtr((np.arange(reach + 2) - 0.5) / sigma))
    out = np.concatenate([half[:0:-1], half])
    return out / out.sum()


def kernels(blur: Blur, d_detector: Pair) -> list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """Return the Gaussians of a blur as (share, taps along v, taps along u); `d_detector` (v, u) in mm."""
    parts = [(1 - blur.tail, blur.fwhm), (blur.tail, blur.tail_fwhm)]
    d_v, d_u = d_detector
    return [(share, taps(fwhm, d_v), taps(fwhm, d_u)) for share, fwhm in parts if share > 0 and fwhm is not None]


def response(parts: Sequence[Lag]) -> NDArray[np.float64]:
    """Return which share of a view's signal is read in it and in each later view: [view], sum 1.

    At most `LATE` of the signal would come after the last of them; it comes in the last.
    """
    left, n = sum(part.share for part in parts), 0
    while left > LATE:
        n += 1
        left = sum(part.share * part.decay**n for part in parts)
    later = np.array([sum(p.share * (1 - p.decay) * p.decay**j for p in parts) for j in range(n)])
    if n:
        later[-1] += left
    return np.concatenate([[1 - later.sum()], later])


class Panel:
    """A panel that sees the views of a scan one after the other; it remembers the last of them.

    `frames` is how many earlier views a view depends on. Stacks are known by their names, and do not mix.
    """

    def __init__(self, blur: Blur | None, lag: Sequence[Lag], d_detector: Pair) -> None:
        self._kernels = [] if blur is None else kernels(blur, d_detector)
        self._response = response(lag)
        self._seen: dict[str, deque[NDArray[np.float32]]] = {}

    @property
    def frames(self) -> int:
        """How many earlier views matter."""
        return self._response.size - 1

    @property
    def reach(self) -> tuple[int, int]:
        """How many pixels (v, u) light spreads at most."""
        return max((k.size // 2 for _, k, _ in self._kernels), default=0), max(
            (k.size // 2 for _, _, k in self._kernels), default=0
        )

    def spread(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return an image [v, u] whose light has spread."""
        if not self._kernels:
            return image
        total = np.zeros(image.shape)
        for share, along_v, along_u in self._kernels:
            total += share * _along(_along(image.astype(np.float64), along_v).T, along_u).T
        return total.astype(np.float32)

    def see(self, name: str, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what is read of the next view [v, u] of the stack `name`."""
        image = self.spread(image)
        if not self.frames:
            return image
        earlier = self._seen.setdefault(name, deque(maxlen=self.frames))
        total = self._response[0] * image
        for share, before in zip(self._response[1:], earlier, strict=False):
            total += share * before
        earlier.appendleft(image)
        return total.astype(np.float32)


def _along(image: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convolve the columns of an image [v, u] with symmetric taps; the image is reflected at its ends.

    A pixel depends on those within reach only, to the last bit.
    """
    reach, n = along.size // 2, len(image)
    padded = np.pad(image, ((reach, reach), (0, 0)), mode="symmetric")
    out = along[reach] * image
    for d in range(1, reach + 1):
        out += along[reach + d] * (padded[reach - d : reach - d + n] + padded[reach + d : reach + d + n])
    return out
