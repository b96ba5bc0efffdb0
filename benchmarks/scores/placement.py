"""Whether a volume made elsewhere has the scan's axes and unit: it is compared with the reference, turned every way.

Volumes are [z, y, x]. The reference is clipped at the 99.9 percentile of the tissue, as the data range of `tissue` is,
so that metal, which no method gets right, does not decide. A measured scan has none: FDK's volume takes its place.
"""

import itertools
import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.benchmarks.scores.protocol import Truth, tissue_range, truth_of
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError
from ctsim.reconstruct.fdk import reconstruct as fdk

Unit = Literal["1/mm", "1/cm", "hu"]
NAMES: dict[Unit, str] = {"1/mm": "1/mm", "1/cm": "1/cm", "hu": "HU"}
AXES = "zyx"
MOST = 2_000_000
"""Voxels that are compared; of a larger volume every second, third … along each axis."""
METAL_FROM = 99.5
"""Percentile of a measured scan's FDK above which there may be metal."""
TURNED = 0.1
"""What a volume differs by from its own turned copy agrees to −1 with the reference's where the volume lies right, to
+1 where it is turned; from this value on it is refused."""
GAINED = 0.003
"""Share of what is missing to a correlation of 1 that turning must win back: a blur of a nearly round body wins 0.0004
of it by chance, turning back mirrored hips 0.09."""
MOVED = (-2, -1, 1, 2)
"""Voxels along an axis by which a volume may be shifted that looks turned: a ball off the middle, for one."""
LEAST_AIR = -500.0
"""HU: the median of what is air lies below in any reconstruction, whatever its streaks and its noise."""
DEEP, ENOUGH = 2, 0.01
"""Air counts that is this many voxels from the body, where that is this share of all voxels: a blur reaches no farther,
and a cavity tells nothing."""
FAR = math.log(3)
"""A spread off by this much, as a logarithm, is in no unit that is known."""
NO_WATER = (
    "--unit hu needs the attenuation of water, which a scan without spectrum.csv does not tell: expected 1/mm or 1/cm, "
    "or a scan that was imported with --kv"
)
NEGATIVE = -0.5
"""Correlation with the reference that no reconstruction has by chance, only one of the wrong sign."""


class Turn(NamedTuple):
    """Axis k of the scan is axis order[k] of the volume, and runs the other way where `flipped`."""

    order: tuple[int, int, int]
    flipped: tuple[bool, bool, bool]

    def apply(self, volume: NDArray[Any]) -> NDArray[Any]:
        """Return the volume turned, a view."""
        back = tuple(slice(None, None, -1 if flip else 1) for flip in self.flipped)
        return np.transpose(volume, self.order)[back]

    @property
    def text(self) -> str:
        """What a volume looks like that this turns back."""
        parts = []
        if self.order != (0, 1, 2):
            theirs = ", ".join(AXES[self.order.index(axis)] for axis in range(3))
            parts.append(f"transposed (its axes seem to be {theirs}, expected z, y, x)")
        if any(self.flipped):
            parts.append("flipped along " + " and ".join(a for a, flip in zip(AXES, self.flipped, strict=True) if flip))
        return " and ".join(parts)


TURNS = tuple(
    Turn((a, b, c), (i, j, k))
    for a, b, c in itertools.permutations(range(3))
    for i, j, k in itertools.product((False, True), repeat=3)
)
"""All 48; the first leaves a volume as it is."""


def to_attenuation(values: NDArray[Any], unit: Unit, water: float | None) -> NDArray[np.float32]:
    """Convert values to 1/mm, float32; `water` is the μ of 0 HU in 1/mm. Raises InputError for HU without it."""
    if unit == "1/mm":
        return np.asarray(values, np.float32)
    if unit == "1/cm":
        return np.asarray(values, np.float64).astype(np.float32) / np.float32(10)
    if water is None:
        raise InputError(NO_WATER)
    return (water * (1 + np.asarray(values, np.float64) / 1000)).astype(np.float32)


