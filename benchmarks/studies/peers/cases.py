"""What `run-benchmark peers` measures: path lengths, line integrals, a dataset, FDK and one slice; `poly` has one more.

Contenders of a case run in one process on the same number of threads, in turns (A B A B …), after an untimed run each.
Times are of whole sweeps over the views. What a contender can prepare once for a scene (bricks, pose matrices, permuted
volumes) is prepared before the clock starts.
"""

import itertools
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.beam.spectrum import Tube
from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.cli import quietly
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.process import Process
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.methods import find
from ctsim.benchmarks.oracles import SIZE, relative, scanner_of, upright_chord, voxelised
from ctsim.benchmarks.studies.peers import finding
from ctsim.benchmarks.studies.peers.finding import OURS, RTK, SIDES, XCIST, Measurement, Setup, versions
from ctsim.benchmarks.studies.peers.libraries import Rtk, Xcist
from ctsim.benchmarks.studies.peers.poly import poly
from ctsim.benchmarks.studies.peers.study import Flags
from ctsim.dataset.store import open_scan
from ctsim.look import present_materials
from ctsim.materials import attenuation
from ctsim.phantoms.bodies.lung import Lung
from ctsim.phantoms.bodies.random import Random
from ctsim.phantoms.bodies.rods import Validation
from ctsim.phantoms.dataset import make_scene
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scanners import ScannerSettings
from ctsim.phantoms.scene import Scene
from ctsim.reconstruct.fdk import fdk as ours_fdk
from ctsim.settings import Truth
from ctsim.simulate import compact
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.tracer.voxelise import attenuation_volume
from ctsim.types import Phantom

KEV = np.array([50.0])


def _thorax(n: int, *, metal: bool) -> Phantom:
    phantom = build_recipe(Lung(n_voxel=(n, n, n), size=SIZE, metal="Fe"), 1)
    phantom = phantom if metal else phantom.without_metal()
    return compact(phantom, present_materials(phantom))


def _mapped(n: int) -> Phantom:
    """Return the thorax with a density of its own in every voxel, 5 % around nominal, as a CT volume has."""
    phantom = _thorax(n, metal=False)
    density = 1 + 0.05 * np.random.default_rng(1).standard_normal(phantom.labels.shape, np.float32)
    return replace(phantom, density=np.maximum(density, np.float32(0)))


def _cylinder(n: int) -> Phantom:
    z = (np.arange(n) + 0.5 - n / 2) * SIZE / n
    y, x = z[:, None], z[None, :]
    disc = np.where(np.hypot(y, x) < 26, 1, 0)
    disc[np.hypot(y, x - 13) < 4] = 2
    disc[np.hypot(y - 9, x + 9) < 3] = 3
    labels = (disc[None] * (np.abs(z) < 27)[:, None, None]).astype(np.uint8)
    names = ("air", "water", "cortical_bone", "Al")
    return Phantom(labels=labels, materials=names, d_voxel=(SIZE / n, SIZE / n, SIZE / n))


PATH_SCENES: dict[str, Callable[[int], Phantom]] = {
    "lung": partial(_thorax, metal=False),
    "lung + Fe": partial(_thorax, metal=True),
    "cylinder": _cylinder,
    "lung, density map": _mapped,
}


def paths(setup: Setup, scene: str) -> list[Measurement]:
    """Measure path lengths in all materials at once, and Joseph's projector on one material."""
    geometry, phantom = scanner_of(setup.side, setup.views).geometry, PATH_SCENES[scene](setup.side)
    tracer = Tracer.of(phantom)

    def trace() -> None:
        for view in range(geometry.n_views):
            path_lengths(tracer, geometry, view)

    contenders: dict[str, Callable[[], object]] = {OURS: trace}
    if setup.measures(RTK):
        rtk = Rtk(geometry, setup.threads)
        commonest = 1 + int(np.argmax(np.bincount(phantom.labels.ravel())[1:]))
        one = (phantom.labels == commonest).astype(np.float32)
        one = one if phantom.density is None else one * phantom.density
        contenders[RTK] = partial(rtk.project, rtk.volume(one))
    notes = {OURS: f"all of {', '.join(phantom.materials[1:])}", RTK: "Joseph, one material"}
    timed = setup.timed(contenders)
    return [msgspec.structs.replace(m, note=notes[name]) for name, (_, m) in timed.items()]


