"""One run of a method in this process: warmed up, measured, and whatever happens turned into an outcome."""

import dataclasses
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.engine.host import measured
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores.protocol import Stored
from ctsim.benchmarks.studies.methods import details, intermediates
from ctsim.benchmarks.studies.methods.intermediates import Intermediates
from ctsim.benchmarks.studies.methods.own import changed, restored
from ctsim.benchmarks.studies.methods.records import Cost
from ctsim.errors import InputError

if TYPE_CHECKING:
    import torch

    from ctsim.types import Scan, Volume

log = logging.getLogger(__name__)

SCORED = ("ok", "diverged")  # a run's status
WARM, WARM_UPS = 1.0, 5  # seconds that a warm-up lasts beyond compiling, where a method knows of time, and how often


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


def scan_for(method: Method, stored: Stored, variant: str) -> "Scan":
    """Return the scan itself or its twin without metal; with the true mask where the method's is "oracle".

    Its arrays are nobody else's. Raises InputError where there is no twin. The twin's true mask is empty.
    """
    found = stored if variant == "metal" else stored.metal_free
    if found is None:
        raise InputError(f"scan {stored.name!r} has no metal-free twin")
    if method.mask != "oracle":
        return found.scan
    import torch

    metal = np.asarray(stored.metal) > 0
    return dataclasses.replace(found.scan, metal=torch.from_numpy(metal & (variant == "metal")))


def run_here(stored: Stored, variant: str, method: Method, warm_up_seconds: float) -> Outcome:
    """Run a method in this process on a view of the scan that is its own; that it changed its input is its error."""
    try:
        scan = scan_for(method, stored, variant)
        outcome = attempt(method, scan, warm_up_seconds)
        parts = ", ".join(changed(scan, scan_for(method, stored, variant)))
    except InputError as error:  # of the scan's files; a method's own are outcomes
        return Outcome(status="error", reason=describe(error))
    if parts:
        what = f"the method changed its input ({parts}): expected it to work on a copy"
        outcome.reason = what if outcome.status in (*SCORED, "nonfinite") else f"{outcome.reason}; {what}"
        outcome.status, outcome.values, outcome.at_50kev = "error", None, None
        outcome.intermediates, outcome.details = {}, {}
    return outcome


def skip(method: Method, stored: Stored, variant: str) -> Outcome | None:
    """Ask a method why it would rather not run; None where it runs."""
    try:
        scan = scan_for(method, stored, variant)
    except InputError as error:
        return Outcome(status="error", reason=describe(error))
    try:
        with restored():
            reason = method.skip(scan)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the asked module is somebody else's
        return Outcome(status="error", reason=f"skip() failed: {describe(error)}")
    return None if reason is None else Outcome(status="skipped", reason=reason)


def describe(error: BaseException) -> str:
    """Say an exception in one line."""
    if isinstance(error, SystemExit):
        return f"the method called for the process to exit (SystemExit: {error})"
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def attempt(method: Method, scan: "Scan", warm_up_seconds: float) -> Outcome:
    """Run a method in this process and turn whatever happens into an outcome; only Ctrl-C is passed on."""
    outcome, usage, view_updates = Outcome(status="error"), None, 0
    try:
        with restored():
            with measured() as usage:
                volume = method.reconstruct(scan)
            _check(volume)
            view_updates = int(volume.details.get("view_updates", scan.geometry.n_views))
            outcome.status, outcome.reason = str(volume.status), volume.reason
            outcome.values = _array(volume.values)
            outcome.intermediates = intermediates.taken(volume.details, scan.geometry)
            outcome.details = details.kept(volume.details)
            if outcome.status in SCORED:
                _read_at_50kev(outcome, volume)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a method's failure is a result
        log.debug("method %s failed", method.name, exc_info=error)
        outcome = _failure(error)
    assert usage is not None
    outcome.cost = Cost(
        wall=usage.wall,
        cpu=usage.cpu,
        peak_bytes=usage.peak_bytes,
        view_updates=view_updates,
        device="cpu",
        warm_up=warm_up_seconds,
    )
    return checked(outcome, scan.geometry.n_voxel)


