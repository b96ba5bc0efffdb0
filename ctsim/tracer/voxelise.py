"""A phantom on the reconstruction grid: material fractions, labels, metal mask and attenuation.

The body's labels are averaged by volume (box overlap; exact where the grids coincide, air outside the
phantom). Solids are painted over by their volume fraction, later ones covering earlier ones. Voxels that
no surface can cross are exact; the others are cut into about 8³ sub-cells whose coverage is linear in the
distance to the surface: measured error at most 1/250 of a voxel (rms over surface voxels 1/1600). Where
the body itself changes within a voxel that a solid crosses, the uncovered part counts with its mean.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.solids import MATERIAL, PRIMITIVE_COLUMNS, pack
from ctsim.tracer.kernels import voxelise_cpu
from ctsim.types import Phantom

_CELLS = 8
_MAX_CELLS = 24


@dataclass(frozen=True, slots=True)
class Cover:
    """Share of the voxels `index` (flat) that each (material index, metal) is seen in, [k, channel]."""

    channels: tuple[tuple[int, bool], ...]
    index: NDArray[np.int64]
    share: NDArray[np.float32]

    def paint(self, volume: NDArray[np.float32], values: NDArray[np.float64]) -> None:
        """Replace, in place, the covered share of a mean `volume` by values[material]."""
        flat = volume.reshape(-1)
        rest = 1 - self.share.sum(1, dtype=np.float32)
        weights = np.array([values[material] for material, _ in self.channels], np.float32)
        flat[self.index] = flat[self.index] * np.maximum(rest, 0) + self.share @ weights


def fractions(phantom: Phantom, geometry: Geometry) -> dict[str, NDArray[np.float32]]:
    """Return the share of each voxel that each material fills, float32 [z, y, x] by material.

    Shares of the body are multiplied by its relative density where it has one (not air's, which is
    the plain volume share); solids have density 1.
    """
    cover = cover_of(phantom, geometry)
    return {name: _fraction(phantom, geometry, cover, k, phantom.density) for k, name in enumerate(phantom.materials)}


def attenuation_volume(phantom: Phantom, geometry: Geometry, mu: Mapping[str, float]) -> NDArray[np.float32]:
    """Return the attenuation Σ fraction·density·mu in 1/mm, float32 [z, y, x].

    `mu` gives 1/mm by material name; air counts as 0. Raises InputError when a material is missing.
    """
    return painted(body_attenuation(phantom, geometry, mu), phantom, mu, cover_of(phantom, geometry))


def body_attenuation(phantom: Phantom, geometry: Geometry, mu: Mapping[str, float]) -> NDArray[np.float32]:
    """Return what `attenuation_volume` does of the phantom without its solids."""
    return _body(phantom, geometry, _values(phantom, mu), phantom.density)


def painted(body: NDArray[np.float32], phantom: Phantom, mu: Mapping[str, float], cover: Cover) -> NDArray[np.float32]:
    """Paint the phantom's solids over a volume of `body_attenuation`, in place, and return it."""
    cover.paint(body, _values(phantom, mu))
    return body


def _values(phantom: Phantom, mu: Mapping[str, float]) -> NDArray[np.float64]:
    missing = [name for name in phantom.materials[1:] if name not in mu]
    if missing:
        raise InputError(f"mu must name every material of the phantom; missing: {', '.join(missing)}")
    return np.array([0.0, *(mu[name] for name in phantom.materials[1:])])


