"""One run of a method in this process: a warm-up, the measured run, and its outcome, failures included.

Runs that share a process do not affect each other: each has its own view of the data, and the state of the process is
restored after it (`restored`).
"""

import contextlib
import dataclasses
import gc
import logging
import os
import random
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.benchmarks.engine.host import measured
from ctsim.benchmarks.methods import Method, named
from ctsim.benchmarks.program import USAGE, ProgramError
from ctsim.benchmarks.scores.score import NO_TWIN
from ctsim.benchmarks.studies.methods.records import METAL, Cost
from ctsim.benchmarks.studies.methods.volumes import Intermediates, attached, recordable
from ctsim.dataset.store import StoredScan
from ctsim.dataset.truth import ScanWithTruth
from ctsim.errors import InputError, Unsuited
from ctsim.reconstruct.watch import resumed
from ctsim.simulate import REFERENCE_KEV
from ctsim.types import Scan, Status, Volume

log = logging.getLogger(__name__)

SCORED = ("ok", "diverged")  # a run's status
WARM, WARM_UPS = 1.0, 5  # for methods with a time limit: seconds of a warm-up, and how often it is repeated at most


@dataclass(slots=True, kw_only=True)
class Outcome:
    """How a run ended: its status and reason, the volume [z, y, x] float32 in 1/mm if any, and its cost.

    `at_50kev` is the volume at 50 keV of a method that knows energies.
    `intermediates` are arrays the method worked with, for pictures; `details` go into the record.
    """

    status: str
    reason: str = ""
    values: NDArray[np.float32] | None = None
    at_50kev: NDArray[np.float32] | None = None
    cost: Cost | None = None
    intermediates: Intermediates = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    def fail(self, status: str, reason: str) -> None:
        """Replace the volumes by a status and its reason."""
        self.status, self.reason, self.values, self.at_50kev = status, reason, None, None


def scan_for(method: Method, stored: ScanWithTruth, variant: str) -> Scan:
    """Return the scan or its metal-free twin, with the true mask for a method of mask "oracle" (the twin's is empty).

    A row of the table that is told the twin gets the twin as its scan: nothing else leads a method there. The arrays
    are not shared. Raises InputError where there is no twin.
    """
    found = stored if variant == METAL and not method.told_twin else stored.metal_free
    if found is None:
        raise InputError(f"scan {stored.name!r} has no metal-free twin")
    if method.mask != "oracle":
        return found.scan
    metal = np.asarray(stored.metal) > 0
    return dataclasses.replace(found.scan, metal=torch.from_numpy(metal & (variant == METAL)))


def run_here(stored: StoredScan, variant: str, method: Method, warm_up_seconds: float) -> Outcome:
    """Run a method in this process on its own view of the scan; a method that changes its input has failed."""
    try:
        scan = scan_for(method, stored, variant)
        outcome = attempt(method, scan, warm_up_seconds)
        parts = ", ".join(changed(scan, scan_for(method, stored, variant)))
    except InputError as error:  # about the scan's files; a method's errors are outcomes
        return Outcome(status="error", reason=describe(error))
    if parts:
        what = f"the method changed its input ({parts}): expected it to work on a copy"
        outcome.fail("error", what if outcome.status in (*SCORED, "nonfinite") else f"{outcome.reason}; {what}")
        outcome.intermediates, outcome.details = {}, {}
    return outcome


def skip(method: Method, stored: StoredScan, variant: str) -> Outcome | None:
    """Ask a method whether it skips this scan; None where it runs."""
    if method.told_twin and stored.metal_free is None:
        return Outcome(status="skipped", reason=f"{NO_TWIN}: there is nothing to reconstruct without the metal")
    try:
        scan = scan_for(method, stored, variant)
    except InputError as error:
        return Outcome(status="error", reason=describe(error))
    try:
        with restored():
            reason = method.skip(scan)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the module may be the user's
        return Outcome(status="error", reason=f"skip() failed: {describe(error)}")
    return None if reason is None else Outcome(status="skipped", reason=reason)


