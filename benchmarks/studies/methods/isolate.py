"""Run one method in a process of its own, with its own memory count and an optional time limit."""

import functools
import pkgutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.engine import apart
from ctsim.benchmarks.studies.methods import intermediates
from ctsim.benchmarks.studies.methods.intermediates import Intermediates
from ctsim.benchmarks.studies.methods.records import Cost

if TYPE_CHECKING:
    from ctsim.benchmarks.methods import Method

_RESULT, _SHOWN = "outcome.json", "intermediates.npz"
_VOLUMES = ("values", "at_50kev")


@dataclass(slots=True, kw_only=True)
class Outcome:
    """How a run ended: its status and reason, the volume [z, y, x] float32 in 1/mm if any, and its cost.

    `at_50kev` is the volume at 50 keV of a method that knows energies.
    `intermediates` are what the method worked with, for pictures (`.intermediates`); `details` what it
    says of its result, for the record (`.details`).
    """

    status: str
    reason: str = ""
    values: NDArray[np.float32] | None = None
    at_50kev: NDArray[np.float32] | None = None
    cost: Cost | None = None
    intermediates: Intermediates = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


class _Ended(msgspec.Struct, frozen=True, kw_only=True):
    """What the process leaves behind beside the volume."""

    status: str
    reason: str
    cost: Cost | None
    details: dict[str, Any]


def _work(store: str, folder: str, variant: str, method: "Method", device: str, out: str) -> None:
    """Be the process: open the scan, warm up, run, leave the outcome in `out`."""
    from ctsim.benchmarks.studies.methods.attempt import run_here, scan_for, warm_up

    stored = pkgutil.resolve_name(store)(folder)
    warm = warm_up(method, scan_for(method, stored, "metal"), device)
    outcome = run_here(stored, variant, method, device, warm)
    for name in _VOLUMES:
        if (volume := getattr(outcome, name)) is not None:
            np.save(Path(out) / f"{name}.npy", volume)
    if outcome.intermediates:
        intermediates.write(Path(out) / _SHOWN, outcome.intermediates, "")
    cost = None if outcome.cost is None else msgspec.structs.replace(outcome.cost, isolated=True)
    ended = _Ended(status=outcome.status, reason=outcome.reason, cost=cost, details=outcome.details)
    (Path(out) / _RESULT).write_bytes(msgspec.json.encode(ended))


def run_apart(store: str, folder: Path, variant: str, method: "Method", device: str, seconds: float | None) -> Outcome:
    """Run `method` on the scan in `folder` in a new process and wait at most `seconds` for it.

    The limit counts the whole process, with its start and compilation. `store` is the "module:function"
    that opens the folder.
    """
    with tempfile.TemporaryDirectory(prefix="run-benchmark-") as out:
        work = functools.partial(_work, store, str(folder), variant, method, device, out)
        with apart.started(work) as process:
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                return Outcome(status="timeout", reason=f"did not end within {seconds:g} s")
        return _collect(Path(out), process.returncode)


def how_it_ended(exit_code: int) -> str:
    """Name the signal or the exit code that a process ended with."""
    return f"signal {signal.Signals(-exit_code).name}" if exit_code < 0 else f"exit code {exit_code}"


def _collect(out: Path, exit_code: int) -> Outcome:
    """Read what the process left, or say how it died."""
    if not (out / _RESULT).exists():
        if exit_code == -signal.SIGKILL and sys.platform != "win32":
            return Outcome(
                status="out_of_memory", reason="the process was killed, as the system does when memory is short"
            )
        return Outcome(status="error", reason=f"the process died with {how_it_ended(exit_code)}")
    ended = msgspec.json.decode((out / _RESULT).read_bytes(), type=_Ended)
    volumes = {name: np.load(path) for name in _VOLUMES if (path := out / f"{name}.npy").exists()}
    shown = intermediates.read(out / _SHOWN, "")
    return Outcome(
        status=ended.status,
        reason=ended.reason,
        cost=ended.cost,
        intermediates=shown,
        details=ended.details,
        **volumes,
    )
