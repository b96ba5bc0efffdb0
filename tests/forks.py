"""Runs commands in forks of one process that has imported and compiled all, so that a run costs what its work costs.

`Forks` starts this file as that process and asks it for runs: to the end, killed after some time, killed at the n-th
change of a file (half of what was to be written is then written) or after a view, or against a small or read-only disk.
"""

import contextlib
import ctypes
import faulthandler
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

CLONE_NEWNS, CLONE_NEWUSER = 0x00020000, 0x10000000
CAPABILITIES_3 = 0x20080522
RUN = "CTSIM_TEST_RUN"  # the output folder, in the environment of all that a run starts
HANGS = 120.0  # seconds after which a run tells where it is and ends
LARGEST = 8192  # less than a volume of the tests
COUNTED = ("write", "pwrite", "fsync", "fdatasync", "replace", "rename", "unlink", "mkdir", "ftruncate")


@dataclass(frozen=True)
class Run:
    """How a run ended: exit code (negative for a signal), what it said, seconds, changes of files, if it was hit."""

    code: int
    said: str
    seconds: float
    changes: int
    hit: bool = False


class Forks:
    """The process that forks; a context manager."""

    def __enter__(self) -> Self:
        one = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_THREADING_LAYER": "workqueue"}  # survive a fork
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            env={**os.environ, **one},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=60)

    def run(self, *command: object, **how: Any) -> Run:
        """Run a command in a fork, killed at seconds= or change=, on a disk=(empty folder, bytes), or powerless=True.

        With view=(number, file) it is killed by `die_after`. With target="worker" one of its workers is killed, with
        target="interrupt" it hears Ctrl-C, each at seconds= and once a worker is there. With begun=file, which has to
        be there, it is killed at seconds= or later.
        A disk that holds= a copy of a folder has no room for anything else.
        With here=True it is run in the process that forks, which has compiled it then.
        """
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps({"command": [str(word) for word in command], **how}) + "\n")
        self._process.stdin.flush()
        return Run(**json.loads(self._process.stdout.readline()))


def serve() -> None:
    """Import, then answer requests from stdin until it closes."""
    import ctsim.benchmarks.make_dataset.work
    import ctsim.benchmarks.studies.methods.panels
    import ctsim.benchmarks.studies.methods.run
    import ctsim.benchmarks.studies.methods.study
    import ctsim.dataset.writer
    import ctsim.phantoms.scene

    note_every_view(ctsim.dataset.writer.SceneWriter)
    assert all(
        (
            ctsim.benchmarks.studies.methods.study,
            ctsim.benchmarks.make_dataset.work,
            ctsim.benchmarks.studies.methods.panels,
            ctsim.benchmarks.studies.methods.run,
            ctsim.phantoms.scene,
        )
    )
    ctsim.benchmarks.studies.methods.panels.DPI = 20  # a picture is to be there; most of the time it would be drawn
    for line in sys.stdin:
        sys.stdout.write(json.dumps(attempt(**json.loads(line))) + "\n")
        sys.stdout.flush()


def note_every_view(writer: type) -> None:
    """Note each view as safe. Usually that takes seconds, in which a small scene is done: no run would go on in one."""
    writer.__init__.__kwdefaults__["sync_seconds"] = 0.0


def die_after(writer: type, view: int, mark: Path) -> None:
    """Kill the process that has noted this view as safe: once, as the file `mark` is there then.

    Each process that writes the next view adds to the file at which view it began.
    """

    def put(self: Any, number: int, arrays: Any, real: Any = writer.put) -> None:
        if number == view + 1:
            with mark.open("a") as file:
                file.write(f"{self.first_view}\n")
        real(self, number, arrays)
        if number == view:
            with contextlib.suppress(FileExistsError):
                mark.touch(exist_ok=False)
                os.kill(os.getpid(), signal.SIGKILL)

    writer.put = put


def patient(scan: Any, *, device: str) -> Any:
    """Reconstruct by FDK, but the first process that is asked waits for its end: RUN with .waits is a file then."""
    from ctsim.reconstruct.fdk import reconstruct

    with contextlib.suppress(FileExistsError):
        Path(os.environ[RUN] + ".waits").touch(exist_ok=False)
        time.sleep(HANGS)
    return reconstruct(scan)


