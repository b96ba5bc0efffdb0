"""A CT volume from a file as a body: grey values become tissue and its density, metal is put into it."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.dataset.arrayfile import MOST
from ctsim.errors import InputError
from ctsim.geometry import Triple
from ctsim.materials import attenuation
from ctsim.phantoms.ct_file import Ct, cut_off, digest_of, read_hu, settle, without_metal
from ctsim.phantoms.fields import LabelGrid, Shape
from ctsim.phantoms.inserts import count, diameter, inserts
from ctsim.phantoms.recipe import REACH, Millimetres, Recipe, assemble
from ctsim.solids import Solid
from ctsim.types import Phantom

TISSUES = ("air", "lung", "adipose", "soft_tissue", "cortical_bone")
FROM_HU = (-900.0, -250.0, -20.0, 200.0)
"""The HU from which a voxel is the next of `TISSUES`."""
WIDEST = 4.0  # mm: in a cube of 60 mm and above an insert's diameter, for implants do not grow with the body
FEW, EACH = 2**24, 64
"""Places to interpolate at: always allowed, and of each of the file's voxels, 4³ where it is as large as a label."""
LEAST_METAL = 1000  # HU: the least metal_hu, for bone lies below
LENGTH = 3.0  # of an insert, in its diameters


class CtVolume(Recipe, frozen=True, kw_only=True, tag="ct_volume"):
    """A CT volume with metal capsules in its bone (Ti by default), two unless `n_inserts` or `at` say otherwise.

    Its middle becomes the middle of the cube of `size`. What lies beyond the object's reach is cut off.
    """

    by_layers: ClassVar[bool] = False  # the file is read and resampled as a whole

    path: str
    """A folder of DICOM slices, or a file: NIfTI, MetaImage, NRRD, a TIFF stack or .npy array [z, y, x], z upwards.

    A relative path begins at the scene file's folder, and in Python at the working directory."""
    spacing: tuple[Millimetres, Millimetres, Millimetres] | None = None
    """Size of its voxels (z, y, x) in mm; by default the file's. Needed for TIFF and .npy."""
    metal: str = "Ti"
    rescale: tuple[float, float] | None = None
    """Slope and intercept: a value v is v·slope + intercept HU. By default the file's, or 1 and 0; values
    without air are then refused."""
    kev: float = 70.0
    """The energy at which every voxel has the attenuation of its HU."""
    at: tuple[Triple, ...] = ()
    """Centres of the inserts (x, y, z) in mm from the middle; without, places in bone are drawn."""
    sha256: str = ""
    """The file's SHA-256, filled in where it is empty; another file is refused."""
    existing_metal: Literal["refuse", "mask", "none"] = "refuse"
    """What becomes of metal in the CT itself: the CT is refused, or tissue near the metal takes its place.
    "none" says that there is none: whatever is bright is bone."""
    metal_hu: float = 3000.0
    """A voxel above this many HU is metal of the CT; 1000 to 100000. A CT of 12 bits ends at 3071 HU."""

    def __post_init__(self) -> None:
        """Check the ranges; take the file's hash, so that the recipe says what is scanned."""
        Recipe.__post_init__(self)
        self.within("kev", 20, 200)
        if self.texture:
            raise InputError("texture: expected none, for a CT volume has a density of its own in every voxel")
        self.within("metal_hu", LEAST_METAL, 100_000)
        if self.existing_metal not in ("refuse", "mask", "none"):
            raise InputError(f'existing_metal must be "refuse", "mask" or "none", got {self.existing_metal!r}')
        if self.rescale is not None and not (np.isfinite(self.rescale).all() and self.rescale[0] > 0):
            raise InputError(f"rescale must be a positive slope and an intercept in HU, got {self.rescale}")
        if self.at and self.n_inserts not in (None, len(self.at)):
            raise InputError(f"n_inserts is {self.n_inserts}, but at has {len(self.at)} places; give one of them")
        if not np.isfinite(self.at).all():
            raise InputError(f"at must be finite places in mm, got {self.at}")
        if not self.sha256 or self.spacing is None or self.rescale is None:
            self._settle()

    def _settle(self) -> None:
        """Fill in what the file says, so that a scene says it, too."""
        settled = settle(self.path, self.spacing, self.rescale)
        said = {"spacing": settled.spacing, "rescale": settled.rescale, "path": str(Path(self.path).resolve())}
        for key, value in (said | {"sha256": self.sha256 or digest_of(settled.file)}).items():
            msgspec.structs.force_setattr(self, key, value)


def ct_volume(grid: LabelGrid, rng: np.random.Generator, params: CtVolume) -> Phantom:
    """Resample a CT volume linearly, split it by its HU into tissues of its own density, put metal into it.

    Raises InputError for a file that cannot be read, is none of a volume, or is not the recipe's.
    """
    ct = _read(params)
    labels, density = _tissues(_resampled(ct, grid), params.kev)
    return replace(assemble(labels, grid, TISSUES, _inserts(ct, params, grid.half_box, rng)), density=density)


