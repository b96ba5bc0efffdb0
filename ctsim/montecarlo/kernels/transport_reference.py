"""What reaches the detector after one collision in a ball, by quadrature in float64 straight from xraylib's tables."""

import numpy as np
import xraylib as xrl
from numpy.typing import NDArray

from ctsim.materials import material

REST = 510.998950  # keV
AVOGADRO = 0.602214076  # per mol, times 1e-24 cm² per barn
Law = tuple[NDArray[np.float64], NDArray[np.float64]]


def single_scatter(
    name: str, radius: float, energy: float, pose: NDArray[np.float64], cells: tuple[int, int], nodes: int = 48
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the energy (keV) per photon that one Compton and one Rayleigh collision bring to each cell: two [v, u].

    A ball of `radius` mm about the origin, a detector of one pixel as large as the steps of `pose`, to every place of
    which the source sends as many photons of `energy` keV. The detector takes all energy. The collision's place is
    integrated by Gauss's rule in spherical coordinates, `nodes` of them in each.
    """
    source, centre, e_u, e_v = pose.reshape(4, 3)
    places, volume = _ball(radius, nodes)
    normal = np.cross(e_u, e_v)  # area of the detector along its normal
    to = places - source
    far = np.linalg.norm(to, axis=1)
    way = to / far[:, None]
    reach = (centre - source) @ normal / (way @ normal)  # distance to the detector's plane along the way
    hit = source + reach[:, None] * way - centre
    seen = (abs(hit @ e_u) <= 0.5 * e_u @ e_u) & (abs(hit @ e_v) <= 0.5 * e_v @ e_v)
    per_sr = np.where(seen, reach**2 / abs(way @ normal), 0.0)
    which = material(name)
    weights = {z: w / xrl.AtomicWeight(z) for z, w in which.mass_fractions.items()}
    arriving = per_sr / far**2 * np.exp(-_mu(which, energy) * _inside(places, -way, radius)) * volume
    out = np.zeros((2, *cells))
    halves = np.linspace(0, 1, 2001)  # of sin(θ/2): in the cosine forward scatter would be a spike
    cosines = 1 - 2 * halves**2
    for j, i in np.ndindex(*cells):
        at = centre + ((i + 0.5) / cells[1] - 0.5) * e_u + ((j + 0.5) / cells[0] - 0.5) * e_v
        off = at - places
        length = np.linalg.norm(off, axis=1)
        off /= length[:, None]
        cos = np.clip((off * way).sum(1), -1, 1)
        angle = abs(off @ normal) / (cells[0] * cells[1] * length**2)
        leaving = _inside(places, off, radius)
        later = energy / (1 + energy / REST * (1 - cos))
        half = np.sqrt((1 - cos) / 2)
        mu_later = np.interp(half, halves, [_mu(which, energy / (1 + energy / REST * (1 - c))) for c in cosines])
        compton = np.interp(half, halves, _compton(weights, energy, cosines))
        rayleigh = np.interp(half, halves, _rayleigh(weights, energy, cosines))
        scale = 0.1 * which.density * arriving * angle
        out[0, j, i] = (scale * compton * later * np.exp(-mu_later * leaving)).sum()
        out[1, j, i] = (scale * rayleigh * energy * np.exp(-_mu(which, energy) * leaving)).sum()
    return out[0], out[1]


def _ball(radius: float, nodes: int) -> Law:
    x, w = np.polynomial.legendre.leggauss(nodes)
    r, wr = radius * (1 + x) / 2, radius * w / 2
    phi = 2 * np.pi * (np.arange(nodes) + 0.5) / nodes
    rr, cc, pp = np.meshgrid(r, x, phi, indexing="ij")
    volume = (wr * r**2)[:, None, None] * w[None, :, None] * np.full(nodes, 2 * np.pi / nodes)
    sine = np.sqrt(1 - cc**2)
    return np.stack([rr * sine * np.cos(pp), rr * sine * np.sin(pp), rr * cc], -1).reshape(-1, 3), volume.ravel()


def _inside(places: NDArray[np.float64], way: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Return the length from places in the ball to its surface."""
    along = (places * way).sum(1)
    return -along + np.sqrt(along**2 + radius**2 - (places**2).sum(1))


def _mu(which, energy: float) -> float:
    return 0.1 * which.density * sum(w * xrl.CS_Total(z, energy) for z, w in which.mass_fractions.items())


def _compton(weights: dict[int, float], energy: float, cosines: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return cm² per sr and g, from xraylib's barn per sr and atom."""
    angles = np.maximum(np.arccos(cosines), 1e-3).tolist()
    return AVOGADRO * np.array([sum(n * xrl.DCSb_Compt(z, energy, a) for z, n in weights.items()) for a in angles])


def _rayleigh(weights: dict[int, float], energy: float, cosines: NDArray[np.float64]) -> NDArray[np.float64]:
    angles = np.maximum(np.arccos(cosines), 1e-3).tolist()
    return AVOGADRO * np.array([sum(n * xrl.DCSb_Rayl(z, energy, a) for z, n in weights.items()) for a in angles])
