"""make-dataset: from scene recipes to scans on disk, resumable at any moment."""

import contextlib
import dataclasses
import shutil
import sys
import time
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from benchmarks.workers import TICK, Lost, Pool, open_pool
from ctsim.errors import InputError
from ctsim.human import human_bytes, human_choice, human_time

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

    from ctsim.plan import Plan
    from ctsim.types import Phantom, Scanner
    from phantoms.scene import Scene

OF_COMMANDS = ("pareto", "peers", "stress")  # what run-benchmark's commands measure: suites, but none of datasets
_SPARE = 64 * 2**20  # bytes left free for the file system's own needs


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Simulate the scans of a suite, with their ground truth, into a data folder.

    An interrupted run goes on where it stopped when it is started again; finished scenes are skipped.
    """

    suite: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")]
    """Name of a bundled suite (quick, core, paper …) or path of a TOML file; with --verify alone, the data folder."""
    out: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")] = None
    """Data folder."""
    dry_run: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what would be done, what is skipped and why, error, time and disk; write nothing."""
    verify: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only check the data folder against its checksums."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Make scenes again that are there, also where another scene has their name."""
    only: tuple[str, ...] = ()
    """Only these scenes of the suite."""
    seeds: tuple[int, ...] = ()
    """Make every scene once for each of these seeds, as NAME-sSEED."""
    workers: int = 1
    """Make so many scenes at once, each with its share of the cores."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Let the workers of this Dask scheduler make the scenes; OUT must be the same folder for them."""


def main(argv: list[str]) -> int:
    """Run the command; return 0, 2 for an error of the user's or damaged data, 130 when interrupted."""
    options = tyro.cli(Options, prog="make-dataset", args=argv)
    try:
        if options.verify:
            return _verify(options.out or Path(options.suite))
        if options.out is None:
            raise InputError("the data folder is missing: expected make-dataset SUITE OUT")
        scenes = select(load(options.suite), options.only, options.seeds)
        return _dry_run(scenes, options) if options.dry_run else _make(scenes, options.out, options)
    except (InputError, OSError, tomllib.TOMLDecodeError) as error:
        _say(f"make-dataset: {_sentence(error)}")
        return 2
    except KeyboardInterrupt:
        _say("make-dataset: interrupted; the same command goes on from here")
        return 130


def load(suite: str) -> "tuple[Scene, ...]":
    """Return the scenes of a bundled suite by its name, or of a TOML file by its path.

    Raises
    ------
    InputError
        When there is no such suite or file, or the file is wrong (naming file, key and what was expected).
    """
    from phantoms.scene import load_suite

    known = bundled()
    if suite in known:
        with resources.as_file(known[suite]) as path:
            return load_suite(path)
    if not Path(suite).is_file():
        raise InputError(f"{suite}: neither a TOML file nor a bundled suite ({', '.join(sorted(known))})")
    return load_suite(Path(suite))


def bundled() -> "dict[str, Traversable]":
    """Return the bundled suites by name, those of `OF_COMMANDS` apart."""
    folder = resources.files("benchmarks") / "suites"
    files = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return {name: entry for name, entry in files.items() if name not in OF_COMMANDS}


def select(scenes: "tuple[Scene, ...]", only: tuple[str, ...], seeds: tuple[int, ...]) -> "tuple[Scene, ...]":
    """Return the named scenes (all when none is named), once for each seed when seeds are given."""
    import msgspec

    names = [scene.name for scene in scenes]
    for name in only:
        if name not in names:
            raise InputError(f"--only {name}: no such scene, expected one of {human_choice(names, name)}")
    chosen = tuple(scene for scene in scenes if not only or scene.name in only)
    if not seeds:
        return chosen
    return tuple(
        msgspec.structs.replace(scene, name=f"{scene.name}-s{seed}", seed=seed) for scene in chosen for seed in seeds
    )


def _verify(data_dir: Path) -> int:
    from ctsim.manifest import read_index, verify

    problems = verify(data_dir)
    for problem in problems:
        _say(problem)
    if not problems:
        sys.stdout.write(f"{data_dir}: {len(read_index(data_dir))} scenes, every file is as it was written\n")
    return 2 if problems else 0