def describe(error: BaseException) -> str:
    """Describe an exception in one line."""
    if isinstance(error, SystemExit):
        return f"the method called for the process to exit (SystemExit: {error})"
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def attempt(method: Method, scan: Scan, warm_up_seconds: float) -> Outcome:
    """Run a method in this process and return its outcome; of all exceptions only Ctrl-C is passed on."""
    outcome, usage, view_updates = Outcome(status="error"), None, None if method.program else 0
    earlier: list[
        float
    ] = []  # seconds before this part of a fit that went on from a checkpoint, also of one that fails
    try:
        with restored():
            with resumed() as earlier, measured() as usage:
                volume = method.reconstruct(scan)
            check_volume(volume)
            if method.program:  # without the time for its copy of the scan
                usage = volume.details[USAGE]
            else:
                view_updates = int(volume.details.get("view_updates", scan.geometry.n_views))
            outcome.status, outcome.reason = str(volume.status), volume.reason
            outcome.values = array_of(volume.values)
            outcome.intermediates = attached(volume.details, scan.geometry)
            outcome.details = recordable(volume.details)
            if outcome.status in SCORED:
                _read_at_50kev(outcome, volume)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a method's failure is a result
        log.debug("method %s failed", method.name, exc_info=error)
        outcome = _failure(error)
        usage = getattr(error, USAGE, None) or usage
    assert usage is not None
    outcome.cost = Cost(
        wall=usage.wall + sum(earlier),
        cpu=None if earlier else usage.cpu,
        peak_bytes=usage.peak_bytes,
        view_updates=view_updates,
        device="cpu",
        warm_up=warm_up_seconds,
    )
    return checked(outcome, scan.geometry.n_voxel)


def check_volume(volume: Any) -> None:
    """Raise InputError unless a method returned a volume of real numbers with a known status."""
    if not isinstance(volume, Volume):
        raise _NoVolume(f"the method returned a {_kind(volume)}, expected a ctsim.types.Volume")
    if not isinstance(volume.values, torch.Tensor):
        raise _NoVolume(f"Volume.values must be a torch.Tensor, got a {_kind(volume.values)}")
    if volume.values.is_complex():
        raise _NoVolume(f"Volume.values must be real numbers, got {volume.values.dtype}")
    if volume.status not in list(Status):
        raise _NoVolume(f"Volume.status must be one of {', '.join(Status)}, got {volume.status!r}")


class _NoVolume(InputError):
    """A method did not return a volume; the message is the whole reason."""


def _kind(value: object) -> str:
    module = type(value).__module__
    return type(value).__name__ if module == "builtins" else f"{module}.{type(value).__name__}"


def _read_at_50kev(outcome: Outcome, volume: Volume) -> None:
    """Add the volume at 50 keV of a method that knows energies; an error there fails the run."""
    try:
        outcome.at_50kev = None if volume.at_energy is None else array_of(volume.at_energy(REFERENCE_KEV))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        failed = _failure(error)
        outcome.fail(failed.status, f"the volume at 50 keV: {failed.reason}")


def _failure(error: BaseException) -> Outcome:
    """Return the outcome of a run that raised `error`."""
    if isinstance(error, Unsuited):
        return Outcome(status="skipped", reason=str(error))
    # torch has its own error for devices
    out_of_memory = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    reason = str(error) if isinstance(error, _NoVolume | ProgramError) else describe(error)
    return Outcome(status="out_of_memory" if out_of_memory else "error", reason=reason)


def checked(outcome: Outcome, shape: tuple[int, int, int]) -> Outcome:
    """Set the status error for a volume of a wrong shape, nonfinite for values that are not finite."""
    for what, values in (("volume", outcome.values), ("volume at 50 keV", outcome.at_50kev)):
        if values is None or outcome.status not in SCORED:
            continue
        if values.shape != shape:
            outcome.fail("error", f"the {what} has shape {values.shape}, the geometry says {shape}")
        elif not (finite := np.isfinite(values)).all():
            outcome.status = "nonfinite"
            outcome.reason = f"{int((~finite).sum())} of {values.size} voxels of the {what} are not finite"
    return outcome


def array_of(volume: torch.Tensor) -> NDArray[np.float32]:
    """Return a copy: a method may reuse its memory while the twin's volume is still needed."""
    return np.array(volume.detach().cpu().numpy(), np.float32)


def warm_up(method: Method, scan: Scan) -> float:
    """Run the method on a tiny scan of the same kind, so that compiling is not timed; return its seconds.

    A method with a time limit runs for one second, repeatedly until it no longer compiles: code that it did not reach
    would be compiled in the timed run. It writes no checkpoints. An error on the tiny scan is only logged. A program,
    which starts afresh each time, has no warm-up.
    """
    if method.program:
        return 0.0
    told = {"seconds": WARM} if "seconds" in method.params else {}
    others = named(method.name, method.overrides)
    method = dataclasses.replace(method, overrides=others | told)
    with measured() as usage:
        for _ in range(WARM_UPS):
            began = time.perf_counter()
            try:
                with restored():
                    method.reconstruct(tiny(scan))
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                log.info("warm-up of %s: %s", method.name, describe(error))
            if "seconds" not in told or time.perf_counter() - began < 2 * WARM:
                break
    return usage.wall