def running(output: Path) -> list[int]:
    """Return the processes that runs into this folder have started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # it has ended, or is somebody else's
            if f"{RUN}={output}".encode() in path.read_bytes().split(b"\0"):
                found.append(int(path.parent.name))
    return found


def strike(child: int, target: str, begun: str | None) -> bool:
    """Send a signal to a run or one of its workers; return whether the moment has come."""
    if begun is not None and not os.path.exists(begun):
        return False
    workers = []
    for thread in Path(f"/proc/{child}/task").glob("*/children"):
        for pid in thread.read_text().split():
            with contextlib.suppress(OSError):
                if b"process.serve(" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    workers.append(int(pid))
    if target != "command" and not workers:
        return False
    os.kill(workers[-1] if target == "worker" else child, signal.SIGINT if target == "interrupt" else signal.SIGKILL)
    return True


def attempt(
    command: list[str],
    here: bool = False,
    seconds: float | None = None,
    target: str = "command",
    begun: str | None = None,
    **how: Any,
) -> dict[str, Any]:
    """Do what `Forks.run` asks for."""
    start, hit = time.perf_counter(), False
    said, counted = os.memfd_create("said"), os.memfd_create("counted")
    if here:
        before = os.dup(1), os.dup(2)
        os.dup2(said, 1)
        os.dup2(said, 2)
        code = call(command)
        os.dup2(before[0], 1)
        os.dup2(before[1], 2)
    else:
        child = os.fork()
        if not child:
            os.dup2(said, 1)
            os.dup2(said, 2)
            be(command, counted, **how)
        while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
            if seconds is not None and not hit and time.perf_counter() - start >= seconds:
                hit = strike(child, target, begun)
            time.sleep(0.0005)
        code = os.waitstatus_to_exitcode(ended[1])
    text = os.pread(said, 10**6, 0).decode()
    changes = int(os.pread(counted, 20, 0) or b"0")
    os.close(said)
    os.close(counted)
    return {"code": code, "said": text, "seconds": time.perf_counter() - start, "changes": changes, "hit": hit}


def be(
    command: list[str],
    counted: int,
    change: int | None = None,
    disk: Any = None,
    holds: str | None = None,
    powerless: bool = False,
    view: tuple[int, str] | None = None,
) -> None:
    """Be the command."""
    code = 99
    faulthandler.dump_traceback_later(HANGS, exit=True)
    os.environ[RUN] = command[2]
    try:
        if disk:
            from ctsim.benchmarks.make_dataset import work

            if holds is None:
                work._SPARE = -(2**40)  # else a disk that is too small would be refused before the first byte
            disk = disk if small_disk(*disk) else None
            if holds is not None and disk is not None:
                fill(Path(disk[0]), holds)
        if powerless:
            drop_powers()
        if view:
            from ctsim.dataset.writer import SceneWriter

            die_after(SceneWriter, view[0], Path(view[1]))
        changes = count_changes(change)
        code = call(command)
        os.pwrite(counted, str(changes[0]).encode(), 0)
        if disk:
            subprocess.run(["cp", "-a", disk[0], disk[0] + ".left"], check=True)  # it vanishes with this process
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def call(command: list[str]) -> int:
    """Call a command as its console script does."""
    from ctsim.benchmarks import cli

    sys.argv = command
    code = {"make-dataset": cli.make_dataset, "run-benchmark": cli.run_benchmark}[command[0]]()
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def count_changes(deadly: int | None) -> list[int]:
    """Count the calls that change files; at number `deadly` do half of a write, or nothing, and be killed."""
    count = [0]

    def counting(name: str, real: Any) -> Any:
        def call(*given: Any, **more: Any) -> Any:
            count[0] += 1
            if count[0] == deadly:
                if name in ("write", "pwrite"):
                    data = memoryview(given[1])
                    real(given[0], data[: data.nbytes // 2], *given[2:])
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*given, **more)

        return call

    for name in COUNTED:
        setattr(os, name, counting(name, getattr(os, name)))
    return count


def small_disk(folder: str, size: int) -> bool:
    """Mount a disk of `size` bytes on an empty folder, seen by this process alone; return whether it is there.

    Where the system does not let a user do so, no file can grow beyond `LARGEST` bytes instead.
    """
    libc = ctypes.CDLL(None)
    user, group = os.getuid(), os.getgid()
    try:
        if libc.unshare(CLONE_NEWUSER | CLONE_NEWNS):
            raise PermissionError
        for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
            Path(f"/proc/self/{name}").write_text(text)
        if libc.mount(b"tmpfs", folder.encode(), b"tmpfs", 0, f"size={size}".encode()):
            raise PermissionError
    except OSError:
        resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, LARGEST))
        return False
    return True


def fill(disk: Path, holds: str) -> None:
    """Copy a folder onto an empty disk, and let nothing of its room remain."""
    shutil.copytree(holds, disk, dirs_exist_ok=True)
    with contextlib.suppress(OSError), (disk / ".filler").open("wb", buffering=0) as file:
        while True:
            file.write(b"x" * 4096)
    assert shutil.disk_usage(disk).free == 0


def drop_powers() -> None:
    """Give up all capabilities, so that modes of files bind root too."""

    class Header(ctypes.Structure):
        _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))

    ctypes.CDLL(None).capset(ctypes.byref(Header(CAPABILITIES_3, 0)), (ctypes.c_uint32 * 6)())


if __name__ == "__main__":
    serve()
