"""What `run-benchmark skipping` measures of reconstruction methods and commands (see `skipping_cases`)."""

import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.baselines.inpaint import Filled, fill
from ctsim.baselines.limar import interpolated
from ctsim.baselines.metal import Trace, find_metal
from ctsim.baselines.nmar import Normalise, normalised
from ctsim.baselines.prior import Choice, choose_prior
from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.cli import quietly
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.studies.methods import study as cli_run
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.volumes import read_volume
from ctsim.benchmarks.studies.skipping import simulator as skipping_cases
from ctsim.benchmarks.studies.skipping.finding import Skip
from ctsim.benchmarks.studies.skipping.simulator import Pair, Pairs, Setup, largest
from ctsim.benchmarks.studies.skipping.study import Flags
from ctsim.phantoms.scene import scene_to_toml
from ctsim.reconstruct.fdk import fdk_stream
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.projector import forward_columns
from ctsim.store import StoredScan, open_scan
from ctsim.types import Scan

HOW = "rows"
Bridge = Callable[[NDArray[np.float32], slice, Filled], None]
# float32 sums in the same order, of rows read at places that were worked out from another centre
MOVED, MOVED_AT = 1e-5, "tests/test_fdk.py"


def made(setup: Setup, *flags: str) -> StoredScan:
    """Make the thorax' scan in the setup's folder unless it is there, and open it."""
    scene = setup.scene()
    recipe = setup.folder / "scene.toml"
    recipe.write_text(scene_to_toml(scene), encoding="utf-8")
    quietly(make_dataset.main, recipe, setup.folder / "data", *flags)
    return open_scan(setup.folder / "data" / scene.name)


# --- the whole way, as published, with nothing left out ---------------------------------------------


def straight(trace: Trace) -> Bridge:
    """Return what bridges the trace as LIMAR does."""

    def bridge(p: NDArray[np.float32], views: slice, filled: Filled) -> None:
        for k, view in enumerate(range(views.start, views.stop)):
            fill(p[k], trace.view(view), HOW, filled)

    return bridge


def through_prior(trace: Trace, choice: Choice) -> Bridge:
    """Return what bridges the trace as NMAR does, with the prior projected on every row of every view."""

    def bridge(p: NDArray[np.float32], views: slice, filled: Filled) -> None:
        q = forward_columns(choice.columns, trace.geometry, views)
        for k, view in enumerate(range(views.start, views.stop)):
            p[k] = Normalise().fill(p[k], q[k], trace.view(view), filled, choice.largest, HOW)

    return bridge


def everything(trace: Trace, bridge: Bridge) -> torch.Tensor:
    """Reconstruct all bridged projections from nothing: [z, y, x] in 1/mm."""
    filled = Filled()

    def read(views: slice) -> NDArray[np.float32]:
        p = trace.logarithm.of(views)[0]
        bridge(p, views, filled)
        return p

    return fdk_stream(read, trace.geometry)


def chosen(trace: Trace, scan: Scan, first: torch.Tensor) -> Choice:
    """Return NMAR's prior."""
    choice = choose_prior(trace, find_metal(scan, first.numpy(), "oracle"), first, "auto", HOW)
    if choice is None:
        raise RuntimeError("the thorax has no tissue to make a prior of")
    return choice


def corrected(method: Method, scan: Scan) -> torch.Tensor:
    """Correct a scan by a method as it is."""
    return method.reconstruct(scan).values


def regardless(scan: Scan, name: str) -> torch.Tensor:
    """Correct a scan as LIMAR or NMAR would, did they not look whether there is metal."""
    first = fdk(scan).values
    trace = Trace(find_metal(scan, first.numpy(), "oracle"), scan)
    if name == "limar":
        return everything(trace, straight(trace))
    return everything(trace, through_prior(trace, chosen(trace, scan, first)))


# --- pairs ---------------------------------------------------------------------------------------------


def volumes_apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """Return the largest difference of two volumes."""
    return largest([(one.numpy(), other.numpy())])


