"""Records of `run-benchmark peers`, their table, and what they say about the targets."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import Host, certain
from ctsim.benchmarks.studies.peers.cases import FAILED, FULL, MEASURED, OURS, RTK, XCIST, Measurement

MEGA = 1e6
ABSENT = "not installed"
WHAT = "a record of run-benchmark peers"
By = tuple[Host, str, dict[str, str]]
"""Who measures: the machine, the commit, and the versions of the peers that are there."""


class PeerRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement with its provenance; `side` is that of the grids, `rtk` and `xcist` the peers' versions.

    `others` are the versions of peers that are installed and not measured; `run` is when the command was started: it
    tells the runs in one file apart.
    """

    measurement: Measurement
    side: int
    rtk: str
    xcist: str = "not measured"
    others: dict[str, str] = {}
    host: Host
    commit: str
    time: str
    run: str = ""

    @property
    def by(self) -> By:
        """Who measured it."""
        there = {RTK: self.rtk, XCIST: self.xcist, **self.others}
        return self.host, self.commit, {name: version for name, version in there.items() if version != ABSENT}


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
    return lines.read(path, PeerRecord, WHAT)


def recorded(measurements: Sequence[Measurement], by: By, **more: Any) -> list[PeerRecord]:
    """Return the records of what was measured by `by`; `more` are the fields that neither says."""
    here, commit, versions = by
    others = {name: version for name, version in versions.items() if name not in MEASURED}
    rtk, xcist = (versions.get(name, ABSENT) for name in (RTK, XCIST))
    shared = {"rtk": rtk, "xcist": xcist, "others": others, "host": here, "commit": commit, **more}
    return [PeerRecord(measurement=one, **shared) for one in measurements]


def known(stored: Sequence[PeerRecord], repeats: int, by: By) -> set[str]:
    """Return the cases, of the records of `latest`, with so many runs, measured by `by`.

    A case that failed is not known, and code that differs from its commit, or has none, knows nothing.
    """
    if not certain(by[1]):
        return set()
    cases = {record.measurement.case for record in stored}
    return cases - {record.measurement.case for record in stored if not _counts(record, repeats, by)}


def _counts(record: PeerRecord, repeats: int, by: By) -> bool:
    """Say whether a record is what another run `by` the same would measure; the case paper has one run always."""
    m = record.measurement
    enough = m.case == "paper" or not m.seconds or len(m.seconds) >= repeats
    return enough and m.status not in FAILED and record.by == by


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
            if all(record.measurement.status not in FAILED for record in rows):
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
        beside = [p for p in measurements if (p.case, p.scene, p.status) == (m.case, m.scene, "ok")]
        if m.status == "ok" and _is_ours(m):
            out += _targets(m, [p for p in beside if not _is_ours(p)])
    return out


def _is_ours(m: Measurement) -> bool:
    return m.contender.partition(",")[0] == OURS


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
    out = [*_provenances(records), "", "| case | scene | contender | s | ms/view | error | peak (MB) | note |"]
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


def _provenances(records: Sequence[PeerRecord]) -> list[str]:
    """Return who measured, on one line where that is one, else a line for each with its cases; and how."""
    groups: dict[bytes, list[PeerRecord]] = {}
    for record in records:
        groups.setdefault(msgspec.json.encode(record.by), []).append(record)
    how = (
        f"grids of side {records[-1].side}. Medians of interleaved runs; ratios of time are medians over pairs, each "
        "to the peer that is best in that quantity."
    )
    if len(groups) == 1:
        return [f"{_provenance(records[-1])}; {how}"]
    cases = [", ".join(dict.fromkeys(record.measurement.case for record in group)) for group in groups.values()]
    parts = [f"- {names}: {_provenance(group[-1])}" for names, group in zip(cases, groups.values(), strict=True)]
    return [f"Cases of several runs, on {how}", "", *parts]


def _provenance(record: PeerRecord) -> str:
    h = record.host
    return (
        f"{record.time}, commit {record.commit[:12]}{'+changes' if record.commit.endswith('+changes') else ''}, "
        f"{h.cpu}, {h.cores} cores, {h.threads} threads, Python {h.python}, numba {h.versions.get('numba', '?')}, "
        f"itk-rtk {record.rtk}, gecatsim {record.xcist}"
    )
