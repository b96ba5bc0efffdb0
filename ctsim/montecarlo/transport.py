"""Scatter images and absorbed energy by photon Monte Carlo."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import Spectrum
from ctsim.detector.response import Detector, response
from ctsim.errors import InputError
from ctsim.materials import E_MIN, attenuation
from ctsim.montecarlo.kernels import transport_cpu
from ctsim.montecarlo.kernels.scoring_cpu import MULTIPLE, SINGLE, SQUARED
from ctsim.montecarlo.kernels.transport_cpu import CHUNKS
from ctsim.montecarlo.tables import STEP
from ctsim.montecarlo.world import World
from ctsim.rng import stream_key

PLANES = SQUARED + 1
_NONE = np.zeros((0, 0), np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Photons on their way to a detector of `n_detector` (v, u) pixels.

    As many photons start to each pixel, or into each solid angle if `isotropic`. `gain` and `layer`, float32 [v, u],
    are the intensity of a pixel and the mm of `layer_material` before it, as of a bow-tie filter. The detector takes
    photons from all sides as it takes those that hit it head-on. `grid_ratio`, if positive, is that of a focused grid
    before it, as `ctsim.scatter.Scatter` says.
    """

    spectrum: Spectrum
    detector: Detector
    n_detector: tuple[int, int]
    isotropic: bool = False
    gain: NDArray[np.float32] | None = None
    layer: NDArray[np.float32] | None = None
    layer_material: str | None = None
    grid_ratio: float = 0.0

    @property
    def most(self) -> float:
        """The greatest intensity of a pixel."""
        return 1.0 if self.gain is None else float(self.gain.max())

    @property
    def open_signal(self) -> float:
        """Mean signal of a photon in the open field."""
        return float(self.spectrum.weights @ response(self.detector, self.spectrum.energies)[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Histories:
    """Photons to follow: `count` histories of a stream of random numbers, from number `first` on."""

    key: np.uint64
    count: int
    first: int = 0

    def __post_init__(self) -> None:
        if self.count < CHUNKS:
            raise InputError(f"histories must be at least {CHUNKS}, got {self.count}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """What reaches the detector, as a share of the open field's signal: float64 [v, u] on cells of the detector.

    `primary`, `single` and `multiple` are photons that were scattered not at all, once and more often; `error` is the
    standard error of single + multiple. `squared` is the mean squared signal of scattered photons over the squared mean
    of the open field, as m2 in `ctsim.beam.quadrature`.
    """

    primary: NDArray[np.float64]
    single: NDArray[np.float64]
    multiple: NDArray[np.float64]
    squared: NDArray[np.float64]
    error: NDArray[np.float64]

    @property
    def scatter(self) -> NDArray[np.float64]:
        """Everything that was scattered."""
        return self.single + self.multiple


def scatter_image(
    world: World,
    source: Source,
    pose: NDArray[np.float64],
    *,
    cells: tuple[int, int],
    histories: int,
    stream: str = "",
) -> Image:
    """Return one view's scatter; `pose` is a row of `Geometry.pose_array`, `cells` (v, u) part the detector."""
    followed = Histories(key=stream_key(stream, "scatter", 0), count=histories)
    images = add_histories(world, source, pose, followed, cells=cells)
    primary, single, multiple, squared = images.sum(0) / histories
    return Image(
        primary=primary,
        single=single,
        multiple=multiple,
        squared=squared,
        error=images[:, SINGLE : MULTIPLE + 1].sum(1).std(0, ddof=1) * np.sqrt(CHUNKS) / histories,
    )


def add_histories(
    world: World,
    source: Source,
    pose: NDArray[np.float64],
    histories: Histories,
    *,
    cells: tuple[int, int],
) -> NDArray[np.float64]:
    """Follow histories; return their sums [part, plane, v, u] times the number of cells.

    The parts are independent; the planes are PRIMARY, SINGLE, MULTIPLE and SQUARED, as in `Image`.
    """
    images = np.zeros((CHUNKS, PLANES, *cells))
    _run(world, source, pose, histories, images=images)
    images *= cells[0] * cells[1] * source.most / source.open_signal
    images[:, SQUARED] /= source.open_signal
    return images


def absorbed_energy(
    world: World,
    source: Source,
    pose: NDArray[np.float64],
    regions: NDArray[np.uint8],
    *,
    histories: int,
    stream: str = "",
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the energy (keV) per photon that each region of the label grid absorbs, and its standard error: [region].

    `regions` is uint8 [z, y, x]; what is absorbed outside the grid counts as region 0.
    """
    deposit = np.zeros((CHUNKS, int(regions.max()) + 1))
    followed = Histories(key=stream_key(stream, "dose", 0), count=histories)
    _run(world, source, pose, followed, deposit=deposit, regions=regions)
    parts = deposit * CHUNKS / histories
    return parts.mean(0), parts.std(0, ddof=1) / np.sqrt(CHUNKS)


def _run(
    world: World,
    source: Source,
    pose: NDArray[np.float64],
    histories: Histories,
    *,
    images: NDArray[np.float64] | None = None,
    deposit: NDArray[np.float64] | None = None,
    regions: NDArray[np.uint8] | None = None,
) -> None:
    tables, spectrum = world.tables, source.spectrum
    grid = E_MIN + STEP * np.arange(tables.mu.shape[1])
    if spectrum.e_max > grid[-2]:
        raise InputError(f"the tables end at {grid[-2]:g} keV, the spectrum at {spectrum.e_max:g} keV")
    n_v, n_u = source.n_detector
    normal = np.cross(pose[6:9], pose[9:12]) * n_v * n_u
    nearest = abs((pose[3:6] - pose[:3]) @ normal) / np.linalg.norm(normal)
    signals = np.stack(response(source.detector, grid))  # scattered photons have energies that the tube does not have
    gain = _NONE if source.gain is None else source.gain / np.float32(source.most)
    layer = _NONE if source.layer is None else source.layer
    stops = np.zeros(0) if source.layer_material is None else attenuation(source.layer_material, grid)
    transport_cpu.transport(
        tuple(world.bricks[:5]), world.prims, tuple(world.blocks),
        (tables.mu, tables.klein, tables.bound, tables.form, 1.0 / tables.d_q),
        (
            np.array(pose), np.array([n_v, n_u], np.float64), normal, signals, nearest if source.isotropic else 0.0,
            float(source.grid_ratio),
        ),
        np.zeros((1, 1, 1), np.uint8) if regions is None else regions,
        (np.cumsum(spectrum.weights), np.array(spectrum.energies), gain, layer, stops),
        histories.key, histories.first, histories.count,
        np.zeros((CHUNKS, PLANES, 0, 0)) if images is None else images,
        np.zeros((CHUNKS, 0)) if deposit is None else deposit,
    )  # fmt: skip
