"""The protocol `artefact`: what the metal did, against the metal-free twin reconstructed by the same method.

The difference of the two volumes holds nothing that the method does to every object (cupping, texture,
energy scale), so it needs no reference. Volumes are [z, y, x] in 1/mm, distances are mm.
"""

import csv
import io
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.benchmarks.scores.metrics import Mask, box_around
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import COLUMNS, NO_TWIN, Score
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError
from ctsim.materials import attenuation

NEAR, NEAR_VOXELS = 5.0, 6
"""Tissue up to this distance from the metal (mm, or voxels if that is more, between centres) is near."""
# 2 voxels next to the metal are left out, and `structure` leaves out the outermost one of the soft tissue: what is left
# begins 4 voxels away along an axis and 4·√2 = 5.7 along the diagonal of a face. 6 voxels hold both on any grid.

ROI_MARGIN = 2
MIN_VOXELS = 64
MAX_PIECES = 32
BINS = 3
REGION = (
    "homogeneous ROIs, lines between metal pieces, and the tissue within 5 mm or 6 voxels (the greater) of the metal "
    "and beyond, all outside the metal dilated by 2 voxels"
)
REFERENCE = "the metal-free scan reconstructed by the same method"
_EVERY_WAY = np.ones((3, 3, 3), bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class Roi:
    """A homogeneous region: the flat indices of its voxels, outermost third and innermost third by depth.

    `edge` and `centre` are empty where the region is too thin to have both.
    """

    material: str
    voxels: NDArray[np.int64]
    edge: NDArray[np.int64]
    centre: NDArray[np.int64]
    middle: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where artefacts are measured in a scan; `water` is μ of water (1/mm) that HU are scaled by.

    `lines` are sample points (z, y, x in voxels) [n, 3] between two pieces of metal; `n_pairs` counts the
    pairs, also those too close to have a line. `note` declares all that was chosen.
    """

    water: float | None
    rois: tuple[Roi, ...]
    lines: tuple[NDArray[np.float64], ...]
    n_pairs: int
    near: Mask
    far: Mask
    note: str


def effective_attenuation(stored: ScanWithTruth, material: str = "water") -> float | None:
    """Return μ of a material in 1/mm under the scan's effective spectrum; None where its spectrum is not stored.

    ω(E) ∝ signal(E)·exp(−μ_water(E)·L0), the weights of the effective-spectrum reference. Raises
    InputError where spectrum.csv is damaged.
    """
    text = stored.text("spectrum.csv")
    if text is None:
        return None
    try:
        rows = csv.DictReader(io.StringIO(text, newline=""))
        table = [(float(row["energy_kev"]), float(row["signal_fraction"])) for row in rows]
    except (KeyError, TypeError, ValueError):
        table = []
    if not table:
        raise InputError(
            f"{stored.place}: spectrum.csv: expected the columns energy_kev and signal_fraction with numbers"
        )
    energies, signal = np.array(table).T
    mu = attenuation("water", energies)
    weights = signal * np.exp((mu.min() - mu) * stored.l0)
    return float(np.average(attenuation(material, energies), weights=weights))


def layout_of(stored: ScanWithTruth, truth: Truth) -> Layout:
    """Choose the ROIs and lines of a scan from its labels and its metal; nothing depends on a method."""
    rois, small = homogeneous(np.asarray(stored.labels), truth, stored.info.materials)
    lines, n_pairs, cut = metal_lines(truth)
    near = near_metal(truth)
    water = effective_attenuation(stored)
    parts = [_roi_text(roi) for roi in rois]
    parts += [f"no ROI in {', '.join(small)}: fewer than {MIN_VOXELS} voxels"] if small else []
    parts += [f"lines for {len(lines)} of {n_pairs} pairs of metal pieces{cut}"]
    parts += [] if near.any() else [f"no tissue within {near_mm(truth.d_voxel):g} mm of the metal"]
    parts += [f"water {water:.5g} 1/mm"] if water else ["no HU: the scan comes without spectrum.csv"]
    return Layout(
        water=water,
        rois=rois,
        lines=lines,
        n_pairs=n_pairs,
        near=near,
        far=truth.tissue & ~near,
        note="; ".join(parts),
    )


def _roi_text(roi: Roi) -> str:
    x, y, z = roi.middle
    return f"ROI {roi.material}: {roi.voxels.size} voxels around ({x:.1f}, {y:.1f}, {z:.1f}) mm"


def homogeneous(labels: NDArray[Any], truth: Truth, names: tuple[str, ...]) -> tuple[tuple[Roi, ...], list[str]]:
    """Return one ROI a material, its largest connected homogeneous piece, and the materials too small for one.

    A voxel is homogeneous where all labels within 2 voxels, diagonals included, are its own, and it is
    outside the dilated metal. What lies at the volume's edge does not count.
    """
    size = 2 * ROI_MARGIN + 1
    low = ndimage.minimum_filter(labels, size, mode="constant", cval=0)
    alike = np.where((low == ndimage.maximum_filter(labels, size)) & truth.tissue, low, 0)
    found, small = [], []
    for label in np.unique(labels[truth.body & truth.tissue]):
        name = names[label] if label < len(names) else f"label {label}"
        pieces = _pieces(alike == label)
        sizes = np.bincount(pieces.ravel(), minlength=2)[1:]
        if sizes.max() < MIN_VOXELS:
            small.append(name)
        else:
            found.append(_roi(pieces == 1 + int(np.argmax(sizes)), name, truth.d_voxel))
    return tuple(found), small


def _pieces(mask: Mask) -> NDArray[np.int32]:
    """Label the pieces of a mask from 1 on; voxels that share a face, edge or corner are one piece."""
    pieces = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, structure=_EVERY_WAY, output=pieces)
    return pieces


def _roi(mask: Mask, material: str, d_voxel: tuple[float, float, float]) -> Roi:
    """Split a region into thirds by depth, the distance (mm) to the nearest voxel outside it."""
    box = box_around(mask)
    inside = np.pad(mask[box], 1)  # the box is tight: its rim is outside the region
    depth = np.asarray(ndimage.distance_transform_edt(inside, sampling=d_voxel))[1:-1, 1:-1, 1:-1][mask[box]]
    voxels = np.flatnonzero(mask)
    low, high = np.quantile(depth, (1 / BINS, 1 - 1 / BINS))
    thick = low < high
    centre_of_volume = (np.asarray(mask.shape) - 1) / 2
    z, y, x = (np.argwhere(mask).mean(0) - centre_of_volume) * d_voxel
    return Roi(
        material=material,
        voxels=voxels,
        edge=voxels[depth <= low] if thick else voxels[:0],
        centre=voxels[depth >= high] if thick else voxels[:0],
        middle=(float(x), float(y), float(z)),
    )


def metal_lines(truth: Truth) -> tuple[tuple[NDArray[np.float64], ...], int, str]:
    """Return sample points between the centroids of every two pieces of metal, the pairs, and what was cut.

    Points have a spacing of half the smallest voxel. A point whose nearest voxel is not judged tissue is left out.
    """
    pieces, n = pieces_of(truth.metal, MAX_PIECES)
    kept = np.unique(pieces[pieces > 0])
    centroids = np.array(ndimage.center_of_mass(truth.metal, pieces, kept)).reshape(-1, 3)
    lines = []
    for a, b in itertools.combinations(centroids, 2):
        length = float(np.linalg.norm((b - a) * truth.d_voxel))
        steps = max(2, math.ceil(2 * length / min(truth.d_voxel)) + 1)
        points = a + np.linspace(0, 1, steps)[:, None] * (b - a)
        inside = truth.tissue[tuple(np.rint(points).astype(int).T)]
        if inside.any():
            lines.append(points[inside])
    cut = f", the {MAX_PIECES} largest of {n}" if n > MAX_PIECES else ""
    return tuple(lines), len(centroids) * (len(centroids) - 1) // 2, cut


def pieces_of(metal: Mask, most: int) -> tuple[NDArray[np.int32], int]:
    """Return numbers of the pieces of metal, from 1 on and 0 for all but the `most` largest; and how many there are."""
    pieces = _pieces(metal)
    sizes = np.bincount(pieces.ravel())[1:]
    kept = np.zeros(sizes.size + 1, np.bool_)
    kept[1 + np.argsort(-sizes, kind="stable")[:most]] = True
    return np.where(kept[pieces], pieces, np.int32(0)), sizes.size


def distance_to_metal(truth: Truth) -> NDArray[np.float64]:
    """Return the distance (mm) from each voxel's centre to that of the next metal voxel; infinity without metal."""
    if not truth.metal.any():
        return np.full(truth.metal.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~truth.metal, sampling=truth.d_voxel))


