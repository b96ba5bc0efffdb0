"""One scene simulated with its truth: into a folder, so that a stopped run goes on where it was, or in memory."""

import contextlib
import functools
import hashlib
import operator
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numba
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import spectrum
from ctsim.dataset.manifest import About, append_index
from ctsim.dataset.memory import MemoryWriter, SimulatedScan
from ctsim.dataset.truth import ScanWithTruth
from ctsim.dataset.writer import SceneWriter, Stack
from ctsim.detector.response import response
from ctsim.errors import InputError, check_kind
from ctsim.look import all_rays
from ctsim.notes import metal_share
from ctsim.phantoms.scene import Scene, build, individual, parse_suite, scene_id, scene_to_toml, stream_id
from ctsim.phantoms.variants import build_all
from ctsim.phantoms.vary import Drawn
from ctsim.plan import Plan, disk_estimate, make_plan, make_plans
from ctsim.signals import Signals, share_rays
from ctsim.simulate import Scattered, SharedTruth, part_of, scan_info, scatter_of, simulate_views, truth_volumes
from ctsim.types import Phantom, Scanner

FEW_TISSUES = 7  # air among them: what recipes have, mostly
Watch = Callable[[Iterable[Any], int, int], Iterable[Any]]
"""Passes on views while it shows how far they are: (views, number of the first, number of all) -> the same views."""

Writer = SceneWriter | MemoryWriter
"""Takes a scene view by view, then its truth."""


@dataclass(slots=True, kw_only=True)
class _Job:
    """A scene on its way to its writer."""

    scene: Scene
    phantom: Phantom
    scanner: Scanner
    plan: Plan
    writer: Writer = field(init=False)

    @property
    def n_views(self) -> int:
        return self.scanner.geometry.n_views

    def views(self, scatter: Scattered, signals: tuple[Signals, int]) -> Iterator[tuple[int, dict[str, NDArray]]]:
        """Simulate the views that the writer lacks."""
        return simulate_views(
            self.plan, self.phantom, self.scanner, self.writer.first_view, scatter=scatter, signals=signals
        )


def plan_scene(scene: Scene) -> Plan:
    """Plan a scene's simulation. Raises InputError where memory is short."""
    with _memory(scene.name):
        phantom = build(scene, whole=False)
        return make_plan(phantom, scene.resolve(), scene.simulation, scene.truth, stream_id(scene))


def _jobs(scenes: Sequence[Scene], phantoms: Sequence[Phantom]) -> list[_Job]:
    """Plan scenes; those of one phantom that differ in beam, scatter, dose and noise alone are looked at together."""
    scanners = [scene.resolve() for scene in scenes]
    asked = [(s.simulation, s.truth, r.geometry, all_rays(r)) for s, r in zip(scenes, scanners, strict=True)]
    plans: dict[int, Plan] = {}

    def together(k: int, other: int) -> bool:
        return phantoms[k] is phantoms[other] and asked[k] == asked[other]

    for k in range(len(scenes)):
        if k not in plans:
            group = [other for other in range(k, len(scenes)) if other not in plans and together(k, other)]
            streams = [stream_id(scenes[other]) for other in group]
            those = [scanners[other] for other in group]
            made = make_plans(phantoms[k], those, scenes[k].simulation, scenes[k].truth, streams)
            plans |= dict(zip(group, made, strict=True))
    return [
        _Job(scene=scene, phantom=phantom, scanner=scanners[k], plan=plans[k])
        for k, (scene, phantom) in enumerate(zip(scenes, phantoms, strict=True))
    ]


def make_scene(
    scene: Scene,
    out: Path,
    *,
    force: bool = False,
    watch: Watch = lambda views, first, n: views,
    tell: Callable[[str], object] = lambda note: None,
) -> Path:
    """Simulate a scene into the data folder `out` and return its folder.

    Goes on after the last view that an earlier run of the same scene and code left safe. With `force`, another scene
    of the same name is replaced. `tell` gets the notes of the plan before the simulation begins.

    Raises
    ------
    InputError
        Where another scene is in the way, the disk is full or memory is short.
    """

    def watch_one(name: str, views: Iterable[Any], first: int, n: int) -> Iterable[Any]:
        return watch(views, first, n)

    return make_scenes((scene,), out, force=force, watch=watch_one, tell=lambda name, note: tell(note))[0]


