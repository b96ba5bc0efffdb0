"""Records of `run-benchmark stress`, one JSON line a row, and the table of them."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import msgspec

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import Host
from ctsim.benchmarks.engine.texts import escape
from ctsim.benchmarks.studies.stress.cases import Case, Outcome

NAME, TABLE_NAME = "stress.jsonl", "stress.md"
A_ROW = "a row of run-benchmark stress"


class StressRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How one case ended on grids of `side` voxels a side; `ok` says whether as expected.

    `identity` hashes case, subject, side and the sources that decide the result.
    """

    identity: str
    case: str
    subject: str
    what: str
    expected: str
    side: int
    ok: bool
    found: str
    seconds: float
    host: Host
    commit: str
    time: str


def identity_of(case: Case, side: int) -> str:
    """Return what tells a row from others: SHA-256 over its case, subject, size, expectation and sources."""
    parts = (case.name, case.subject, str(side), case.expected, case.code)
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def record_of(case: Case, side: int, outcome: Outcome, by: tuple[Host, str, str]) -> StressRecord:
    """Return the record of an outcome; `by` are machine, commit and time."""
    host, commit, time = by
    return StressRecord(
        identity=identity_of(case, side),
        case=case.name,
        subject=case.subject,
        what=case.what,
        expected=case.expected,
        side=side,
        ok=outcome.ok,
        found=outcome.found,
        seconds=round(outcome.seconds, 3),
        host=host,
        commit=commit,
        time=time,
    )


def read(path: Path) -> list[StressRecord]:
    """Read the rows of a stress file (see `lines.read`)."""
    return lines.read(path, StressRecord, A_ROW)


def latest(records: Sequence[StressRecord], wanted: Sequence[str]) -> list[StressRecord]:
    """Return the last record of each identity, in the order in which they are `wanted`."""
    last = {record.identity: record for record in records}
    return [last[identity] for identity in wanted if identity in last]


def newest(records: Sequence[StressRecord], wanted: Sequence[tuple[str, str]], side: int) -> list[StressRecord]:
    """Return the last record of each (case, subject) on grids of `side`, whatever its sources, as in `latest`."""
    last = {(record.case, record.subject): record for record in records if record.side == side}
    return [last[place] for place in wanted if place in last]


def render(records: Sequence[StressRecord]) -> str:
    """Render rows as Markdown: what is not as expected, the cases, then every row."""
    wrong = [r for r in records if not r.ok]
    seconds = sum(r.seconds for r in records)
    out = [
        _provenance(records[-1]),
        "",
        f"{len(records) - len(wrong)} of {len(records)} rows are as expected; {seconds:.0f} s in all.",
    ]
    if wrong:
        out += ["", "Not as expected:", ""]
        out += [f"- {r.case}, {r.subject}: {escape(r.found, 'md')}" for r in wrong]
    return "\n".join([*out, "", *by_case(records), "", *_rows(records)]) + "\n"


def by_case(records: Sequence[StressRecord]) -> list[str]:
    """Return the lines of a table of the cases, with how many of their rows are as expected."""
    out = ["| case | what | rows | as expected | s |", "|---|---|--:|--:|--:|"]
    for name in dict.fromkeys(r.case for r in records):
        rows = [r for r in records if r.case == name]
        seconds = sum(r.seconds for r in rows)
        out.append(f"| {name} | {rows[-1].what} | {len(rows)} | {sum(r.ok for r in rows)} | {seconds:.1f} |")
    return out


def _rows(records: Sequence[StressRecord]) -> list[str]:
    out = ["| case | subject | what | expected | found | ok |", "|---|---|---|---|---|---|"]
    for r in records:
        cells = (r.case, r.subject, r.what, r.expected, r.found)
        out.append("| " + " | ".join(escape(c, "md") for c in cells) + f" | {'yes' if r.ok else 'NO'} |")
    return out


def _provenance(record: StressRecord) -> str:
    h = record.host
    commit = record.commit[:12] + ("+changes" if record.commit.endswith("+changes") else "")
    return (
        f"{record.time}, commit {commit}, {h.cpu}, {h.cores} cores, Python {h.python}, "
        f"numba {h.versions.get('numba', '?')}; {record.side} voxels a side."
    )