def reference_of(stored: ScanWithTruth) -> NDArray[np.float32]:
    """Return what volumes of a scan are compared with, [z, y, x] in 1/mm.

    It is a constant, with which nothing but the shape compares, where a measured scan has no FDK.
    """
    if stored.has_truth:
        return tissue_of(truth_of(stored))
    if stored.geometry.poses is not None:
        return np.ones(stored.geometry.n_voxel, np.float32)
    values = np.nan_to_num(fdk(stored.scan).values.numpy())
    return np.clip(values, 0, np.percentile(values, METAL_FROM))


def tissue_of(truth: Truth) -> NDArray[np.float32]:
    """Return a truth without its metal, [z, y, x] in 1/mm."""
    return np.minimum(truth.references["effective"], np.float32(tissue_range(truth, "effective")))


def check(
    name: str,
    values: NDArray[Any],
    reference: NDArray[np.float32],
    unit: Unit,
    water: float | None,
    option: str = "",
) -> None:
    """Raise InputError, a sentence that begins with `name`, for a volume of another shape, unit or orientation.

    `values` are as stored, in `unit`. A unit is refused where another one brings both mean and standard deviation
    nearer to those of the `reference`, in 1/mm; `option` names the flag that states it. HU are refused whose air is
    not that of HU, and without `water`. So are numbers that are not finite, and a volume of one value.
    """
    shape = reference.shape
    if sorted(values.shape) != sorted(shape):
        raise InputError(f"{name} has shape {values.shape}, expected {shape} (z, y, x)")
    if not (finite := np.isfinite(values)).all():
        raise InputError(f"{name} has {int((~finite).sum())} of {values.size} voxels that are not finite")
    if (low := values.min()) == values.max():
        raise InputError(f"{name} holds {float(low):g} in every voxel, expected a reconstruction")
    if unit == "hu" and water is None:
        raise InputError(NO_WATER)
    _check_unit(name, values, reference, unit, water, option)
    found = to_attenuation(values, unit, water)
    if unit == "hu" and water is not None:
        _check_air(name, values, reference, water)
    _check_sign(name, found, reference)
    _check_turn(name, found, reference)


def _check_unit(
    name: str, values: NDArray[Any], reference: NDArray[np.float32], unit: Unit, water: float | None, option: str
) -> None:
    """Refuse values whose mean and spread, which no turn changes, are nearer to the reference's in another unit."""
    mean, spread = float(reference.mean(dtype=np.float64)), float(reference.std(dtype=np.float64))
    own_mean, own_spread = float(values.mean(dtype=np.float64)), float(values.std(dtype=np.float64))
    if own_spread == 0 or spread == 0:
        return  # a constant has no scale
    off: dict[Unit, tuple[float, float]] = {}
    for other in NAMES:
        if other == "hu" and water is None:
            continue
        scale = {"1/mm": 1.0, "1/cm": 0.1, "hu": (water or 0) / 1000}[other]
        shifted = own_mean * scale + (water or 0) * (other == "hu")
        off[other] = abs(math.log(own_spread * scale / spread)), _distance(shifted, mean)
    nearer: list[Unit] = [other for other in off if all(a < b for a, b in zip(off[other], off[unit], strict=True))]
    better = min(nearer, key=lambda other: sum(off[other]), default=None)
    if better is None:
        return
    found = f"its mean is {own_mean:.3g} and its standard deviation {own_spread:.3g}, the reference's {mean:.3g} and "
    found += f"{spread:.3g} 1/mm; expected {NAMES[unit]}"
    if off[better][0] > FAR:
        raise InputError(f"{name} is in none of {', '.join(NAMES.values())}: {found}")
    instead = f", or {option} {better}" if option else ""
    raise InputError(f"{name} looks like {NAMES[better]}: {found}{instead}")


def _distance(one: float, other: float) -> float:
    """Return the distance of two means as a logarithm; infinite where one is not positive."""
    return abs(math.log(one / other)) if one > 0 and other > 0 else math.inf