def label_volume(
    phantom: Phantom, geometry: Geometry, cover: Cover | None = None, body: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Return the index in `phantom.materials` that fills most of each voxel (the lowest of equals), uint8.

    `cover` is that of `cover_of` and `body` what `body_labels` returned, where they are known; `body` is overwritten.
    """
    cover = cover or cover_of(phantom, geometry)
    labels = body_labels(phantom, geometry) if body is None else body
    shares = np.zeros((len(cover.index), len(phantom.materials)), np.float32)
    voxelise_cpu.shares_at(phantom.labels, *_overlaps(phantom, geometry), geometry.n_voxel, cover.index, shares)
    shares *= np.maximum(1 - cover.share.sum(1, dtype=np.float32), 0)[:, None]
    for channel, (material, _) in enumerate(cover.channels):
        shares[:, material] += cover.share[:, channel]
    labels.reshape(-1)[cover.index] = shares.argmax(1)
    return labels


def body_labels(phantom: Phantom, geometry: Geometry) -> NDArray[np.uint8]:
    """Return what `label_volume` does of the phantom without its solids."""
    labels = np.empty(geometry.n_voxel, np.uint8)
    voxelise_cpu.dominant(phantom.labels, len(phantom.materials), *_overlaps(phantom, geometry), labels)
    return labels


def metal_mask(phantom: Phantom, geometry: Geometry, cover: Cover | None = None) -> NDArray[np.uint8]:
    """Return 1 where solids marked as metal fill at least half of the voxel, else 0; uint8 [z, y, x].

    `cover` is that of `cover_of`, where it is known.
    """
    cover = cover or cover_of(phantom, geometry)
    mask = np.zeros(geometry.n_voxel, np.uint8)
    metal = [metal for _, metal in cover.channels]
    mask.reshape(-1)[cover.index] = cover.share[:, metal].sum(1) >= 0.5 - 1e-5
    return mask


def _fraction(
    phantom: Phantom, geometry: Geometry, cover: Cover, material: int, density: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    one = np.zeros(len(phantom.materials))
    one[material] = 1
    if material == 0:  # air is what the other materials leave, outside the phantom too
        volume = _body(phantom, geometry, 1 - one, None)
        np.subtract(1, volume, out=volume)
        np.clip(volume, 0, 1, out=volume)
    else:
        volume = _body(phantom, geometry, one, density)
    cover.paint(volume, one)
    return volume


def _body(
    phantom: Phantom, geometry: Geometry, values: NDArray[np.float64], density: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """Mean of values[label]·density over each voxel of the grid; 0 outside the phantom."""
    out = np.empty(geometry.n_voxel, np.float32)
    relative = np.empty((0, 0, 0), np.float32) if density is None else density
    voxelise_cpu.average(phantom.labels, relative, values, *_overlaps(phantom, geometry), out)
    return out


def _overlaps(phantom: Phantom, geometry: Geometry) -> tuple[Any, Any, Any]:
    """Return what `_overlap` does for the three axes: first voxels, shares and numbers."""
    first, weights, counts = zip(*(_overlap(phantom, geometry, axis) for axis in range(3)), strict=True)
    return first, weights, counts


def _overlap(
    phantom: Phantom, geometry: Geometry, axis: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """First source voxel, shares [target, k] and number of source voxels under each target voxel."""
    n_in, d_in = phantom.labels.shape[axis], phantom.d_voxel[axis]
    n, d = geometry.n_voxel[axis], geometry.d_voxel[axis]
    origin = phantom.off_origin[axis] - n_in * d_in / 2
    edges = (geometry.off_origin[axis] - n * d / 2 + np.arange(n + 1) * d - origin) / d_in
    near = np.round(edges)
    edges = np.where(np.abs(edges - near) < 1e-9 * max(n_in, n), near, edges)  # grids that coincide stay exact
    low, high = np.clip(edges[:-1], 0, n_in), np.clip(edges[1:], 0, n_in)
    first, last = np.floor(low).astype(np.int64), np.ceil(high).astype(np.int64)
    counts = np.maximum(last - first, 0)
    at = first[:, None] + np.arange(max(int(counts.max()), 1))
    weights = np.minimum(at + 1, high[:, None]) - np.maximum(at, low[:, None])
    return first, np.maximum(weights, 0) * (d_in / d), counts


def metal_planes(phantom: Phantom, geometry: Geometry) -> NDArray[np.bool_]:
    """Return in which planes along z `metal_mask` holds metal; a plane is sampled up to its first voxel of it."""
    return np.any(metal_mask(phantom, geometry, cover_of(phantom, geometry, until_metal=True)), axis=(1, 2))


def cover_of(phantom: Phantom, geometry: Geometry, *, until_metal: bool = False) -> Cover:
    """Sample all solids on the grid; serves every volume of the same phantom and grid.

    With `until_metal` each plane along z is sampled up to its first voxel of which metal fills half: it serves
    `metal_planes` alone.
    """
    channels = sorted({(phantom.materials.index(s.material), s.metal) for s in phantom.solids})
    rows, of = [np.zeros((0, PRIMITIVE_COLUMNS))], [np.zeros(0, np.int64)]
    for solid in phantom.solids:
        packed = pack([solid], phantom.materials)
        channel = channels.index((phantom.materials.index(solid.material), solid.metal))
        packed[:, MATERIAL] = channel
        rows.append(packed)
        of.append(np.full(len(packed), channel, np.int64))
    prims, channel_of = np.concatenate(rows), np.concatenate(of)
    start, pitch = np.array([c[0] for c in geometry.voxel_centres()]), np.array(geometry.d_voxel, np.float64)
    nz, ny, nx = geometry.n_voxel
    if len(prims) == 0:
        return Cover(tuple(channels), np.zeros(0, np.int64), np.zeros((0, len(channels)), np.float32))
    touched = np.zeros(geometry.n_voxel, np.uint8)
    voxelise_cpu.mark(prims, start, pitch, touched)
    index = np.flatnonzero(touched)
    del touched
    first = np.searchsorted(index, np.arange(nz + 1) * (ny * nx))
    mean = math.prod(geometry.d_voxel) ** (1 / 3)
    z, y, x = (min(max(round(_CELLS * d / mean), 1), _MAX_CELLS) for d in geometry.d_voxel)
    share = np.zeros((len(index), len(channels)), np.float32)
    sought = np.array([until_metal and metal for _, metal in channels])
    voxelise_cpu.cover(prims, channel_of, start, pitch, (z, y, x), (nz, ny, nx), index, first, sought, share)
    return Cover(tuple(channels), index, share)
