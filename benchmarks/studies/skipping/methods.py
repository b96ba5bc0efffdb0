"""What `run-benchmark skipping` measures of methods and commands; `simulator` and `effects` have the other cases."""

import functools
import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
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
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.methods import study as cli_run
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.benchmarks.studies.methods.volumes import read_volume
from ctsim.benchmarks.studies.skipping import effects, simulator
from ctsim.benchmarks.studies.skipping.simulator import Bench, Cases, Pair, largest
from ctsim.benchmarks.studies.skipping.study import CORE, Flags, Skip
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.phantoms.dataset import make_scenes
from ctsim.phantoms.scene import Scene, scene_to_toml
from ctsim.reconstruct.fdk import fdk_stream
from ctsim.reconstruct.fdk import ramp as fdk
from ctsim.reconstruct.filters import RAMP
from ctsim.reconstruct.projector import forward_columns
from ctsim.types import Scan

HOW = "rows"
# float32 sums in the same order, of rows read at places computed from another centre
MOVED, MOVED_AT = 1e-5, "tests/test_fdk.py"


def made(setup: Bench, *flags: str) -> StoredScan:
    """Open the thorax' scan in the setup's folder; make it if it is missing."""
    scene = setup.scene()
    recipe = setup.folder / "scene.toml"
    recipe.write_text(scene_to_toml(scene), encoding="utf-8")
    quietly(make_dataset.main, recipe, setup.folder / "data", *flags)
    return open_scan(setup.folder / "data" / scene.name)


def stored_arrays(scan: StoredScan) -> list[NDArray[Any]]:
    """Return all arrays of a scan, mapped and not read."""
    return [scan.array(name.removesuffix(".tif")) for name in sorted(scan.files) if name.endswith(".tif")]


def everything(trace: Trace, choice: Choice | None = None) -> torch.Tensor:
    """Fill the trace in all projections, with a prior as NMAR, else as LIMAR; reconstruct the whole volume.

    The prior is projected onto every row of every view. Returns [z, y, x] in 1/mm.
    """
    filled = Filled()

    def read(views: slice) -> NDArray[np.float32]:
        p = trace.logarithm.of(views)[0]
        q = None if choice is None else forward_columns(choice.columns, trace.geometry, views)
        for k, view in enumerate(range(views.start, views.stop)):
            if choice is None or q is None:
                fill(p[k], trace.view(view), HOW, filled)
            else:
                p[k] = Normalise().fill(p[k], q[k], trace.view(view), filled, choice.largest, HOW)
        return p

    return fdk_stream(read, trace.geometry)


def begun(scan: Scan) -> tuple[torch.Tensor, Trace]:
    """Return FDK's volume and the metal trace."""
    first = fdk(scan).values
    return first, Trace(find_metal(scan, first.numpy(), "oracle"), scan)


def chosen(trace: Trace, scan: Scan, first: torch.Tensor) -> Choice:
    """Return NMAR's prior."""
    choice = choose_prior(trace, find_metal(scan, first.numpy(), "oracle"), first, RAMP, "auto", HOW)
    if choice is None:
        raise RuntimeError("the thorax has no tissue to make a prior of")
    return choice


def without_metal_check(scan: Scan, name: str) -> torch.Tensor:
    """Correct a scan as LIMAR or NMAR would without first looking for metal."""
    first, trace = begun(scan)
    return everything(trace, chosen(trace, scan, first) if name == "nmar" else None)


# --- pairs ---------------------------------------------------------------------------------------------


def metal_free(setup: Bench) -> Iterator[Pair]:
    """Yield LIMAR and NMAR on the twin, where they stop after FDK, and the full correction of an empty trace."""
    stored = made(setup)
    for name in ("limar", "nmar"):
        method = find(name, {"window": RAMP.window, "cutoff": RAMP.cutoff})
        scan = scan_for(method, stored, "metal_free")
        yield Pair(
            scene=f"{stored.name}, twin",
            what=f"all that {name.upper()} does after FDK where there is no metal",
            skipping=functools.partial(method.reconstruct, scan),
            whole=functools.partial(without_metal_check, scan, name),
            difference=lambda volume, values: largest(volume.values, values),
            unit="1/mm",
        )


