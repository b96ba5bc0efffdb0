"""The focal spot: a source of finite size, as a few point sources whose intensities are averaged.

An edge of the object has a penumbra on the detector: the spot's image, magnified by its distance to the detector over
its distance to the source. The detector averages it over a pixel. A spot of n points draws n steps instead, each as
wide as a pixel. How far their sum is from the penumbra, as a share of the edge's step, is known in closed form, and
decides the number of points. Where there is no edge all points see the same.
"""

import math
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ctsim.errors import InputError
from ctsim.geometry import Geometry, Pair, few_views

LARGEST, WIDEST = 20.0, 50.0  # mm, of a spot and of what is around it
MOST_POINTS = 64  # along an axis
FWHM = 2 * math.sqrt(2 * math.log(2))  # of a Gaussian, over its standard deviation


class FocalSpot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The tube's focal spot as the detector's centre sees it.

    Pixels far off the centre see a tilted anode's spot longer or shorter; here they see the same one.
    """

    size: Pair
    """Size (v, u) in mm: full width at half maximum of a Gaussian, else full width; 0 to 20."""
    shape: Literal["gaussian", "uniform", "measured"] = "gaussian"
    """A Gaussian, an even rectangle, or the cells of `weights`."""
    weights: tuple[tuple[float, ...], ...] | None = None
    """Relative intensities of the equal cells of a measured spot, rows along v, at most 64 by 64."""

    def __post_init__(self) -> None:
        if not all(math.isfinite(s) and 0 <= s <= LARGEST for s in self.size) or max(self.size) == 0:
            raise InputError(
                f"focal_spot: size must be two lengths (v, u) of 0 to {LARGEST:g} mm, not both 0, got {self.size}"
            )
        if self.shape not in ("gaussian", "uniform", "measured"):
            raise InputError(f"focal_spot: shape must be 'gaussian', 'uniform' or 'measured', got {self.shape!r}")
        if (self.weights is not None) != (self.shape == "measured"):
            raise InputError(f"focal_spot: weights belong to shape = 'measured' and to no other, got {self.shape!r}")
        if self.weights is not None:
            _check_weights(self.weights)


class OffFocal(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Radiation from around the focal spot: an even Gaussian that no collimator limits."""

    share: float
    """Its share of the intensity, above 0 and at most 0.5."""
    fwhm: float
    """Full width at half maximum in mm, above 0 and at most 50."""

    def __post_init__(self) -> None:
        if not 0 < self.share <= 0.5:
            raise InputError(f"off_focal: share must be within (0, 0.5], got {self.share}")
        if not 0 < self.fwhm <= WIDEST:
            raise InputError(f"off_focal: fwhm must be within (0, {WIDEST:g}] mm, got {self.fwhm}")


