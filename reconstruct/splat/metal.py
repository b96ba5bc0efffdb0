"""Metal on splats half as far apart, seen by sub-pixels.

A pixel on the edge of metal averages intensities: half of it open and half behind metal read P = ln 2, however thick
the metal is. The mean of the line integrals, which one ray a pixel gives, is far more, so that a fit makes the metal
fainter or smears it. Where there is metal, P is therefore −ln of the mean of exp(−P) over four sub-pixels, and the
splats near its surface are half as far apart, so that sub-pixels differ.
"""

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.curve import DENSEST
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.reconstruct.splat.level import refined
from ctsim.reconstruct.splat.part import Part
from ctsim.reconstruct.splat.response import Response, evaluate

FINER = 2  # splats along an axis, and sub-pixels, for one
AROUND, WITHIN = 2, 3  # voxels outside and inside a metal's surface that are fine: its inside is as smooth as tissue

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


def surface(part: Part) -> Mask:
    """Return the voxels of the lattice's support near the surface of dense metal: [z, y, x].

    Bone is none of it: on splats as fine as that the thorax of `headline` lost 0.4 dB, to noise.
    """
    support = part.lattice.support
    metal = part.lattice.scattered(part.u) > DENSEST * part.curve.water
    if not metal.any():
        return np.zeros_like(support)
    inside = ndimage.binary_erosion(metal, iterations=WITHIN)
    return support & ndimage.binary_dilation(metal, iterations=AROUND) & ~inside


def split(part: Part, fine: Mask) -> list[Part]:
    """Return `part` without the voxels `fine` [z, y, x], which must not be none, and those on finer splats.

    Memory is at its peak here: a `part` that only the caller's expression knows is gone before its rest is made.
    """
    geometry, support, measured = part.geometry, part.lattice.support, part.measured
    curve, exact = part.curve, part.exact
    values, *curvature = map(part.lattice.scattered, (part.u, part.curvature[:, 0], part.curvature[:, 1]))
    del part
    rest = Lattice(geometry=geometry, support=support & ~fine)
    tissue = Part(geometry=geometry, lattice=rest, curve=curve, u=rest.gather(values), exact=exact)
    for channel in (0, 1):
        tissue.curvature[:, channel] = rest.gather(curvature[channel])
    tissue.measured = measured
    box = ndimage.find_objects(fine.astype(np.uint8))[0]
    finer = _finer(geometry, box)
    lattice = Lattice(geometry=finer, support=fine[box].repeat(FINER, 0).repeat(FINER, 1).repeat(FINER, 2))
    start = lattice.gather(refined(values[box], finer))
    metal = Part(geometry=finer, lattice=lattice, curve=curve, u=start, finer=FINER, exact=exact)
    return [tissue, metal]


def average(
    response: Response, rest: tuple[Image, Image], fine: Part, paths: Image, found: tuple[Image, Image, Image]
) -> Image:
    """Correct `found`, P and its derivatives, for one ray a pixel, in place where there is fine metal.

    `rest`, as the coarse part has them, and `paths`, as the fine part has them, are La and Lb, which add up. The
    derivatives by the sub-pixels' own are returned as `paths` is; those by `rest` are their sums.
    """
    own = [_sub_pixels(fine, paths[:, channel]) for channel in (0, 1)]
    met = own[0][0] != 0
    for one in own[0][1:]:
        met |= one != 0
    p, by_a, by_b = evaluate(
        response,
        *(np.stack([one[met] for one in a]) + b[..., :-WIDTH][met] for a, b in zip(own, rest, strict=True)),
    )
    least = p.min(0)
    shares = np.exp(least - p)
    total = shares.sum(0)
    shares /= total
    by_a *= shares
    by_b *= shares
    for image, values in zip(found, (least - np.log(total / len(p)), by_a.sum(0), by_b.sum(0)), strict=True):
        image[..., :-WIDTH][met] = values
    slopes = np.zeros_like(paths)
    for channel, values in enumerate((by_a, by_b)):
        for one, its_own in zip(_sub_pixels(fine, slopes[:, channel]), values, strict=True):
            one[met] = its_own
    return slopes


def _sub_pixels(fine: Part, image: Image) -> list[Image]:
    """View each sub-pixel of the pixels of an image: [view, …] without scratch."""
    blocks = fine.blocks(image)
    return [blocks[:, :, j, :, i] for j in range(FINER) for i in range(FINER)]


def _finer(geometry: Geometry, box: tuple[slice, ...]) -> Geometry:
    """Return the geometry of a box of voxels with finer voxels and pixels."""
    poses = geometry.pose_array()
    poses[:, 6:12] /= FINER
    sides = [s.stop - s.start for s in box]
    shift = [0.5 * (s.start + s.stop - n) * d for s, n, d in zip(box, geometry.n_voxel, geometry.d_voxel, strict=True)]
    return msgspec.structs.replace(
        geometry,
        n_voxel=tuple(FINER * n for n in sides),
        d_voxel=tuple(d / FINER for d in geometry.d_voxel),
        off_origin=tuple(o + s for o, s in zip(geometry.off_origin, shift, strict=True)),
        n_detector=tuple(FINER * n for n in geometry.n_detector),
        d_detector=tuple(d / FINER for d in geometry.d_detector),
        angles_deg=None,
        poses=tuple(tuple(row) for row in poses.tolist()),
    )
