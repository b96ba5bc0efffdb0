"""Records of `run-benchmark skipping` and their table."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median

import msgspec

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import Host, certain
from ctsim.benchmarks.studies.methods.records import OK

CORE, WHAT = "core", "a record of run-benchmark skipping"


class Measured(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One skip: seconds with and without it, run by run in pairs, and the largest difference of the result.

    `difference` is in what `unit` says, None where it is not finite; `limit` is what `stated` allows it, None where
    the two are meant to differ. A case that did not end has no seconds, and a `status` and its `reason`.
    """

    case: str
    scene: str
    what: str
    skipping: tuple[float, ...]
    whole: tuple[float, ...]
    difference: float | None
    unit: str
    limit: float | None
    stated: str
    note: str = ""
    status: str = OK
    reason: str = ""

    @property
    def held(self) -> bool:
        """Whether the difference is finite and stays within what is stated."""
        return self.difference is not None and (self.limit is None or self.difference <= self.limit)

    @property
    def gain(self) -> float:
        """Median over pairs of neighbouring runs of the time without the skip over that with it."""
        return median(b / a for a, b in zip(self.skipping, self.whole, strict=True))


def failed(case: str, status: str, reason: str) -> Measured:
    """Return what stands for a case that did not end."""
    return Measured(
        case=case,
        scene="",
        what="",
        skipping=(),
        whole=(),
        difference=None,
        unit="",
        limit=None,
        stated="",
        status=status,
        reason=reason,
    )


class SkipRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement with its provenance; `run` is when the command was started."""

    measured: Measured
    size: str
    host: Host
    commit: str
    time: str
    run: str


def read(path: Path) -> list[SkipRecord]:
    """Read the records of a skipping file (see `lines.read`)."""
    return lines.read(path, SkipRecord, WHAT)


def known(path: Path, size: str, repeats: int, at: tuple[Host, str]) -> set[str]:
    """Return the cases last recorded at `size` with so many runs on this machine by this commit: `at` = (host, commit).

    Code that differs from its commit, or has none, knows nothing.
    """
    if not certain(at[1]):
        return set()
    last = {r.measured.case: r.measured for r in read(path) if (r.size, r.host, r.commit) == (size, *at)}
    return {case for case, m in last.items() if len(m.skipping) >= repeats}


def seconds(records: Sequence[SkipRecord]) -> dict[str, float]:
    """Return what one run both ways takes of each case, all of its pairs together, as in the records of `latest`."""
    found: dict[str, float] = {}
    for m in (record.measured for record in records if record.measured.status == OK):
        found[m.case] = found.get(m.case, 0.0) + median(m.skipping) + median(m.whole)
    return found


def latest(records: Sequence[SkipRecord], size: str, order: Sequence[str]) -> list[SkipRecord]:
    """Keep what the newest run of each case measured at `size`; cases stand in `order`."""
    ours = [record for record in records if record.size == size]
    newest = {record.measured.case: record.run for record in ours}
    kept = [record for record in ours if record.run == newest[record.measured.case]]
    return sorted(kept, key=lambda record: order.index(record.measured.case))


def render(records: Sequence[SkipRecord]) -> str:
    """Render measurements as Markdown."""
    head = (
        "case | what is left out | scene | with (s) | without (s) | gain | largest difference | allowed | held | note"
    )
    out = [_provenance(records), "", f"| {head} |", "|---|---|---|--:|--:|--:|--:|---|---|---|"]
    out += ["| " + " | ".join(_cells(record.measured)) + " |" for record in records]
    if records[-1].size != CORE:
        out += ["", "Grids this small are all overhead: they prove the command, not what a skip is worth."]
    return "\n".join(out) + "\n"


def _cells(m: Measured) -> tuple[str, ...]:
    if m.status != OK:
        return m.case, *("–",) * 7, "NO", f"{m.status}: {m.reason}"
    difference = "not finite" if m.difference is None else f"{m.difference:.2g} {m.unit}" if m.difference else "0"
    allowed = m.stated if not m.limit else f"≤ {m.limit:.2g} ({m.stated})"
    seconds = (f"{median(s):.4f}" for s in (m.skipping, m.whole))
    held = "NO" if not m.held else "–" if m.limit is None else "yes"
    return m.case, m.what, m.scene, *seconds, f"{m.gain:.2f}", difference, allowed, held, m.note


def _provenance(records: Sequence[SkipRecord]) -> str:
    """Say where and by what code; cases that were measured one by one may be of several machines and commits."""
    times = sorted(record.time for record in records)
    machines = dict.fromkeys(_machine(r.host) for r in sorted(records, key=lambda record: record.time))
    commits = dict.fromkeys(r.commit[:12] + "+changes" * r.commit.endswith("+changes") for r in records)
    least = min((len(r.measured.skipping) for r in records if r.measured.status == OK), default=0)
    return (
        f"{times[0]} to {times[-1]}, commit {', '.join(commits)}, {' and '.join(machines)}; size {records[-1].size}. "
        f"Medians of {least} or more interleaved runs; the gain is the median over pairs of the time without the skip "
        "over that with it."
    )


def _machine(h: Host) -> str:
    return f"{h.cpu}, {h.cores} cores, {h.threads} threads, Python {h.python}, numba {h.versions.get('numba', '?')}"