def near_mm(d_voxel: tuple[float, float, float]) -> float:
    """Return the distance from the metal (mm, between voxel centres) up to which tissue is near, on a grid."""
    return max(NEAR, NEAR_VOXELS * max(d_voxel))


def is_near(distance: NDArray[np.float64], d_voxel: tuple[float, float, float]) -> Mask:
    """Return where a distance from the metal (mm) counts as near."""
    return distance <= near_mm(d_voxel) * (1 + 1e-9)  # a sum of voxel sizes may be rounded up or down


def near_metal(truth: Truth) -> Mask:
    """Return the tissue that is near the metal."""
    near = np.zeros_like(truth.metal)
    if truth.metal.any():
        box = box_around(truth.metal, [math.ceil(near_mm(truth.d_voxel) / d) + 1 for d in truth.d_voxel])
        distance = np.asarray(ndimage.distance_transform_edt(~truth.metal[box], sampling=truth.d_voxel))
        near[box] = is_near(distance, truth.d_voxel)
    return near & truth.tissue


def artefact_score(
    values: NDArray[Any], twin: NDArray[Any] | None, layout: Layout, truth: Truth, reason: str = NO_TWIN
) -> Score:
    """Score a volume against its method's volume of the twin; all None with `reason` where there is none.

    HU = 1000·μ/μ_water, of differences; `cupping` is in percentage points.
    """
    found: dict[str, float | None] = dict.fromkeys(COLUMNS["artefact"])
    if twin is not None and twin.shape != values.shape:
        raise InputError(f"the volume has shape {values.shape}, the twin's {twin.shape}")
    if twin is not None and layout.water:
        difference = (values.astype(np.float64) - twin) * (1000 / layout.water)
        found = {
            **_roi_metrics(values, twin, difference, layout),
            "streak": rms([line_mean(difference, line) for line in layout.lines]),
            "rmse": _rmse(difference[truth.tissue]),
            "rmse_near": _rmse(difference[layout.near]),
            "rmse_far": _rmse(difference[layout.far]),
        }
    return Score(
        region=REGION,
        reference=REFERENCE,
        alignment="none",
        data_range=None,
        n_voxels=int(truth.tissue.sum()),
        values=found,
        identical=twin is not None and bool(np.array_equal(values, twin)),
        note=reason if twin is None else layout.note,
    )


