"""Files of records, one JSON line each, of commands that append as they measure and go on after they were stopped."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar, cast

import msgspec

from ctsim.durable import append_synced, cut_torn, locked, write_synced
from ctsim.errors import InputError

R = TypeVar("R", bound=msgspec.Struct)


class _Dated(Protocol):
    time: str


def append(path: Path, *records: msgspec.Struct) -> None:
    """Append records and force them to the disk, alone among processes.

    A line whose writing was interrupted is cut off first.
    """
    with locked(path) as handle:
        cut_torn(handle)
        append_synced(path, handle, b"".join(msgspec.json.encode(record) + b"\n" for record in records))


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
    decoder, found = msgspec.json.Decoder(kind), []
    for number, line in enumerate(data[: _whole(data)].splitlines(), 1):
        try:
            found.append(decoder.decode(line))
        except msgspec.MsgspecError as error:
            raise InputError(f"{path}, line {number}: expected {what}: {error}") from None
    return found


def collect(path: Path, others: Sequence[Path], kind: type[R], what: str) -> dict[Path, int]:
    """Take over the records that `path` lacks of files of its name in other folders; return how many from each.

    The file is replaced whole, all records in the order of their `time`, so that the newest is the last.
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
        for other, found in brought.items():
            lacked = {line: record for record in found if (line := msgspec.json.encode(record)) not in held}
            held |= lacked
            counts[other] = len(lacked)
        ordered = sorted(held, key=lambda line: cast(_Dated, held[line]).time)
        write_synced(path, b"".join(line + b"\n" for line in ordered))
    return counts


def take_over(path: Path, others: Sequence[Path], kind: type[R], what: str, *, dry_run: bool) -> None:
    """Do what --collect asks for and say how many records came from each folder; nothing without folders.

    Raises InputError with --dry-run, which promises to write nothing.
    """
    if others and dry_run:
        raise InputError("--collect writes records, --dry-run writes nothing: expected one of them")
    for other, count in collect(path, others, kind, what).items() if others else ():
        sys.stderr.write(f"{other}: {count} records taken over\n")
