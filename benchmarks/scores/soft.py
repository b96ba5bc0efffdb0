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
from ctsim.benchmarks.scores.artefact import MIN_VOXELS, distance_to_metal, is_near
from ctsim.benchmarks.scores.metrics import Mask, dilate, erode
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import COLUMNS, Score

SOFT_HU = 300.0
"""A material is soft tissue if the median of its reference is within this of water."""
AIR_HU = -900.0
RANGE_HU = 1000.0
"""Data range: from −500 to 500 HU."""
LEAST_CONTRAST = 50.0
NEAR_EDGE = 10.0
CUBE, STRIDE = 12, 6
"""A cube whose centre is at most `NEAR_EDGE` mm or `CUBE` voxels, the greater, from metal is near it: of large voxels
hardly a cube of tissue fits in between."""
MOST_CUBES = 400
LEAST_CUBES = 8
LEAST_LIKENESS = 0.05
DENSEST = 2000.0
SIGMAS = np.array([0.37, 0.45, 0.525, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0, 2.4, 2.8, 3.3, 4.0])
"""Blurs that are tried (σ in voxels); half of the modulation is left by the first at the grid's highest frequency."""
FINE = 5
"""What a cube of this edge (voxels) does not fit into is a fine structure, such as a vessel."""
LEAST_POWER = 1e6
"""HU², summed over fine structures: white noise of 100 HU changes the share that is left by 100/√power, here 0.1."""
AROUND = 9
"""The contrast of a fine structure is against the mean over a cube of this edge."""
LEAST_DEVIATION = 0.01
"""HU: below it, as in a volume of one value, a deviation is rounding, and a contrast over it says nothing."""
HIGH_PASS = 5
"""Noise is what is left of an error without its mean over a cube of this edge (voxels)."""
REGION = "soft tissue inside the body, outside the metal dilated by 2 voxels"
NO_HU = "no HU: the scan comes without spectrum.csv"
NO_SOFT = f"no material of the labels is within {SOFT_HU:g} HU of water"


@dataclass(frozen=True, slots=True, kw_only=True)
class Edges:
    """Cubes of a reference with an edge in them: their `corners` [n, 3], and what each is like `blurred` by a Gaussian.

    `blurred` is [σ, n, voxel] in HU, without each cube's mean.
    """

    corners: NDArray[np.int64]
    blurred: NDArray[np.float32]

    @classmethod
    def of(cls, reference: NDArray[np.float64], corners: NDArray[np.int64]) -> "Edges":
        """Blur a reference [z, y, x] in HU; what is denser than bone would outshine the tissue, so it is cut there."""
        cut = np.clip(reference, -1000, DENSEST)
        blurred = [_cubes_of(ndimage.gaussian_filter(cut, sigma), corners) for sigma in SIGMAS if len(corners)]
        return cls(corners=corners, blurred=np.array(blurred, np.float32))


