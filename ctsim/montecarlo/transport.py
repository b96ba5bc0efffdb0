"""Scatter images and absorbed energy by photon Monte Carlo."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.materials import E_MIN
from ctsim.montecarlo.kernels import transport_cpu
from ctsim.montecarlo.tables import STEP
from ctsim.montecarlo.world import World
from ctsim.rng import stream_key
from ctsim.spectrum import Spectrum


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """What reaches the detector, as a share of the open field's signal: float64 [v, u] on cells of the detector.

    `primary`, `single` and `multiple` are photons that were scattered not at all, once and more often; `error` is the
    standard error of single + multiple.
    """

    primary: NDArray[np.float64]
    single: NDArray[np.float64]
    multiple: NDArray[np.float64]
    error: NDArray[np.float64]

    @property
    def scatter(self) -> NDArray[np.float64]:
        """Everything that was scattered."""
        return self.single + self.multiple


def scatter_image(
    world: World,
    spectrum: Spectrum,
    signal: NDArray[np.float64],
    pose: NDArray[np.float64],
    n_detector: tuple[int, int],
    *,
    cells: tuple[int, int],
    histories: int,
    stream: str = "",
    isotropic: bool = False,
) -> Image:
    """Return one view's scatter.

    The source sends as many photons to each pixel of the detector, or into each solid angle if `isotropic`. `signal`
    [n] is what the detector makes of a photon at the spectrum's energies; `pose` is a row of `Geometry.pose_array`;
    `cells` (v, u) part the detector.
    """
    if histories < 1:
        raise InputError(f"histories must be at least 1, got {histories}")
    images = np.zeros((transport_cpu.CHUNKS, 3, *cells))
    _run(
        world,
        spectrum,
        signal,
        pose,
        n_detector,
        histories,
        stream,
        isotropic,
        images,
        np.zeros((transport_cpu.CHUNKS, 0)),
    )
    open_signal = float(spectrum.weights @ signal) * histories / (cells[0] * cells[1])
    primary, single, multiple = images.sum(0) / open_signal
    parts = images[:, 1:].sum(1) * transport_cpu.CHUNKS / open_signal
    return Image(
        primary=primary,
        single=single,
        multiple=multiple,
        error=parts.std(0, ddof=1) / np.sqrt(transport_cpu.CHUNKS),
    )


def absorbed_energy(
    world: World,
    spectrum: Spectrum,
    pose: NDArray[np.float64],
    n_detector: tuple[int, int],
    regions: NDArray[np.uint8],
    *,
    histories: int,
    stream: str = "",
    isotropic: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the energy (keV) per photon that each region of the label grid absorbs, and its standard error: [region].

    `regions` is uint8 [z, y, x]; what is absorbed outside the grid counts as region 0.
    """
    deposit = np.zeros((transport_cpu.CHUNKS, int(regions.max()) + 1))
    images = np.zeros((transport_cpu.CHUNKS, 3, 0, 0))
    _run(
        world,
        spectrum,
        np.ones_like(spectrum.energies),
        pose,
        n_detector,
        histories,
        stream,
        isotropic,
        images,
        deposit,
        regions,
    )
    parts = deposit * transport_cpu.CHUNKS / histories
    return parts.mean(0), parts.std(0, ddof=1) / np.sqrt(transport_cpu.CHUNKS)


def _run(
    world, spectrum, signal, pose, n_detector, histories, stream, isotropic, images, deposit, regions=None
) -> None:
    tables = world.tables
    n = tables.mu.shape[1]
    grid = E_MIN + STEP * np.arange(n)
    if spectrum.e_max > grid[-2]:
        raise InputError(f"the tables end at {grid[-2]:g} keV, the spectrum at {spectrum.e_max:g} keV")
    absorbed = np.interp(grid, spectrum.energies, signal)
    normal = np.cross(pose[6:9], pose[9:12]) * n_detector[0] * n_detector[1]
    nearest = abs((pose[3:6] - pose[:3]) @ normal) / np.linalg.norm(normal)
    transport_cpu.transport(
        tuple(world.bricks[:5]), world.prims, tuple(world.blocks),
        (tables.mu, tables.klein, tables.bound, tables.form, 1.0 / tables.d_q),
        (np.array(pose), np.array(n_detector, np.float64), normal, absorbed, nearest if isotropic else 0.0),
        np.zeros((1, 1, 1), np.uint8) if regions is None else regions,
        (np.cumsum(spectrum.weights), np.array(spectrum.energies)),
        stream_key(stream, "montecarlo", 0), 0, histories, images, deposit,
    )  # fmt: skip
