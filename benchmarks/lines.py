"""Files of records, one JSON line each, of commands that append as they measure and go on after they were stopped."""

import os
from pathlib import Path
from typing import TypeVar

import msgspec

from ctsim.errors import InputError

R = TypeVar("R", bound=msgspec.Struct)


def append(path: Path, *records: msgspec.Struct) -> None:
    """Append records in one write, forced to the disk; a line whose writing was interrupted is cut off first."""
    if path.exists() and (whole := _whole(data := path.read_bytes())) < len(data):
        os.truncate(path, whole)
    with path.open("ab") as file:
        file.write(b"".join(msgspec.json.encode(record) + b"\n" for record in records))
        file.flush()
        os.fsync(file.fileno())


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