def _roi_metrics(
    values: NDArray[Any], twin: NDArray[Any], difference: NDArray[np.float64], layout: Layout
) -> dict[str, float | None]:
    """Return std and excess cupping over all ROIs, and each ROI's own under its material's name."""
    stds, cuppings = {}, {}
    for roi in layout.rois:
        stds[roi.material] = float(difference.ravel()[roi.voxels].std())
        found, before = cupping_index(values, roi), cupping_index(twin, roi)
        cuppings[roi.material] = None if found is None or before is None else found - before
    return {
        "roi_std": rms(list(stds.values())),
        "cupping": rms([c for c in cuppings.values() if c is not None]),
        **{f"roi_std:{name}": value for name, value in stds.items()},
        **{f"cupping:{name}": value for name, value in cuppings.items()},
    }


def cupping_index(values: NDArray[Any], roi: Roi) -> float | None:
    """Return 100·(edge − centre)/edge in %, of the means over the ROI's outer and inner third.

    None where the ROI is too thin to have both, or its edge is not above 0.
    """
    if roi.edge.size == 0:
        return None
    flat = values.reshape(-1)
    edge, centre = (float(flat[part].mean(dtype=np.float64)) for part in (roi.edge, roi.centre))
    return 100 * (edge - centre) / edge if edge > 0 else None


def line_mean(difference: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """Return the mean along a line of points (z, y, x in voxels), interpolated linearly; signed."""
    return float(np.mean(ndimage.map_coordinates(difference, points.T, order=1, mode="nearest")))


def rms(numbers: list[float]) -> float | None:
    """Return the root mean square; None for an empty array."""
    return math.sqrt(sum(n * n for n in numbers) / len(numbers)) if numbers else None


def _rmse(differences: NDArray[np.float64]) -> float | None:
    return math.sqrt(float(np.vdot(differences, differences)) / differences.size) if differences.size else None
