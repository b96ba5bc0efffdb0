"""What the tables of `run-benchmark` say above and below their numbers."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.scores.score import AS_RETURNED, NMAR, row_of
from ctsim.benchmarks.studies.methods.records import METAL, RunRecord

RANGES_DIFFER = 1.05
"""Ratio of the data ranges of two scenes above which dB do not compare between them."""


def main_caption(shown: Sequence[RunRecord]) -> str:
    """Say what the columns of the main tables are, and where scenes do not compare by dB."""
    text = (
        "PSNR3D and SSIM3D of all tissue outside the metal (protocol tissue). Cost of metal: what PSNR3D loses against "
        "the same method on the metal-free twin. Short of FDK without metal: what it lacks of the best FDK of that "
        "twin, so that erasing detail with and without metal alike is no gain. False bone: share of soft tissue near "
        "and between metal that reads as bone (protocol structure). Soft tissue RMSE: protocol soft. Controls have no "
        "rank."
    )
    ranges = [r.scores["tissue"].data_range for r in shown if r.run.variant == METAL and "tissue" in r.scores]
    known = [x for x in ranges if x]
    if known and max(known) > RANGES_DIFFER * min(known):
        text += (
            f" The range that PSNR3D is taken of differs between scenes ({min(known):.4g} to {max(known):.4g} 1/mm): "
            "compare scenes by HU, and methods within a scene by either."
        )
    return text


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
            "error by less than a tenth."
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
