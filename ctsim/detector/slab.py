"""Energy that a photon leaves in a slab, by Monte Carlo: mean, mean square and the share of photons that leave any.

Photoelectric absorption with the fluorescence of all K and L shells, Compton scatter with the incoherent scattering
function, Rayleigh scatter with form factors, all from xraylib's tables. A vacancy moves on by radiation and by
Coster–Kronig transitions; those of Auger electrons emit nothing. Electrons stop where they are made.
"""

import functools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctsim.detector.kernels import slab_cpu
from ctsim.errors import InputError
from ctsim.materials import (
    E_MIN,
    SHARES_END,
    absorption_edges,
    attenuation,
    compton,
    material,
    photoelectric,
    scattering_function,
)
from ctsim.rng import stream_key

E_MAX = 500.0
"""The greatest energy (keV), as in `ctsim.beam.spectrum`."""
_STEP = 0.005  # between logarithms of energies: linear between the nodes, E^-3 is wrong by 4e-5
_EDGE = 1e-3  # xraylib's shells begin up to this share of an edge's energy away from it
_N_Q = 2048
_Q_MIN = 0.005  # 1/Å; xraylib has four digits of the scattering function there, none below 0.001: it goes as q²
_SHELLS = ("K", "L1", "L2", "L3")
_COSTER_KRONIG = {"L1": ("L2", "L3"), "L2": ("L3",)}


