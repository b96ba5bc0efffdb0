"""Scatter of all views from photons of a few: Monte Carlo on coarse cells, smoothed, and a series of waves in between.

Scatter changes slowly over the detector and from view to view. Photons are followed in a few views, on cells much
wider than pixels. What their independent halves disagree on is noise, and is smoothed away.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.montecarlo.kernels.scoring_cpu import MULTIPLE, SINGLE, SQUARED
from ctsim.montecarlo.kernels.transport_cpu import CHUNKS
from ctsim.montecarlo.transport import Histories, Source, add_histories
from ctsim.montecarlo.world import World
from ctsim.rng import stream_key
from ctsim.types import Phantom

CELLS = 32
"""Cells along the longer side of the detector."""
STEP_DEG = 15.0
"""Between two views whose photons are followed."""
LEAST_VIEWS = 8
FIRST, MOST = 20_000, 20_480_000
"""Histories of a view: at first, and at most; they are doubled until the error is reached."""
USUAL, USUAL_ERROR = 300_000, 0.02
"""Histories of a view that reach an error: 160,000 for a head of water to 640,000 for broccoli of 60 mm."""
NEGLIGIBLE = 2e-6
"""RMS error, as a share of the open field, below which no tolerance asks for more photons."""


@dataclass(frozen=True, slots=True)
class ScatterSeries:
    """Scatter as a share of the open field, for every view and pixel.

    `coefficients` [2, t, v, u] are those of waves over views, rows and columns, for the mean signal and the mean
    squared one (as m1 and m2 in `ctsim.beam.quadrature`); `error` is the RMS error of the mean signal over its mean;
    `histories` is how many photons were followed.
    """

    coefficients: NDArray[np.float64]
    shape: tuple[int, int, int]
    periodic: bool
    error: float
    histories: int

    @property
    def mean(self) -> float:
        """Return the scatter averaged over all pixels and views, which is the wave that is constant."""
        return float(self.coefficients[0, 0, 0, 0])

    def view(self, k: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the mean and the mean squared signal of view k, float32 [v, u]."""
        _, n_t, n_v, n_u = self.coefficients.shape
        along, _ = _waves(np.array([(k + 0.5) / self.shape[0]]), n_t, periodic=self.periodic)
        rows, columns = (_waves(_middles(n), c)[0] for n, c in zip(self.shape[1:], (n_v, n_u), strict=True))
        mean, squared = rows @ np.einsum("t,qtvu->qvu", along[0], self.coefficients) @ columns.T
        return np.maximum(mean, 0.0).astype(np.float32), np.maximum(squared, 0.0).astype(np.float32)


