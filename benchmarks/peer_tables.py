"""Records of `run-benchmark peers`, their table, and what they say about the targets."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from statistics import median

import msgspec

from benchmarks import lines
from benchmarks.host import Host, certain
from benchmarks.peer_cases import FULL, OURS, PEERS, Measurement

MEGA = 1e6


class PeerRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement with its provenance; `side` is that of the grids, `rtk` and `xcist` the peers' versions.

    `run` is when the command was started: it tells the runs in one file apart.
    """

    measurement: Measurement
    side: int
    rtk: str
    xcist: str = "not measured"
    host: Host
    commit: str
    time: str
    run: str = ""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """A target: what was measured, the limit it has to stay within, on which scene, and against which peer."""

    case: str
    scene: str
    quantity: str
    value: float
    limit: float
    against: str = ""

    @property
    def met(self) -> bool:
        """Say whether the target is met."""
        return self.value <= self.limit


def read(path: Path) -> list[PeerRecord]:
    """Read the records of a peers file (see `lines.read`)."""
    return lines.read(path, PeerRecord, "a record of run-benchmark peers")


def known(stored: Sequence[PeerRecord], repeats: int, by: tuple[Host, str, str, str]) -> set[str]:
    """Return the cases, of the records of `latest`, with so many runs, `by` = (host, commit, rtk, xcist).

    A case with an error is not known, and code that differs from its commit, or has none, knows nothing.
    """
    if not certain(by[1]):
        return set()
    cases = {record.measurement.case for record in stored}
    return cases - {record.measurement.case for record in stored if not _counts(record, repeats, by)}


def _counts(record: PeerRecord, repeats: int, by: tuple[Host, str, str, str]) -> bool:
    """Say whether a record is what another run `by` the same would measure; the case paper has one run always."""
    m = record.measurement
    enough = m.case == "paper" or not m.seconds or len(m.seconds) >= repeats
    return enough and m.status != "error" and (record.host, record.commit, record.rtk, record.xcist) == by


def seconds(records: Sequence[PeerRecord], repeats: int) -> dict[str, float]:
    """Return what so many runs take of each case, by the clock when it was last recorded, on one size of grids.

    A case began when the one before it was recorded, or the run was started; one that failed tells nothing.
    """
    found: dict[str, float] = {}
    for run in dict.fromkeys(record.run for record in records if record.run):
        mine, began = [record for record in records if record.run == run], run
        for case in dict.fromkeys(record.measurement.case for record in mine):
            rows = [record for record in mine if record.measurement.case == case]
            took = (datetime.fromisoformat(rows[-1].time) - datetime.fromisoformat(began)).total_seconds()
            began = rows[-1].time
            timed = [r.measurement.seconds for r in rows if r.measurement.seconds and case != "paper"]
            more = sum(median(s) * (repeats - len(s)) for s in timed)
            if all(record.measurement.status != "error" for record in rows):
                found[case] = max(took + more, 0.0)
    return found


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
    """Compare with the targets; those that need a peer are left out where none is there.

    Time is held against the fastest peer and error against the most accurate, be they two.
    """
    out: list[Verdict] = []
    for m in measurements:
        peers = [p for p in measurements if (p.case, p.scene) == (m.case, m.scene) and p.contender in PEERS]
        if m.status == "ok" and m.contender not in PEERS:
            out += _targets(m, [p for p in peers if p.status == "ok"])
    return out


def _targets(m: Measurement, peers: Sequence[Measurement]) -> list[Verdict]:
    """Return the targets of one measurement of ours."""
    who = m.contender.removeprefix(OURS).removeprefix(", ")
    named = {"case": m.case, "scene": f"{m.scene} ({who})" if who else m.scene}
    limits: list[tuple[str, float | None, float]] = []
    out: list[Verdict] = []
    if m.case == "paths":
        out = _beside(m, peers, named, time=0.25)
    elif m.case == "exact" and who == "exact solids":
        limits = [("relative RMS", m.error, 1e-4)]
    elif m.case == "paper":
        limits = [("seconds", median(m.seconds), 60.0), ("peak GB", _scaled(m.peak_bytes, 1e9), 2.0)]
    elif m.case == "fdk":
        # 2 %: what interpolation of the filtered rows may differ by
        out = _beside(m, peers, named, time=1 / 3, error=1.02)
    elif m.case == "poly":
        limits = [("peak GB", _scaled(m.peak_bytes, 1e9), 0.5)]
        out = _beside(m, peers, named, time=0.2, error=0.2)
    own = [Verdict(quantity=q, value=value, limit=limit, **named) for q, value, limit in limits if value is not None]
    return own + out


def _beside(
    m: Measurement, peers: Sequence[Measurement], named: Mapping[str, str], *, time: float, error: float | None = None
) -> list[Verdict]:
    """Return the targets relative to the best peer in time, and to the best in error where that has a limit."""
    out: list[Verdict] = []
    fastest = min((p for p in peers if p.seconds), key=lambda p: median(p.seconds), default=None)
    if fastest and m.seconds:
        ratio = time_ratio(m, fastest)
        out.append(Verdict(quantity="time ratio", value=ratio, limit=time, against=fastest.contender, **named))
    errors = {p.contender: p.error for p in peers if p.error}
    if error is not None and m.error is not None and errors:
        closest = min(errors, key=errors.__getitem__)
        ratio = m.error / errors[closest]
        out.append(Verdict(quantity="error ratio", value=ratio, limit=error, against=closest, **named))
    return out


def _scaled(value: float | None, unit: float) -> float | None:
    return None if value is None else value / unit


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
        out += ["", "| case | scene | quantity | best peer | reached | target | met |", "|---|---|---|---|--:|--:|---|"]
        out += ["| " + " | ".join(_judged(v)) + " |" for v in found]
    return "\n".join(out) + "\n"


def _judged(v: Verdict) -> tuple[str, ...]:
    met = "yes" if v.met else "NO"
    return v.case, v.scene, v.quantity, v.against or "–", f"{v.value:.3g}", f"≤ {v.limit:.3g}", met


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
        f"itk-rtk {record.rtk}, gecatsim {record.xcist}; grids of side {record.side}. Medians of interleaved runs; "
        "ratios of time are medians over pairs, each to the peer that is best in that quantity."
    )
