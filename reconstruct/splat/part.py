"""The splats of one lattice: their unknowns, their pictures, and how they step."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.columns import LatticeProjector
from ctsim.reconstruct.splat.curve import METAL, MaterialCurve
from ctsim.reconstruct.splat.kernels import curve_cpu, step_cpu
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.volume import voxelise

LONGEST = 3.0  # times the median root of a step: hardly seen splats, their steps spread by F, make a fit diverge
SAMPLE = 1 << 18  # roots of which the median is taken
FAINT = 0.5  # times water: splats below are preconditioned as if they held this
LONGER = 1.8
"""Steps of fine splats, in those of the majoriser, which are short: 1 lost 1.2 dB on a copper wire, 3 another 2.5."""

Image = NDArray[np.float32]


@dataclass(slots=True, kw_only=True)
class Part:
    """Splats with unknowns `u`, float32 [splat] in 1/mm of the hardened beam, on one lattice.

    `geometry` has `finer` × `finer` sub-pixels in each pixel of the scan's. Splats are projected by EWA unless `exact`.
    Images are as `LatticeProjector` has them: [view, channel, …].
    """

    geometry: Geometry
    lattice: Lattice
    curve: MaterialCurve
    u: Image
    finer: int = 1
    exact: bool = False
    projector: LatticeProjector = field(init=False)
    curvature: Image = field(init=False)  # by both densities, summed over the views that it was `measured` in
    measured: int = 0
    _pair: Image = field(init=False)  # densities, then sums by them: memory that is used again costs less than new
    _halves: Image = field(init=False)  # roots times gradients, on the way to steps
    _roots: Image = field(init=False)  # of the steps that curvature allows

    def __post_init__(self) -> None:
        self.projector = LatticeProjector(self.geometry, self.lattice, exact=self.exact)
        n = len(self.lattice)
        self.curvature, self._pair = np.zeros((n, 2), np.float32), np.empty((n, 2), np.float32)
        self._halves, self._roots = np.empty(n, np.float32), np.empty(n, np.float32)

    def state(self) -> dict[str, Image]:
        """Return all that the next step depends on, as arrays that it changes."""
        return {"u": self.u, "curvature": self.curvature, "dual": self.lattice.dual}

    def paths(self, views: NDArray[np.int64]) -> Image:
        """Return the line integrals of both densities (La, Lb)."""
        return self.projector.forward(self.curve.densities_of(self.u, self.lattice.unit, self._pair), views)

    def integrals(self, values: Image, views: NDArray[np.int64]) -> Image:
        """Return the line integrals (mm) of `values` [splat], a mean over each pixel of the scan: [view, v, u]."""
        # the projector takes two channels: the second is not looked at
        np.stack([values, values], 1, out=self._pair)
        self._pair /= np.float32(self.lattice.unit)
        return self.projector.turned(self.blocks(self.projector.forward(self._pair, views)[:, 0]).mean((2, 4)))

    def blocks(self, image: Image) -> Image:
        """View images of one channel, without scratch, as sub-pixels in pixels: [view, row, sub-pixel, column, …]."""
        inner = image[..., :-WIDTH]
        n_view, n_row, n_column = inner.shape
        return inner.reshape(n_view, n_row // self.finer, self.finer, n_column // self.finer, self.finer)

    def along(self, slopes: Image, paths: Image) -> Image:
        """Sum slopes times paths over channels and the sub-pixels of a pixel: [view, …] without scratch."""
        a, b = (self.blocks(slopes[:, k]) * self.blocks(paths[:, k]) for k in (0, 1))
        return (a + b).sum((2, 4))

    def back(self, slopes: Image, pixels: Image, views: NDArray[np.int64], out: Image | None = None) -> Image:
        """Sum slopes times what the scan's `pixels` hold over the pixels: [splat, channel], until the next call.

        The products are in `out`, which may be `slopes`, where that is given.
        """
        images = np.empty_like(slopes) if out is None else out
        step_cpu.multiply(slopes, pixels, self.finer, WIDTH, images)
        return self.projector.adjoint(images, views, self._pair)

    def measure(self, slopes: Image, along: Image, views: NDArray[np.int64]) -> None:
        """Add the curvature of some views."""
        self.curvature += self.back(slopes, along, views)
        self.measured += len(views)

    def move(self, slopes: Image, lacking: Image, views: NDArray[np.int64], length: float) -> None:
        """Step by `length` of a step towards what pixels lack; slopes are overwritten.

        The curvature is that of all views in which it was measured: it changes little from subset to subset. Metal,
        and all fine splats, step each by itself: metal's steps are so large that spread they swamp the tissue.
        """
        sums, share = self.back(slopes, lacking, views, slopes), len(views) / self.measured
        fine, last = self.finer > 1, np.float32(self.curve.knots[-1])
        metal = np.float32(0 if fine else METAL * self.curve.water)
        self._precondition(sums, length * (LONGER if fine else 1), share, metal)
        halves = self._halves if fine else self.lattice.spread(self.u, metal, self._halves, len(views))
        step_cpu.move(self.u, metal, last, self._roots, self._halves, self.lattice.index, halves)

    def _precondition(self, sums: Image, length: float, share: float, metal: np.float32) -> None:
        """Write the roots of steps, and these times the gradient of `sums`; the curvature is a `share` of the known."""
        curve, faint = self.curve, np.float32(FAINT * self.curve.water)
        few = slice(None, None, max(len(self.u) // SAMPLE, 1))
        u, seen = self.u[few], curve.transpose(self.u[few], self.curvature[few], share)
        roots = np.sqrt(np.maximum(u, faint) / np.maximum(seen, np.float32(curve_cpu.LEAST)))[u < metal]
        longest = np.float32(LONGEST * np.median(roots)) if roots.size else np.float32(np.inf)
        downhill, upwards = ((curve.slopes * factor).astype(np.float32) for factor in (length, share))
        limits = faint, metal, longest
        curve_cpu.precondition(
            self.u, curve.knots, downhill, sums, upwards, self.curvature, limits, self._halves, self._roots
        )

    def denoise(self, threshold: float, iterations: int) -> None:
        """Take away total variation."""
        self.u = self.lattice.denoise(self.u, threshold, iterations)

    def densities(self, geometry: Geometry) -> Image:
        """Return ρa and ρb, means over the voxels of a grid: [2, z, y, x]."""
        return self._voxelised(self.curve.densities_of(self.u), geometry)

    def volume(self, geometry: Geometry) -> Image:
        """Return u, a mean over the voxels of a grid: [z, y, x] in 1/mm."""
        return self._voxelised(self.u[:, None], geometry)[0]

    def _voxelised(self, densities: Image, geometry: Geometry) -> Image:
        volumes = (voxelise(piece, geometry) for piece in self.lattice.pieces(densities))
        volume = next(volumes)
        for more in volumes:
            volume += more
        return volume
