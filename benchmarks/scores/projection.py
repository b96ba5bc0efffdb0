"""The protocol `projection`: a volume's line integrals in views that no method saw, against the simulator's truth.

The views lie half-way between the scan's. Their noise-free P = −ln(signal/open) and their linear line integrals are
simulated from the scan's scene.toml when they are needed, and are not stored. Projections are [view, v, u], unitless.
"""

from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim import settings
from ctsim.beam.quadrature import effective_weights
from ctsim.benchmarks.scores.protocol import Truth
from ctsim.benchmarks.scores.score import AS_RETURNED, Score
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.phantoms.dataset import scene_of
from ctsim.phantoms.scene import build, stream_id
from ctsim.plan import make_plan
from ctsim.reconstruct.projector import forward_columns
from ctsim.simulate import REFERENCE_KEV, simulate_views

N_VIEWS = 12
MARGIN = 2
"""Pixels by which the metal's trace is dilated before rays count as outside it."""

WIDE = 2.001
"""A gap this many times wider than the median was not scanned, and has no half-way."""

TARGETS = ("noise_free", "effective", "50kev")
REGIONS = ("body", "outside", "trace")
REGION = (
    "rays through the body in views half-way between the scan's: all of them, those more than 2 pixels outside the "
    "metal's trace, and those through metal"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """The held-out views' true line integrals by target and ray masks by region, all [view, v, u]."""

    geometry: Geometry
    truths: dict[str, NDArray[np.float32]]
    regions: dict[str, NDArray[np.bool_]]
    reference: str
    note: str


def half_way(geometry: Geometry) -> Geometry | str:
    """Return the geometry of at most 12 views half-way between the scan's, evenly chosen, or why there are none.

    "Half-way" is between neighbouring angles, in any order of acquisition. An angle that was scanned several times
    counts once, and a gap in the arc has no half-way.
    """
    if geometry.poses is not None:
        return "the scan's views are poses, not angles on a circle: there is no half-way between them"
    angles = np.unique(np.round(np.mod(np.degrees(geometry.angles), 360.0), 6))
    angles = angles[angles < 360.0]
    if len(angles) < 2:
        return "the scan has a single angle: there is no half-way"
    gaps = np.diff(angles, append=angles[0] + 360.0)
    middles = np.mod(angles + gaps / 2, 360.0)[gaps <= WIDE * np.median(gaps)]
    chosen = np.unique(np.linspace(0, len(middles) - 1, min(N_VIEWS, len(middles))).round().astype(int))
    picked = tuple(float(a) for a in middles[chosen])
    return msgspec.structs.replace(geometry, n_views=len(picked), angles_deg=picked)


def held_out(stored: ScanWithTruth) -> HeldOut | str:
    """Simulate the held-out views of a scan, or say why there are none."""
    views = half_way(stored.geometry)
    if isinstance(views, str):
        return views
    scene = scene_of(stored)
    if isinstance(scene, str):
        return f"held-out views cannot be simulated: {scene}"
    try:
        return _simulated(scene, views, stored)
    except InputError as error:  # such as a CT volume's file that is not here
        return f"held-out views cannot be simulated: {' '.join(str(error).split())}"
    except MemoryError:
        return "there was not enough memory to simulate held-out views"


def _simulated(scene: Any, geometry: Geometry, stored: ScanWithTruth) -> HeldOut:
    phantom = build(scene)
    scanner = msgspec.structs.replace(scene.resolve(), geometry=geometry)
    asked = settings.Truth(twin=False, noise_free=True, paths=True, trace=True, mono_kev=(REFERENCE_KEV,))
    plan = make_plan(phantom, scanner, scene.simulation, asked, stream_id(scene))
    energies, weights = effective_weights(plan.spectrum, scanner.detector, stored.l0)
    mu = np.array([float(attenuation(m, energies) @ weights) for m in plan.told[1:]])
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    paths = np.stack([images["paths"] for images in views])
    body = paths.sum(1) > 0
    trace = np.stack([images["trace"] > 0 if "trace" in images else np.zeros_like(body[0]) for images in views])
    size = (1, 2 * MARGIN + 1, 2 * MARGIN + 1)
    near = ndimage.maximum_filter(trace.astype(np.uint8), size, mode="constant", cval=0) > 0
    angles = geometry.angles_deg or ()
    scatter = "scatter included, " if scanner.scatter.level else ""
    return HeldOut(
        geometry=geometry,
        truths={
            "noise_free": np.stack([images["noise_free"] for images in views]),
            "effective": np.tensordot(paths, mu, (1, 0)).astype(np.float32),
            "50kev": np.stack([images[f"mono_{REFERENCE_KEV:g}kev"] for images in views]),
        },
        regions={"body": body, "outside": body & ~near, "trace": body & trace},
        reference=f"P = −ln(signal/open) without noise, {scatter}and line integrals at the effective spectrum behind "
        f"{stored.l0:.1f} mm of water and at {REFERENCE_KEV:g} keV",
        note=f"{len(angles)} views held out, {min(angles):.2f}° to {max(angles):.2f}°",
    )


def rmse_by_target(
    values: NDArray[Any], held: HeldOut, at_50kev: NDArray[Any] | None = None
) -> dict[str, float | None]:
    """Return the RMSE of a volume's line integrals, "target/region", and for P of each view, "target/region:angle".

    The target at 50 keV is compared with the volume `at_50kev`, if given.
    """
    found = _projected(values, held)
    own = {"50kev": found if at_50kev is None else _projected(at_50kev, held)}
    scores: dict[str, float | None] = {}
    for target in TARGETS:
        squared = np.square(own.get(target, found) - held.truths[target], dtype=np.float64)
        for region in REGIONS:
            mask = held.regions[region]
            scores[f"{target}/{region}"] = _root(squared[mask])
            if target == "noise_free":
                for k, angle in enumerate(held.geometry.angles_deg or ()):
                    scores[f"{target}/{region}:{angle:.2f}deg"] = _root(squared[k][mask[k]])
    return scores


def _projected(values: NDArray[Any], held: HeldOut) -> NDArray[np.float32]:
    return forward_columns(np.ascontiguousarray(values.transpose(1, 2, 0), np.float32), held.geometry)


def _root(squared: NDArray[np.float64]) -> float | None:
    return float(np.sqrt(squared.mean())) if squared.size else None


def projection_score(values: NDArray[Any], held: HeldOut | str, at_50kev: NDArray[Any] | None = None) -> Score:
    """Score a volume's line integrals; at 50 keV those of the volume `at_50kev`, if given.

    Without held-out views the numbers are None and the note says why.
    """
    if isinstance(held, str):
        names = [f"{target}/{region}" for target in TARGETS for region in REGIONS]
        return Score.none(REGION, names, held)
    return Score(
        region=REGION,
        reference=held.reference,
        alignment="none",
        data_range=None,
        n_voxels=int(held.regions["body"].sum()),
        values=rmse_by_target(values, held, at_50kev),
        note=held.note,
        volume=AS_RETURNED if at_50kev is None else f"{AS_RETURNED}; against 50 keV, read there",
    )


def with_floor(held: HeldOut | str, truth: Truth) -> HeldOut | str:
    """Add to the note the scores of the reference volumes: the error of voxels and of a linear model alone."""
    if isinstance(held, str):
        return held
    own = {"noise_free": "effective", "effective": "effective", "50kev": "50kev"}
    scores = {which: rmse_by_target(truth.references[which], held) for which in ("effective", "50kev")}
    found = {target: scores[which][f"{target}/outside"] for target, which in own.items()}
    floor = ", ".join(f"{'–' if v is None else f'{v:.4f}'} ({target})" for target, v in found.items())
    return replace(held, note=f"{held.note}; the references' own voxels leave outside the trace {floor}")
