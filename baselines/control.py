"""Controls: volumes that no correction made, for a reader to hold the methods against.

`zero` and `hull` say what a score is worth without any picture of the inside. `twin_fdk` says what FDK has where the
metal never was. None of them is a method, so tables never rank them.
"""

import math

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.reconstruct.fdk import Settings as Fdk
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.log import NO_SIGNAL, LineIntegrals, is_blind
from ctsim.reconstruct.projector import adjoint_columns, forward_columns
from ctsim.reconstruct.settings import keywords
from ctsim.types import Scan, Status, Volume

FAINTEST = 0.02  # P of a millimetre of water: the least that counts as shadow
SIGMAS = 5.0  # of photon noise of an open pixel, above which a pixel is in the shadow
OPEN = 0.03
"""How much of the length of rays through a voxel of the hull may be open: a voxel of side h whose centre is on the edge
of a round body of radius R has (2/π)(2/3)(1/2)√(h/R), 0.05 to 0.03 for radii of 20 to 60 voxels."""
CHUNK = 16  # views at a time
Array = NDArray[np.float32]


class Nothing(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Nothing to set."""


@keywords(Nothing)
def zero(scan: Scan, settings: Nothing) -> Volume:
    """Return a volume of zeros."""
    return Volume(values=torch.zeros(scan.geometry.n_voxel), details={"view_updates": 0})


@keywords(Nothing)
def hull(scan: Scan, settings: Nothing) -> Volume:
    """Return one attenuation, in 1/mm, in the hull of the object's shadows and 0 outside.

    A pixel is in the shadow where P is above five standard deviations of an open pixel's photon noise and above 0.02,
    or where nothing was seen. A voxel is in the hull if rays meet it, of whose length in it at most `OPEN` is open.
    The attenuation is the one whose line integrals through the hull fit P best by least squares over all pixels that
    saw something: near that of water for a body that is mostly water.
    Details hold "attenuation" and "voxels", the number of voxels in the hull.
    """
    geometry, logarithm = scan.geometry, LineIntegrals(scan)
    faintest = max(FAINTEST, SIGMAS / math.sqrt(scan.i0))
    n_z, n_y, n_x = geometry.n_voxel
    open_length, dark_length = np.zeros((n_y, n_x, n_z), np.float32), np.zeros((n_y, n_x, n_z), np.float32)
    clamped = 0
    for views in _chunks(geometry.n_views):
        p, unseen = logarithm.of(views)
        clamped += int(unseen.sum())
        shadow = (p > faintest) | unseen
        dark_length += adjoint_columns(shadow.astype(np.float32), geometry, views)
        open_length += adjoint_columns((~shadow).astype(np.float32), geometry, views)
    inside = (dark_length > 0) & (open_length <= OPEN * (open_length + dark_length))
    if is_blind(scan, clamped):
        return Volume(values=torch.zeros(geometry.n_voxel), status=Status.ERROR, reason=NO_SIGNAL)
    attenuation = _least_squares(inside.astype(np.float32), logarithm, scan)
    values = np.where(inside, np.float32(attenuation), np.float32(0)).transpose(2, 0, 1)
    details: dict[str, object] = {
        "attenuation": attenuation,
        "voxels": int(inside.sum()),
        "clamped_pixels": clamped,
        "view_updates": 3 * geometry.n_views,
    }
    if not inside.any():
        details["limitation"] = "no voxel is in the shadow of every view: the volume is empty"
    return Volume(values=torch.from_numpy(np.ascontiguousarray(values)), details=details)


def _least_squares(inside: Array, logarithm: LineIntegrals, scan: Scan) -> float:
    """Return the attenuation that minimises Σ (P − attenuation · length)², lengths through the hull [y, x, z] in mm."""
    along, square = 0.0, 0.0
    for views in _chunks(scan.geometry.n_views):
        p, unseen = logarithm.of(views)
        lengths = forward_columns(inside, scan.geometry, views).astype(np.float64)
        lengths[unseen] = 0.0
        along += float((lengths * p).sum())
        square += float((lengths**2).sum())
    return along / square if square > 0 else 0.0


def _chunks(n_views: int) -> list[slice]:
    return [slice(first, min(first + CHUNK, n_views)) for first in range(0, n_views, CHUNK)]


@keywords(Fdk)
def twin_fdk(scan: Scan, settings: Fdk) -> Volume:
    """Reconstruct by FDK; the benchmark hands this row the metal-free twin in place of the scan."""
    return fdk(scan, settings)
