"""Make tungsten_spectra.npz from SpekPy (casim model); run once: python -m ctsim.beam.make_table.

The table holds, on kVp × take-off angle × E/kVp, the logarithm of the unfiltered continuum divided by
(kvp/E − 1) and by Philibert's self-absorption, which takes the anode's absorption edges out of it, and
the lines separately. No air. Needs the extra `spekpy`; the table is derived from SpekPy's (see the notice).
"""

import math
from pathlib import Path

import numpy as np
import spekpy  # pyright: ignore[reportMissingImports]

from ctsim.beam.anode import K_EDGE, L_EDGE, self_absorption

KVP = np.array([20, 25, 30, 35, 40, 50, 60, 70, 80, 90, 100, 110, 120, 130, 140, 150, 175, 200, 230, 260, 300.0])
ANGLES_DEG = np.array([1, 2, 3, 4.5, 6, 8, 11, 15, 20, 28, 40.0])
U = np.linspace(0.01, 1.0, 100)
# Windows (keV) that hold one line or a close group each: Ll, Lα, Lβ, Lγ, Kα2, Kα1, Kβ3, Kβ1, Kβ2.
WINDOWS = ((7, 7.9), (7.9, 9), (9, 10.4), (10.4, 12.4), (56, 58.7), (58.7, 61), (66, 67.1), (67.1, 68.2), (68.2, 70))
EDGES = np.array([L_EDGE] * 4 + [K_EDGE] * 5)


def _spectrum(kvp: float, angle: float, dk: float, brem: bool) -> tuple[np.ndarray, np.ndarray]:
    tube = spekpy.Spek(
        kvp=kvp, th=angle, physics="casim", mu_data_source="nist", dk=dk, mas=1, z=100, brem=brem, char=not brem
    )
    e, flux = tube.get_spectrum()
    return np.asarray(e), np.asarray(flux)


def main() -> None:
    """Compute every node and write the table next to this file."""
    log_g = np.zeros((KVP.size, ANGLES_DEG.size, U.size), np.float32)
    log_line = np.full((KVP.size, ANGLES_DEG.size, len(WINDOWS)), np.nan, np.float32)
    line_energy = np.zeros(len(WINDOWS))
    for i, kvp in enumerate(KVP):
        for j, angle in enumerate(ANGLES_DEG):
            e, flux = _spectrum(kvp, angle, 0.1 if kvp < 160 else 0.2, brem=True)
            inside = e < kvp * 0.995  # the last bins are averages across the end point
            e, flux = e[inside], flux[inside]
            g = flux / (kvp / e - 1) / self_absorption(kvp, math.radians(angle), e)
            log_g[i, j] = np.interp(U, e / kvp, np.log(g))
            e, flux = _spectrum(kvp, angle, 0.1, brem=False)
            for k, (low, high) in enumerate(WINDOWS):
                here = (e >= low) & (e < high)
                photons = flux[here].sum() * 0.1
                if photons > 0 and kvp > EDGES[k]:
                    line_energy[k] = (e[here] * flux[here]).sum() / flux[here].sum()
                    log_line[i, j, k] = np.log(photons / (kvp / EDGES[k] - 1) ** 1.65)
    for k in range(len(WINDOWS)):  # below threshold: the lowest node above it, so that interpolation is finite
        first = int(np.argmax(np.isfinite(log_line[:, 0, k])))
        log_line[:first, :, k] = log_line[first, :, k]
    np.savez_compressed(
        Path(__file__).with_name("tungsten_spectra.npz"),
        kvp=KVP,
        angle_deg=ANGLES_DEG,
        u=U,
        log_continuum=log_g,
        line_energy=line_energy,
        line_edge=EDGES,
        log_line=log_line,
    )


if __name__ == "__main__":
    main()
