"""Records: one JSON line per measurement, appended and flushed, so that a crash loses one line at most.

A run is what a scene, its files, a method, its parameters and its code determine; its identity is a
SHA-256 over them. Of a run that was recorded several times the last record that is ok counts, without one the last.
Within a file the order of lines says which is the last; times come from the clocks of several machines and only merge
files. Workers hand their records to the command that started them, which alone appends; the lock on the file is for
two commands on one folder.
"""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.collector import uncollected
from ctsim.benchmarks.engine.host import Host
from ctsim.benchmarks.methods import TABLE
from ctsim.benchmarks.scores.protocol import VERSION, Score
from ctsim.durable import append_synced, write_synced
from ctsim.errors import InputError
from ctsim.folder import mixture
from ctsim.locks import locked

NAME, WHAT = "records.jsonl", "a record of run-benchmark"
OK = "ok"


class Cost(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a run took: seconds, bytes, views used times passes; the warm-up stands apart."""

    wall: float
    cpu: float
    peak_bytes: int
    view_updates: int
    device: str
    warm_up: float = 0.0
    isolated: bool = False


class Run(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What determines a measurement; `identity` hashes it.

    `variant` is "metal" for the scan itself and "metal_free" for its twin; `mask` names the source of
    a metal mask ("none", "oracle", "auto"); `code` hashes the method's sources.
    """

    scene: str
    scene_id: str
    scan: str
    seed: int
    method: str
    params: dict[str, Any]
    mask: str = "none"
    variant: str = "metal"
    code: str = ""
    protocol: int = VERSION

    @property
    def identity(self) -> str:
        """SHA-256 over all fields, independent of their order."""
        return hashlib.sha256(msgspec.json.encode(self, order="sorted")).hexdigest()


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement: the run, how it ended, its scores under each protocol, cost and provenance.

    `label` is the method with the parameters that differ from its defaults; `inputs` what the method
    needs beside the counts; `volume` the path of the kept volume relative to the results folder; `place`
    the numbers of the scan in its dataset and of the method in its command, by which tables are ordered;
    `details` what the method says of its result (`.details`); `data_code` hashes the code of the
    simulator that made the scan (empty: not noted).
    """

    identity: str
    run: Run
    label: str
    inputs: str
    status: str
    reason: str = ""
    scores: dict[str, Score] = {}
    cost: Cost | None = None
    volume: str | None = None
    place: tuple[int, int] = (0, 0)
    host: Host | None = None
    commit: str = "unknown"
    time: str = ""
    details: dict[str, Any] = {}
    data_code: str = ""


class Torn(msgspec.Struct, frozen=True, kw_only=True):
    """The rest of a line whose writing was interrupted: its file, where it begins, and its length in bytes."""

    path: Path
    offset: int
    length: int

    def __str__(self) -> str:
        return f"{self.path}: the last line was cut short ({self.length} bytes); that measurement is left out"


def append(path: Path, record: Record) -> None:
    """Append one record and force it to the disk.

    Raises OSError where it cannot be written; the file is then as it was before.
    """
    line = msgspec.json.encode(record) + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path) as descriptor:
        _mend(path, descriptor)  # another command may have been killed while it wrote
        append_synced(path, descriptor, line)


@uncollected()
def read(path: Path) -> tuple[list[Record], Torn | None]:
    """Read a records file; a last line that was cut short is left out and returned as `Torn`.

    Raises InputError where any other line is not a record. A file that is not there has no records.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return [], None
    records: list[Record] = []
    decoder = msgspec.json.Decoder(Record)
    offset = 0
    for number, line in enumerate(data.splitlines(keepends=True), 1):
        if line.strip():
            try:
                records.append(lines.decoded(line, decoder, f"{path}, line {number}", WHAT))
            except InputError:
                if not line.endswith(b"\n"):
                    return records, Torn(path=path, offset=offset, length=len(line))
                raise
        offset += len(line)
    return records, None


def repair(path: Path) -> Torn | None:
    """Set aside the rest of a torn last line beside the file, so that records can be appended again.

    Returns what was torn, None where nothing was. A whole last line that only lacks its end gets it.
    """
    if not path.exists():
        return None
    with locked(path) as descriptor:
        return _mend(path, descriptor)


def _mend(path: Path, descriptor: int) -> Torn | None:
    """Do what `repair` says with a file that is locked."""
    size = os.fstat(descriptor).st_size
    if not size or os.pread(descriptor, 1, size - 1) == b"\n":
        return None
    _, torn = read(path)
    if torn is None:
        append_synced(path, descriptor, b"\n")
    else:
        path.with_suffix(".torn").write_bytes(os.pread(descriptor, torn.length, torn.offset))
        os.ftruncate(descriptor, torn.offset)
    return torn


def read_all(results: Path) -> tuple[list[Record], list[Torn]]:
    """Read every `records*.jsonl` of a results folder, oldest record first: files of other machines merge so."""
    found = [read(path) for path in sorted(results.glob("records*.jsonl"))]
    return lines.merged([records for records, _ in found]), [torn for _, torn in found if torn]


def collect(results: Path, others: Sequence[Path]) -> dict[Path, int]:
    """Take over the records that `results` lacks of other results folders; return how many came from each.

    What is there already is left out, and so is a run that failed there as here. Volumes stay where they
    are: a collected record leads to them. The file is replaced whole, see `lines.merged`. Raises InputError for a
    folder without records.
    """
    if not others:
        return {}
    brought = {other: last(read_all(other)[0]) for other in others}
    for other, found in brought.items():
        if not found:
            raise InputError(f"--collect {other}: there are no records, expected a results folder of run-benchmark")
    results.mkdir(parents=True, exist_ok=True)
    path = results / NAME
    with locked(path) as descriptor:  # what another command appends meanwhile would be lost
        _mend(path, descriptor)
        known, files = last(read_all(results)[0]), [read(path)[0]]
        for other, found in brought.items():
            lacked = {k: _of(other, r, results) for k, r in found.items() if k not in known or _mends(r, known[k])}
            files.append(list(lacked.values()))
            known |= lacked
        if any(files[1:]):
            write_synced(path, lines.encoded(lines.merged(files)))
    return {other: len(lacked) for other, lacked in zip(brought, files[1:], strict=True)}


def _mends(record: Record, known: Record) -> bool:
    """Say whether a record ended well of a run that is known to have failed."""
    return record.status == OK and known.status != OK


def _of(other: Path, record: Record, results: Path) -> Record:
    """Return a record of another results folder with the way from `results` to its volume."""
    volume = record.volume and os.path.relpath(other.resolve() / record.volume, results.resolve())
    return msgspec.structs.replace(record, volume=volume)


def latest(records: list[Record]) -> list[Record]:
    """Keep what a table shows: of each scene, seed, variant and method label the run that was recorded last.

    Only this protocol version counts, and only the newest data of a scene and seed: a scan that was made
    anew supersedes all that was measured on the old one, and a method's new code supersedes its old.
    Their order is that of the dataset, of the methods table and of the command, whichever run ended first.
    """
    records = [r for r in records if r.run.protocol == VERSION]
    newest = {(r.run.scene, r.run.seed): (r.run.scene_id, r.run.scan) for r in records}
    rows: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        run = record.run
        if newest[run.scene, run.seed] == (run.scene_id, run.scan):
            rows.setdefault((run.scene, run.seed, run.variant, record.label), []).append(record)
    kept = [last(found)[found[-1].identity] for found in rows.values()]
    scenes: dict[str, int] = {}
    labels: dict[str, int] = {}
    for record in kept:
        scene, method = record.place
        scenes[record.run.scene] = min(scene, scenes.get(record.run.scene, scene))
        labels[record.label] = min(method, labels.get(record.label, method))
    columns = _numbered(sorted(scenes, key=lambda scene: scenes[scene]))
    methods = _numbered(sorted(labels, key=lambda label: (rank(label), labels[label])))

    def order(record: Record) -> tuple[int, int, int, bool]:
        run = record.run
        return columns[run.scene], run.seed, methods[record.label], run.variant == "metal"

    return sorted(kept, key=order)


def _numbered(names: list[str]) -> dict[str, int]:
    return {name: k for k, name in enumerate(names)}


def rank(label: str) -> int:
    """Return the place of a method in the methods table by its label; those outside come after all of it."""
    return list(TABLE).index(name) if (name := label.partition("[")[0]) in TABLE else len(TABLE)


def outdated(records: list[Record]) -> str:
    """Say in one sentence how many records are of other protocol versions and so in no table; "" if none is."""
    others = [r.run.protocol for r in records if r.run.protocol != VERSION]
    if not others:
        return ""
    versions = ", ".join(str(v) for v in sorted(set(others)))
    return (
        f"{len(others)} of {len(records)} records are of protocol version {versions} and left out: "
        f"this is version {VERSION}, run the methods again"
    )


def remarks(records: list[Record]) -> list[str]:
    """Say, a sentence without its stop each, what tables of these records leave out and what they mix."""
    shown = latest(records)
    known = {r.run.scan: r.data_code for r in shown if r.data_code}  # records of before that do not note it
    made = {f"{r.run.scene} (seed {r.run.seed})": known.get(r.run.scan, "") for r in shown}
    return [text for text in (outdated(records), mixture(made.items())) if text]


def last(records: list[Record]) -> dict[str, Record]:
    """Return the record of each identity that counts: the last that is ok, without one the last.

    The same data, parameters and code failed another time for a reason that lies outside them.
    """
    found: dict[str, Record] = {}
    for record in records:
        known = found.get(record.identity)
        if known is None or record.status == OK or known.status != OK:
            found[record.identity] = record
    return found


def done(records: list[Record]) -> set[str]:
    """Return the identities that need no rerun: those with a record that is ok. Failures are never among them."""
    return {identity for identity, record in last(records).items() if record.status == OK}
