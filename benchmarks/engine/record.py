"""Tasks, their outcomes, and records of both: JSON lines, appended as tasks are measured.

A record is on the disk before the next task begins; a line whose writing was interrupted is cut off by the next one.
"""

import contextlib
import gc
import hashlib
import logging
import os
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import msgspec

from ctsim.benchmarks.engine.host import Host
from ctsim.dataset.durable import append_synced, cut_torn, write_synced
from ctsim.dataset.locks import locked
from ctsim.errors import InputError

log = logging.getLogger(__name__)

OK = "ok"
BROKEN = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)  # raised by a line that is no record


class Task(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row to measure: everything that determines the result, so that equal identities are measured once.

    `part`, `case` and `subject` name the row. `data` and `code` are hashes; `machine` is set where time is what is
    measured. A study counts `version` up when it measures something else. `place` orders tables, and `hints` tell a
    worker where it finds its inputs; neither determines anything.
    """

    study: str
    part: str = ""
    case: str
    subject: str = ""
    settings: dict[str, Any] = {}
    data: str = ""
    code: str = ""
    machine: str = ""
    version: int = 1
    place: tuple[int, ...] = ()
    hints: dict[str, Any] = {}

    @property
    def identity(self) -> str:
        """SHA-256 over all fields but the place and the hints."""
        fields = msgspec.structs.replace(self, place=(), hints={})
        return hashlib.sha256(msgspec.json.encode(fields, order="sorted")).hexdigest()

    @property
    def row(self) -> tuple[str, str, str]:
        """The row of the table."""
        return self.part, self.case, self.subject


class Found(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The outcome of a task or of one part of it; studies add what they measure.

    `ok` says whether it is as expected; `status` is not "ok" where it did not finish, for the `reason`. `seconds` are
    the times of its runs by name, `files` what it left in the results folder, by path relative to that.
    """

    ok: bool = True
    status: str = OK
    reason: str = ""
    seconds: dict[str, tuple[float, ...]] = {}
    files: dict[str, str] = {}


F = TypeVar("F", bound=Found)


class Record(msgspec.Struct, Generic[F], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A task with its outcome: where, when and by which commit it was measured."""

    task: Task
    found: Annotated[tuple[F, ...], msgspec.Meta(min_length=1)]
    host: Host
    commit: str
    time: str

    @property
    def ok(self) -> bool:
        """Whether every part is as expected."""
        return all(one.ok for one in self.found)

    @property
    def status(self) -> str:
        """The status of the first part that did not end well, else "ok"."""
        for one in self.found:
            if one.status != OK:
                return one.status
        return OK

    @property
    def finished(self) -> bool:
        """Whether every part ended well; otherwise the task is measured again."""
        return self.status == OK

    @property
    def repeats(self) -> int:
        """The least number of timed runs of its parts; 1 where none is timed."""
        return min((len(s) for one in self.found for s in one.seconds.values()), default=1)


R = TypeVar("R", bound=Record[Any])


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Switch the garbage collector off within a block or function: reading and tables take a third less time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


class Store(Generic[R]):
    """The records of one study in a results folder: `NAME.jsonl`, and files of other machines, `NAME-*.jsonl`.

    `what` says in errors what a line should be.
    """

    def __init__(self, folder: Path, name: str, kind: type[R], what: str) -> None:
        self.folder, self.path, self._name, self._kind, self._what = folder, folder / f"{name}.jsonl", name, kind, what
        self._decoder = msgspec.json.Decoder(kind)
        self._warned: set[Path] = set()

    @uncollected()
    def read(self) -> list[R]:
        """Return all records, oldest first; none where there is no file. Warns of a last line that was cut short.

        Raises InputError where a whole line is not a record.
        """
        files = [*self.folder.glob(f"{self._name}.jsonl"), *self.folder.glob(f"{self._name}-*.jsonl")]
        return merged([list(self._of(path)) for path in sorted(files)])

    def append(self, records: Iterable[R]) -> None:
        """Append records and force them to the disk; alone among processes."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.path) as handle:
            self._end_last_line(handle)
            append_synced(self.path, handle, encoded(records))

    def collect(self, others: Sequence[Path]) -> dict[Path, int]:
        """Take over the records of other results folders that this one lacks; return how many came from each.

        What ended well here, or failed here as there, is left out. Files of a record stay where they are. Raises
        InputError for a folder without records.
        """
        brought = {other: Store(other, self._name, self._kind, self._what).read() for other in others}
        for other, records in brought.items():
            if not records:
                raise InputError(f"--collect {other}: there are no records, expected a folder with {self.path.name}")
        self.folder.mkdir(parents=True, exist_ok=True)
        counts: dict[Path, int] = {}
        with locked(self.path) as handle:  # otherwise records that another command appends meanwhile are lost
            self._end_last_line(handle)
            files = [list(self._of(self.path))]
            ended, known = _identities(self.read())
            for other, records in brought.items():
                lacked = [r for r in records if r.task.identity not in (ended if r.finished else known)]
                more_ended, more = _identities(lacked)
                ended, known = ended | more_ended, known | more
                files.append([_moved(r, other, self.folder) for r in lacked])
                counts[other] = len(lacked)
            if any(files[1:]):
                write_synced(self.path, encoded(merged(files)))
        return counts

    def _of(self, path: Path) -> Iterator[R]:
        data = path.read_bytes() if path.exists() else b""
        *lines, rest = data.split(b"\n")  # not splitlines: a carriage return ends no line
        for number, line in enumerate(lines, 1):
            try:
                yield self._decoder.decode(line)
            except BROKEN as error:
                raise InputError(f"{path}, line {number}: expected {self._what}: {error}") from None
        try:
            yield from [self._decoder.decode(rest)] if rest else []
        except BROKEN:
            if path not in self._warned:
                log.warning("%s: the last line was cut short; that measurement is left out", path)
            self._warned.add(path)

    def _end_last_line(self, handle: int) -> None:
        """Remove the broken last line of a killed command; complete one that only lacks its line end."""
        size = os.fstat(handle).st_size
        if not size or os.pread(handle, 1, size - 1) == b"\n":
            return
        with contextlib.suppress(*BROKEN):
            self._decoder.decode(os.pread(handle, size, 0).rpartition(b"\n")[2])
            append_synced(self.path, handle, b"\n")
        cut_torn(handle)


def encoded(records: Iterable[msgspec.Struct]) -> bytes:
    """Return records as lines."""
    return b"".join(msgspec.json.encode(record) + b"\n" for record in records)


def _identities(records: Iterable[Record[Any]]) -> tuple[set[str], set[str]]:
    """Return the identities of records that ended well, and of all."""
    return {r.task.identity for r in records if r.finished}, {r.task.identity for r in records}


def _moved(record: R, source: Path, folder: Path) -> R:
    """Return a record of another results folder with the paths from `folder` to its files."""

    def path(name: str) -> str:
        return os.path.relpath(source.resolve() / name, folder.resolve())

    found = tuple(
        msgspec.structs.replace(one, files={what: path(name) for what, name in one.files.items()})
        for one in record.found
    )
    return msgspec.structs.replace(record, found=found)


def merged(files: Sequence[Sequence[R]]) -> list[R]:
    """Merge the records of several files, oldest first; those of one file keep their order.

    Records are dated by the clocks of several machines, which may be wrong; the order of lines never is.
    """
    if len(files) == 1:
        return list(files[0])
    dated = [
        (time, number, k)
        for number, found in enumerate(files)
        for k, time in enumerate(_never_falling([record.time for record in found]))
    ]
    return [files[number][k] for _, number, k in sorted(dated)]


def _never_falling(times: Sequence[str]) -> list[str]:
    """Return the times of a file's lines; where a clock was out of step with most others, that of the line before."""
    if all(a <= b for a, b in pairwise(times)):
        return list(times)
    # the longest sequence that never falls: `last[n]` is the line that ends one of n + 1 lines at the earliest time
    last: list[int] = []
    ends: list[str] = []
    before: list[int] = []
    for k, time in enumerate(times):
        n = bisect_right(ends, time)
        before.append(last[n - 1] if n else -1)
        last[n : n + 1], ends[n : n + 1] = [k], [time]
    in_step, k = set(), last[-1]
    while k >= 0:
        in_step.add(k)
        k = before[k]
    out, now = [], times[min(in_step)]
    for k, time in enumerate(times):
        now = time if k in in_step else now
        out.append(now)
    return out


def by_row(records: Sequence[R]) -> dict[tuple[str, str, str], list[R]]:
    """Return, for each row, the records of its newest identity, those that ended well where any did.

    Of a case only its newest data count, and the machine that was last to measure it: a scan that was made again
    supersedes all that was measured on the old one, and times of two machines do not compare.
    """
    data = {(r.task.part, r.task.case): r.task.data for r in records}
    records = [r for r in records if r.task.data == data[r.task.part, r.task.case]]
    ended = sorted(records, key=lambda r: r.finished)
    machine = {(r.task.part, r.task.case): r.task.machine for r in ended}
    rows: dict[tuple[str, str, str], list[R]] = {}
    for record in records:
        if record.task.machine == machine[record.task.part, record.task.case]:
            rows.setdefault(record.task.row, []).append(record)
    return {row: _newest(found) for row, found in rows.items()}


def _newest(found: list[R]) -> list[R]:
    if len(found) == 1:
        return found
    identity = found[-1].task.identity
    newest = [r for r in found if r.task.identity == identity]
    return [r for r in newest if r.finished] or newest[-1:]


def latest(records: Sequence[R]) -> list[R]:
    """Return the record of each row that tables show: the last that ended well, without one the last. By place."""
    return sorted((found[-1] for found in by_row(records).values()), key=lambda r: r.task.place)


def done(records: Sequence[R], repeats: int = 1) -> Counter[str]:
    """Count the records of each identity that ended well with at least `repeats` timed runs."""
    return Counter(r.task.identity for r in records if r.finished and r.repeats >= repeats)


def provenance(records: Sequence[R]) -> str:
    """Say when, on which machines and by which commits the records were measured."""
    times = sorted(r.time for r in records)
    machines = dict.fromkeys(
        f"{h.cpu}, {h.cores} cores, {h.threads} threads, Python {h.python}, numba {h.versions.get('numba', '?')}"
        for h in (r.host for r in records)
    )
    commits = dict.fromkeys(short(r.commit) for r in records)
    when = times[0] if times[0] == times[-1] else f"{times[0]} to {times[-1]}"
    return f"{when}, commit {', '.join(commits)}, {' and '.join(machines)}."


def short(commit: str) -> str:
    """Return the first digits of a commit, with "+changes" where files differed from it."""
    return commit[:12] + "+changes" * commit.endswith("+changes")
