"""Score the kept volumes of a results folder again, after a protocol changed and no method did.

    python -m ctsim.benchmarks.tools.rescore results/ data/ [PROTOCOL ...]

Each last record of an older protocol version gets one of the present version with new scores: of the protocols named,
which are those that the new version changed, or of all; the others keep theirs, which only records of the version
before may. Its volume, cost, time
and commit stay those of the run; the details name the commit that scored it again. What has no volume is left out and
said.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from msgspec.structs import replace

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.host import commit
from ctsim.benchmarks.engine.record import Store, latest
from ctsim.benchmarks.scores.judge import Judge, Twin
from ctsim.benchmarks.scores.projection import HeldOut
from ctsim.benchmarks.scores.score import NO_TWIN, NOT_ASKED, PROJECTION, PROTOCOLS, TWIN_ENDED, VERSION
from ctsim.benchmarks.studies.methods import heldout
from ctsim.benchmarks.studies.methods.attempt import SCORED
from ctsim.benchmarks.studies.methods.records import FILE, METAL, WHAT, RunRecord, read
from ctsim.benchmarks.studies.methods.volumes import identity_of, keep, own_at_50kev, read_volume
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError

AGAIN = "scored again"  # among the details


def main(arguments: list[str]) -> int:
    """Append the new records; return 0 if all could be scored, else 1."""
    if len(arguments) < 2:
        raise InputError("expected RESULTS, DATA and protocols or none")
    results, protocols = Path(arguments[0]), tuple(arguments[2:]) or PROTOCOLS
    if unknown := [name for name in protocols if name not in PROTOCOLS]:
        raise InputError(f"{unknown[0]!r}: expected protocols among {', '.join(PROTOCOLS)}")
    scans = {scan.content_hash: scan for scan in map(open_scan, list_scans(Path(arguments[1])))}
    shown = latest(read(results))
    store, missing = Store(results, FILE, RunRecord, WHAT), 0
    for data in dict.fromkeys(record.task.data for record in shown if record.task.version != VERSION):
        rows = [record for record in shown if record.task.data == data]
        if data not in scans or not scans[data].has_truth:
            why = "was measured: run the methods again" if data in scans else f"is not in {arguments[1]}"
            sys.stderr.write(f"{rows[0].task.case}: the scan {why}\n")
            missing += len(rows)
            continue
        for record in _scored(rows, scans[data], results, protocols):
            missing += record is None
            if record is not None:
                store.append([record])
                sys.stderr.write(f"{record.task.case}: {record.label}, {record.task.part}\n")
    return 1 if missing else 0


def _scored(
    rows: Sequence[RunRecord], stored: StoredScan, results: Path, protocols: Sequence[str]
) -> Iterator[RunRecord | None]:
    """Score the rows of one scan again, the scan itself before its twin, whose volume it needs as the run left it."""
    views = heldout.kept(stored, results) if PROJECTION in protocols else "not scored again"
    judge = Judge.of(stored, views)
    if views is None and isinstance(judge.views, HeldOut):
        heldout.keep(judge.views, stored, results)
    for row in sorted(rows, key=lambda r: r.task.part != METAL):
        if row.task.version != VERSION:
            twin = next((r for r in rows if r.label == row.label and r.task.part != METAL), None)
            yield _again(row, _pair(twin, stored, results), judge, results, protocols)


def _pair(twin: RunRecord | None, stored: StoredScan, results: Path) -> Twin:
    if stored.metal_free is None:
        return Twin(reason=NO_TWIN)
    if twin is None:
        return Twin(reason=NOT_ASKED)
    if twin.found[0].status not in SCORED:
        return Twin(reason=f"{TWIN_ENDED} {twin.found[0].status}: {twin.reason}")
    path = _volume_of(twin, results)
    return Twin(reason=NOT_ASKED) if path is None else Twin(values=read_volume(path))


def _again(row: RunRecord, pair: Twin, judge: Judge, results: Path, protocols: Sequence[str]) -> RunRecord | None:
    """Return a record with new scores, and let the volume name its run; None where the volume is not there."""
    result, task = row.found[0], replace(row.task, version=VERSION)
    if result.status not in SCORED:
        return replace(row, task=task)
    path, whole = _volume_of(row, results), set(protocols) == set(PROTOCOLS)
    if path is None or not (whole or row.task.version == VERSION - 1):
        why = f"the run's volume is not in {results}" if path is None else f"of version {row.task.version}: name none"
        sys.stderr.write(f"{row.task.case}: {row.label}, {row.task.part}: {why}\n")
        return None
    at_50kev = own_at_50kev(path, row.identity)
    values, mono = read_volume(path), None if at_50kev is None else read_volume(at_50kev)
    scores = result.scores | judge.scores(values, row.task.part, pair, mono, protocols)
    keep(path, values, mono, task.identity)
    return replace(row, task=task, found=(replace(result, scores=scores, details=result.details | {AGAIN: commit()}),))


def _volume_of(row: RunRecord, results: Path) -> Path | None:
    path = None if row.volume is None else results / row.volume
    return path if path is not None and identity_of(path) == row.identity else None


if __name__ == "__main__":
    sys.exit(guarded("rescore", "ctsim.benchmarks.tools.rescore", sys.argv[1:]))
