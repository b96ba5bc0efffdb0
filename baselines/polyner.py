"""Polyner: a neural field of attenuation at several energies, told the metal mask and the spectrum.

Wu et al., NeurIPS 2023, arXiv:2306.15203, from the equations. Here the field is evaluated at voxels instead of along
rays, and the spectrum has K bins of equal detected signal where theirs has 101.
"""

import functools
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.metal import Mask, Metal, check_mask, find_metal
from ctsim.reconstruct.beam import DetectorTable, TubeTable, check_tables, detected
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.field.fit import Common
from ctsim.reconstruct.field.grid import Grid, overlaps
from ctsim.reconstruct.field.physics import Bins, Image
from ctsim.reconstruct.field.run import Given, Model, on_cpu, run, truncated
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import about, keywords
from ctsim.reconstruct.splat.common import Energy
from ctsim.types import Scan, Volume

skip = truncated
Smoothness = Annotated[float, about("", "of water", ge=0, le=1e6)]


class Settings(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Common`, the mask, the beam, and the bins.

    `smoothness` "limit" makes all bins equal outside the mask; a number is the weight of their differences, as
    published (0.2). `readout` "mean" is Σ η_k μ_k, "middle", as published, the bin in the middle, a number an energy.
    """

    mask: Mask = "oracle"
    bins: Annotated[int, about("bins of the spectrum, of equal detected signal", ge=2, le=101)] = 8
    smoothness: Annotated[Smoothness | Literal["limit"], about("weight of differences between bins")] = "limit"
    readout: Annotated[Energy | Literal["mean", "middle"], about("how the volume is read from the bins")] = "mean"
    tube: TubeTable = None
    detector: DetectorTable = None

    def __post_init__(self) -> None:
        check_mask(self.mask)
        check_tables(self.tube, self.detector)


@keywords(Settings)
@on_cpu
@primary
def reconstruct(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct by P = −log Σ η_k exp(−L[μ_k]), in 1/mm; keywords are those of `Settings`.

    A mask that is not to be relied on is not used: all bins are then equal everywhere. Raises InputError as FDK's
    correction by a mask does, and for a scan that a field cannot explain.
    """

    def make(given: Given) -> Model:
        return _model(given, settings)

    return run(scan, settings, make)


def _model(given: Given, settings: Settings) -> Model:
    scan = given.scan
    shown = fdk(scan).values.numpy() if settings.mask == "auto" else np.zeros(scan.geometry.n_voxel, np.float32)
    metal = find_metal(scan, shown, settings.mask)
    energies, eta = equal_bins(*detected(settings.tube, settings.detector, scan.e_max), settings.bins)
    physics = _bins(given, metal, eta, settings)
    limitation = {"limitation": f"the mask is not used: {metal.doubt}"} if metal.doubt else {}
    return Model(
        physics=physics,
        read=functools.partial(_read, physics, energies, settings.readout),
        details={"energies_kev": energies.tolist(), "eta": eta.tolist(), **metal.details(), **limitation},
        at_energy=functools.partial(_at_energy, physics, energies),
    )


def _bins(given: Given, metal: Metal, eta: NDArray[np.float64], settings: Settings) -> Bins:
    inside = _on_grid(metal.mask, given.grid) if metal.found else np.zeros(given.grid.whole.n_voxel, bool)
    points = given.grid.of_volume(inside)
    inside = given.grid.filled(points)
    return Bins(
        grid=given.grid,
        metal_grid=Grid.of(given.grid.whole, inside) if points.any() else None,
        metal=torch.from_numpy(points),
        eta=torch.tensor(eta, dtype=torch.float32),
        unit=given.unit,
        smoothness=None if settings.smoothness == "limit" else float(settings.smoothness),
    )


def _on_grid(mask: NDArray[np.bool_], grid: Grid) -> NDArray[np.bool_]:
    """Return a mask [z, y, x] on a finer grid: the voxels of which at least half is metal."""
    share = mask.astype(np.float32)
    for axis, (n, m) in enumerate(zip(grid.whole.n_voxel, mask.shape, strict=True)):
        share = np.moveaxis(np.tensordot(overlaps(n, m), share, (1, axis)), 0, axis)
    return share >= 0.5


def equal_bins(
    energies: NDArray[np.float64], signal: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean energy (keV) and the share of the signal of up to `n` bins of about equal signal.

    A spectral line with more than a bin's signal is a bin, so there may be fewer.
    """
    share = signal / signal.sum()
    bins = np.minimum(((np.cumsum(share) - 0.5 * share) * n).astype(int), n - 1)
    eta, sums = (np.bincount(bins, each, n).astype(np.float64) for each in (share, share * energies))
    kept = eta > 0
    return sums[kept] / eta[kept], eta[kept]


def _read(
    physics: Bins, energies: NDArray[np.float64], readout: float | str, values: torch.Tensor
) -> tuple[Image, str]:
    mu = physics.attenuations(values)
    if readout == "mean":
        return (mu @ physics.eta).numpy(), "mean over the detected signal"
    if readout == "middle":
        middle = (len(energies) - 1) // 2
        return mu[:, middle].contiguous().numpy(), f"bin of {energies[middle]:.1f} keV"
    return _at_energy(physics, energies, values, float(readout)), f"at {float(readout):g} keV"


def _at_energy(physics: Bins, energies: NDArray[np.float64], values: torch.Tensor, kev: float) -> Image:
    """Interpolate between the bins' energies; beyond the first and the last they are as there."""
    weights = [np.interp(kev, energies, unit) for unit in np.eye(len(energies))]
    return (physics.attenuations(values) @ torch.tensor(weights, dtype=values.dtype)).numpy()