def metal_free(setup: Setup) -> Iterator[Pair[torch.Tensor]]:
    """Yield LIMAR and NMAR on the twin, where they stop after FDK, and all they would do for an empty trace."""
    stored = made(setup)
    for name in ("limar", "nmar"):
        method = find(name)
        scan = scan_for(method, stored, "metal_free")

        yield Pair(
            scene=f"{stored.name}, twin",
            what=f"all that {name.upper()} does after FDK where there is no metal",
            skipping=functools.partial(corrected, method, scan),
            whole=functools.partial(regardless, scan, name),
            difference=volumes_apart,
            unit="1/mm",
        )


def rows(setup: Setup) -> Iterator[Pair[torch.Tensor]]:
    """Yield LIMAR and NMAR reconstructing what they change, and reconstructing all of it again.

    FDK, the trace and the prior, which both ways need, are prepared.
    """
    stored = made(setup)
    scan = scan_for(find("limar"), stored, "metal")
    first = fdk(scan).values
    trace = Trace(find_metal(scan, first.numpy(), "oracle"), scan)
    choice, touched = chosen(trace, scan, first), trace.rows()
    bridge = functools.partial(Normalise().fill, largest=choice.largest, how=HOW)
    ways: dict[str, tuple[Callable[[], torch.Tensor], Bridge]] = {
        "LIMAR": (lambda: interpolated(trace, first, HOW)[0], straight(trace)),
        "NMAR": (lambda: normalised(trace, first, choice.columns, bridge)[0], through_prior(trace, choice)),
    }
    for name, (part, bridging) in ways.items():
        most = float(part().abs().max())
        yield Pair(
            scene=stored.name,
            what=f"detector rows that {name} leaves as they are",
            skipping=part,
            whole=functools.partial(everything, trace, bridging),
            difference=volumes_apart,
            unit="1/mm",
            limit=MOVED * most,
            stated=MOVED_AT,
            note=f"{touched.stop - touched.start} of {scan.geometry.n_detector[0]} rows hold metal",
        )


def stored_scan(setup: Setup) -> Iterator[Pair[list[NDArray[Any]]]]:
    """Yield make-dataset where the scan is there, and made again."""
    stored = made(setup)
    names = sorted(name.removesuffix(".tif") for name in stored.files if name.endswith(".tif"))

    def arrays(*flags: str) -> list[NDArray[Any]]:
        found = made(setup, *flags)
        return [found.array(name) for name in names]  # mapped, not read

    yield Pair(
        scene=stored.name,
        what="make-dataset of a scan that is there",
        skipping=arrays,
        whole=functools.partial(arrays, "--force"),
        difference=lambda a, b: largest(list(zip(a, b, strict=True))),
        unit="any array",
    )


def recorded_run(setup: Setup) -> Iterator[Pair[list[NDArray[np.float32]]]]:
    """Yield run-benchmark where the run is recorded, and run again; both render the tables and pictures."""
    name = made(setup).name
    results = setup.folder / "results"

    def volumes(*flags: str) -> list[NDArray[np.float32]]:
        quietly(cli_run.main, setup.folder / "data", results, "--method", "limar", *flags)
        return [read_volume(path) for path in sorted((results / "volumes").glob("*.tif"))]

    yield Pair(
        scene=name,
        what="run-benchmark of a run that is recorded, LIMAR on the scan and its twin",
        skipping=volumes,
        whole=functools.partial(volumes, "--force"),
        difference=lambda a, b: largest(list(zip(a, b, strict=True))),
        unit="1/mm",
    )


CASES: dict[str, Pairs] = {"metal-free": metal_free, "rows": rows, "scan": stored_scan, "record": recorded_run}


def measure(task: Task, given: Flags) -> list[Skip]:
    """Measure all pairs of a case."""
    setup = Setup(size=task.part, repeats=given.repeats, folder=_folder())
    return [pair.measure(given.repeats) for pair in (skipping_cases.CASES | CASES)[task.case](setup)]


@functools.cache
def _folder() -> Path:
    """Return a folder that all cases of this process share, so that a scan is made once."""
    return Path(tempfile.mkdtemp(prefix="ctsim-skipping-"))  # goes with the process's own TMPDIR
