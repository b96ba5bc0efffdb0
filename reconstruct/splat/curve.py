"""One unknown a splat: its hardened attenuation, from which a curve through known materials gives both densities.

Blind data cannot tell ρa from ρb at every point, but matter is not arbitrary: behind a given spectrum a material's
attenuation u tells its atomic number well enough, from fat and water through bone and aluminium to titanium and iron.
Well below fat a material is thin water, as lung is. The tables are those of xraylib (`ctsim.materials`); no mask and no
scene enters.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ctsim.materials import attenuation
from ctsim.reconstruct.splat.kernels import curve_cpu
from ctsim.reconstruct.splat.response import Response, tangent

MATERIALS = ("adipose", "water", "cortical_bone", "Al", "Ti", "Fe")
THIN = 0.7  # times the attenuation of fat, up to which a material is thin water
DEEPEST = 8.0  # of P, to which a material's own hardening is fitted
STRONGEST = 20.0  # times iron, where the curve ends: twice what gold and tungsten have behind 150 mm of water
METAL = 6.0  # times water: above it a splat is metal to the fit's preconditioner (bone 5.3, aluminium 6.4 at 90 kVp)
DENSEST = 15.0  # times water: above it is dense metal (titanium 43), below bone and, but in soft beams, enamel (9)

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialCurve:
    """Piecewise linear from u (1/mm) to (ρa, ρb): `knots` [knot], `densities` [knot, 2] and `slopes` [knot − 1, 2].

    Knots are nothing, thin water, the materials by their attenuation, and `STRONGEST` times the last of them.
    u = ā·ρa + b̄·ρb with (ā, b̄) = `tangent`, what one more mm adds to P behind the read-out's water. `of_water` is
    (ρa, ρb) of water, 1/mm.
    """

    knots: NDArray[np.float64]
    densities: NDArray[np.float64]
    slopes: NDArray[np.float64]
    tangent: tuple[float, float]
    of_water: tuple[float, float]

    @classmethod
    def of(cls, response: Response, length: float) -> "MaterialCurve":
        """Build the curve for a response, read out behind `length` mm of water."""
        known = {m: _densities(response, m) for m in MATERIALS}
        water = known["water"]
        slope = tangent(response, tuple(water), length)
        thin = THIN * np.dot(slope, known["adipose"]) / np.dot(slope, water)
        found = sorted([thin * water, *known.values()], key=lambda rho: float(np.dot(slope, rho)))
        densities = np.stack([np.zeros(2), *found, STRONGEST * found[-1]])
        knots = densities @ slope
        return cls(
            knots=knots,
            densities=densities,
            slopes=np.diff(densities, axis=0) / np.diff(knots)[:, None],
            tangent=slope,
            of_water=tuple(water.tolist()),
        )

    @property
    def water(self) -> float:
        """Attenuation of water in the hardened beam, 1/mm."""
        return float(np.dot(self.tangent, self.of_water))

    def densities_of(self, u: Image, unit: float = 1.0, out: Image | None = None) -> Image:
        """Return (ρa, ρb) over `unit`, float32 [splat, 2], in `out` where that is given."""
        out = np.empty((u.size, 2), np.float32) if out is None else out
        curve_cpu.evaluate(u, self.knots, self.densities, self.slopes, unit, out)
        return out

    def transpose(self, u: Image, sums: Image, factor: float = 1.0) -> Image:
        """Return how sums by (ρa, ρb), float32 [splat, 2], change with each unknown, times a factor: [splat]."""
        out = np.empty_like(u)
        curve_cpu.transpose(u, self.knots, self.slopes * factor, sums, out)
        return out


def _densities(response: Response, material: str) -> NDArray[np.float64]:
    """Fit (ρa, ρb) of a material (1/mm) to the P of its own paths, up to P = 8.

    Attenuation itself is not fitted: behind thick metal only the hardest photons count, and there a small share of a
    misfit that is least squares over all energies makes half of P.
    """
    nodes, mu = np.stack([response.a, response.b], 1), attenuation(material, response.energies_kev)

    def p_of(attenuations: NDArray[np.float64]) -> NDArray[np.float64]:
        exponents = np.outer(lengths, attenuations)
        least = exponents.min(1)
        return least - np.log(np.exp(least[:, None] - exponents) @ response.eta)

    lengths = np.geomspace(1e-3, 1.0, 60) * DEEPEST / mu.min()
    p = p_of(mu)
    lengths, p = lengths[p < DEEPEST], p[p < DEEPEST]
    start, *_ = np.linalg.lstsq(nodes * np.sqrt(response.eta)[:, None], mu * np.sqrt(response.eta), rcond=None)
    return least_squares(lambda x: (p_of(nodes @ x) - p) / (0.02 + 0.05 * p), start).x