def rows(setup: Bench) -> Iterator[Pair]:
    """Yield LIMAR and NMAR reconstructing only what they change, and the whole volume.

    FDK, the trace and the prior, which both ways need, are made before.
    """
    stored = made(setup)
    scan = scan_for(find("limar"), stored, "metal")
    first, trace = begun(scan)
    choice, touched = chosen(trace, scan, first), trace.rows()
    bridge = functools.partial(Normalise().fill, largest=choice.largest, how=HOW)
    ways: dict[str, tuple[Callable[[], torch.Tensor], Choice | None]] = {
        "LIMAR": (lambda: interpolated(trace, first, HOW, RAMP)[0], None),
        "NMAR": (lambda: normalised(trace, first, choice.columns, bridge, RAMP)[0], choice),
    }
    for name, (part, prior) in ways.items():
        most = float(part().abs().max())
        yield Pair(
            scene=stored.name,
            what=f"detector rows that {name} leaves as they are",
            skipping=part,
            whole=functools.partial(everything, trace, prior),
            unit="1/mm",
            limit=MOVED * most,
            stated=MOVED_AT,
            note=f"{touched.stop - touched.start} of {scan.geometry.n_detector[0]} rows hold metal",
        )


def variants(setup: Bench) -> Iterator[Pair]:
    """Yield scans of one body made together, which share its building and its rays, and made one after another."""
    scene, doses = setup.scene(), 8 if setup.size == CORE else 4

    def scans(metals: tuple[str, ...], voltages: tuple[float, ...], doses: int) -> tuple[Scene, ...]:
        found = []
        for number, (metal, kvp, k) in enumerate(itertools.product(metals, voltages, range(doses))):
            tube = msgspec.structs.replace(scene.resolve().tube, kvp=kvp)
            scanner = msgspec.structs.replace(scene.scanner, tube=tube, i0=5e4 * 2**k)
            phantom = msgspec.structs.replace(scene.phantom, metal=metal)
            found.append(msgspec.structs.replace(scene, name=f"s{number}", scanner=scanner, phantom=phantom))
        return tuple(found)

    def voltages(n: int) -> tuple[float, ...]:
        return tuple(np.linspace(80.0, 140.0, n).tolist())

    def make(groups: Iterable[Sequence[Scene]], where: str) -> list[Path]:
        shutil.rmtree(setup.folder / where, ignore_errors=True)
        return [folder for group in groups for folder in make_scenes(group, setup.folder / where)]

    def stored(folders: Sequence[Path]) -> Iterator[NDArray[Any]]:
        return itertools.chain.from_iterable(stored_arrays(open_scan(folder)) for folder in folders)

    def difference(ours: Sequence[Path], others: Sequence[Path]) -> float:
        """Read one pair of arrays after the other, off the clock."""
        return max(largest([a], [b]) for a, b in zip(stored(ours), stored(others), strict=True))

    for what, many in {
        f"rays of {doses} doses": scans(("Fe",), (90.0,), doses),
        f"rays of 2 metals, each at 2 voltages and {doses // 4} doses": scans(("Fe", "Ti"), (90.0, 120.0), doses // 4),
        f"rays of {doses} voltages": scans(("Fe",), voltages(doses), 1),
        f"rays of {2 * doses} voltages": scans(("Fe",), voltages(2 * doses), 1),
    }.items():
        yield Pair(
            scene=scene.name,
            what=f"{what}: traced once for {len(many)} scans of one body",
            skipping=functools.partial(make, [many], "together"),
            whole=functools.partial(make, [(one,) for one in many], "one by one"),
            difference=difference,
            unit="any array",
            note=f"{len(many)} scans with twins, built, planned and written",
        )


def stored_scan(setup: Bench) -> Iterator[Pair]:
    """Yield make-dataset of a scan that exists, and of the scan made again."""

    def arrays(*flags: str) -> list[NDArray[Any]]:
        return stored_arrays(made(setup, *flags))

    yield Pair(
        scene=made(setup).name,
        what="make-dataset of a scan that is there",
        skipping=arrays,
        whole=functools.partial(arrays, "--force"),
        unit="any array",
    )


def recorded_run(setup: Bench) -> Iterator[Pair]:
    """Yield run-benchmark of a recorded run, and of the run repeated; both write tables and pictures."""
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
        unit="1/mm",
    )


CASES: Cases = {
    "variants": variants,
    "metal-free": metal_free,
    "rows": rows,
    "scan": stored_scan,
    "record": recorded_run,
}


def measure(task: Task, given: Flags) -> list[Skip]:
    """Measure all pairs of a case."""
    setup = Bench(size=task.part, repeats=given.repeats, folder=_folder())
    return [pair.measure(given.repeats) for pair in (simulator.CASES | effects.CASES | CASES)[task.case](setup)]


@functools.cache
def _folder() -> Path:
    """Return a folder that this process's cases share, so that a scan is made once."""
    return Path(tempfile.mkdtemp(prefix="ctsim-skipping-"))  # removed with the process's own TMPDIR
