"""Records of `run-benchmark skipping` and their table."""

import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import msgspec

from benchmarks.host import Host

CORE = "core"


class Measured(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One skip: seconds with and without it, run by run in pairs, and the largest difference of the result.

    `difference` is in what `unit` says, None where it is not finite; `limit` is what `stated` allows it, None where
    the two are meant to differ.
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

    @property
    def held(self) -> bool:
        """Whether the difference is finite and stays within what is stated."""
        return self.difference is not None and (self.limit is None or self.difference <= self.limit)

    @property
    def gain(self) -> float:
        """Median over pairs of neighbouring runs of the time without the skip over that with it."""
        return median(b / a for a, b in zip(self.skipping, self.whole, strict=True))


class SkipRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement with its provenance; `run` is when the command was started."""

    measured: Measured
    size: str
    host: Host
    commit: str
    time: str
    run: str


def append(path: Path, record: SkipRecord) -> None:
    """Append one JSON line and force it to the disk."""
    with path.open("ab") as file:
        file.write(msgspec.json.encode(record) + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read(path: Path) -> list[SkipRecord]:
    """Read the records of a skipping file; one that is not there has none."""
    if not path.exists():
        return []
    decoder = msgspec.json.Decoder(SkipRecord)
    return [decoder.decode(line) for line in path.read_bytes().splitlines() if line.strip()]


def known(path: Path, size: str, repeats: int, at: tuple[Host, str]) -> set[str]:
    """Return the cases recorded at `size`, with so many runs, on this machine by this commit: `at` = (host, commit).

    Code that differs from its commit, or has none, knows nothing.
    """
    if at[1] == "unknown" or at[1].endswith("+changes"):
        return set()
    found = [r for r in read(path) if (r.size, r.host, r.commit) == (size, *at)]
    return {r.measured.case for r in found if len(r.measured.skipping) >= repeats}


def latest(records: Sequence[SkipRecord], size: str, order: Sequence[str]) -> list[SkipRecord]:
    """Keep what the newest run of each case measured at `size`; cases stand in `order`."""
    ours = [record for record in records if record.size == size]
    newest = {record.measured.case: record.run for record in ours}
    kept = [record for record in ours if record.run == newest[record.measured.case]]
    return sorted(kept, key=lambda record: order.index(record.measured.case))


def render(records: Sequence[SkipRecord]) -> str:
    """Render measurements as Markdown."""
    head = (
        "case",
        "what is left out",
        "scene",
        "with (s)",
        "without (s)",
        "gain",
        "largest difference",
        "allowed",
        "held",
    )
    out = [
        _provenance(records[-1]),
        "",
        "| " + " | ".join((*head, "note")) + " |",
        "|---|---|---|--:|--:|--:|--:|---|---|---|",
    ]
    out += ["| " + " | ".join(_cells(record.measured)) + " |" for record in records]
    if records[-1].size != CORE:
        out += ["", "Grids this small are all overhead: they prove the command, not what a skip is worth."]
    return "\n".join(out) + "\n"


def _cells(m: Measured) -> tuple[str, ...]:
    difference = "not finite" if m.difference is None else f"{m.difference:.2g} {m.unit}" if m.difference else "0"
    allowed = m.stated if not m.limit else f"≤ {m.limit:.2g} ({m.stated})"
    seconds = (f"{median(s):.4f}" for s in (m.skipping, m.whole))
    held = "–" if m.limit is None else "yes" if m.held else "NO"
    return m.case, m.what, m.scene, *seconds, f"{m.gain:.2f}", difference, allowed, held, m.note


def _provenance(record: SkipRecord) -> str:
    h = record.host
    return (
        f"{record.time}, commit {record.commit[:12]}{'+changes' if record.commit.endswith('+changes') else ''}, "
        f"{h.cpu}, {h.cores} cores, {h.threads} threads, Python {h.python}, numba {h.versions.get('numba', '?')}; "
        f"size {record.size}. Medians of {len(record.measured.skipping)} interleaved runs; the gain is the median over "
        "pairs of the time without the skip over that with it."
    )
