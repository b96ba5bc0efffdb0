"""Stress case of the whole chain: counts and FDK in float32 beside closed-form P and FDK in float64."""

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.methods import code_version
from ctsim.benchmarks.studies.stress.cases import Case, Findings
from ctsim.benchmarks.studies.stress.methods import bound
from ctsim.benchmarks.studies.stress.scans import USUAL, chords, exact_p, geometry, in_air, scan_from, simulated
from ctsim.benchmarks.studies.stress.simulator import LIMIT, QUIET
from ctsim.geometry import Geometry
from ctsim.kernels.backproject_reference import backproject
from ctsim.reconstruct.fdk import reconstruct
from ctsim.reconstruct.filters import padded_length, ramp_kernel
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.settings import Truth
from ctsim.types import Scanner


def fdk_in_float64(p: NDArray[np.float64], of: Geometry) -> NDArray[np.float64]:
    """Reconstruct line integrals [view, v, u] of a full turn on a centred detector: [z, y, x] in 1/mm."""
    (n_v, n_u), (d_v, d_u), weights = of.n_detector, of.d_detector, ray_weights(of)
    u, v = (np.arange(n_u) - (n_u - 1) / 2) * d_u, (np.arange(n_v) - (n_v - 1) / 2) * d_v
    cosine = of.dsd / np.sqrt(of.dsd**2 + u**2 + v[:, None] ** 2)
    spacing, n = d_u * of.dso / of.dsd, padded_length(n_u)
    weighted = p * cosine * weights.values.astype(np.float64)[:, None]
    spectrum = np.fft.rfft(weighted, n, axis=-1) * np.fft.rfft(ramp_kernel(n, spacing)).real * spacing
    filtered = np.fft.irfft(spectrum, n, axis=-1)[..., :n_u]
    volume = np.zeros(of.n_voxel)
    orbit, grid = np.array([of.dso, of.dsd, d_v, d_u, 0, 0]), np.array([*of.d_voxel, 0, 0, 0, weights.radius])
    backproject(filtered, of.angles, orbit, grid, volume)  # pyright: ignore[reportArgumentType]  float64 is not rounded
    return volume


def whole_chain(side: int, found: Findings) -> None:
    """Compare the volumes of both chains; P may differ by the simulator's limit, the volume by that through FDK."""
    scanner = Scanner(geometry=geometry(side), noise=QUIET)
    stacks, volumes = simulated(in_air(USUAL), scanner, Truth(twin=False))
    scan = scan_from(stacks, volumes, scanner)
    values = reconstruct(scan).values.numpy()
    p = exact_p(scanner, chords(scanner.geometry, *USUAL))
    exact = fdk_in_float64(p, scanner.geometry)
    found.finite("the volume", values)
    found.at_most("volume off float64's by (1/mm)", float(np.abs(values - exact).max()), bound(scan) * LIMIT / p.max())
    found.say(f"greatest value {exact.max():.2g} 1/mm")


def cases() -> list[Case]:
    """Return the case of the whole chain."""
    what, expected = "closed-form P and FDK in float64 beside the chain", f"as far apart as |ΔP| ≤ {LIMIT:g} allows"
    code = code_version(__name__) + code_version("ctsim.phantoms.shapes")
    return [Case(name="float64", subject="fdk", what=what, expected=expected, run=whole_chain, code=code)]
