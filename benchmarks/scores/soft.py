"""The protocol `soft`: what is left of soft tissue, in HU: error, bias, contrast, noise and sharpness.

HU = 1000·(μ/μ_water − 1) under the scan's effective spectrum. Volumes are [z, y, x] in 1/mm, distances are mm.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.artefact import MIN_VOXELS, distance_to_metal
from ctsim.benchmarks.scores.metrics import Mask
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import COLUMNS, Score

SOFT_HU = 300.0
"""A material is soft tissue if the median of its reference is within this of water."""
RANGE_HU = 1000.0
"""Data range: from −500 to 500 HU."""
LEAST_CONTRAST = 50.0
NEAR_EDGE = 10.0
"""A cube whose centre is at most this far from metal (mm) is near it."""
CUBE, STRIDE = 12, 6
MOST_CUBES = 2000
LEAST_CUBES = 8
HIGH_PASS = 5
"""Noise is what is left of an error without its mean over a cube of this edge (voxels)."""
LEAST_GAIN = 0.1
REGION = "soft tissue inside the body, outside the metal dilated by 2 voxels"
NO_HU = "no HU: the scan comes without spectrum.csv"
NO_SOFT = f"no material of the labels is within {SOFT_HU:g} HU of water"


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftLayout:
    """Where soft tissue is judged in a scan. Masks are [z, y, x].

    `region` holds all voxels of soft classes, `classes` each class's own; `even` those whose 26 neighbours are of the
    same class, and `wide` those whose neighbours within 2 voxels are. `pair` names two classes to tell apart. The
    `reference` is in HU. `near` is up to 5 mm from the metal. `cubes` are corners of cubes with structure, near metal
    and far.
    """

    water: float
    reference: NDArray[np.float64]
    region: Mask
    classes: dict[str, Mask]
    even: dict[str, Mask]
    wide: Mask
    near: Mask
    pair: tuple[str, str] | None
    cubes: dict[str, NDArray[np.int64]]
    pitch: float
    note: str


def soft_layout(
    labels: NDArray[Any], truth: Truth, materials: tuple[str, ...], water: float | None
) -> SoftLayout | str:
    """Choose where a scan's soft tissue is judged; a sentence where there is none or no HU."""
    if not water:
        return NO_HU
    reference = (truth.references["effective"].astype(np.float64) / water - 1) * 1000
    classes: dict[str, Mask] = {}
    for label in np.unique(labels[truth.body & truth.tissue]):
        mask = (labels == label) & truth.tissue
        if label and abs(float(np.median(reference[mask]))) <= SOFT_HU:
            classes[materials[label] if label < len(materials) else f"label {label}"] = mask
    if not classes:
        return NO_SOFT
    even = {name: _within(labels, mask, 1) for name, mask in classes.items()}
    wide = np.zeros_like(truth.tissue)
    for mask in classes.values():
        wide |= _within(labels, mask, HIGH_PASS // 2)
    distance = distance_to_metal(truth)
    pair = _pair(reference, even)
    told = "no two classes to tell apart" if pair is None else f"contrast of {pair[0]} and {pair[1]}"
    region = np.logical_or.reduce(list(classes.values()))
    return SoftLayout(
        water=water,
        reference=reference,
        region=region,
        classes=classes,
        even=even,
        wide=wide,
        near=distance <= 5.0 * (1 + 1e-9),
        pair=pair,
        cubes=_cubes(reference, truth, distance),
        pitch=float(np.prod(truth.d_voxel) ** (1 / 3)),
        note=f"soft tissue: {', '.join(classes)}; {told}; water {water:.5g} 1/mm",
    )


def _within(labels: NDArray[Any], mask: Mask, reach: int) -> Mask:
    """Return the voxels of a class whose neighbours within `reach` voxels, diagonals included, have its label."""
    size = 2 * reach + 1
    return mask & (ndimage.minimum_filter(labels, size) == ndimage.maximum_filter(labels, size))


def _pair(reference: NDArray[np.float64], even: dict[str, Mask]) -> tuple[str, str] | None:
    """Return the two classes that differ by 50 HU or more whose smaller one is largest; None if there are none."""
    means = {name: float(reference[mask].mean()) for name, mask in even.items() if mask.sum() >= MIN_VOXELS}
    found = [
        (min(int(even[a].sum()), int(even[b].sum())), (a, b))
        for a in means
        for b in means
        if means[a] - means[b] >= LEAST_CONTRAST
    ]
    return max(found)[1] if found else None


def _cubes(reference: NDArray[np.float64], truth: Truth, distance: NDArray[np.float64]) -> dict[str, NDArray[np.int64]]:
    """Return corners [n, 3] of cubes within the judged tissue that hold an edge, near the metal and far from it."""
    if min(truth.tissue.shape) < CUBE:
        return {"near": np.zeros((0, 3), np.int64), "far": np.zeros((0, 3), np.int64)}
    starts = [np.arange(0, n - CUBE + 1, STRIDE) for n in truth.tissue.shape]
    corners = np.stack(np.meshgrid(*starts, indexing="ij"), -1).reshape(-1, 3)
    kept = [c for c in corners if truth.tissue[_box(c)].all() and np.ptp(reference[_box(c)]) >= LEAST_CONTRAST]
    found = np.array(kept, np.int64).reshape(-1, 3)
    middle = distance[tuple((found + CUBE // 2).T)] if len(found) else np.zeros(0)
    near = middle <= NEAR_EDGE
    return {
        name: part[:: max(1, len(part) // MOST_CUBES)] for name, part in (("near", found[near]), ("far", found[~near]))
    }


def _box(corner: NDArray[np.int64]) -> tuple[slice, ...]:
    return tuple(slice(int(c), int(c) + CUBE) for c in corner)


def soft_score(values: NDArray[Any], layout: SoftLayout | str) -> Score:
    """Score the soft tissue of a volume; all None with the reason where the layout is a sentence."""
    if isinstance(layout, str):
        return Score.none(REGION, COLUMNS["soft"], layout)
    hu = (values.astype(np.float64) / layout.water - 1) * 1000
    error = hu - layout.reference
    mse = float(np.mean(error[layout.region] ** 2))
    found: dict[str, float | None] = {
        "psnr3d": metrics.psnr(mse, RANGE_HU),
        "ssim3d": metrics.ssim3d(hu, layout.reference, data_range=RANGE_HU, region=layout.region),
        "rmse": math.sqrt(mse),
        **_told_apart(hu, error, layout),
        **_noise(error, layout),
        **{f"mtf50_{where}": mtf50(hu, layout.reference, c, layout.pitch) for where, c in layout.cubes.items()},
    }
    for name, mask in layout.classes.items():
        even = layout.even[name]
        found[f"bias:{name}"] = float(error[even].mean()) if even.any() else None
        found[f"rmse:{name}"] = math.sqrt(float(np.mean(error[mask] ** 2)))
    return Score(
        region=REGION,
        reference="effective spectrum, in HU",
        alignment="none; data range 1000 HU (−500 to 500)",
        data_range=None,
        n_voxels=int(layout.region.sum()),
        values=found,
        identical=mse == 0,
        note=layout.note,
    )


def _told_apart(hu: NDArray[np.float64], error: NDArray[np.float64], layout: SoftLayout) -> dict[str, float | None]:
    """Return how much of the contrast of two classes is left, and the contrast over the error's deviation in them."""
    if layout.pair is None:
        return {"contrast": None, "cnr": None}
    a, b = (layout.even[name] for name in layout.pair)
    found, true = (float(image[a].mean() - image[b].mean()) for image in (hu, layout.reference))
    deviation = math.sqrt((float(error[a].var()) + float(error[b].var())) / 2)
    return {"contrast": found / true, "cnr": abs(found) / deviation if deviation else None}


def _noise(error: NDArray[np.float64], layout: SoftLayout) -> dict[str, float | None]:
    """Return the noise in HU near the metal and far from it, and its correlation at a distance of one voxel.

    Noise is the error without its mean over 5³ voxels, where all of these are of one class; white noise of σ has σ and
    a correlation of 0. The correlation is the mean of the cosine over the noise power spectrum (Wiener–Khinchin).
    """
    n = HIGH_PASS**3
    local = error - ndimage.uniform_filter(error, HIGH_PASS)
    found: dict[str, float | None] = {}
    for where, mask in (("near", layout.wide & layout.near), ("far", layout.wide & ~layout.near)):
        enough = int(mask.sum()) >= MIN_VOXELS
        variance = float(np.mean(local[mask] ** 2)) * n / (n - 1) if enough else None
        found[f"noise_{where}"] = None if variance is None else math.sqrt(variance)
        found[f"grain_{where}"] = _correlation(local, mask) if variance else None
    return found


def _correlation(local: NDArray[np.float64], mask: Mask) -> float | None:
    """Return the correlation of neighbours along the axes; that of white noise without its local mean is added."""
    n = HIGH_PASS**3
    products, squares = [], []
    for axis in range(3):
        first, second = (np.take(mask, range(k, mask.shape[axis] - 1 + k), axis) for k in (0, 1))
        a, b = (np.take(local, range(k, mask.shape[axis] - 1 + k), axis)[first & second] for k in (0, 1))
        products.append(a * b)
        squares.append((a * a + b * b) / 2)
    product, square = (float(np.mean(np.concatenate(x))) if sum(map(len, x)) else 0.0 for x in (products, squares))
    # white noise of variance 1: each mean is of 125 voxels, those of neighbours share 100, so the product is
    # −2/125 + 100/125² and the square 1 − 1/125
    white = (-2 / n + (n - HIGH_PASS**2) / n**2) / (1 - 1 / n)
    return (product / square - white) / (1 - white) if square else None


def mtf50(
    hu: NDArray[np.float64], reference: NDArray[np.float64], corners: NDArray[np.int64], pitch: float
) -> float | None:
    """Return the frequency (1/mm) at which half of the reference's modulation is left, over cubes with structure.

    The transfer is the cross spectrum of volume and reference over the reference's power (Hann windows, means removed,
    bins of radial frequency as wide as a cube's), so noise and the reference's own voxels do not count. It is compared
    with its lowest bin; None where there are too few cubes or too little of the structure is left, the highest full
    frequency of the grid where more than half is left everywhere.
    """
    if len(corners) < LEAST_CUBES:
        return None
    taper = np.hanning(CUBE + 2)[1:-1]
    window = taper[:, None, None] * taper[:, None] * taper
    cross, power = np.zeros((CUBE,) * 3), np.zeros((CUBE,) * 3)
    for corner in corners:
        box = _box(corner)
        v, r = (np.fft.fftn((image[box] - _mean(image[box], window)) * window) for image in (hu, reference))
        cross += (v * r.conj()).real
        power += np.abs(r) ** 2
    f = np.fft.fftfreq(CUBE)
    radius = np.sqrt(f[:, None, None] ** 2 + f[:, None] ** 2 + f**2) * CUBE
    rings = [(radius >= k - 0.5) & (radius < k + 0.5) for k in range(1, CUBE // 2 + 1)]
    where = np.array([float(np.average(radius[ring], weights=power[ring])) for ring in rings]) / (CUBE * pitch)
    gain = np.array([cross[ring].sum() / power[ring].sum() for ring in rings])
    if gain[0] < LEAST_GAIN:
        return None
    gain = gain / gain[0]
    below = np.flatnonzero(gain < 0.5)
    if not below.size:
        return float(where[-1])
    k = int(below[0])
    share = (gain[k - 1] - 0.5) / (gain[k - 1] - gain[k])
    return float(where[k - 1] + share * (where[k] - where[k - 1]))


def _mean(part: NDArray[np.float64], window: NDArray[np.float64]) -> float:
    return float(np.vdot(part, window) / window.sum())