def _check_air(name: str, values: NDArray[Any], reference: NDArray[np.float32], water: float) -> None:
    """Refuse HU whose darkest voxels, as many as the reference has of air within the circle, are nowhere near −1000."""
    _, n_y, n_x = reference.shape
    y, x = np.ogrid[-1 : 1 : n_y * 1j, -1 : 1 : n_x * 1j]
    air = ndimage.binary_erosion(reference < water / 10, iterations=DEEP, border_value=1) & (np.hypot(y, x) <= 1)
    share = float(np.mean(air))
    if share < ENOUGH or (dark := float(np.quantile(values, share / 2))) <= LEAST_AIR:
        return
    if dark == values.min():
        raise InputError(f"{name} is cut off at {dark:.4g} HU, where air has -1000; expected all values")
    raise InputError(f"{name} is not in HU: the air in it has {dark:.4g}, expected -1000, or another unit")


def _check_sign(name: str, values: NDArray[np.float32], reference: NDArray[np.float32]) -> None:
    """Refuse the negative of a volume."""
    top, few = float(reference.max()), _few(reference)
    target = _standard(reference[few])
    if values.shape != reference.shape or target is None:
        return
    if (own := _correlation(np.clip(values[few], -top, top), target)) < NEGATIVE:
        raise InputError(f"{name} looks like the negative of a volume: correlation with the reference {own:.2f}")


def _check_turn(name: str, values: NDArray[np.float32], reference: NDArray[np.float32]) -> None:
    """Refuse a volume that fits better when it is turned.

    Only what a body differs by from its own turned copy tells how it lies; what both share, and errors that a turn
    leaves as they are, must not count. For a volume v and the reference r, both of mean 0 and norm 1, and their turned
    copies Tv and Tr, ⟨Tv − v, r⟩ / √((1 − ⟨Tv, v⟩)(1 − ⟨Tr, r⟩)) is −1 for v = r and +1 for Tv = r. It is near 0 where
    noise, or a body that has no orientation, decides.
    """
    clipped = np.clip(values, 0, float(reference.max()))
    few = _few(reference)
    target = _standard(reference[few])
    fits = [turn for turn in TURNS if turn.apply(clipped).shape == reference.shape]
    if target is None or not fits:
        return
    found = {turn: _correlation(turn.apply(clipped)[few], target) for turn in fits}
    best = max(found, key=lambda turn: found[turn])
    own, other = found.get(TURNS[0]), found[best]
    if own is None:  # only turned does it have the shape
        raise InputError(f"{name} has shape {values.shape}, expected {reference.shape} (z, y, x): it is {best.text}")
    copy = _standard(clipped[few])
    if best == TURNS[0] or other <= 0 or copy is None:
        return
    alike = _correlation(best.apply(clipped)[few], copy), _correlation(best.apply(reference)[few], target)
    turned = (other - own) / math.sqrt(max((1 - alike[0]) * (1 - alike[1]), 1e-12))
    if turned <= TURNED or other - own <= GAINED * (1 - own):
        return
    shifts = itertools.product(range(3), MOVED)
    if max(_correlation(np.roll(clipped[few], by, axis), target) for axis, by in shifts) >= other:
        return  # a shift is an error to be scored
    raise InputError(f"{name} looks {best.text}: correlation with the reference {own:.3f}, turned back {other:.3f}")


def _few(reference: NDArray[Any]) -> tuple[slice, ...]:
    """Return which voxels are compared."""
    return (slice(None, None, math.ceil((reference.size / MOST) ** (1 / 3))),) * 3


def _standard(values: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return values with mean 0 and norm 1; None for a constant."""
    flat = np.array(values, np.float64)
    flat -= flat.mean()
    norm = float(np.linalg.norm(flat))
    return flat / norm if norm > 0 else None


def _correlation(values: NDArray[Any], target: NDArray[np.float64]) -> float:
    """Return Pearson's correlation with a standardised array; 0 for a constant."""
    own = _standard(values)
    return 0.0 if own is None else float(np.vdot(own, target))
