"""The protocols: which region, which reference, which range, and the scores of a volume under each.

A score always comes with its region, reference, alignment and data range: in the record with the
numbers, and in the caption of every table.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.metrics import Mask
from ctsim.benchmarks.scores.score import AS_RETURNED, AT_50KEV, PROTOCOLS, Score
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError
from ctsim.geometry import Geometry

METAL_MARGIN = 2
THIN = 0.05
"""Share of the body's median by which metal that fills less than half of a voxel raises the reference, to count."""
BODY_MARGIN = 4
RANGE_PERCENTILE = 99.9
ReferenceKind = Literal["effective", "50kev"]
TISSUE = "inside the body dilated by 4 voxels, outside the metal dilated by 2"
CUT = ", inside the field of view of all views"


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The truth that a volume is compared with: two references and the regions, all [z, y, x].

    `tissue` is the judged region of the protocols `tissue` and `aligned`; `judged` is the dilated body. `cut` says that
    both end at the field of view, because the body does not. `kinds` are the metals' labels, 0 elsewhere; None
    where they are not told, so that all metal is of one kind.
    """

    references: dict[str, NDArray[np.float32]]
    metal: Mask
    body: Mask
    tissue: Mask
    judged: Mask
    near_metal: Mask
    d_voxel: tuple[float, float, float]
    l0: float
    cut: bool = False
    kinds: NDArray[np.uint8] | None = None


def truth_of(stored: ScanWithTruth) -> Truth:
    """Load the references of a stored scan and derive the regions from its masks."""
    metal, body = np.asarray(stored.metal) > 0, np.asarray(stored.labels) > 0
    near_metal = metrics.dilate(metal, METAL_MARGIN) if metal.any() else metal
    thin = _thin_metal(stored, body & ~near_metal)
    near_metal = near_metal | metrics.dilate(thin, METAL_MARGIN) if thin.any() else near_metal
    judged = metrics.dilate(body | metal, BODY_MARGIN)
    field = field_of_view(stored.geometry)
    cut = bool((body | metal)[~field].any())
    judged = judged & field if cut else judged
    tissue = judged & ~near_metal
    if not tissue.any():
        raise InputError(f"scan {stored.name!r}: nothing is left to judge outside the dilated metal")
    references = {kind: np.asarray(stored.reference(kind), np.float32) for kind in ("effective", "50kev")}
    for kind, volume in references.items():
        if not np.isfinite(volume).all():
            raise InputError(f"scan {stored.name!r}: the {kind} reference must be finite")
    return Truth(
        references=references,
        metal=metal,
        body=body,
        tissue=tissue,
        judged=judged,
        near_metal=near_metal,
        d_voxel=stored.geometry.d_voxel,
        l0=float(stored.l0),
        kinds=_kinds(stored, metal),
        cut=cut,
    )


def _kinds(stored: ScanWithTruth, metal: Mask) -> NDArray[np.uint8]:
    """Return the labels of the metal's voxels that have a metal's label, else 0."""
    labels = np.asarray(stored.labels)
    names = [k for k, name in enumerate(stored.info.materials) if name in stored.info.metal]
    return np.where(metal & np.isin(labels, names), labels, 0).astype(np.uint8)


def _thin_metal(stored: ScanWithTruth, body: Mask) -> Mask:
    """Return the voxels of `body` that hold metal which the mask leaves out, because it fills less than half of them.

    They are those in which the reference is above that of the twin without metal; a scan without twin does not tell.
    """
    if stored.metal_free is None or not body.any():
        return np.zeros_like(body)
    bare = np.asarray(stored.metal_free.reference("effective"))
    more = np.asarray(stored.reference("effective")) - bare
    return body & (more > THIN * np.median(bare[body]))


def field_of_view(geometry: Geometry) -> Mask:
    """Return the voxels [z, y, x] whose centres every view of an orbit sees; all of them for views with poses.

    A voxel is seen if it is within the cylinder of the fans, and within the cone where it comes nearest to the source.
    """
    if geometry.poses is not None:
        return np.ones(geometry.n_voxel, np.bool_)
    z, y, x = geometry.voxel_centres()
    radius = np.hypot(y[:, None], x)
    half, off = geometry.s_detector[0] / 2, geometry.off_detector[0]
    magnified = geometry.dsd / np.maximum(geometry.dso - radius, 1e-9) * z[:, None, None]
    return (radius <= geometry.fov_radius) & (magnified <= half + off) & (magnified >= off - half)


def tissue_range(truth: Truth, kind: ReferenceKind) -> float:
    """Return the data range of `tissue` and `aligned`: the 99.9 percentile of the reference in the region."""
    found = float(np.percentile(truth.references[kind][truth.tissue], RANGE_PERCENTILE))
    if found <= 0:
        raise InputError(f"the {kind} reference is 0 in the judged region: there is no data range")
    return found


def _reference_text(truth: Truth, kind: ReferenceKind) -> str:
    return f"effective spectrum behind {truth.l0:.1f} mm of water" if kind == "effective" else "50 keV"


def paper_score(values: NDArray[Any], truth: Truth) -> Score:
    """Score every voxel against μ at 50 keV, range = max − min of the reference; compatibility columns too."""
    reference = truth.references["50kev"]
    data_range = float(reference.max()) - float(reference.min())
    mse = metrics.mse3d(values, reference)
    return Score(
        region="all voxels",
        reference=_reference_text(truth, "50kev"),
        alignment="none",
        data_range=data_range,
        n_voxels=reference.size,
        identical=mse == 0,
        values={
            "psnr3d": metrics.psnr(mse, data_range),
            "ssim3d": metrics.ssim3d(values, reference, data_range=data_range),
            "rmse": mse**0.5,
            "psnr3d_full_gtmax": metrics.psnr(mse, float(reference.max())),
            "psnr3d_r2": metrics.psnr(mse, 1.0),
            "ssim3d_r2": metrics.ssim3d_r2(values, reference),
            "ssim3d_naf": metrics.ssim3d_naf(values, reference),
        },
    )


def tissue_score(values: NDArray[Any], truth: Truth, kind: ReferenceKind = "effective") -> Score:
    """Score the tissue outside the metal, without alignment: the primary protocol."""
    return _region_score(values, truth, kind, "none", {})


def aligned_score(values: NDArray[Any], truth: Truth, kind: ReferenceKind) -> Score:
    """Score the tissue after one least-squares gain, fitted on the judged body outside the dilated metal.

    No gain is applied where only 0 or a negative one would fit: it would turn the negative of a volume into the volume.
    """
    body = truth.body & truth.tissue
    gain = metrics.least_squares_gain(values, truth.references[kind], body if body.any() else truth.tissue)
    if gain is None or gain <= 0:
        why = "the reconstruction is 0 in the body" if gain is None else "no positive gain fits"
        return _region_score(values, truth, kind, f"none: {why}", {"gain": None})
    scaled = values * np.float32(gain)
    return _region_score(scaled, truth, kind, f"one least-squares gain on the body, {gain:.4f}", {"gain": gain})


def _region_score(
    values: NDArray[Any], truth: Truth, kind: ReferenceKind, alignment: str, extra: dict[str, float | None]
) -> Score:
    reference, data_range = truth.references[kind], tissue_range(truth, kind)
    mse = metrics.mse3d(values, reference, truth.tissue)
    ssim = metrics.ssim3d(values, reference, data_range=data_range, region=truth.tissue)
    return Score(
        region=TISSUE + CUT * truth.cut,
        reference=_reference_text(truth, kind),
        alignment=alignment,
        data_range=data_range,
        n_voxels=int(truth.tissue.sum()),
        identical=mse == 0,
        values={"psnr3d": metrics.psnr(mse, data_range), "ssim3d": ssim, "rmse": mse**0.5, **extra},
    )


def metal_score(values: NDArray[Any], truth: Truth) -> Score:
    """Score the metal itself against its exact mask and the effective-spectrum reference."""
    reference = truth.references["effective"]
    cored = metrics.erode(truth.metal).any()
    return Score(
        region="metal",
        reference="the exact solids, as voxels; " + _reference_text(truth, "effective"),
        alignment="none",
        data_range=None,
        n_voxels=int(truth.metal.sum()),
        values=metrics.metal_metrics(values, reference, truth.metal, truth.judged, truth.d_voxel, truth.kinds),
        note="" if cored else "the metal is too thin to be eroded: its core is all of it",
    )


def evaluate(
    values: NDArray[Any],
    truth: Truth,
    *,
    at_50kev: NDArray[Any] | None = None,
    anchor: bool = False,
    protocols: Collection[str] = PROTOCOLS,
) -> dict[str, Score]:
    """Score a volume [z, y, x] in 1/mm under those `protocols` of this module that apply.

    Protocols at 50 keV score `at_50kev`, if given. With `anchor`, for a scan without the metal, only `tissue` and
    `aligned` apply. The volumes must be finite.
    """
    if values.shape != truth.metal.shape:
        raise InputError(f"the volume has shape {values.shape}, the reference {truth.metal.shape}")
    mono, which = (values, AS_RETURNED) if at_50kev is None else (at_50kev, AT_50KEV)
    scores: dict[str, Callable[[], Score]] = {
        "tissue": lambda: tissue_score(values, truth),
        "aligned": lambda: aligned_score(values, truth, "effective"),
        "aligned_50kev": lambda: replace(aligned_score(mono, truth, "50kev"), volume=which),
    }
    if not anchor:
        scores["paper"] = lambda: replace(paper_score(mono, truth), volume=which)
    if not anchor and truth.metal.any():
        scores["metal"] = lambda: metal_score(values, truth)
    return {name: score() for name, score in scores.items() if name in protocols}
