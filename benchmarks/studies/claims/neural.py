"""When does a neural or a learned method work? Five rules, judged by its records and by the courses of its fits.

The rules compare with a windowed FDK, with an outline (`hull`), and with the same method without what it is named for
(its ablations), so that a gain by denoising alone is none.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.methods.records import METAL, TWIN, RunRecord

ABLATIONS: dict[str, tuple[str, ...]] = {
    "naf": (),
    "polyner": ("naf",),
    "park": ("naf",),
    "field": ("naf",),
    "denoise": (),
    "fusion": ("denoise", "limar", "nmar"),
    "denoise-lite": (),
    "dicdnet-lite": ("denoise-lite", "limar", "nmar"),
    "acdnet-lite": ("denoise-lite", "limar", "nmar"),
    "oscnet-lite": ("denoise-lite", "limar", "nmar"),
}
"""What a method must be better than: the same without its physics, its mask, or the prior volumes."""
FIELDS = ("naf", "polyner", "park", "field")
OTHERS = ("fdk", "hull", "limar", "nmar")
AGAIN = 1
"""The seed of a field's second run."""
ABOVE_FDK, SHARE, ABOVE_ABLATION, BELOW_FDK, APART = 1.0, 0.7, 0.5, 0.3, 0.3
SUITE, NAME, COURSES = "neural", "neural.md", "courses.json"

Runs = dict[tuple[str, str, str], RunRecord]
"""(scene, variant, label) -> its record."""


class Course(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PSNR3D of tissue (dB) of a field's volume at its best and at its end; `code` hashes the method's sources."""

    scene: str
    method: str
    code: str
    best: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a method shows of one rule, and whether it holds; None where it does not apply or was not measured."""

    text: str
    holds: bool | None


def chosen() -> tuple[list[str], list[str]]:
    """Return the flags of run-benchmark for the runs: of all methods, then of the fields by another seed."""
    again = [flag for name in FIELDS for flag in (f"--method={name}", f"--set={name}.seed={AGAIN}")]
    return [f"--method={name}" for name in (*OTHERS, *ABLATIONS)], again


def judged(found: Sequence[RunRecord], fitted: Sequence[Course]) -> dict[str, list[Finding]]:
    """Return what each method shows of rules 1 to 5."""
    runs: Runs = {(r.run.scene, r.run.variant, r.label): r for r in found if r.status == OK}
    rules = (_first, _second, _third, _fourth)
    return {name: [*(rule(runs, name) for rule in rules), _fifth(runs, name, fitted)] for name in ABLATIONS}


def _first(runs: Runs, name: str) -> Finding:
    """Compare PSNR3D of tissue with the windowed FDK's and with that of an outline."""
    over_fdk, over_hull = (_gains(runs, name, other) for other in ("fdk", "hull"))
    if not over_fdk or not over_hull:
        return UNKNOWN
    fdk, hull = statistics.fmean(over_fdk), statistics.fmean(over_hull)
    return Finding(text=f"{fdk:+.2f} / {hull:+.2f}", holds=fdk >= ABOVE_FDK and hull > 0)


def _second(runs: Runs, name: str) -> Finding:
    """Compare the error against a method's own twin, which denoising cancels, with FDK's."""
    ratios = []
    for (scene, variant, label), record in runs.items():
        base = runs.get((scene, METAL, "fdk"))
        if variant == METAL and label == name and base is not None:
            mine, theirs = (_value(r, "artefact", "rmse") for r in (record, base))
            if mine is not None and theirs:
                ratios.append(mine / theirs)
    if not ratios:
        return UNKNOWN
    ratio = statistics.fmean(ratios)
    return Finding(text=f"{ratio:.2f}", holds=ratio <= SHARE)


def _third(runs: Runs, name: str) -> Finding:
    """Compare with the ablations: a learned method on iron alone, where metal matters."""
    if not ABLATIONS[name]:
        return Finding(text="–", holds=None)
    only = "" if name in FIELDS else "-Fe"
    gains = {other: _gains(runs, name, other, only) for other in ABLATIONS[name]}
    if not all(gains.values()):
        return UNKNOWN
    least = {other: statistics.fmean(values) for other, values in gains.items()}
    text = ", ".join(f"{value:+.2f} over {other}" for other, value in least.items())
    return Finding(text=text, holds=min(least.values()) >= ABOVE_ABLATION)


def _fourth(runs: Runs, name: str) -> Finding:
    """Compare with FDK on the metal-free twins, where nothing is to be corrected."""
    gains = _gains(runs, name, "fdk", variant=TWIN)
    if not gains:
        return UNKNOWN
    gain = statistics.fmean(gains)
    return Finding(text=f"{gain:+.2f}", holds=gain >= -BELOW_FDK)


def _fifth(runs: Runs, name: str, fitted: Sequence[Course]) -> Finding:
    """Compare the seeds of a fit, and its end with its best moment; a trained network has neither."""
    if name not in FIELDS:
        return Finding(text="–", holds=None)
    seeds = [abs(gain) for gain in _gains(runs, name, f"{name}[seed={AGAIN}]")]
    lost = [c.best - c.end for c in fitted if c.method == name and c.code == find(name).code]
    if not seeds or not lost:
        return UNKNOWN
    return Finding(text=f"{max(seeds):.2f} / {max(lost):.2f}", holds=max(*seeds, *lost) <= APART)


UNKNOWN = Finding(text="not measured", holds=None)


def _gains(runs: Runs, name: str, other: str, only: str = "", variant: str = METAL) -> list[float]:
    """Return by how many dB a method is above another one, scene by scene."""
    gains = []
    for scene in sorted({scene for scene, *_ in runs if only in scene}):
        pair = [runs.get((scene, variant, label)) for label in (name, other)]
        values = [None if record is None else _value(record, "tissue", "psnr3d") for record in pair]
        if values[0] is not None and values[1] is not None:
            gains.append(values[0] - values[1])
    return gains


def _value(record: RunRecord, protocol: str, metric: str) -> float | None:
    score = record.scores.get(protocol)
    return None if score is None else score.values.get(metric)


def table(found: dict[str, list[Finding]]) -> Table:
    """Return a row for each method; one that fails has a dagger and the numbers of the rules that it failed."""
    heads = (
        "method",
        "1: over FDK / hull (dB)",
        "2: artefact over FDK's",
        "3: over its ablation (dB)",
        "4: over FDK without metal (dB)",
        "5: seeds / lost since the best (dB)",
    )
    rows = []
    for name, findings in found.items():
        failed = [str(k) for k, finding in enumerate(findings, 1) if finding.holds is False]
        rows.append([f"{name} †{','.join(failed)}" if failed else name, *(finding.text for finding in findings)])
    return simple(heads, rows, title="Neural and learned methods")


def works(found: dict[str, list[Finding]]) -> bool:
    """Say whether every method passes every rule that applies, and all were measured."""
    return all(finding.holds is not False and finding != UNKNOWN for findings in found.values() for finding in findings)
