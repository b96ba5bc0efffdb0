"""What the tables of `run-benchmark` say above and below their numbers."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.scores.score import (
    AS_RETURNED,
    LEAST_LOSS,
    MAIN,
    MAIN_ACROSS,
    MAIN_MEASURED,
    NEED_TRUTH,
    NMAR,
    NO_REFERENCE,
    Metric,
    row_of,
)
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord

RANGES_DIFFER = 1.05
"""Ratio of the data ranges of two scenes above which dB do not compare between them."""


def main_caption(shown: Sequence[RunRecord]) -> str:
    """Say what the columns of the main tables are, and where scenes do not compare by dB."""
    if measured(shown):
        return (
            "Measured scans have no truth, so nothing here says how right a volume is. Streaks in air: RMS of the air "
            "around the body, smoothed. Artefact index: how much more the body varies near the metal than "
            "beyond. Held out: line integrals against measured views that no method saw; they hold noise, scatter and "
            "beam hardening, which a good volume does not. A method that erases detail may win any of these. "
            f"Skipped, since they need a truth: {', '.join(NEED_TRUTH)}. Controls have no rank."
        )
    image = "PSNR3D and SSIM3D of all tissue outside the metal (protocol tissue)."
    bone = (
        "False bone, false air: shares of soft tissue near and between metal that read so (protocol structure); "
        "between metal: in soft tissue that has metal on both sides alone."
    )
    clean = (
        "Short of FDK without metal: what it lacks of the best FDK of that twin, so that erasing detail with and "
        "without metal alike is no gain."
    )
    ranges = [found for group in _ranges(shown).values() for found in group.values()]
    span = f"{min(ranges):.4g} to {max(ranges):.4g} 1/mm" if ranges else ""
    if across_scanners(shown):
        return (
            "These scenes show the same object to different scanners, so HU come first. The range that PSNR3D is taken "
            f"of moves with the spectrum ({span}): an image with half the error in HU may have the lower PSNR3D. Soft "
            "tissue RMSE: protocol soft. Artefact RMSE: what the metal changes, against the same method on the "
            "metal-free twin (protocol artefact). Cost of metal: what soft tissue RMSE loses against that twin. "
            f"{clean} {bone} {image} Controls have no rank."
        )
    text = (
        f"{image} Cost of metal: what PSNR3D loses against the same method on the metal-free twin. {clean} {bone} "
        "Soft tissue RMSE: protocol soft. Controls have no rank."
    )
    if ranges and max(ranges) > RANGES_DIFFER * min(ranges):
        text += (
            f" The range that PSNR3D is taken of differs between scenes ({span}): "
            "compare scenes by HU, and methods within a scene by either."
        )
    return text


def main_columns(shown: Sequence[RunRecord]) -> dict[tuple[str, str], Metric]:
    """Return the columns of the main table of these records."""
    if measured(shown):
        return MAIN_MEASURED
    return MAIN_ACROSS if across_scanners(shown) else MAIN


def measured(shown: Sequence[RunRecord]) -> bool:
    """Whether there are scores, and all are of measured scans, which have no truth."""
    scored = [r.scores for r in shown if r.scores]
    return bool(scored) and all(NO_REFERENCE in scores for scores in scored)


def across_scanners(shown: Sequence[RunRecord]) -> bool:
    """Whether the scenes differ by scanner: every object is in several of them, and the range of its PSNR3D moves.

    The range is a percentile of the true volume, so for one object it moves with the spectrum only.
    """
    ranges = _ranges(shown)
    shared = "" not in ranges and all(len(group) > 1 for group in ranges.values())
    return shared and any(max(g.values()) > RANGES_DIFFER * min(g.values()) for g in ranges.values())


def _ranges(shown: Sequence[RunRecord]) -> dict[str, dict[str, float]]:
    """Return the data range of `tissue` by object and scene; the object "" is unknown."""
    found: dict[str, dict[str, float]] = {}
    for r in shown:
        if r.run.variant == METAL and "tissue" in r.scores and (size := r.scores["tissue"].data_range):
            found.setdefault(r.phantom, {})[r.run.scene] = size
    return found


def merged(texts: Iterable[str]) -> str:
    """Join texts that differ in numbers only into one with their ranges, others with " / "."""
    kinds: dict[tuple[str, ...], list[list[str]]] = {}
    for text in texts:
        kinds.setdefault(tuple(_NUMBER.split(text)), []).append(_NUMBER.findall(text))
    out = []
    for pieces, found in kinds.items():
        ranges = [sorted(set(column), key=float) for column in zip(*found, strict=True)]
        shown = [r[0] if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in ranges]
        out.append("".join(a + b for a, b in zip(pieces, [*shown, ""], strict=True)))
    return " / ".join(out)


_NUMBER = re.compile(r"\d+\.\d+")


def caption(records: Sequence[RunRecord], protocol: str) -> str:
    """State protocol, region, reference, alignment and data range of a table."""
    if protocol == "cost":
        return (
            "Protocol cost: seconds and peak resident memory of a run; compilation and first call are not included. "
            "Air kerma is that of the whole scan at the isocentre without the object, the same for every method."
        )
    if protocol == "metal_cost":
        return (
            "Protocol metal_cost: what the metal costs, in dB of tissue PSNR3D and in HU of soft-tissue RMSE. Against "
            "the own twin: the loss against the same method on the scan without metal. Against FDK without metal: the "
            "loss against the best FDK row of that scan, so that a method that erases detail in both does not win."
        )
    if protocol == "against":
        nmar = row_of(NMAR, (r.label for r in records if r.status == OK and r.run.variant == METAL))
        return (
            "Protocol tissue, compared: gain in PSNR3D (dB) over no correction (FDK) and over NMAR"
            f"{'' if nmar is None else f' (the row {nmar})'}, scene by scene and seed by seed."
        )
    if protocol == "anchored":
        return (
            "Anchored scores s = (e − e_ref)/(e_FDK − e_ref), e_ref from the metal-free scan reconstructed by FDK: "
            "0 as if the metal had never been there, 1 uncorrected. Harm rate: share of scenes with s > 1, "
            "and how many of how many scenes that have a score. There is no score where the metal raises FDK's "
            f"error by no more than {LEAST_LOSS:.0%}; for artefacts the error that counts is the RMSE under tissue."
        )
    found = [(r, r.scores[protocol]) for r in records if protocol in r.scores and r.run.variant == METAL]
    if not found:
        return f"Protocol {protocol}."
    score = found[0][1]
    references = merged(dict.fromkeys(s.reference for _, s in found))
    alignment = "one least-squares gain on the body" if protocol.startswith("aligned") else score.alignment
    text = f"Protocol {protocol}: region {score.region}; reference {references}; alignment {alignment}"
    ranges: dict[str, list[float]] = {}
    others: dict[str, list[str]] = {}
    for r, s in found:
        if s.data_range is not None:
            ranges.setdefault(r.run.scene, []).append(s.data_range)
        if s.volume != AS_RETURNED:
            others.setdefault(s.volume, []).append(r.label)
    if ranges:
        text += "; data range " + ", ".join(f"{_span(v)} ({s})" for s, v in ranges.items()) + " 1/mm"
    return text + "".join(f"; {', '.join(dict.fromkeys(who))} {how}" for how, who in others.items()) + "."


def _span(numbers: list[float]) -> str:
    """Write numbers as one, or as the least and the greatest where seeds differ."""
    low, high = f"{min(numbers):.4g}", f"{max(numbers):.4g}"
    return low if low == high else f"{low} to {high}"


def declared(records: Sequence[RunRecord], protocol: str) -> list[str]:
    """Return what the scores of a protocol declare: once for a scene and seed where its methods agree."""
    labels: dict[tuple[str, int, str], list[str]] = {}
    for record in records:
        if record.run.variant == METAL and protocol in record.scores and record.scores[protocol].note:
            key = (record.run.scene, record.run.seed, record.scores[protocol].note)
            labels.setdefault(key, []).append(record.label)
    said = Counter((scene, seed) for scene, seed, _ in labels)
    return [
        f"{scene} (seed {seed}{'' if said[scene, seed] == 1 else ', ' + ', '.join(methods)}): {note}"
        for (scene, seed, note), methods in labels.items()
    ]