def make_scenes(
    scenes: Sequence[Scene],
    out: Path,
    *,
    force: bool = False,
    watch: Callable[[str, Iterable[Any], int, int], Iterable[Any]] = lambda name, views, first, n: views,
    tell: Callable[[str, str], object] = lambda name, note: None,
) -> list[Path]:
    """Simulate scenes view by view at the same time, and return their folders: see `make_scene`.

    Scenes that differ in metal, beam, noise and dose alone share the work on their rays (`ctsim.signals.same_rays`).
    Each is, to the last bit, what it is when it is made alone. `watch` and `tell` get the name of the scene first.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(_memory(" to ".join(dict.fromkeys((scenes[0].name, scenes[-1].name)))))
        jobs, writers = _jobs(scenes, build_all(scenes)), []
        for job in jobs:
            for note in job.plan.notes:
                tell(job.scene.name, note)
            writer = SceneWriter(
                out,
                job.scene.name,
                scene_id=scene_id(job.scene),
                plan_hash=plan_hash(job.plan),
                stacks=_stacks(job.plan, job.scanner),
                force=force,
            )
            job.writer = stack.enter_context(writer)
            writers.append(writer)
        shared = _simulate(jobs, watch)
        shares = dict[int, float]()
        told = list[About | None]()
        for job, (signals, _) in zip(jobs, shared, strict=True):
            if job.scene.drawn and id(signals) not in shares:
                shares[id(signals)] = metal_share(job.phantom, job.scanner.geometry)
            told.append(about(job.scene, shares[id(signals)]) if job.scene.drawn else None)
        return _finish(writers, told)


def _finish(writers: Sequence[SceneWriter], told: Sequence[About | None]) -> list[Path]:
    """Put the folders in their places, several at a time, and list them in the index in the order of the scenes."""
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        ends = [pool.submit(writer.settle, one) for writer, one in zip(writers, told, strict=True)]
    append_index(writers[0].data_dir, *(end.result() for end in ends if end.exception() is None))
    for end in ends:
        end.result()  # raises what one of them met
    return [writer.final for writer in writers]


def about(scene: Scene, share: float) -> About:
    """Return what the index says of a drawn scene; `share` is that of its rays that meet metal."""
    drawn, plain = scene.drawn or Drawn(table="", index=0), msgspec.to_builtins(scene)
    return About(
        individual=individual(scene),
        split=drawn.split,
        metal_share=share,
        drawn={key: functools.reduce(operator.getitem, key.split("."), plain) for key in drawn.keys},
    )


def disk_bytes(scene: Scene) -> int:
    """Estimate what a scene takes on disk without building it: path lengths as of `FEW_TISSUES` materials."""
    metal = scene.phantom.metal != "none"
    return disk_estimate(scene.resolve(), scene.truth, metal=metal, n_tissues=FEW_TISSUES)


def simulate_scene(scene: Scene) -> SimulatedScan:
    """Simulate a scene in memory: the same numbers as `make_scene` writes, and no file.

    Raises InputError where memory is short.
    """
    check_kind("scene", scene, Scene, "a Scene, such as of find_scene or new_scene")
    with _memory(scene.name):
        (job,) = _jobs([scene], [build(scene, whole=False)])
        writer = MemoryWriter(scene.name, scene_id=scene_id(scene), stacks=_stacks(job.plan, job.scanner))
        job.writer = writer
        _simulate([job])
        return writer.finish()


def _stacks(plan: Plan, scanner: Scanner) -> tuple[Stack, ...]:
    """Return the stacks of views that a plan asks for."""
    views, pixel = scanner.geometry.n_views, scanner.geometry.d_detector
    return tuple(Stack(name=o.name, shape=(views, *o.shape), dtype=o.dtype, pixel=pixel) for o in plan.outputs)


def _simulate(
    jobs: Sequence[_Job],
    watch: Callable[[str, Iterable[Any], int, int], Iterable[Any]] = lambda name, views, first, n: views,
) -> list[tuple[Signals, int]]:
    """Simulate the views that the writers lack, of all scenes in step, and the truth; return what they share."""
    scatter = [scatter_of(job.plan, job.phantom, job.scanner) for job in jobs]
    shared = share_rays([part_of(job.plan, job.phantom, job.scanner) for job in jobs])
    views = [
        iter(watch(job.scene.name, job.views(scattered, signals), job.writer.first_view, job.n_views))
        for job, scattered, signals in zip(jobs, scatter, shared, strict=True)
    ]
    for k in range(min(job.writer.first_view for job in jobs), max(job.n_views for job in jobs)):
        for job, its in zip(jobs, views, strict=True):
            if job.writer.first_view <= k < job.n_views:
                job.writer.put(*next(its))
    groups = [id(signals) for signals, _ in shared]
    truths = {group: SharedTruth() for group in groups if groups.count(group) > 1}
    for k, (job, its, scattered, group) in enumerate(zip(jobs, views, scatter, groups, strict=True)):
        next(its, None)  # the last view is done
        _write_truth(job, scattered, truths.get(group))
        if group not in groups[k + 1 :]:
            truths.pop(group, None)
        job.writer.write_text("scene.toml", scene_to_toml(job.scene))
    return shared


def _write_truth(job: _Job, scatter: Scattered, shared: SharedTruth | None) -> None:
    """Write what a scan has once: the flat, the true volumes, and how both were made."""
    writer, scanner = job.writer, job.scanner
    info = dict(scan_info(job.plan, job.phantom, scanner, scatter))
    writer.write_image("flat", info.pop("flat"), scanner.geometry.d_detector)
    at_once = min(2, numba.get_num_threads())  # more would take memory
    with ThreadPoolExecutor(at_once) as pool:
        left = deque[Future[None]]()
        for name, volume in truth_volumes(job.plan, job.phantom, scanner, shared):
            left.append(pool.submit(writer.write_image, name, volume, scanner.geometry.d_voxel))
            if len(left) == at_once:
                left.popleft().result()
        for one in left:
            one.result()
    writer.write_text("scan.json", _json(info))
    writer.write_text("plan.json", _json(job.plan.to_dict()))
    writer.write_text("spectrum.csv", spectrum_csv(scanner))


def scene_of(scan: ScanWithTruth) -> Scene | str:
    """Return the scene that a scan was simulated from, or why it is not known."""
    try:
        if (text := scan.text("scene.toml")) is None:
            return "the scan comes without scene.toml"
        (scene,) = parse_suite(text, f"{scan.place}: scene.toml")
    except ValueError as error:  # InputError, or a file of several scenes
        return " ".join(str(error).split())
    if scene.resolve().geometry != scan.geometry:
        return "scene.toml describes another geometry than the scan's"
    return scene


def plan_hash(plan: Plan) -> str:
    """Hash what a plan does, leaving out its estimates of time, which change with the machine."""
    kept = {k: v for k, v in plan.to_dict().items() if k != "seconds"}
    return hashlib.sha256(_json(kept)).hexdigest()


def spectrum_csv(scanner: Scanner) -> str:
    """Return the tube's spectrum and what the detector makes of it as CSV."""
    tube = spectrum(scanner.tube)
    signal = tube.weights * response(scanner.detector, tube.energies)[0]
    signal = signal / signal.sum()
    rows = zip(tube.energies, tube.weights, signal, strict=True)
    return "energy_kev,photon_fraction,signal_fraction\n" + "".join(f"{e:.4f},{w:.8g},{s:.8g}\n" for e, w, s in rows)


@contextlib.contextmanager
def _memory(name: str) -> Iterator[None]:
    """Turn a lack of memory into an InputError that names the scene."""
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"{name}: there is not enough memory ({error or 'no size is known'}); expected a smaller "
            "phantom.n_voxel, scanner.n_voxel or scanner.n_detector"
        ) from error


def _json(value: Any) -> bytes:
    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")

    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=1) + b"\n"
