"""What the detector makes of one photon.

A sensitive slab hit head-on. In closed form every outcome of the first interaction has a probability and a deposit:
all of E; E less a K-fluorescence photon that got out; the Compton electron alone. A table made by Monte Carlo
(`ctsim.detector.slab`) corrects it for everything later. Energies keV, thicknesses mm.
"""

import functools
import math
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expn

from ctsim.detector.panel import Blur, Lag, check_lag
from ctsim.errors import InputError
from ctsim.materials import E_MIN, attenuation, compton, incoherent, k_shell, k_vacancies, photoelectric

_SLAB = {"gos": "GOS", "csi": "CsI", "ideal": "GOS", "counting": "CdTe@5.85"}
_DEPTHS = 24  # Gauss–Legendre nodes over the depth of the first interaction, in its own probability


class Detector(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A detector.

    "gos" and "csi" integrate energy, with K-escape. "ideal" integrates E(1 − exp(−μt)) of GOS, for comparison.
    "counting" counts photons that deposit more than `threshold` in CdTe; it has neither blur nor lag.
    """

    kind: Literal["gos", "csi", "ideal", "counting"] = "gos"
    """The sensitive layer."""
    thickness: float = 0.1
    """Its thickness in mm."""
    threshold: float = 15.0
    """Threshold of "counting" in keV."""
    blur: Blur | None = None
    """How light spreads over the panel; it blurs the signal and its photon noise."""
    lag: tuple[Lag, ...] = ()
    """Parts of the signal that come in later views."""

    def __post_init__(self) -> None:
        if self.kind not in _SLAB:
            raise InputError(f"detector: kind must be one of {', '.join(_SLAB)}, got {self.kind!r}")
        if not 1e-6 <= self.thickness <= 100:  # the square of what a thinner slab absorbs may underflow
            raise InputError(f"detector: thickness must be within [1e-6, 100] mm, got {self.thickness}")
        if not (math.isfinite(self.threshold) and self.threshold >= 0):
            raise InputError(f"detector: threshold must be at least 0 keV, got {self.threshold}")
        check_lag(self.lag)
        if self.kind == "counting" and (self.blur is not None or self.lag):
            raise InputError('detector: "counting" has no light; expected neither blur nor lag with it')

    def text(self) -> str:
        """Return kind and thickness for people."""
        above = f" above {self.threshold:g} keV" if self.kind == "counting" else ""
        return f"{self.kind} of {self.thickness:g} mm{above}"


def response(detector: Detector, energies: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean deposit a1 (keV) [n] and mean squared deposit a2 (keV2) [n] per incident photon.

    "gos" and "csi" are the closed form times the ratio of a slab Monte Carlo to it, tabulated for 0.01–10 mm and
    1–500 keV; outside, the ratio of the nearest thickness and energy is used. For "counting", in closed form, both are
    the probability that the photon is counted.
    """
    _, a1, a2 = _of(detector, energies)
    return a1, a2


def swank(detector: Detector, energies: ArrayLike) -> NDArray[np.float64]:
    """Return Swank's factor a1²/(a0·a2) [n], where a0 is the share of photons that deposit any energy.

    It is how much of the quantum efficiency a0 the spread of the deposits leaves for the detective one. Raises
    InputError for "counting", where all photons count alike.
    """
    if detector.kind == "counting":
        raise InputError('detector: "counting" has no Swank factor, its photons count alike')
    a0, a1, a2 = _of(detector, energies)
    return a1**2 / (a0 * a2)


def _of(detector: Detector, energies: ArrayLike) -> NDArray[np.float64]:
    e = np.ascontiguousarray(np.atleast_1d(np.asarray(energies, dtype=np.float64)))
    return _moments(detector, e.tobytes())


@functools.lru_cache(maxsize=64)
def _moments(detector: Detector, packed: bytes) -> NDArray[np.float64]:
    """Return moments 0, 1 and 2 of the deposit [3, n]; read-only."""
    e = np.frombuffer(packed)
    which = _SLAB[detector.kind]
    if detector.kind == "ideal":
        absorbed = -np.expm1(-attenuation(which, e) * detector.thickness)
        out = np.stack([absorbed, absorbed * e, absorbed * e**2])
    elif detector.kind == "counting":
        pairs = outcomes(which, detector.thickness, e)
        counted = sum((p * (deposit > detector.threshold) for deposit, p in pairs), np.zeros(e.size))
        out = np.stack([counted] * 3)
    else:
        out = closed_form(which, detector.thickness, e) * _ratio(which, detector.thickness, e)
    out.flags.writeable = False
    return out


def closed_form(which: str, thickness: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return moments 0, 1 and 2 of the deposit [3, n] in a slab of a material, all secondaries but one left out."""
    pairs = outcomes(which, thickness, energies)
    return np.stack([sum((p * deposit**k for deposit, p in pairs), np.zeros(energies.size)) for k in range(3)])


@functools.lru_cache(maxsize=1)
def _table() -> dict[str, NDArray[np.float64]]:
    with np.load(Path(__file__).with_name("detector_response.npz"), allow_pickle=False) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


def _ratio(which: str, thickness: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate Monte Carlo over closed form [3, n], linearly in the logarithms; clamped outside the table."""
    t = _table()
    grid = np.log(t["thickness"])
    place = np.interp(math.log(thickness), grid, np.arange(grid.size))
    low = min(int(place), grid.size - 2)
    near = t[f"{which}_ratio"][:, low : low + 2]
    rows = near[:, 0] + (place - low) * (near[:, 1] - near[:, 0])
    x, nodes = np.log(energies), np.log(t[f"{which}_energy"])
    return np.stack([np.interp(x, nodes, row) for row in rows])


def outcomes(
    which: str, thickness: float, energies: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return what a photon may leave in the slab: pairs of deposit (keV) [n] and probability [n].

    Coherent scatter, mostly forward, counts as no interaction. Secondaries are isotropic; one that does not
    escape directly is absorbed in full. The rest of 1 is the photon that passes.
    """
    e = energies
    photo, (scattered, share) = photoelectric(which, e), compton(which, e)
    mu = photo + scattered
    interacting = -np.expm1(-mu * thickness)
    depth, weight = _depths(mu, thickness)
    pairs, full = [], interacting.copy()
    for z, vacancies in k_vacancies(which, e).items():
        shell = k_shell(z)
        if shell is None or not vacancies.any():
            continue
        for line, part in shell.lines:
            if line < E_MIN:
                continue  # such soft lines stay where they are made
            escape = _escape(np.full(e.size, _stopping(which, np.array([line]))[0]), depth, weight, thickness)
            probability = interacting * vacancies / mu * shell.fluorescence_yield * part * escape
            pairs.append((np.maximum(e - line, 0.0), probability))
            full -= probability
    away = np.maximum(e * (1 - share), E_MIN)
    probability = interacting * scattered / mu * _escape(_stopping(which, away), depth, weight, thickness)
    pairs.append((e * share, probability))
    pairs.append((e, full - probability))
    return pairs


def _stopping(which: str, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Attenuation (1/mm) [n] without coherent scatter."""
    return photoelectric(which, energies) + incoherent(which, energies)


def _depths(mu: NDArray[np.float64], thickness: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths [n, k] of the first interaction at Gauss nodes of its cumulative probability, and weights [k]."""
    x, w = np.polynomial.legendre.leggauss(_DEPTHS)
    part = 0.5 * (1 + x)
    depth = -np.log1p(part * np.expm1(-mu[:, None] * thickness)) / mu[:, None]
    return depth, 0.5 * w


def _escape(
    mu: NDArray[np.float64], depth: NDArray[np.float64], weight: NDArray[np.float64], thickness: float
) -> NDArray[np.float64]:
    """Mean probability [n] that an isotropic secondary (attenuated by `mu` [n]) leaves through either face.

    ∫ exp(−μd/cosθ) over a half-sphere is E2(μd), the exponential integral.
    """
    front = expn(2, mu[:, None] * depth)
    back = expn(2, mu[:, None] * np.maximum(thickness - depth, 0.0))
    return 0.5 * (front + back) @ weight