class Rods:
    """Three rods of a metal in a water cylinder, its scan, and attenuation (1/mm) at 50 keV by material."""

    def __init__(self, setup: Setup, metal: str) -> None:
        n = setup.side
        self.geometry = scanner_of(n, setup.views).geometry
        self.phantom = build_recipe(Validation(n_voxel=(n, n, n), size=SIZE, metal=metal), 1)
        self.mu = {m: float(attenuation(m, KEV)[0]) for m in ("water", metal)}
        self.volume = attenuation_volume(self.phantom, self.geometry, self.mu)

    def integrals(self, phantom: Phantom) -> NDArray[np.float64]:
        """Return our line integrals through a version of the phantom: [view, v, u]."""
        tracer, mu = Tracer.of(phantom), np.array([self.mu.get(m, 0.0) for m in phantom.materials])
        views = range(self.geometry.n_views)
        return np.stack([np.tensordot(mu, path_lengths(tracer, self.geometry, k), 1) for k in views])

    def closed_form(self) -> NDArray[np.float64]:
        """Return the exact line integrals along central rays: [view, v, u]."""
        water, *rods = self.phantom.solids
        mu = [self.mu["water"], *(self.mu[rod.material] - self.mu["water"] for rod in rods)]
        weighted = list(zip(mu, (water, *rods), strict=True))
        views = [[m * upright_chord(self.geometry, k, s) for m, s in weighted] for k in range(self.geometry.n_views)]
        return np.sum(views, 1)


def exact(setup: Setup, metal: str) -> list[Measurement]:
    """Compare line integrals at 50 keV with the closed form along central rays."""
    scene = Rods(setup, metal)
    phantom, geometry = scene.phantom, scene.geometry
    variants = {
        f"{OURS}, exact solids": phantom,
        f"{OURS}, exact rods in voxels": voxelised(phantom, geometry, phantom.solids[1:]),
        f"{OURS}, voxels only": voxelised(phantom, geometry, ()),
    }
    integrals: dict[str, NDArray] = {name: scene.integrals(variant) for name, variant in variants.items()}
    if setup.measures(RTK):
        rtk = Rtk(geometry, setup.threads)
        integrals[RTK] = rtk.project(rtk.volume(scene.volume))
    if setup.measures(XCIST):
        one = np.ones(1)
        integrals[XCIST] = Xcist(geometry, [scene.volume], one[:, None], KEV, one).project()
    notes = {RTK: "Joseph", XCIST: "distance-driven, which averages over the pixel"}
    truth, shared = scene.closed_form(), {"views": setup.views, "error_kind": "relative RMS of line integrals"}
    return [
        Measurement(contender=name, error=relative(p, truth), note=notes.get(name, ""), **shared)
        for name, p in integrals.items()
    ]


def fdk(setup: Setup, metal: str) -> list[Measurement]:
    """Measure FDK of exact line integrals at 50 keV: RMSE against the truth in voxels that every view sees."""
    scene = Rods(setup, metal)
    geometry, truth = scene.geometry, scene.volume
    p = scene.integrals(scene.phantom).astype(np.float32)
    z, y, x = geometry.voxel_centres()
    seen = np.broadcast_to(np.hypot(y[:, None], x) < 0.98 * min(geometry.fov_radius, SIZE / 2), truth.shape).copy()
    seen[np.abs(z) > SIZE / 4] = False
    contenders: dict[str, Callable[[], NDArray]] = {OURS: lambda: ours_fdk(torch.from_numpy(p), geometry).numpy()}
    if setup.measures(RTK):
        rtk = Rtk(geometry, setup.threads)
        contenders[RTK] = partial(rtk.fdk, rtk.stack(p))

    def rmse(volume: NDArray) -> float:
        return float(np.sqrt(np.mean((volume[seen] - truth[seen]) ** 2, dtype=np.float64)))

    timed = setup.timed(contenders).values()
    return [msgspec.structs.replace(m, error=rmse(volume), error_kind="RMSE (1/mm)") for volume, m in timed]


