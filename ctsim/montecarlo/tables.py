"""Cross-sections and scattering laws as the transport kernel wants them: flat tables on an even grid of energies.

Photoelectric absorption, Compton scatter with the incoherent scattering function, Rayleigh scatter with form factors
(xraylib's tables: Kissel; Hubbell et al. 1975). Electrons stop where they are made. Momentum transfer is
q = E/12.398·sin(θ/2) in 1/Å, E in keV.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.materials import E_MIN, attenuation, compton, material, photoelectric
from ctsim.materials import scattering_function as sf

STEP = 0.1
"""Width of the energy grid (keV): an absorption edge is blurred over one step."""
N_Q = 512
"""Nodes of the grid of momentum transfer."""
_ELECTRON_REST, HC = 510.998950, 12.3984198  # keV, keV·Å


class Interactions(NamedTuple):
    """What photons do in each material.

    `mu` [material, energy, 3] is the attenuation (1/mm) by photoelectric absorption, Compton and Rayleigh scatter at
    E_MIN + i·STEP keV; `klein` [material, energy] is the integral over all directions of the Compton law, in units of
    r_e²/2 per electron; `bound` [material, q] the incoherent scattering function per electron; `form` [material, q]
    the integral of the squared form factor over q² from 0; `d_q` the step of q (1/Å). Material 0 is air, which nothing
    happens in.
    """

    mu: NDArray[np.float32]
    klein: NDArray[np.float32]
    bound: NDArray[np.float32]
    form: NDArray[np.float64]
    d_q: float

    @staticmethod
    def of(materials: Sequence[str], e_max: float) -> "Interactions":
        """Tabulate the materials, of which the first is air, up to `e_max` keV."""
        return _tabulated(tuple(materials), float(e_max))


@functools.lru_cache(maxsize=8)
def _tabulated(materials: tuple[str, ...], e_max: float) -> Interactions:
    n = math.ceil((e_max - E_MIN) / STEP) + 2
    energies = E_MIN + STEP * np.arange(n, dtype=np.float64)
    q = np.linspace(0.0, energies[-1] / HC, N_Q)
    mu, klein = np.zeros((len(materials), n, 3)), np.ones((len(materials), n))
    bound, form = np.zeros((len(materials), N_Q)), np.zeros((len(materials), N_Q))
    for k, name in enumerate(materials):
        if k == 0:
            continue
        mu[k, :, 0], mu[k, :, 1] = photoelectric(name, energies), compton(name, energies)[0]
        mu[k, :, 2] = np.maximum(attenuation(name, energies) - mu[k, :, 0] - mu[k, :, 1], 0.0)
        bound[k], squared = sf(material(name), q)
        klein[k] = _klein(energies, q, bound[k])
        steps = 0.5 * (squared[1:] + squared[:-1]) * np.diff(q**2)
        form[k, 1:] = np.cumsum(steps)
    return Interactions(
        mu=mu.astype(np.float32), klein=klein.astype(np.float32), bound=bound.astype(np.float32), form=form, d_q=q[1]
    )


def _klein(energies: NDArray[np.float64], q: NDArray[np.float64], bound: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate ε²(ε + 1/ε − sin²θ)·S(q) over all directions, by 48 Gauss nodes in sin(θ/2)."""
    x, w = np.polynomial.legendre.leggauss(48)
    half = 0.5 * (1 + x)  # sin(θ/2); dΩ = 8π·half dhalf
    cos = 1 - 2 * half**2
    ratio = 1 / (1 + energies[:, None] / _ELECTRON_REST * (1 - cos))
    s = np.interp(energies[:, None] / HC * half, q, bound)
    return 8 * np.pi * (ratio**2 * (ratio + 1 / ratio - 1 + cos**2) * s * half) @ (0.5 * w)