def tiny(scan: Scan) -> Scan:
    """Return a scan of the first 8 views of `scan` and 8 whole slices of its volume.

    The counts are a view into the scan's own and the slices keep their size, so that kernels are compiled for the types
    of the timed run (dtype, layout, alignment; one tile or several). Of a true mask the 8 slices with the most metal
    are kept, so that the correction is compiled too.
    """
    g = scan.geometry
    n = min(8, g.n_views)
    changes: dict[str, Any] = {"n_views": n, "n_voxel": (min(8, g.n_voxel[0]), *g.n_voxel[1:])}
    for name in ("angles_deg", "poses"):
        if getattr(g, name) is not None:
            changes[name] = getattr(g, name)[:n]
    more: dict[str, Any] = {}
    if scan.metal is not None:
        height = changes["n_voxel"][0]
        per_slice = np.asarray(scan.metal.sum((1, 2)))
        most = int(np.argmax(np.convolve(per_slice, np.ones(height, per_slice.dtype), "valid")))
        more["metal"] = scan.metal[most : most + height]
    return dataclasses.replace(scan, **more, geometry=msgspec.structs.replace(g, **changes), counts=scan.counts[:n])


Setting = tuple[Callable[[], Any], Callable[[Any], object]]


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Restore the global state of the process when the block ends.

    That is: work folder, threads, defaults, random states, environment, warning filters. What a block imports or starts
    stays.
    """
    settings = _settings()
    before, environment = [get() for get, _ in settings], dict(os.environ)
    with warnings.catch_warnings(), np.errstate():
        try:
            yield
        finally:
            for (get, put), value in zip(settings, before, strict=True):
                with contextlib.suppress(OSError):  # a folder that is gone
                    if get() != value:
                        put(value)
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]
            os.environ.update({k: v for k, v in environment.items() if os.environ.get(k) != v})


def _settings() -> tuple[Setting, ...]:
    numpy_state, torch_state = np.random.get_state, torch.get_rng_state
    return (
        (_folder, os.chdir),
        (numba.get_num_threads, numba.set_num_threads),
        (torch.get_num_threads, torch.set_num_threads),
        (torch.get_default_device, lambda to: torch.set_default_device(None if to.type == "cpu" else to)),
        (torch.get_default_dtype, torch.set_default_dtype),
        (torch.is_grad_enabled, torch.set_grad_enabled),
        (torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
        (random.getstate, random.setstate),
        (lambda: _plain(numpy_state()), np.random.set_state),
        (lambda: torch_state().tolist(), lambda state: torch.set_rng_state(torch.tensor(state, dtype=torch.uint8))),
        (sys.getrecursionlimit, sys.setrecursionlimit),
        (lambda: signal.getsignal(signal.SIGINT), lambda handler: signal.signal(signal.SIGINT, handler)),
        (gc.isenabled, lambda enabled: gc.enable() if enabled else gc.disable()),
        (lambda: sys.stdout, lambda stream: setattr(sys, "stdout", stream)),
        (lambda: sys.stderr, lambda stream: setattr(sys, "stderr", stream)),
    )


def _folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:
        return ""


def _plain(state: Any) -> tuple[Any, ...]:
    name, keys, *rest = state
    return name, keys.tolist(), *rest


def changed(scan: Scan, fresh: Scan) -> list[str]:
    """Return the names of the fields of a scan that differ from those of `fresh` in any bit."""
    names = [field.name for field in dataclasses.fields(scan)]
    return [name for name in names if not _same(getattr(scan, name), getattr(fresh, name))]


def _same(one: Any, other: Any) -> bool:
    if not (isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor)):
        return type(one) is type(other) and one == other
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    # view by view, since a comparison needs memory; as bytes, so that NaN equals itself
    pairs = zip(one.detach().numpy(), other.detach().numpy(), strict=True)
    return all(np.array_equal(_bytes(a), _bytes(b)) for a, b in pairs)


def _bytes(array: Any) -> Any:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)
