"""Which score sees which fault: faults painted on the truth of a scan, and every score of the result.

    make-dataset headline data/ --only thorax-Fe --seeds 1
    python -m ctsim.benchmarks.tools.sensitivity data/thorax-Fe-s1 docs/measured

The volume without fault is the scan's reference at the effective spectrum plus white noise of 20 HU. Faults are painted
on the reference, the noise is added after. The page is written to the folder, or printed without one.
"""

import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.host import commit, machine
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.metrics import Mask, dilate
from ctsim.benchmarks.scores.score import COLUMNS, PROTOCOLS, Metric
from ctsim.benchmarks.scores.soft import AROUND, SoftLayout
from ctsim.benchmarks.scores.structure import StructureLayout
from ctsim.benchmarks.tools.page import put
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError

NAME = "sensitivity.md"
TITLE = "Which score sees which fault"
NOISE = 20.0
DRAWS = 4
FALSE_BONE = 1250.0
"""HU of the bar: streaks between iron rods reach it, while cortical bone has far more under a soft spectrum."""
SEEN = 5.0
"""A score sees a fault that makes it worse by more than this many standard deviations over draws of the noise."""
NONE = "none"
Volume = NDArray[np.float64]
Place = tuple[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What faults are painted on: the truth in HU and the regions, all [z, y, x]."""

    hu: Volume
    soft: SoftLayout
    between: Mask
    near: Mask
    metal: Mask
    body: Mask
    bone: float
    bar: Mask = field(repr=False)

    @classmethod
    def of(cls, judge: Judge) -> "Scene":
        """Raise InputError where the scan has no soft tissue in two classes, or nothing between two pieces of metal."""
        soft, structure = judge.soft, judge.structure
        if not isinstance(soft, SoftLayout) or soft.pair is None:
            raise InputError("expected a scan with two classes of soft tissue")
        if not isinstance(structure, StructureLayout) or not structure.between.any() or not judge.layout.lines:
            raise InputError("expected a scan with soft tissue between two pieces of metal")
        return cls(
            hu=soft.reference,
            soft=soft,
            between=structure.between,
            near=structure.near,
            metal=judge.truth.metal,
            body=judge.truth.body,
            bone=structure.bone,
            bar=_bar(judge, structure.between),
        )


def _bar(judge: Judge, between: Mask) -> Mask:
    """Return a bar 3 voxels thick along the line between two pieces of metal that has most soft tissue on it."""
    bars = []
    for line in judge.layout.lines:
        bar = np.zeros_like(between)
        bar[tuple(np.rint(line).astype(np.int64).T)] = True
        bars.append(dilate(bar, 1) & between)
    return max(bars, key=lambda bar: int(bar.sum()))


def _alike(scene: Scene) -> Volume:
    upper, lower = (scene.soft.classes[name] for name in scene.soft.pair or ())
    return np.where(lower, scene.hu[upper].mean(), scene.hu)


def _faded(scene: Scene) -> Volume:
    """Halve what fine structures differ by from the mean around them."""
    fine = scene.soft.fine
    mean = ndimage.uniform_filter(np.where(fine, scene.hu, 0), AROUND)
    share = np.maximum(ndimage.uniform_filter(fine.astype(np.float64), AROUND), 1 / AROUND**3)
    return np.where(fine, (scene.hu + mean / share) / 2, scene.hu)


def _shading(scene: Scene) -> Volume:
    """Darken the body towards its axis, as beam hardening does: by 100 HU in the middle, 0 at the edge."""
    y, x = (np.linspace(-1, 1, n) for n in scene.hu.shape[1:])
    depth = np.clip(1 - y[:, None] ** 2 - x**2, 0, None)
    return np.where(scene.body, scene.hu - 100 * depth / depth[scene.body.any(0)].max(), scene.hu)


def _speckled(mask: Mask) -> Mask:
    """Return a tenth of a mask's voxels, at random."""
    return mask & (np.random.default_rng(0).random(mask.shape) < 0.1)


def _thicker(scene: Scene) -> Volume:
    return np.where(dilate(scene.metal, 1), np.median(scene.hu[scene.metal]), scene.hu)


def _weaker(scene: Scene) -> Volume:
    return np.where(scene.metal, (scene.hu + 1000) * 0.7 - 1000, scene.hu)


def _noise(scene: Scene, sigma: float, smooth: float) -> Volume:
    found = np.random.default_rng(0).standard_normal(scene.hu.shape)
    found = ndimage.gaussian_filter(found, smooth) if smooth else found
    return scene.hu + sigma * found / found.std()


FAULTS: dict[str, Callable[[Scene], Volume]] = {
    NONE: lambda s: s.hu,
    "fat as muscle": _alike,
    "vessels faded": _faded,
    "bar of bone": lambda s: np.where(s.bar, min(s.bone, FALSE_BONE), s.hu),
    "dark band": lambda s: np.where(s.bar, -800.0, s.hu),
    "bright halo": lambda s: np.where(_speckled(s.near), FALSE_BONE, s.hu),
    "dark halo": lambda s: np.where(_speckled(s.near), -800.0, s.hu),
    "shading": _shading,
    "noise 100 HU": lambda s: _noise(s, 100, 0),
    "coarse noise 50 HU": lambda s: _noise(s, 50, 1),
    "blur": lambda s: ndimage.gaussian_filter(s.hu, 1),
    "scale 1.02": lambda s: (s.hu + 1000) * 1.02 - 1000,
    "shift": lambda s: ndimage.shift(s.hu, (0, 0, 0.5), order=3, mode="nearest"),
    "metal thicker": _thicker,
    "metal at 70 %": _weaker,
}
"""Fault -> the volume [z, y, x] with it, in HU. Blur is of σ = 1 voxel, the shift half a voxel, thicker by 1 voxel."""

FOR: dict[str, tuple[Place, ...]] = {
    "fat as muscle": (
        *(("soft", m) for m in ("contrast", "cnr", "rmse", "psnr3d", "worst_bias", "worst_rmse")),
        ("artefact", "rmse_far"),
    ),
    "vessels faded": (("soft", "fine_contrast"), ("soft", "fine_cnr")),
    "bar of bone": (
        *(("structure", m) for m in ("false_bone", "false_bone_between", "rmse_between", "bias_between")),
        ("artefact", "streak"),
    ),
    "dark band": (
        *(("structure", m) for m in ("false_air", "false_air_between", "rmse_between", "bias_between")),
        ("artefact", "streak"),
    ),
    "bright halo": (("structure", "false_bone_near"), ("artefact", "rmse_near")),
    "dark halo": (("structure", "false_air_near"), ("artefact", "rmse_near")),
    "shading": (("soft", "rmse"), ("artefact", "rmse"), ("aligned", "psnr3d")),
    "noise 100 HU": (
        *(("soft", m) for m in ("noise_near", "noise_far", "cnr", "ssim3d")),
        *((protocol, "ssim3d") for protocol in ("aligned", "paper")),
        *(("aligned", "psnr3d"), ("artefact", "roi_std")),
    ),
    "coarse noise 50 HU": (("soft", "grain_near"), ("soft", "grain_far"), ("soft", "rmse")),
    "blur": (("soft", "mtf50_near"), ("soft", "mtf50_far"), ("tissue", "ssim3d")),
    "scale 1.02": (("aligned", "gain"), ("soft", "rmse"), ("projection", "effective/outside")),
    "shift": (("tissue", "psnr3d"), ("metal", "dice"), ("soft", "mtf50_far")),
    "metal thicker": (("metal", "dice"), ("metal", "boundary_rms"), ("paper", "psnr3d")),
    "metal at 70 %": (("metal", "core_ratio"), ("projection", "effective/trace")),
}
"""Fault -> the scores that exist to see it."""

EXEMPT: dict[Place, str] = {
    **{("aligned_50kev", m): "as `aligned`, of another reference" for m in COLUMNS["aligned_50kev"]},
    **{
        ("paper", m): "published under other ranges, for comparison with papers alone"
        for m in ("psnr3d_full_gtmax", "psnr3d_r2", "ssim3d_r2", "ssim3d_naf")
    },
    ("artefact", "cupping"): "its regions are small, so that noise moves it as much as shading of the whole body; RMSE "
    "sees shading",
    (
        "projection",
        "noise_free/outside",
    ): "the truth itself has one energy and misses polychromatic P, so that a darker volume may be nearer to it",
    ("projection", "50kev/outside"): "as at the effective spectrum; the volume painted here is not at 50 keV",
    ("projection", "50kev/trace"): "as at the effective spectrum; the volume painted here is not at 50 keV",
}
"""Columns of tables for which no fault is painted, and why."""

DERIVED: dict[str, str] = {
    "metal_cost": "differences of the scores above, between a scan and its metal-free twin",
    "against": "differences of `tissue` PSNR3D between rows",
    "anchored": "quotients of errors above, by FDK's",
    "no_reference": "of measured scans, which have no truth to paint faults on",
    "cost": "of the run, not of its volume",
}
"""Protocols of tables that judge no volume with a painted fault, and what their columns are."""

SHOWN: tuple[Place, ...] = tuple(
    (protocol, metric) for protocol in PROTOCOLS for metric in COLUMNS[protocol] if (protocol, metric) not in EXEMPT
)

CAPTION = (
    "Each row is a score, each column a fault that was painted on the truth. ✓: the score sees the fault, for it is "
    f"worse by more than {SEEN:g} standard deviations over {DRAWS} draws of the noise. ▲: it exists to see this fault. "
    "The artefact is measured against the volume without fault, with noise of its own. Blur lessens no noise, which is "
    "added after it."
)


def main(arguments: list[str]) -> int:
    """Write or print the page; return 0."""
    if len(arguments) not in (1, 2):
        raise InputError("expected SCAN, and the folder of the measured pages or nothing")
    stored = open_scan(Path(arguments[0]))
    return put(page(stored.name, Judge.of(stored)), NAME, arguments[1] if len(arguments) > 1 else None)


def page(name: str, judge: Judge) -> str:
    """Return the page on one scan: how it was made, and the table."""
    commands = "; ".join(f"`{line.strip()}`" for line in (__doc__ or "").splitlines() if line.startswith("    "))
    made = (
        f"# {TITLE}\n\nMade by {commands}. Do not edit. Scan {name}, commit {commit()}, {machine()}.\n\n{CAPTION}\n\n"
    )
    unseen = "".join(f"- `{p}` {_metric((p, m)).title}: {why}.\n" for (p, m), why in EXEMPT.items())
    unseen += "".join(f"- `{protocol}`, all columns: {what}.\n" for protocol, what in DERIVED.items())
    return (
        f"{made}{table(*measure(judge)).markdown()}\nColumns of the results for which no fault is painted:\n\n{unseen}"
    )


def measure(judge: Judge) -> tuple[dict[str, dict[Place, float]], dict[Place, float]]:
    """Return each fault's scores, and the standard deviation of each score without fault.

    A score that does not exist for a volume is left out.
    """
    scene = Scene.of(judge)
    draws = [_scores(judge, scene, scene.hu, k) for k in range(DRAWS)]
    spread = {place: statistics.stdev(draw[place] for draw in draws) for place in draws[0]}
    found = {name: _scores(judge, scene, fault(scene), 0) for name, fault in FAULTS.items() if name != NONE}
    return {NONE: draws[0], **found}, spread


def _scores(judge: Judge, scene: Scene, hu: Volume, draw: int) -> dict[Place, float]:
    """Return the scores of a volume with one draw of noise; the twin is the truth with another."""
    values, twin = (
        (v + NOISE * np.random.default_rng([place, draw]).standard_normal(hu.shape) + 1000) / 1000 * scene.soft.water
        for place, v in enumerate((hu, scene.hu))
    )
    scores = judge.scores(values.astype(np.float32), "metal", Twin(values=twin.astype(np.float32)))
    found: dict[Place, Any] = {(p, m): scores[p].values.get(m) for p, m in SHOWN if p in scores}
    return {place: float(value) for place, value in found.items() if value is not None}


def sees(place: Place, clean: float, value: float, spread: float) -> bool:
    """Whether a score is worse than without fault by more than the noise explains; any change if none is better."""
    metric = _metric(place)
    change = {
        "max": clean - value,
        "min": value - clean,
        "one": abs(value - 1) - abs(clean - 1),
        "": abs(value - clean),
    }[metric.better]
    # half a unit of the last digit shown: less is not to be seen in a table
    return change > max(SEEN * spread, 0.5 * 10.0**-metric.digits / metric.scale)


def _metric(place: Place) -> Metric:
    return COLUMNS[place[0]][place[1]]


def table(found: dict[str, dict[Place, float]], spread: dict[Place, float]) -> Table:
    """Return the table: a row a score, a column a fault."""
    rows = []
    for place in (p for p in SHOWN if p in spread):
        metric, clean = _metric(place), found[NONE][place]
        cells = [f"`{place[0]}` {metric.title}"]
        for fault, scores in found.items():
            text = "–" if place not in scores else f"{scores[place] * metric.scale:.{metric.digits}f}"
            text += " ▲" if place in FOR.get(fault, ()) else ""
            worse = fault != NONE and place in scores and sees(place, clean, scores[place], spread[place])
            cells.append(f"{text} ✓" if worse else text)
        rows.append(cells)
    return simple(["score", *found], rows, numbers=[*found])


if __name__ == "__main__":
    sys.exit(guarded("sensitivity", "ctsim.benchmarks.tools.sensitivity", sys.argv[1:]))