def paper(setup: Setup, scene: str) -> list[Measurement]:
    """Measure make-dataset on a scene of the suite `paper`, in a process of its own, start included.

    The scene of the suite `quick` is made first, so that kernels are compiled and cached.
    """
    with tempfile.TemporaryDirectory(prefix="ctsim-peers-") as folder:
        seconds, peak = [], 0
        for suite in ("quick", "paper"):
            start = time.perf_counter()
            try:
                with Process() as process:
                    process.run(quietly, make_dataset.main, suite, Path(folder) / suite, "--only", scene)
                    peak = process.run(host.peak_memory)
            except RuntimeError as error:
                reason = f"make-dataset {suite}: {error}"
                return [Measurement(contender=OURS, ok=False, status="error", reason=reason)]
            seconds.append(time.perf_counter() - start)
        size = sum(f.stat().st_size for f in (Path(folder) / "paper").rglob("*") if f.is_file())
    note = f"{size / 1e6:.0f} MB written, one run"
    timed = {"seconds": {"run": (seconds[1],)}, "warm_up": seconds[0], "views": setup.views}
    return [Measurement(contender=OURS, peak_bytes=peak, note=note, **timed)]


ROW_BODIES = {"lung": Lung(n_voxel=(104, 104, 104), metal="Fe"), "random": Random(n_voxel=(104, 104, 104), metal="Ti")}


def row(setup: Setup, body: str) -> list[Measurement]:
    """Measure one slice in one thread: the scan and its metal-free twin, made and written, and FDK of both.

    One detector row of 641 pixels, a slice of 416². A worker that makes a training set does this again and again, each
    time with another body and another beam, for which nothing is prepared. Comes last: the process keeps to one thread.
    """
    scanner = ScannerSettings(preset="ideal", n_views=setup.views, n_detector=(1, 641), n_voxel=(1, 416, 416))
    method, number = find("fdk"), itertools.count()

    def make(folder: Path) -> None:
        k = next(number)
        scene = Scene(
            name=f"row-{k}",
            phantom=ROW_BODIES[body],
            scanner=msgspec.structs.replace(scanner, tube=Tube(kvp=90.0 + k)),
            seed=k,
            truth=Truth(trace=True),
            truncated=True,  # a body higher than one row
            metal_in_view=True,
        )
        stored = open_scan(make_scene(scene, folder))
        for scan in (stored, stored.metal_free):
            assert scan is not None  # twins are made by default
            method.reconstruct(scan.scan)

    host.use_threads(1)
    with tempfile.TemporaryDirectory(prefix="ctsim-peers-") as folder:
        timed = setup.timed({OURS: lambda: make(Path(folder))})
    note = "one thread of a warm process; another body and beam each time"
    return [msgspec.structs.replace(m, note=note) for _, m in timed.values()]


NAMED = (paths, exact, paper, fdk, poly, row)
CASES: dict[str, Callable[[Setup, str], list[Measurement]]] = {case.__name__: case for case in NAMED}


def measure(task: Task, given: Flags) -> list[Measurement]:
    """Measure a case on all its scenes."""
    host.use_threads(task.settings["threads"])
    case = finding.case(task.case)
    runs = {"repeats": given.repeats, "threads": host.host().threads}  # the machine may have fewer than asked for
    setup = Setup(case=case, side=SIDES[task.part], versions=versions(task), **runs)
    out: list[Measurement] = []
    for name in case.scenes or case.metals:
        scene = name if case.scenes else f"{name} rods in water"
        found = [*CASES[case.name](setup, name), *setup.left_out()]
        out += [msgspec.structs.replace(m, scene=scene) for m in found]
    return out
