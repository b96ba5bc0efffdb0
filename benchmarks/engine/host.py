"""Where a measurement runs (machine, threads, versions, commit) and what it costs."""

import contextlib
import functools
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import msgspec

from ctsim.benchmarks.engine.process import THREADS, Jobs, Pool, at_most
from ctsim.errors import InputError

VERSIONS_OF = ("ctsim", "numpy", "numba", "torch", "scipy", "scikit-image", "xraylib")


class Host(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The machine and the software of a measurement. `ram` is bytes, `versions` maps package to version."""

    cpu: str
    cores: int
    threads: int
    ram: int
    system: str
    python: str
    versions: dict[str, str]


def _line_of(file: str, key: str) -> str:
    """Return the value of a key in one of Linux's files; "" on other systems."""
    with contextlib.suppress(OSError):
        for line in Path(file).read_text().splitlines():
            if line.startswith(key):
                return line.partition(":")[2].strip()
    return ""


def threads() -> int:
    """Return the threads that the kernels use."""
    numba = sys.modules.get("numba")
    cores = len(os.sched_getaffinity(0))
    return int(numba.get_num_threads()) if numba else int(os.environ.get("NUMBA_NUM_THREADS", cores))


def use_threads(threads: int) -> None:
    """Limit the threads of the kernels and of torch, now or when they are loaded; loads neither."""
    variables = at_most(threads)
    for name, variable in THREADS.items():
        if library := sys.modules.get(name):
            library.set_num_threads(min(threads, library.get_num_threads()))
        else:
            os.environ[variable] = variables[variable]


def host() -> Host:
    """Describe this machine."""
    return Host(
        cpu=_line_of("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        cores=len(os.sched_getaffinity(0)),
        threads=threads(),
        ram=os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        versions=_versions(),
    )


@functools.cache
def _versions() -> dict[str, str]:
    found: dict[str, str] = dict.fromkeys(VERSIONS_OF, "not installed")
    for package in VERSIONS_OF:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


@functools.cache
def commit() -> str:
    """Return the commit of this code, with "+changes" where files differ from it; "unknown" outside git."""
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        head = git("rev-parse", "HEAD")
        return head + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def certain(commit: str) -> bool:
    """Whether the commit is known and the work tree was clean."""
    return commit != "unknown" and not commit.endswith("+changes")


@dataclass(slots=True)
class Usage:
    """The seconds and bytes that a block of code took; set when the block ends."""

    wall: float = 0.0
    cpu: float = 0.0
    peak_bytes: int = 0


def peak_memory() -> int:
    """Return the highest resident memory in bytes since the last reset, else since the process began."""
    if kilobytes := _line_of("/proc/self/status", "VmHWM:"):
        return int(kilobytes.split()[0]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


@contextlib.contextmanager
def measured() -> Iterator[Usage]:
    """Measure wall time, CPU time of all threads, and peak resident memory of this process.

    The peak is the whole process's, with the interpreter, the libraries and the mapped files.
    """
    usage = Usage()
    with contextlib.suppress(OSError):  # Linux forgets the peak so far
        Path("/proc/self/clear_refs").write_text("5")
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        yield usage
    finally:
        usage.wall = time.perf_counter() - wall
        usage.cpu = time.process_time() - cpu
        usage.peak_bytes = peak_memory()


def machine() -> str:
    """Return what times depend on: the processor and the threads of the kernels."""
    here = host()
    return f"{here.cpu}, {here.threads} threads"


def in_turns(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, tuple[float, tuple[float, ...]]]:
    """Call the functions once each, then in turns; return (seconds of the first call, seconds of the others)."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: (s[0], tuple(s[1:])) for name, s in seconds.items()}


def check_workers(workers: int, scheduler: str | None) -> None:
    """Raise InputError for less than one worker, and for --workers with --scheduler."""
    if workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more")
    if scheduler is not None and workers != 1:
        raise InputError("--workers and --scheduler exclude each other: the scheduler's own workers do the work")


def open_jobs(workers: int, scheduler: str | None) -> contextlib.AbstractContextManager[Jobs | None]:
    """Return the workers that --workers and --scheduler ask for; None for this process alone.

    Raises InputError as `check_workers` does, and for a scheduler that cannot be used.
    """
    check_workers(workers, scheduler)
    if scheduler is not None:
        try:
            from ctsim.benchmarks.engine.dask import Cluster  # the package distributed, an extra
        except ImportError:
            raise InputError("--scheduler needs the package distributed: pip install 'ctsim[cluster]'") from None
        return Cluster(scheduler)
    return contextlib.nullcontext() if workers == 1 else Pool(workers)
