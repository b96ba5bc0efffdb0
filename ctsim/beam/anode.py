"""What leaves a thick tungsten anode, in closed form: continuum, K and L lines, self-absorption.

Photons per keV (or per line), per mAs and cm2 at 1 m, before any filter. Formula and constants:
A. L. Finkelshtein and T. O. Pavlova, X-Ray Spectrometry 28 (1999) 27–32, with Philibert's absorption
correction. Fluorescence yields and line energies are xraylib's.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ctsim.materials import mass_attenuation

Z, A = 74, 183.84
K_EDGE, L_EDGE = 69.525, 10.2068
_PER_CM2 = 1e-4  # steradians that 1 cm2 covers at 1 m
_ELECTRONS_PER_MAS = 6.241509e15
_CONTINUUM = 5.47152e9  # photons per mAs, sr and keV over the dimensionless shape

# Lines: energy (keV), share of the shell's photons. K: Kα2 Kα1 Kβ3 Kβ1 Kβ2. L: Ll, Lα, Lβ, Lγ.
_K_LINES = ((57.98, 0.2900), (59.32, 0.5025), (66.95, 0.0550), (67.24, 0.1065), (69.07, 0.0460))
_L_LINES = ((7.39, 0.022), (8.39, 0.475), (9.73, 0.425), (11.29, 0.078))
_YIELD = {"K": 0.958, "L": 0.280}
_JUMP_SHARE = {"K": 4.018 / 5.018, "L": 3.280 / 4.280}  # of the absorption above the edge, (J − 1)/J


def self_absorption(kvp: float, takeoff: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Philibert's share [n] of photons that get out of the anode at `takeoff` (radians), 0 to 1."""
    sine = math.sin(takeoff)
    h = 1.2 * A / Z**2
    depth = np.maximum(kvp**1.65 - energies**1.65, 0.0) / 4.0e5
    chi = mass_attenuation("W", energies) * depth
    return sine**2 / ((sine + chi) * (sine + h / (1 + h) * chi))


def continuum(kvp: float, takeoff: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bremsstrahlung [n] per keV, cm2 at 1 m and mAs; zero above `kvp`."""
    e = np.minimum(energies, kvp)
    shape = Z * (kvp / e - 1) * (kvp / (2 * e)) ** (0.2010 - 0.00069 * Z)
    return _CONTINUUM * _PER_CM2 * shape * _back(kvp, e) / _slowing(kvp, e) * self_absorption(kvp, takeoff, e)


def _slowing(kvp: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.log(33.397 * (2 * kvp + energies) / Z)


def _back(kvp: float, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the intensity that back-scattered electrons leave."""
    return 1 - 0.0081517 * Z + 3.613e-5 * Z**2 + 0.009583 * Z * np.exp(-kvp / energies) + 0.001141 * kvp


def lines(kvp: float, takeoff: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the characteristic lines: energies (keV) and photons per cm2 at 1 m and mAs."""
    energies, photons = [], []
    for shell, edge, capacity, table in (
        ("K", K_EDGE, 2 * 0.35 * 1.73, _K_LINES),
        ("L", L_EDGE, 8 * (2.519 / (Z - 26.6) - 0.0968 + 0.0103 * Z), _L_LINES),
    ):
        if kvp <= edge:
            continue
        over = kvp / edge
        at = np.array([edge])
        made = capacity / (2 * Z) * (over * math.log(over) - over + 1) / float(_slowing(kvp, at)[0])
        made *= float(_back(kvp, at)[0]) / (4 * math.pi) * _YIELD[shell]
        e = np.array([line[0] for line in table])
        made = made * (1 + _by_continuum(kvp, edge, capacity, _JUMP_SHARE[shell], e))
        share = np.array([line[1] for line in table])
        energies.append(e)
        photons.append(_ELECTRONS_PER_MAS * _PER_CM2 * made * share * self_absorption(kvp, takeoff, e))
    if not energies:
        return np.zeros(0), np.zeros(0)
    return np.concatenate(energies), np.concatenate(photons)


def _by_continuum(
    kvp: float, edge: float, capacity: float, jump_share: float, lines: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Photons [n] that the continuum excites in the anode per photon that electrons excite: 2 for K, 0.1 for L."""
    e = np.linspace(edge * (1 + 1e-6), kvp, 25)
    absorbing = float(np.average(mass_attenuation("W", e), weights=kvp / e - 1))
    ratio = mass_attenuation("W", lines) / absorbing
    return 1.098e-5 * Z**2 * jump_share * edge / capacity * np.log1p(ratio) / ratio