def _read(params: CtVolume) -> Ct:
    """Return the file's volume in HU, its metal replaced. Raises InputError where it has some that is to be refused."""
    settled = settle(params.path, params.spacing, params.rescale)
    if (found := digest_of(settled.file)) != params.sha256:
        raise InputError(f"path: {params.path} has the SHA-256 {found}, the scene was made of {params.sha256}")
    ct = Ct(hu=read_hu(settled), spacing=settled.spacing)
    if params.existing_metal == "none":
        return ct
    cut = cut_off(ct.hu)
    if cut and cut[0] <= params.metal_hu:
        masked = f"metal_hu below {cut[0]:g} if it is metal" if cut[0] > LEAST_METAL else "a CT that is not cut off"
        raise InputError(
            f"path: {params.path} ends at {cut[0]:g} HU, with {cut[1]} voxels of that value in one piece, so metal may "
            f'be cut off there; expected existing_metal = "none" if it is bone, or {masked}'
        )
    number = int(np.count_nonzero(ct.hu > params.metal_hu))
    if params.existing_metal == "mask":
        return without_metal(ct, params.metal_hu)
    if number:
        raise InputError(
            f"path: {params.path} holds metal, {number} voxels above metal_hu = {params.metal_hu:g} HU (up to "
            f'{ct.hu.max():.0f}); expected a CT without, existing_metal = "mask", '
            + ('or existing_metal = "none" if it is bone' if cut else "or a higher metal_hu")
        )
    return ct


def _resampled(ct: Ct, grid: LabelGrid) -> NDArray[np.float32]:
    """Return mean HU over the voxels of the label grid, middle on middle; −1000 outside the volume.

    HU are interpolated at as many places in a voxel as it takes that none of the file's is passed over.
    """
    hu, spacing, n = ct.hu, ct.spacing, grid.n
    times = np.ceil(np.divide(grid.d_voxel, spacing) - 1e-9).astype(int)
    step = np.divide(grid.d_voxel, spacing) / times  # in the file's voxels, whose middles are whole numbers
    first = (0.5 - np.multiply(n, times) / 2 + np.multiply(grid.shift, times)) * step
    first += np.divide(hu.shape, 2) - 0.5
    low, high = _covered(n, times, first, step, hu.shape)
    fine = (high - low) * times
    places, most = math.prod(fine.tolist()), min(MOST, max(FEW, EACH * hu.size))
    if places > most:
        raise InputError(f"spacing: {spacing} mm makes {places} places of {hu.size} voxels, expected at most {most}")
    start: Any = first + low * times * step
    found = np.empty(fine, np.float32)
    ndimage.affine_transform(hu, step, start, output=found, order=1, mode="nearest")
    for axis, (count_fine, size) in enumerate(zip(fine, hu.shape, strict=True)):
        at = start[axis] + step[axis] * np.arange(count_fine)
        np.moveaxis(found, axis, 0)[(at < -0.5) | (at > size - 0.5)] = -1000
    blocks = found.reshape(np.stack([high - low, times], 1).reshape(-1)).mean((1, 3, 5), dtype=np.float32)
    out = np.full(n, -1000, np.float32)
    out[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = blocks
    return out


def _covered(
    n: Shape, times: NDArray[np.int_], first: NDArray[np.float64], step: NDArray[np.float64], shape: Shape
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return the first label voxel that the file covers, and the one after the last, along each axis."""
    ends = np.floor((np.array([[-0.5] * 3, np.subtract(shape, 0.5)]) - first) / step / times).astype(int)
    low = np.clip(ends[0], 0, np.subtract(n, 1))
    return low, np.clip(ends[1] + 1, low + 1, n)


def _tissues(hu: NDArray[np.float32], kev: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return labels and densities, relative to nominal, that have the attenuation of `hu` at `kev`."""
    labels = np.digitize(hu, FROM_HU).astype(np.uint8)
    water, *nominal = (float(attenuation(name, np.array([kev]))[0]) for name in ("water", *TISSUES[1:]))
    scale = np.array([0, *(water / mu for mu in nominal)], np.float32)
    density = np.maximum(1 + hu / np.float32(1000), 0) * scale[labels]
    return labels, np.where(labels, density, np.float32(1))


def _inserts(ct: Ct, params: CtVolume, unit: float, rng: np.random.Generator) -> list[Solid]:
    """Return capsules of random direction at the places that are given, or at random ones."""
    if not (n := count(params, len(params.at) or 2)):
        return []
    make, d = inserts(params, unit), diameter(params, min(WIDEST, WIDEST * 30 / unit), unit)
    limit = REACH * unit - LENGTH / 2 * d
    places = np.array(params.at) if params.at else _drawn(ct, params, limit, rng, n)
    if np.hypot(*places[:, :2].T).max() > limit or np.abs(places[:, 2]).max() > limit:
        raise InputError(
            f"at: inserts {LENGTH * d:.3g} mm long must be centred within {limit:.4g} mm of the axis and of the middle"
        )
    ways = rng.standard_normal((n, 3))
    ways *= LENGTH / 2 * d / np.linalg.norm(ways, axis=1, keepdims=True)
    ends = [((place - way) / unit, (place + way) / unit) for place, way in zip(places, ways, strict=True)]
    return [make.rod(f"insert{k}", *both, d, round_ends=True) for k, both in enumerate(ends)]


def _drawn(ct: Ct, params: CtVolume, limit: float, rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Draw n places (x, y, z) in mm from the file's own voxels, independent of the label grid: bone, or else tissue."""
    z, y, x = ((np.arange(k) + 0.5 - k / 2) * d for k, d in zip(ct.hu.shape, ct.spacing, strict=True))
    near = (np.abs(z)[:, None, None] <= limit) & (np.hypot(y[:, None], x) <= limit)
    for least in (FROM_HU[-1], FROM_HU[0]):
        if (found := np.flatnonzero((ct.hu >= least) & near)).size:
            k, j, i = np.unravel_index(rng.choice(found, n, replace=n > found.size), ct.hu.shape)
            return np.stack([x[i], y[j], z[k]], 1)
    raise InputError(
        f"path: {params.path} has no voxel above {FROM_HU[0]:g} HU within {limit:.4g} mm; is rescale right?"
    )