def _check(volume: Any) -> None:
    """Raise InputError unless a method returned a volume of real numbers that ended in a way that there is."""
    import torch

    from ctsim.types import Status, Volume

    if not isinstance(volume, Volume):
        raise _NoVolume(f"the method returned a {_kind(volume)}, expected a ctsim.types.Volume")
    if not isinstance(volume.values, torch.Tensor):
        raise _NoVolume(f"Volume.values must be a torch.Tensor, got a {_kind(volume.values)}")
    if volume.values.is_complex():
        raise _NoVolume(f"Volume.values must be real numbers, got {volume.values.dtype}")
    if volume.status not in list(Status):
        raise _NoVolume(f"Volume.status must be one of {', '.join(Status)}, got {volume.status!r}")


class _NoVolume(InputError):
    """What a method returned is no volume; the sentence says all."""


def _kind(value: object) -> str:
    module = type(value).__module__
    return type(value).__name__ if module == "builtins" else f"{module}.{type(value).__name__}"


def _read_at_50kev(outcome: Outcome, volume: "Volume") -> None:
    """Add the volume at 50 keV where the method knows energies; what goes wrong there is the run's failure."""
    from ctsim.simulate import REFERENCE_KEV

    try:
        outcome.at_50kev = None if volume.at_energy is None else _array(volume.at_energy(REFERENCE_KEV))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        failed = _failure(error)
        outcome.values = None
        outcome.status, outcome.reason = failed.status, f"the volume at 50 keV: {failed.reason}"


def _failure(error: BaseException) -> Outcome:
    """Return the outcome of a run that ended by an exception."""
    # torch has an error of its own for devices
    out_of_memory = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    reason = str(error) if isinstance(error, _NoVolume) else describe(error)
    return Outcome(status="out_of_memory" if out_of_memory else "error", reason=reason)


def checked(outcome: Outcome, shape: tuple[int, int, int]) -> Outcome:
    """Turn a volume of another shape into an error and one that is not finite into that status."""
    for what, values in (("volume", outcome.values), ("volume at 50 keV", outcome.at_50kev)):
        if values is None or outcome.status not in SCORED:
            continue
        if values.shape != shape:
            outcome.status, outcome.values, outcome.at_50kev = "error", None, None
            outcome.reason = f"the {what} has shape {values.shape}, the geometry says {shape}"
        elif not (finite := np.isfinite(values)).all():
            outcome.status = "nonfinite"
            outcome.reason = f"{int((~finite).sum())} of {values.size} voxels of the {what} are not finite"
    return outcome


def _array(volume: "torch.Tensor") -> NDArray[np.float32]:
    """Return a copy: a method may use its memory again while the twin's volume waits for the scan's."""
    return np.array(volume.detach().cpu().numpy(), np.float32)


def warm_up(method: Method, scan: "Scan") -> float:
    """Run the method on a tiny scan of the same kind, so that compiling is not timed; return its seconds.

    A method that can be told how many seconds it may take gets one, again until it needs no more: what it did not get
    to while it was compiled would be compiled in the timed run. It keeps nothing that a later run would go on from.
    Its own complaint about the tiny scan is not its result and is only logged.
    """
    told = {"seconds": WARM} if "seconds" in method.params else {}
    others = {name: value for name, value in method.overrides.items() if name != "checkpoints"}
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


def tiny(scan: "Scan") -> "Scan":
    """Return a scan of the first 8 views of `scan` and 8 whole slices of its volume.

    The counts are a view into the scan's own and the slices keep their size, so that kernels are
    compiled for the very types (dtype, layout, alignment; one tile or several) of the timed run. Of a
    true mask the 8 slices with the most metal are kept, so that correcting it is compiled too.
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