def _cubes_of(volume: NDArray[np.float64], corners: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the cubes [n, voxel] of a volume at their corners, without their means."""
    found = np.lib.stride_tricks.sliding_window_view(volume, (CUBE,) * 3)[tuple(corners.T)].reshape(len(corners), -1)
    return found - found.mean(1, keepdims=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftLayout:
    """Where soft tissue is judged in a scan. Masks are [z, y, x].

    `region` holds all voxels of soft classes, `classes` each class's own; `even` those whose 26 neighbours are of the
    same class, and `wide` those whose neighbours within 2 voxels are, and are judged. `pair` names two classes to tell
    apart. `fine` holds fine structures and what is up to 2 voxels from them, away from bone and air. The `reference` is
    in HU. `near` is what `is_near` calls so. `edges` are cubes with structure, "near" metal and "far".
    """

    water: float
    reference: NDArray[np.float64]
    region: Mask
    classes: dict[str, Mask]
    even: dict[str, Mask]
    wide: Mask
    near: Mask
    pair: tuple[str, str] | None
    fine: Mask
    edges: dict[str, Edges]
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
    wide &= erode(truth.tissue, HIGH_PASS // 2)  # errors of the metal's edge next to it are no noise
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
        near=is_near(distance, truth.d_voxel),
        pair=pair,
        fine=_fine(reference, truth, classes),
        edges=_edges(reference, truth, distance),
        pitch=_pitch(truth),
        note=f"soft tissue: {', '.join(classes)}; {told}; water {water:.5g} 1/mm",
    )


def _pitch(truth: Truth) -> float:
    return float(np.prod(truth.d_voxel) ** (1 / 3))


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


def _fine(reference: NDArray[np.float64], truth: Truth, classes: dict[str, Mask]) -> Mask:
    """Return the fine structures of the classes and their surroundings, without what touches bone, metal or air.

    Partial volumes with bone or air have far more contrast than a vessel; they would decide the score.
    """
    found = np.zeros_like(truth.tissue)
    for mask in classes.values():
        found |= mask & np.logical_not(ndimage.binary_opening(mask, np.ones((FINE,) * 3, np.bool_)))
    strong: Mask = (reference > SOFT_HU) | (reference < AIR_HU) | ~truth.body
    away = truth.tissue & ~dilate(strong, 2)
    return dilate(found & away, 2) & away


def _edges(reference: NDArray[np.float64], truth: Truth, distance: NDArray[np.float64]) -> dict[str, Edges]:
    """Return the cubes within the judged tissue that hold an edge, those near the metal and those far from it."""
    if min(truth.tissue.shape) < CUBE:
        return {where: Edges.of(reference, np.zeros((0, 3), np.int64)) for where in ("near", "far")}
    starts = [np.arange(0, n - CUBE + 1, STRIDE) for n in truth.tissue.shape]
    corners = np.stack(np.meshgrid(*starts, indexing="ij"), -1).reshape(-1, 3)
    boxes = (tuple(slice(int(c), int(c) + CUBE) for c in corner) for corner in corners)
    kept = [truth.tissue[box].all() and np.ptp(reference[box]) >= LEAST_CONTRAST for box in boxes]
    found = corners[np.array(kept, np.bool_)]
    near = distance[tuple((found + CUBE // 2).T)] <= max(NEAR_EDGE, CUBE * _pitch(truth))
    return {
        where: Edges.of(reference, part[:: max(1, -(-len(part) // MOST_CUBES))])
        for where, part in (("near", found[near]), ("far", found[~near]))
    }


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
        **_fine_structures(hu, layout),
        **_noise(error, layout),
        **{f"mtf50_{where}": mtf50(hu, edges, layout.pitch) for where, edges in layout.edges.items()},
    }
    for name, mask in layout.classes.items():
        even = layout.even[name]
        found[f"bias:{name}"] = float(error[even].mean()) if even.any() else None
        found[f"rmse:{name}"] = math.sqrt(float(np.mean(error[mask] ** 2)))
    found |= {f"worst_{what}": _greatest(found, f"{what}:") for what in ("bias", "rmse")}
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


def _greatest(found: dict[str, float | None], start: str) -> float | None:
    """Return the value of greatest magnitude among those whose name starts so."""
    values = [value for name, value in found.items() if name.startswith(start) and value is not None]
    return max(values, key=abs) if values else None


def _told_apart(hu: NDArray[np.float64], error: NDArray[np.float64], layout: SoftLayout) -> dict[str, float | None]:
    """Return how much of the contrast of two classes is left, and that contrast over the error's deviation in them.

    Both are negative where the darker class reads as the brighter one.
    """
    if layout.pair is None:
        return {"contrast": None, "cnr": None}
    a, b = (layout.even[name] for name in layout.pair)
    found, true = (float(image[a].mean() - image[b].mean()) for image in (hu, layout.reference))
    deviation = math.sqrt((float(error[a].var()) + float(error[b].var())) / 2)
    return {"contrast": found / true, "cnr": found / deviation if deviation > LEAST_DEVIATION else None}


def _fine_structures(hu: NDArray[np.float64], layout: SoftLayout) -> dict[str, float | None]:
    """Return how much of the contrast of fine structures is left, and that contrast over what does not belong to it.

    Contrast is the deviation from the mean over 9³ voxels, of those in `layout.fine`. The share left is its regression
    on the reference's; 0 is nothing, 1 is all. The RMS of the contrast left over that of the residual is the CNR, with
    the sign of the share.
    """
    none: dict[str, float | None] = {"fine_contrast": None, "fine_cnr": None}
    if not layout.fine.any():
        return {**none}
    weight = ndimage.uniform_filter(layout.fine.astype(np.float64), AROUND)[layout.fine]
    found, true = (
        image[layout.fine] - ndimage.uniform_filter(np.where(layout.fine, image, 0), AROUND)[layout.fine] / weight
        for image in (hu, layout.reference)
    )
    power = float(true @ true)
    if power < LEAST_POWER:
        return {**none}
    left = float(found @ true) / power
    residual = math.sqrt(float(np.mean((found - left * true) ** 2)))
    rms = math.sqrt(power / len(true))
    return {"fine_contrast": left, "fine_cnr": left * rms / residual if residual > LEAST_DEVIATION else None}


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


def mtf50(hu: NDArray[np.float64], edges: Edges, pitch: float) -> float | None:
    """Return the frequency (1/mm) at which half of the modulation is left, by the blur that explains the cubes best.

    It is that of the Gaussian whose blur of the reference is most like the volume over all cubes: neither noise, nor an
    offset of a cube, nor lost contrast changes it. At most the highest frequency of the grid, 1/(2·pitch); None
    where there are too few cubes, or where the volume holds next to nothing of the reference.
    """
    if len(edges.corners) < LEAST_CUBES:
        return None
    found = _cubes_of(hu, edges.corners).ravel()
    blurred = edges.blurred.reshape(len(SIGMAS), -1).astype(np.float64)
    along, power = blurred @ found, np.sum(blurred**2, 1)
    likeness = along / np.sqrt(power)
    least = LEAST_LIKENESS * math.sqrt(float(found @ found))
    k = int(likeness.argmax())
    if not likeness[k] > least:
        return None
    best, square = float(likeness[k]), float(SIGMAS[k] ** 2)
    for j in (k - 1, k):
        if 0 <= j < len(SIGMAS) - 1:
            shared = float(blurred[j] @ blurred[j + 1])
            share = _share(along[j], along[j + 1], power[j], power[j + 1], shared)
            mixed = (1 - share) * along[j] + share * along[j + 1]
            norm = (1 - share) ** 2 * power[j] + share**2 * power[j + 1] + 2 * share * (1 - share) * shared
            if mixed / math.sqrt(norm) > best:
                best = mixed / math.sqrt(norm)
                square = float((1 - share) * SIGMAS[j] ** 2 + share * SIGMAS[j + 1] ** 2)
    finest = math.sqrt(math.log(2) / 2) / math.pi  # of a Gaussian, times its σ
    return min(finest / math.sqrt(square), 0.5) / pitch


def _share(a: float, b: float, aa: float, bb: float, ab: float) -> float:
    """Return the second share, 0 to 1, of the mixture of two vectors that is most like a third, by their products.

    A blur changes nearly linearly with σ², so the mixture of two neighbours stands for those between them.
    """
    first, second = a * bb - b * ab, b * aa - a * ab
    return float(np.clip(second / (first + second), 0, 1)) if first + second > 0 else 0.0
