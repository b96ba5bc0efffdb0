"""Files of records, one JSON line each, of commands that append as they measure and go on after they were stopped."""

import sys
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Protocol, TypeVar, cast

import msgspec

from ctsim.durable import append_synced, cut_torn, write_synced
from ctsim.errors import InputError
from ctsim.locks import locked

R = TypeVar("R", bound=msgspec.Struct)


class _Dated(Protocol):
    time: str


def decoded(line: bytes, decoder: msgspec.json.Decoder[R], where: str, what: str) -> R:
    """Decode a line; `where` (file and line) and `what` (a kind of record) stand in the message.

    Raises InputError whatever is wrong with it.
    """
    try:
        return decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{where}: expected {what}: {error}") from None


def encoded(records: Iterable[msgspec.Struct]) -> bytes:
    """Return records as lines."""
    return b"".join(msgspec.json.encode(record) + b"\n" for record in records)


def merged(files: Sequence[Sequence[R]]) -> list[R]:
    """Merge the records of several files, oldest first; those of one file keep their order.

    Records are dated by the clocks of several machines, which may be wrong; the order of lines never is.
    """
    dated = [
        (time, number, k)
        for number, found in enumerate(files)
        for k, time in enumerate(_never_falling([cast(_Dated, record).time for record in found]))
    ]
    return [files[number][k] for _, number, k in sorted(dated)]


def _never_falling(times: Sequence[str]) -> list[str]:
    """Return the times of a file's lines, where a clock was out of step with most others that of the line before."""
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


def append(path: Path, *records: msgspec.Struct) -> None:
    """Append records and force them to the disk, alone among processes.

    A line whose writing was interrupted is cut off first.
    """
    with locked(path) as handle:
        cut_torn(handle)
        append_synced(path, handle, encoded(records))


def _whole(data: bytes) -> int:
    """Return how many bytes are whole lines."""
    return data.rfind(b"\n") + 1


def read(path: Path, kind: type[R], what: str) -> list[R]:
    """Read the records, none where there is no file; the rest of a line that was interrupted is left out.

    Raises InputError where a whole line is not a record of this kind, called `what` in the message.
    """
    if not path.exists():
        return []
    data = path.read_bytes()
    decoder, lines = msgspec.json.Decoder(kind), data[: _whole(data)].splitlines()
    return [decoded(line, decoder, f"{path}, line {number}", what) for number, line in enumerate(lines, 1)]


def collect(path: Path, others: Sequence[Path], kind: type[R], what: str) -> dict[Path, int]:
    """Take over the records that `path` lacks of files of its name in other folders; return how many from each.

    The file is replaced whole, all records in the order of `merged`, so that the newest is the last.
    Raises InputError for a folder without records.
    """
    brought = {other: read(other / path.name, kind, what) for other in others}
    for other, found in brought.items():
        if not found:
            raise InputError(f"--collect {other}: there are no records, expected a folder with {path.name}")
    path.parent.mkdir(parents=True, exist_ok=True)
    counts = {}
    with locked(path):  # what another command appends meanwhile would be lost
        held = {msgspec.json.encode(record): record for record in read(path, kind, what)}
        files = [list(held.values())]
        for other, found in brought.items():
            lacked = {line: record for record in found if (line := msgspec.json.encode(record)) not in held}
            held |= lacked
            files.append(list(lacked.values()))
            counts[other] = len(lacked)
        write_synced(path, encoded(merged(files)))
    return counts


def take_over(path: Path, others: Sequence[Path], kind: type[R], what: str, *, dry_run: bool) -> None:
    """Do what --collect asks for and say how many records came from each folder; nothing without folders.

    Raises InputError with --dry-run, which promises to write nothing.
    """
    if others and dry_run:
        raise InputError("--collect writes records, --dry-run writes nothing: expected one of them")
    for other, count in collect(path, others, kind, what).items() if others else ():
        sys.stderr.write(f"{other}: {count} records taken over\n")
