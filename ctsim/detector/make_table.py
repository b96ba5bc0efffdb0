"""Make detector_response.npz by Monte Carlo: python -m ctsim.detector.make_table (20 minutes of CPU time).

The table holds, for a slab of GOS and of CsI, moments 0, 1 and 2 of the deposit divided by those of
`ctsim.detector.response.closed_form`: float32 [moment, thickness, energy]. The quotient is smooth between the breaks,
where either one jumps, and each break lies between two nodes 0.2 % from each other. Nothing is smoothed.

Two million histories a node: the deposit of a photon that collides has a relative standard deviation of 1 at most (thin
slabs at 500 keV), hence the mean deposit a standard error of 7e-4 at most. Each node has its own random numbers, and a
second run makes the same file.
"""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctsim.detector.response import closed_form
from ctsim.detector.slab import E_MAX, Slab, absorbed
from ctsim.materials import E_MIN, SHARES_END, absorption_edges, compton, k_edges

THICKNESS = np.geomspace(0.01, 10.0, 19)  # mm
HISTORIES = 2_000_000
STEP = 1.1  # between energies, at most
CLOSE = 1e-3  # relative distance of the nodes from a break; xraylib's edges are blurred by as much


def breaks(name: str) -> list[float]:
    """Return where the quotient may jump: edges, and where the closed form's Compton photon crosses a K edge.

    At SHARES_END it has a kink, since the share of the K shell is constant above.
    """
    crossed = []
    for edge in k_edges([name], 10.0, E_MAX):

        def above(e: float, edge: float = edge) -> float:
            return e * (1 - float(compton(name, [e])[1][0])) - edge

        crossed.append(brentq(above, edge, 2 * edge, xtol=1e-6))
    return sorted({*absorption_edges([name], E_MIN, E_MAX), *crossed, SHARES_END})


@functools.cache
def energies(name: str) -> NDArray[np.float64]:
    """Return the table's energies (keV) [n], between breaks evenly spaced in their logarithm."""
    ends = [E_MIN, *(b * (1 + side) for b in breaks(name) for side in (-CLOSE, CLOSE)), E_MAX]
    parts = []
    for low, high in zip(ends[::2], ends[1::2], strict=True):
        parts.append(np.geomspace(low, high, 1 + math.ceil(math.log(high / low, STEP))))
    return np.concatenate(parts)


def node(name: str, thickness: float, energy: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the quotients [3] at one node and their standard errors [3]."""
    stream = f"{name} {thickness:.6g} mm {energy:.6g} keV"
    found = absorbed(Slab.of(name), thickness, energy, histories=HISTORIES, stream=stream)
    base = closed_form(name, thickness, np.array([energy]))[:, 0]
    return found.moments / base, found.errors / base


def main() -> None:
    """Compute every node and write the table next to this file."""
    table: dict[str, Any] = {"thickness": THICKNESS}
    for name in ("GOS", "CsI"):
        grid = energies(name)
        found = np.array([[node(name, t, e) for e in grid.tolist()] for t in THICKNESS.tolist()])
        table[f"{name}_energy"] = grid
        table[f"{name}_ratio"] = np.ascontiguousarray(found[:, :, 0].transpose(2, 0, 1), dtype=np.float32)
        table[f"{name}_error"] = found[:, :, 1].max((0, 1))  # the largest standard error of each moment
    np.savez_compressed(Path(__file__).with_name("detector_response.npz"), **table)


if __name__ == "__main__":
    main()