def _check_weights(weights: tuple[tuple[float, ...], ...]) -> None:
    rows = {len(row) for row in weights}
    if len(rows) != 1 or not 1 <= min(rows) <= MOST_POINTS or len(weights) > MOST_POINTS:
        raise InputError(f"focal_spot: weights must be rows of equal length, at most {MOST_POINTS} of {MOST_POINTS}")
    flat = [w for row in weights for w in row]
    if not all(math.isfinite(w) and w >= 0 for w in flat) or not sum(flat) > 0:
        raise InputError("focal_spot: weights must be finite and not negative, and not all 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class SubSources:
    """The points of a focal spot: `offsets` [n, 2] (v, u) in mm from its centre and `weights` [n] that add up to 1.

    `grid` is how many of the focal spot there are along v and u; those of off-focal radiation follow. `error` is the
    largest error of the signal at a straight edge along the detector's rows or columns, as a share of the edge's step;
    at an oblique edge it is at most √2 times that.
    """

    offsets: NDArray[np.float64]
    weights: NDArray[np.float64]
    grid: tuple[int, int]
    error: float

    def geometry(self, geometry: Geometry, view: int) -> Geometry:
        """Return a geometry whose views are one view seen from each point."""
        source, centre, e_u, e_v = geometry.pose(view).reshape(4, 3)
        along = np.stack([e_v / np.linalg.norm(e_v), e_u / np.linalg.norm(e_u)])
        rest = (*centre.tolist(), *e_u.tolist(), *e_v.tolist())
        poses = tuple((*point, *rest) for point in (source + self.offsets @ along).tolist())
        return msgspec.structs.replace(geometry, n_views=len(poses), angles_deg=None, poses=poses)


def magnification(geometry: Geometry, points: NDArray[np.float64]) -> Pair:
    """Return the largest penumbra (v, u), in pixels, that 1 mm of the spot casts of points [n, 3] of the object."""
    poses = geometry.pose_array()[few_views(geometry.n_views, 64)]
    source, centre, e_u, e_v = (poses[:, k : k + 3] for k in (0, 3, 6, 9))
    normal = np.cross(e_u, e_v)
    depth = (points @ normal.T - (source * normal).sum(1)) / ((centre - source) * normal).sum(1)
    ahead = depth[(depth > 0) & (depth < 1)]
    if not ahead.size:
        return 0.0, 0.0
    penumbra = 1 / float(ahead.min()) - 1
    return penumbra / float(np.linalg.norm(e_v, axis=1).min()), penumbra / float(np.linalg.norm(e_u, axis=1).min())


def sub_sources(
    spot: FocalSpot | None, pixels: Pair, tolerance: float, off_focal: OffFocal | None = None
) -> SubSources:
    """Part a spot, a point if None, into the fewest points whose error, see `SubSources`, is at most `tolerance`.

    `pixels` (v, u) is the penumbra of 1 mm of the spot (`magnification`). Off-focal radiation gets points of its own;
    half the tolerance is theirs. Raises InputError where an axis takes more than `MOST_POINTS`.
    """
    if off_focal is None:
        return _point() if spot is None else _parted(spot, pixels, tolerance)
    around = FocalSpot(size=(off_focal.fwhm, off_focal.fwhm))
    share, half = off_focal.share, tolerance / 2
    main = _point() if spot is None else _parted(spot, pixels, half / (1 - share))
    wide = _parted(around, pixels, half / share)
    return SubSources(
        offsets=np.concatenate([main.offsets, wide.offsets]),
        weights=np.concatenate([(1 - share) * main.weights, share * wide.weights]),
        grid=main.grid,
        error=(1 - share) * main.error + share * wide.error,
    )


def _point() -> SubSources:
    return SubSources(offsets=np.zeros((1, 2)), weights=np.ones(1), grid=(1, 1), error=0.0)


def _parted(spot: FocalSpot, pixels: Pair, tolerance: float) -> SubSources:
    """Part one spot; see `sub_sources`."""
    sides = [_fewest(spot, axis, spot.size[axis] * pixels[axis], tolerance) for axis in (0, 1)]
    (v, w_v, error_v), (u, w_u, error_u) = sides
    if spot.weights is None:
        weights = np.outer(w_v, w_u)
    else:
        cells = np.array(spot.weights, np.float64)
        times = [n // m for n, m in zip((v.size, u.size), cells.shape, strict=True)]
        weights = cells.repeat(times[0], 0).repeat(times[1], 1)
    lit = weights.ravel() > 0
    offsets = np.stack(np.meshgrid(v * spot.size[0], u * spot.size[1], indexing="ij"), -1).reshape(-1, 2)
    return SubSources(
        offsets=offsets[lit],
        weights=weights.ravel()[lit] / weights.sum(),
        grid=(v.size, u.size),
        error=max(error_v, error_u),
    )


def _fewest(
    spot: FocalSpot, axis: int, width: float, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return points (over the size), weights and error along an axis, for a penumbra of `width` pixels."""
    cells = np.ones(1) if spot.weights is None else np.sum(spot.weights, 1 - axis) / np.sum(spot.weights)
    for n in range(1, MOST_POINTS // cells.size + 1):
        points, weights = _gaussian(n) if spot.shape == "gaussian" else _even(cells, n)
        error = _gaussian_error(points, weights, width) if spot.shape == "gaussian" else _even_error(weights, width)
        if error <= tolerance:
            return points, weights, error
    name = ("v", "u")[axis]
    raise InputError(
        f"tube.focal_spot: along {name} it blurs edges over {width:.3g} pixels, which takes more than {MOST_POINTS} "
        "sub-sources; expected a smaller spot, larger pixels or a larger simulation.spot_error"
    )


def _even(cells: NDArray[np.float64], n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Part each of the cells, evenly lit, into n points."""
    total = cells.size * n
    return (np.arange(total) + 0.5) / total - 0.5, cells.repeat(n) / n


def _even_error(weights: NDArray[np.float64], width: float) -> float:
    """Bound the error of points in the middle of equal cells that part `width` pixels.

    A step seen through a pixel is a ramp with two kinks; averaged over h pixels a kink moves by h/8. Of a row of cells
    one at a time is at a kink of either sign.
    """
    return float(weights.max()) * width / weights.size / 8


def _gaussian(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Part a Gaussian into n cells: their centres of mass, over its FWHM, and masses.

    Cells are equally wide within a number of standard deviations that makes the error small; the outer two hold the
    tails, too.
    """
    reach = 1 + 0.4 * math.log2(n)
    edges = np.linspace(-reach, reach, n + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    mass = np.diff(ndtr(edges))
    heights = _bell(edges)
    return (heights[:-1] - heights[1:]) / mass / FWHM, mass


def _gaussian_error(points: NDArray[np.float64], weights: NDArray[np.float64], width: float) -> float:
    """Return the largest difference of a Gaussian's edge and its points', both averaged over a pixel."""
    if width == 0:
        return 0.0
    sigma = width / FWHM
    x = np.linspace(0.0, 4 * sigma + 0.5, 2001)  # both are odd about the edge
    steps = np.clip(x[:, None] - width * points + 0.5, 0, 1) @ weights
    return float(np.abs(steps - (_ramp((x + 0.5) / sigma) - _ramp((x - 0.5) / sigma)) * sigma).max())


def _bell(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)


def _ramp(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate the normal distribution function from −∞."""
    return z * ndtr(z) + _bell(z)