def _plan(scene: "Scene") -> "tuple[Plan, Phantom, Scanner]":
    from ctsim.plan import make_plan
    from phantoms.scene import build, stream_id

    with _memory(scene.name):
        phantom, scanner = build(scene), scene.resolve()
        return make_plan(phantom, scanner, scene.simulation, scene.truth, stream_id(scene)), phantom, scanner


@contextlib.contextmanager
def _memory(name: str) -> Iterator[None]:
    """Turn a lack of memory into the user's error that names the scene."""
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"{name}: there is not enough memory ({error or 'no size is known'}); expected a smaller "
            "phantom.n_voxel, scanner.n_voxel or scanner.n_detector"
        ) from error


def _dry_run(scenes: "tuple[Scene, ...]", options: Options) -> int:
    from ctsim.writer import is_complete
    from phantoms.scene import scene_id

    seconds, size = 0.0, 0
    for scene in scenes:
        if options.out and not options.force and is_complete(options.out, scene.name, scene_id(scene)):
            sys.stdout.write(f"{scene.name}: already complete\n")
            continue
        plan, *_ = _plan(scene)
        sys.stdout.write(f"{scene.name}\n{plan.text()}\n")
        seconds, size = seconds + plan.seconds, size + plan.disk_bytes
    sys.stdout.write(f"total: {human_time(seconds)}, {human_bytes(size)} on disk\n")
    return 0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A scene to make, as it travels to a worker."""

    scene: "Scene"
    plan: "Plan"
    out: Path
    force: bool


def _make(scenes: "tuple[Scene, ...]", out: Path, options: Options) -> int:
    from ctsim.manifest import arrange_index
    from ctsim.writer import is_complete
    from phantoms.scene import scene_id

    # what is in the way shows before the first hour is spent, not after it
    todo = [s for s in scenes if options.force or not is_complete(out, s.name, scene_id(s))]
    for scene in scenes:
        if scene not in todo:
            _say(f"{scene.name}: already complete")
    with open_pool(options.workers, options.scheduler) as pool:
        plans = {scene.name: _plan(scene)[0] for scene in todo}  # all phantoms could be more than memory holds
        for name, plan in plans.items():
            for note in plan.notes:
                _say(f"{name}: {note}")
        _check_space(out, sum(plan.disk_bytes for plan in plans.values()))
        if pool:
            where = out.resolve()
            _make_apart([Job(scene=s, plan=plans[s.name], out=where, force=options.force) for s in todo], pool)
        else:
            _make_here(todo, plans, out, options.force)
    arrange_index(out, [scene.name for scene in scenes])
    return 0


def _make_here(scenes: "list[Scene]", plans: "dict[str, Plan]", out: Path, force: bool) -> None:
    """Make scenes one after another in this process."""
    from phantoms.scene import build

    for number, scene in enumerate(scenes, 1):
        title = f"{number}/{len(scenes)} {scene.name}"
        with _memory(scene.name):
            make_scene(scene, plans[scene.name], (build(scene), scene.resolve()), out, force=force, title=title)


def _make_apart(jobs: list[Job], pool: Pool) -> None:
    """Make scenes on workers behind one progress bar, which follows the views that the workers noted as safe."""
    from tqdm import tqdm

    from ctsim.writer import views_noted

    views = [job.scene.resolve().geometry.n_views for job in jobs]
    left = set(range(len(jobs)))
    with tqdm(total=sum(views), unit="view", disable=None, file=sys.stderr) as bar:
        for answer in pool.answers(do, jobs):
            if answer is not None:
                number, end = answer
                name = jobs[number].scene.name
                if isinstance(end, Lost):
                    raise InputError(f"{name}: {end.reason}, as happens when memory is short; expected fewer workers")
                left.discard(number)
                bar.set_description(f"{len(jobs) - len(left)}/{len(jobs)} {name}")
            noted = views_noted(jobs[0].out)
            bar.n = sum(noted.get(jobs[k].scene.name, 0) if k in left else n for k, n in enumerate(views))
            bar.refresh()


def do(job: Job) -> None:
    """Be the worker: make a scene unless it is there, after any process that makes it just now."""
    from ctsim.locks import Busy
    from ctsim.writer import is_complete
    from phantoms.scene import build, scene_id

    name = job.scene.name
    while job.force or not is_complete(job.out, name, scene_id(job.scene)):
        with contextlib.suppress(Busy), _memory(name):
            make_scene(
                job.scene, job.plan, (build(job.scene), job.scene.resolve()), job.out, force=job.force, title=None
            )
            return
        time.sleep(TICK)  # a worker that was thought lost may still be at it


def make_scene(
    scene: "Scene",
    plan: "Plan",
    parts: "tuple[Phantom, Scanner]",
    out: Path,
    *,
    force: bool = False,
    title: str | None = "",
) -> Path:
    """Simulate one scene into `out`, going on from where an earlier run stopped; return its folder.

    Its progress is shown under `title`, not at all where that is None.

    Raises
    ------
    InputError
        When another scene is in the way or the disk is full.
    """
    from ctsim.simulate import scan_info, simulate_views, truth_volumes
    from ctsim.writer import SceneWriter, Stack
    from phantoms.scene import scene_id, scene_to_toml

    phantom, scanner = parts
    geometry = scanner.geometry
    stacks = tuple(
        Stack(name=o.name, shape=(geometry.n_views, *o.shape), dtype=o.dtype, pixel=geometry.d_detector)
        for o in plan.outputs
    )
    with SceneWriter(
        out, scene.name, scene_id=scene_id(scene), plan_hash=plan_hash(plan), stacks=stacks, force=force
    ) as writer:
        if writer.first_view and title is not None:
            _say(f"{scene.name}: goes on from view {writer.first_view} of {geometry.n_views}")
        views = simulate_views(plan, phantom, scanner, first_view=writer.first_view)
        shown = title if title is None else title or scene.name
        for view, arrays in _progress(views, writer.first_view, geometry.n_views, shown):
            writer.put(view, arrays)
        info = dict(scan_info(plan, phantom, scanner))
        writer.write_image("flat", info.pop("flat"), geometry.d_detector)
        for name, volume in truth_volumes(plan, phantom, scanner):
            writer.write_image(name, volume, geometry.d_voxel)
        writer.write_text("scene.toml", scene_to_toml(scene))
        writer.write_text("scan.json", _json(info))
        writer.write_text("plan.json", _json(plan.to_dict()))
        writer.write_text("spectrum.csv", spectrum_csv(scanner))
        return writer.finish()


def plan_hash(plan: "Plan") -> str:
    """Hash what a plan does, leaving out its estimates of time, which change with the machine."""
    import hashlib

    kept = {k: v for k, v in plan.to_dict().items() if k != "seconds"}
    return hashlib.sha256(_json(kept)).hexdigest()


def spectrum_csv(scanner: "Scanner") -> str:
    """Return the tube's spectrum and what the detector makes of it as CSV."""
    from ctsim.detector import response
    from ctsim.spectrum import spectrum

    tube = spectrum(scanner.tube)
    signal = tube.weights * response(scanner.detector, tube.energies)[0]
    signal = signal / signal.sum()
    rows = zip(tube.energies, tube.weights, signal, strict=True)
    return "energy_kev,photon_fraction,signal_fraction\n" + "".join(f"{e:.4f},{w:.8g},{s:.8g}\n" for e, w, s in rows)


def _check_space(out: Path, need: int) -> None:
    folder = out.absolute()
    while not folder.exists():
        folder = folder.parent
    unfinished = sum(p.stat().st_blocks * 512 for p in out.glob(".*.partial/**/*.tif")) if out.is_dir() else 0
    free = shutil.disk_usage(folder).free + unfinished
    if need + _SPARE > free:
        raise InputError(f"{out}: the dataset needs {human_bytes(need)} but only {human_bytes(free)} are free")


def _progress(views: Iterator[Any], first: int, n_views: int, title: str | None) -> Iterator[Any]:
    from tqdm import tqdm

    hidden = True if title is None else None  # None: hidden where nobody watches
    return iter(tqdm(views, title, n_views, initial=first, unit="view", disable=hidden, file=sys.stderr))


def _json(value: Any) -> bytes:
    import msgspec
    import numpy as np

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")

    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=1) + b"\n"


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file system'}: {error.strerror}"
    return " ".join(str(error).split())


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