class Slab(NamedTuple):
    """What photons do in one material, as `slab_cpu` wants it.

    `rates` [energy, kind] are attenuations (1/mm) summed over kinds of collision: photoelectric in each shell that
    fluoresces, in all others, Compton, Rayleigh. Rows first[s] to first[s + 1] of `lines` [transition, 3] are what may
    fill a vacancy of shell s: cumulative probability, photon energy (keV; 0 for none), shell of the new vacancy or −1.
    `bound` [q] is the incoherent scattering function per electron, `form` [q] the integral of the squared form factor
    over q² from 0; the nodes are q = most·(i/n)², 1/Å.
    """

    energies: NDArray[np.float64]
    rates: NDArray[np.float64]
    first: NDArray[np.int64]
    lines: NDArray[np.float64]
    bound: NDArray[np.float64]
    form: NDArray[np.float64]
    most: float

    @staticmethod
    @functools.lru_cache(maxsize=8)
    def of(name: str) -> "Slab":
        """Tabulate a material from 1 to 500 keV."""
        energies = _grid(name)
        shells = _shells(name)
        numbers = {shell: k for k, shell in enumerate(shells)}
        steps = [_transitions(z, shell, numbers) for z, shell in shells]
        scattered = compton(name, energies)[0]
        photo = photoelectric(name, energies)
        parts = [_photo(name, z, shell, energies) for z, shell in shells]
        other = np.maximum(photo - sum(parts, np.zeros_like(photo)), 0.0)
        coherent = np.maximum(attenuation(name, energies) - photo - scattered, 0.0)
        most = E_MAX / slab_cpu.HC
        q = most * np.linspace(0, 1, _N_Q) ** 2
        tabulated = np.maximum(q, _Q_MIN)
        bound, squared = scattering_function(name, tabulated)
        rising = 0.5 * (squared[1:] + squared[:-1]) * np.diff(q**2)
        return Slab(
            energies=energies,
            rates=np.ascontiguousarray(np.cumsum([*parts, other, scattered, coherent], axis=0).T),
            first=np.cumsum([0, *map(len, steps)]).astype(np.int64),
            lines=np.array([line for step in steps for line in step], np.float64).reshape(-1, 3),
            bound=bound * (q / tabulated) ** 2,
            form=np.concatenate([[0.0], np.cumsum(rising)]),
            most=most,
        )

    def attenuation(self, energy: float) -> float:
        """Return the attenuation (1/mm) at `energy` keV."""
        return float(np.interp(energy, self.energies, self.rates[:, -1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Absorbed:
    """What one incident photon leaves in a slab on average, and what leaves the slab.

    `moments` [3] are the probability to leave any energy, the mean deposit (keV) and the mean squared deposit (keV²),
    `errors` [3] their standard errors. `front` and `back` are the energies (keV) that leave through the two faces after
    a collision, `passed` the share of photons without one.
    """

    moments: NDArray[np.float64]
    errors: NDArray[np.float64]
    front: float
    back: float
    passed: float


def absorbed(slab: Slab, thickness: float, energy: float, *, histories: int, stream: str = "", forced=True) -> Absorbed:
    """Follow photons of `energy` keV that hit a slab of `thickness` mm head-on.

    If `forced`, all of them collide at least once and count 1 − exp(−μt) each, which leaves the moments unbiased.
    """
    if histories < slab_cpu.CHUNKS:
        raise InputError(f"histories must be at least {slab_cpu.CHUNKS}, got {histories}")
    if not E_MIN <= energy <= E_MAX:
        raise InputError(f"the energy must be within [{E_MIN}, {E_MAX}] keV, got {energy}")
    share = -math.expm1(-slab.attenuation(energy) * thickness) if forced else 1.0
    out = np.zeros((slab_cpu.CHUNKS, 6))
    slab_cpu.slab(slab, thickness, energy, share, stream_key(stream, "slab", 0), histories, out)
    parts = out * (share * slab_cpu.CHUNKS / histories)
    mean, error = parts.mean(0), parts.std(0, ddof=1) / math.sqrt(slab_cpu.CHUNKS)
    passed = 1.0 - share if forced else float(mean[slab_cpu.PASSED])
    return Absorbed(
        moments=mean[:3], errors=error[:3], front=float(mean[slab_cpu.FRONT]), back=float(mean[slab_cpu.BACK]),
        passed=passed,
    )  # fmt: skip


def _grid(name: str) -> NDArray[np.float64]:
    """Return energies evenly spaced in their logarithm, with nodes close to both sides of every edge."""
    n = math.ceil(math.log(E_MAX / E_MIN) / _STEP) + 1
    edges = np.array(absorption_edges([name], E_MIN, E_MAX))
    close = (edges[:, None] * (1 + np.array([-_EDGE, -1e-9, 1e-9, _EDGE]))).ravel()
    grid = np.unique(np.concatenate([np.geomspace(E_MIN, E_MAX, n), close]))
    return grid[(grid >= E_MIN) & (grid <= E_MAX)]


def _shells(name: str) -> list[tuple[int, str]]:
    """List the shells whose fluorescence is above E_MIN, as (atomic number, shell)."""
    found = ((z, shell) for z in material(name).mass_fractions for shell in _SHELLS)
    return [(z, shell) for z, shell in found if any(energy >= E_MIN for _, energy, _ in _lines(z, shell))]


def _photo(name: str, z: int, shell: str, energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the attenuation (1/mm) [n] that leaves a vacancy in a shell of element `z`."""
    import xraylib as xrl

    number = getattr(xrl, f"{shell}_SHELL")
    edge = xrl.EdgeEnergy(z, number)
    out = np.zeros(energies.size)
    for i in np.flatnonzero(energies > edge):
        e = float(energies[i])
        at = min(e, SHARES_END)
        out[i] = xrl.CS_Photo(z, e) * xrl.CS_Photo_Partial(z, number, at) / xrl.CS_Photo_Total(z, at)
    which = material(name)
    return 0.1 * which.density * which.mass_fractions[z] * out


def _transitions(z: int, shell: str, numbers: dict[tuple[int, str], int]) -> list[tuple[float, float, float]]:
    """List what may fill a vacancy: cumulative probability, photon energy (keV), number of the next shell or −1."""
    import xraylib as xrl

    fluorescence = xrl.FluorYield(z, getattr(xrl, f"{shell}_SHELL"))
    lines = list(_lines(z, shell))
    total = sum(rate for rate, _, _ in lines)
    steps = [(fluorescence * rate / total, energy, donor) for rate, energy, donor in lines]
    for to in _COSTER_KRONIG.get(shell, ()):
        steps.append((xrl.CosKronTransProb(z, getattr(xrl, f"F{shell}{to[1]}_TRANS")), 0.0, to))
    sums = np.cumsum([probability for probability, _, _ in steps])
    return [(float(s), e, numbers.get((z, to), -1)) for s, (_, e, to) in zip(sums, steps, strict=True)]


def _lines(z: int, shell: str) -> Iterator[tuple[float, float, str]]:
    """Yield a shell's lines: rate, energy (keV), shell that the electron comes from."""
    import xraylib as xrl

    for name in sorted(dir(xrl)):
        match = re.fullmatch(rf"{shell}([LMNO]\d)_LINE", name)
        if match:
            line = getattr(xrl, name)
            try:
                rate, energy = xrl.RadRate(z, line), xrl.LineEnergy(z, line)
            except ValueError:  # not a line of this element
                continue
            yield rate, energy, match[1]