def scatter_series(
    phantom: Phantom, source: Source, geometry: Geometry, *, tolerance: float, stream: str = ""
) -> ScatterSeries:
    """Follow photons until the RMS error of the scatter is at most `tolerance` of its mean, or NEGLIGIBLE.

    Images are parted into waves over the views, rows and columns, and waves that hold little more than noise are
    weakened (see `_smooth`). The noise is known, since the photons come in two halves.

    Raises
    ------
    InputError
        When the most photons that are followed do not reach `tolerance`.
    """
    world = World.of(phantom, source.spectrum.e_max)
    poses, cells = _few(geometry), _cells(geometry)
    sizes = (len(poses), *cells)
    turning = geometry.is_full_turn and geometry.angles_deg is None  # evenly: waves count views
    periodic = (turning, False, False)
    bases, frequencies = zip(
        *(_waves(_middles(n), n, periodic=p) for n, p in zip(sizes, periodic, strict=True)), strict=True
    )
    norms = np.einsum("i,j,k->ijk", *((b**2).sum(0) for b in bases))
    halves = np.zeros((2, 2, len(poses), *cells))
    done, wanted = 0, FIRST
    while True:
        for j, pose in enumerate(poses):
            more = Histories(key=stream_key(stream, "scatter", j), count=wanted - done, first=done)
            images = add_histories(world, source, pose, more, cells=cells)
            parts = images.reshape(2, CHUNKS // 2, *images.shape[1:]).sum(1)
            halves[:, 0, j] += parts[:, SINGLE] + parts[:, MULTIPLE]
            halves[:, 1, j] += parts[:, SQUARED]
        done = wanted
        waves = np.einsum("hqtvu,ta,vb,uc->hqabc", halves * (2 / done), *bases, optimize=True) / norms
        kept, error = _smooth(waves[:, 0] * np.sqrt(norms / math.prod(sizes)), frequencies)
        is_reached = error <= tolerance or error * waves[:, 0, 0, 0, 0].mean() <= NEGLIGIBLE
        if not is_reached and done >= MOST:
            raise InputError(
                f"simulation.scatter_error: {done * len(poses):.1e} photons reach {error:.2g} of the scatter, "
                f"not {tolerance:g}; expected at least {error:.2g}"
            )
        if is_reached:
            series = waves.mean(0) * kept
            # a cell holds the average of a wave over its width
            series /= np.multiply.outer(*(np.sinc(np.arange(n) / (2 * n)) for n in cells))
            return ScatterSeries(series, geometry.shape, turning, error, done * len(poses))
        wanted = 2 * done


def expected_histories(geometry: Geometry, tolerance: float) -> int:
    """Estimate how many photons `scatter_series` follows in all views, before any is followed."""
    return len(_few(geometry)) * max(FIRST, round(USUAL * (USUAL_ERROR / tolerance) ** 2))


def _cells(geometry: Geometry) -> tuple[int, int]:
    size = geometry.s_detector
    n_v, n_u = (min(n, max(1, round(CELLS * s / max(size)))) for n, s in zip(geometry.n_detector, size, strict=True))
    return n_v, n_u


def _few(geometry: Geometry) -> NDArray[np.float64]:
    """Return the poses from which photons are followed: those at the middles of equal parts of the views."""
    poses = geometry.pose_array()
    ways = poses[:, :3] - poses[:, 3:6]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    turned = np.degrees(np.arccos(np.clip((ways[1:] * ways[:-1]).sum(1), -1, 1)))
    n = max(LEAST_VIEWS, math.ceil(turned.sum() / STEP_DEG))
    if 2 * n >= len(poses) or turned.max() > STEP_DEG:
        return poses
    return geometry.poses_between(_middles(n) * len(poses) - 0.5)


def _middles(n: int) -> NDArray[np.float64]:
    """Return the middles of n equal parts of 0 … 1."""
    return (np.arange(n) + 0.5) / n


def _waves(
    places: NDArray[np.float64], n: int, *, periodic: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return n waves at places within 0 … 1, [place, wave], and how many half periods each has.

    They are at right angles to each other at the middles of n parts.
    """
    number = np.arange(n, dtype=np.int64)
    half_periods = (2 * ((number + 1) // 2) if periodic else number).astype(np.float64)
    phase = np.pi * half_periods * places[:, None]
    return np.where(periodic & (number % 2 == 1), np.sin(phase), np.cos(phase)), half_periods


def _smooth(
    halves: NDArray[np.float64], frequencies: tuple[NDArray[np.float64], ...]
) -> tuple[NDArray[np.float64], float]:
    """Return the weights of waves and the RMS error that stays, over the mean.

    `halves` [2, t, v, u] are the coefficients from either half of the photons, of waves whose mean square is 1. Noise,
    half the difference of the halves, has the same variance σ² in each. L waves of like frequencies, whose squares
    add up to Y, get the weight max(0, 1 − L·σ²/Y) (James and Stein 1961). The error is L·σ² times the weight, which for
    waves that hold nothing but noise is too much rather than too little.
    """
    mean, noise = halves.mean(0), float(((halves[0] - halves[1]) ** 2).mean()) / 4
    t, v, u = frequencies
    bands = np.stack(np.broadcast_arrays(_bands(t)[:, None, None], _bands(np.hypot(v[:, None], u))), -1)
    _, block = np.unique(bands.reshape(-1, 2), axis=0, return_inverse=True)
    expected = np.bincount(block.ravel()) * noise
    found = np.maximum(np.bincount(block.ravel(), (mean**2).ravel()), 1e-300)
    weight = np.maximum(0.0, 1 - expected / found)
    stays = (expected * weight).sum()
    level = mean[0, 0, 0]
    return weight[block].reshape(mean.shape), math.sqrt(stays) / level if level > 0 else 0.0


def _bands(frequencies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the number of each frequency's band: bands are 1 wide to 8, and a quarter of an octave beyond."""
    octaves = np.log2(np.maximum(frequencies, 8) / 8)
    return np.where(frequencies < 8, np.round(frequencies), 8 + np.floor(4 * octaves))
