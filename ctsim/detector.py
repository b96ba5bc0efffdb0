"""What the detector makes of one photon.

A sensitive slab hit head-on. Every outcome of the first interaction has a probability and a deposit: all of
E; E less a K-fluorescence photon that got out; the Compton electron alone. Energies keV, thicknesses mm.
"""

import functools
import math
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expn

from ctsim.errors import InputError
from ctsim.materials import E_MIN, attenuation, compton, k_shell, k_vacancies, photoelectric

_SLAB = {"gos": "GOS", "csi": "CsI", "ideal": "GOS", "counting": "CdTe@5.85"}
_DEPTHS = 24  # Gauss–Legendre nodes over the depth of the first interaction, in its own probability


class Detector(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A detector.

    "gos" and "csi" integrate energy, with K-escape. "ideal" integrates E(1 − exp(−μt)) of GOS, for comparison.
    "counting" counts photons that deposit more than `threshold` in CdTe.
    """

    kind: Literal["gos", "csi", "ideal", "counting"] = "gos"
    """The sensitive layer."""
    thickness: float = 0.1
    """Its thickness in mm."""
    threshold: float = 15.0
    """Threshold of "counting" in keV."""

    def __post_init__(self) -> None:
        if self.kind not in _SLAB:
            raise InputError(f"detector: kind must be one of {', '.join(_SLAB)}, got {self.kind!r}")
        if not 1e-6 <= self.thickness <= 100:  # the square of what a thinner slab absorbs may underflow
            raise InputError(f"detector: thickness must be within [1e-6, 100] mm, got {self.thickness}")
        if not (math.isfinite(self.threshold) and self.threshold >= 0):
            raise InputError(f"detector: threshold must be at least 0 keV, got {self.threshold}")


def response(detector: Detector, energies: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean deposit a1 (keV) [n] and mean squared deposit a2 (keV2) [n] per incident photon.

    For "counting" both are the probability that the photon is counted. The closed form lets a photon interact
    once and follows one secondary; `docs/explanation/physics.md` says how far that is from a slab Monte Carlo.
    """
    e = np.ascontiguousarray(np.atleast_1d(np.asarray(energies, dtype=np.float64)))
    return _response(detector, e.tobytes())


@functools.lru_cache(maxsize=64)
def _response(detector: Detector, packed: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    e = np.frombuffer(packed)
    if detector.kind == "ideal":
        absorbed = -np.expm1(-attenuation(_SLAB["ideal"], e) * detector.thickness)
        a1, a2 = absorbed * e, absorbed * e**2
    else:
        a1, a2 = np.zeros(e.size), np.zeros(e.size)
        for deposit, probability in outcomes(_SLAB[detector.kind], detector.thickness, e):
            if detector.kind == "counting":
                a1 += probability * (deposit > detector.threshold)
            else:
                a1 += probability * deposit
                a2 += probability * deposit**2
        if detector.kind == "counting":
            a2 = a1
    a1.flags.writeable = a2.flags.writeable = False
    return a1, a2


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
    return photoelectric(which, energies) + compton(which, energies)[0]


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
