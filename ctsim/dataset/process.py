"""Which process left a file, and whether it still runs."""

import contextlib
import os
import platform
import zlib
from pathlib import Path


def machine() -> str:
    """Return 8 hexadecimal digits for this machine since it started and, in a container, for its process numbers."""
    known = [platform.node()]
    with contextlib.suppress(OSError):  # elsewhere than on Linux the host's name alone
        known += [Path("/proc/sys/kernel/random/boot_id").read_text(), os.readlink("/proc/self/ns/pid")]
    return f"{zlib.crc32(' '.join(known).encode()):08x}"


def started(pid: int) -> str:
    """Return when a process of this machine started, as the system counts; empty where it does not say."""
    return _stat(pid)[1]


def ended(on: str, pid: int, since: str = "") -> bool:
    """Say whether a process has surely ended: False also for one of another `machine`, of which nothing is known.

    `since` is what `started` said of it: another process may have its number by now.
    """
    if on != machine():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass  # it runs, as another user's
    state, now = _stat(pid)
    return state in ("Z", "X") or bool(since and now and since != now)


def _stat(pid: int) -> tuple[str, str]:
    """Return the state and the start of a process, empty where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return fields[0], fields[19]
    except (OSError, IndexError):
        return "", ""
