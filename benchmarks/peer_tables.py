"""Records of `run-benchmark peers`, their table, and what they say about the targets."""

import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import msgspec

from benchmarks.host import Host
from benchmarks.peer_cases import FULL, OURS, RTK, Measurement

MEGA = 1e6


class PeerRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement with its provenance; `side` is that of the grids, `rtk` the version of itk-rtk.

    `run` is when the command was started: it tells the runs in one file apart.
    """

    measurement: Measurement
    side: int
    rtk: str
    host: Host
    commit: str
    time: str
    run: str = ""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """A target: what was measured, the limit it has to stay within, and on which scene."""

    case: str
    scene: str
    quantity: str
    value: float
    limit: float

    @property
    def met(self) -> bool:
        """Say whether the target is met."""
        return self.value <= self.limit


def append(path: Path, record: PeerRecord) -> None:
    """Append one JSON line and force it to the disk."""
    with path.open("ab") as file:
        file.write(msgspec.json.encode(record) + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read(path: Path) -> list[PeerRecord]:
    """Read the records of a peers file."""
    decoder = msgspec.json.Decoder(PeerRecord)
    return [decoder.decode(line) for line in path.read_bytes().splitlines() if line.strip()]


def latest(records: Sequence[PeerRecord], side: int) -> list[PeerRecord]:
    """Keep the last measurement of each case on grids of `side`, all of its contenders from one run, oldest first.

    Contenders that did not run in turns with each other are never put side by side.
    """
    last: dict[tuple[str, str, str], PeerRecord] = {}
    for record in records:
        if record.side == side:
            m = record.measurement
            last.pop((m.case, m.scene, m.contender), None)
            last[m.case, m.scene, m.contender] = record
    newest = {record.measurement.case: record.run for record in last.values()}
    return [record for record in last.values() if record.run == newest[record.measurement.case]]


def time_ratio(ours: Measurement, theirs: Measurement) -> float:
    """Return the median of the ratios of neighbouring runs, which drifts of the machine hardly touch."""
    return median(a / b for a, b in zip(ours.seconds, theirs.seconds, strict=True))


def verdicts(measurements: Sequence[Measurement]) -> list[Verdict]:
    """Compare with the targets; those that need RTK are left out where it is absent."""
    out: list[Verdict] = []
    for m in measurements:
        peers = [p for p in measurements if (p.case, p.scene, p.contender) == (m.case, m.scene, RTK)]
        peer = next((p for p in peers if p.status == "ok"), None)
        if m.status == "ok" and m.contender != RTK:
            out += _targets(m, peer)
    return out


def _targets(m: Measurement, peer: Measurement | None) -> list[Verdict]:
    """Return the targets of one measurement of ours."""
    limits: list[tuple[str, float | None, float]] = []
    who = m.contender.removeprefix(OURS).removeprefix(", ")
    if m.case == "paths" and peer:
        limits = [("time / RTK's", time_ratio(m, peer), 0.25)]
    elif m.case == "exact" and who == "exact solids":
        limits = [("relative RMS", m.error, 1e-4)]
    elif m.case == "paper":
        limits = [("seconds", median(m.seconds), 60.0), ("peak GB", _scaled(m.peak_bytes, 1e9), 2.0)]
    elif m.case == "fdk" and peer:
        # 2 %: what interpolation of the filtered rows may differ by
        limits = [("time / RTK's", time_ratio(m, peer), 1 / 3), ("RMSE / RTK's", _ratio(m, peer), 1.02)]
    elif m.case == "poly":
        limits = [("peak GB", _scaled(m.peak_bytes, 1e9), 0.5)]
        if peer:
            limits += [("time / RTK's", time_ratio(m, peer), 0.2), ("error / RTK's", _ratio(m, peer), 0.2)]
    scene = f"{m.scene} ({who})" if who else m.scene
    return [
        Verdict(case=m.case, scene=scene, quantity=quantity, value=value, limit=limit)
        for quantity, value, limit in limits
        if value is not None
    ]


def _scaled(value: float | None, unit: float) -> float | None:
    return None if value is None else value / unit


def _ratio(m: Measurement, peer: Measurement) -> float | None:
    return m.error / peer.error if m.error is not None and peer.error else None


def render(records: Sequence[PeerRecord]) -> str:
    """Render measurements and targets as Markdown."""
    measurements = [r.measurement for r in records]
    out = [_provenance(records[-1]), "", "| case | scene | contender | s | ms/view | error | peak (MB) | note |"]
    out.append("|---|---|---|--:|--:|--:|--:|---|")
    out += ["| " + " | ".join(_cells(m)) + " |" for m in measurements]
    found = verdicts(measurements)
    if records[-1].side < FULL:
        out += [
            "",
            "Grids this small are all overhead: they prove the command, not the speed, and meet or miss no target.",
        ]
    elif found:
        out += ["", "| case | scene | quantity | reached | target | met |", "|---|---|---|--:|--:|---|"]
        out += [
            f"| {v.case} | {v.scene} | {v.quantity} | {v.value:.3g} | ≤ {v.limit:.3g} | {'yes' if v.met else 'NO'} |"
            for v in found
        ]
    return "\n".join(out) + "\n"


def _cells(m: Measurement) -> tuple[str, ...]:
    if m.status != "ok":
        return m.case, m.scene, m.contender, m.status, "–", "–", "–", m.reason
    seconds = median(m.seconds) if m.seconds else None
    error = "–" if m.error is None else f"{m.error:.2e} {m.error_kind}"
    notes = [m.note] if m.note else []
    if m.warm_up is not None:
        notes.append(f"first run {m.warm_up:.2f} s")
    return (
        m.case,
        m.scene,
        m.contender,
        "–" if seconds is None else f"{seconds:.3f}",
        "–" if seconds is None else f"{1e3 * seconds / m.views:.2f}",
        error,
        "–" if m.peak_bytes is None else f"{m.peak_bytes / MEGA:.0f}",
        "; ".join(notes),
    )


def _provenance(record: PeerRecord) -> str:
    h = record.host
    return (
        f"{record.time}, commit {record.commit[:12]}{'+changes' if record.commit.endswith('+changes') else ''}, "
        f"{h.cpu}, {h.cores} cores, {h.threads} threads, Python {h.python}, numba {h.versions.get('numba', '?')}, "
        f"itk-rtk {record.rtk}; grids of side {record.side}. Medians of interleaved runs; "
        "ratios are medians over pairs."
    )
