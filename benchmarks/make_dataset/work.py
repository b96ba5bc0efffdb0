"""What `make-dataset` does: check, plan or make the scenes of a suite, here or on workers."""

import dataclasses
import functools
import shutil
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from ctsim.benchmarks.engine.host import open_jobs
from ctsim.benchmarks.engine.process import TICK, Jobs, Lost
from ctsim.benchmarks.engine.terminal import Bar, announced
from ctsim.benchmarks.make_dataset import Flags
from ctsim.benchmarks.suites import load, select
from ctsim.dataset.folder import (
    finished,
    is_complete,
    listing,
    other_code,
    partial_of,
    recover,
    remarks,
    tidy,
    unfinished,
)
from ctsim.dataset.locks import PATIENCE, Busy
from ctsim.dataset.manifest import Manifest, mend_index, read_index, verify
from ctsim.dataset.sources import source_hash
from ctsim.errors import InputError
from ctsim.human import human_bytes, human_time
from ctsim.phantoms.dataset import disk_bytes, make_scenes, plan_scene
from ctsim.phantoms.scene import Scene, scene_id
from ctsim.phantoms.variants import MOST, families

PLANNED = 24  # scenes; a plan takes up to a second
T = TypeVar("T")
_SPARE = 64 * 2**20  # bytes left free for the file system's own needs


def run(options: Flags) -> int:
    """Verify, plan or make what the flags ask for; return the exit code."""
    try:
        if options.verify:
            return _verify(options.out or Path(options.suite))
        if options.out is None:
            raise InputError("the data folder is missing: expected make-dataset SUITE OUT")
        scenes = select(load(options.suite), options.only, options.seeds)
        with announced(say):
            return _dry_run(scenes, options) if options.dry_run else _make(scenes, options.out, options)
    except (InputError, OSError, tomllib.TOMLDecodeError) as error:
        say(f"make-dataset: {_sentence(error)}")
        return 2
    except KeyboardInterrupt:
        forced = " without --force" if options.force else ""
        say(f"make-dataset: interrupted; the same command{forced} goes on from here")
        return 130


def _verify(data_dir: Path) -> int:
    problems = verify(data_dir)
    for text in [*problems, *remarks(data_dir)]:
        say(text)
    if not problems:
        sys.stdout.write(f"{data_dir}: {len(read_index(data_dir))} scenes, every file is as it was written\n")
    return 2 if problems else 0


def _dry_run(scenes: tuple[Scene, ...], options: Flags) -> int:
    there = {} if options.out is None else _finished(scenes, options.out, options.force)
    seconds, size = 0.0, 0
    for manifest in there.values():
        sys.stdout.write(f"{_complete(manifest)}\n")
    groups = alike([scene for scene in scenes if scene.name not in there])
    for first, n, of in groups:
        plan = plan_scene(first)
        sys.stdout.write(f"{first.name}{f', and {n - 1} more {of}' if n > 1 else ''}\n{plan.text()}\n")
        seconds, size = seconds + n * plan.seconds, size + n * plan.disk_bytes
    n_scenes = sum(n for _, n, _ in groups)
    sample = f" (planned {len(groups)} of {n_scenes} scenes)" if len(groups) < n_scenes else ""
    sys.stdout.write(f"total: {human_time(seconds)}, {human_bytes(size)} on disk{sample}\n")
    for text in _of_other_code(scenes, there, options.out):
        sys.stdout.write(f"{text}\n")
    return 0


def alike(scenes: Sequence[Scene]) -> list[tuple[Scene, int, str]]:
    """Return what a dry run plans: a scene that stands for others, how many they are with it, and what they share.

    These are the scenes of a table with `count`, and those that differ in their seed alone. Where that leaves more than
    `PLANNED`, one scene stands for all of its recipe, metal, grids and number of views.
    """
    groups = _grouped(scenes, lambda s: s.drawn.table if s.drawn else _text(s, "name", "seed"))
    if len(groups) <= PLANNED:
        return [(g[0], len(g), "of its table" if g[0].drawn else "that differ in their seed alone") for g in groups]
    return [(g[0], len(g), "of its recipe, metal, grids and number of views") for g in _grouped(scenes, _kind)]


def _grouped(scenes: Sequence[Scene], key: Callable[[Scene], object]) -> list[list[Scene]]:
    found: dict[object, list[Scene]] = {}
    for scene in scenes:
        found.setdefault(key(scene), []).append(scene)
    return list(found.values())


def _kind(scene: Scene) -> tuple[object, ...]:
    """Return what decides most of a scene's time and disk: not tube, dose, the draw of the body and sizes in mm."""
    scanner = scene.resolve()
    shape = (scene.phantom.recipe, scene.phantom.metal, scene.phantom.n_voxel, scanner.scatter.level)
    geometry = scanner.geometry
    return *shape, geometry.n_views, geometry.n_detector, geometry.n_voxel, scene.truth, scene.simulation


def _text(given: msgspec.Struct, *without: str) -> bytes:
    """Return the settings of a struct, some of which may be lists, as what a dict takes for a key."""
    return msgspec.json.encode({key: getattr(given, key) for key in given.__struct_fields__ if key not in without})


def _finished(scenes: tuple[Scene, ...], out: Path, force: bool) -> dict[str, Manifest]:
    """Return the manifests of finished scenes that are kept, by name; reads only."""
    found = {} if force else {s.name: finished(out, s.name, scene_id(s)) for s in scenes}
    return {name: manifest for name, manifest in found.items() if manifest is not None}


def _complete(manifest: Manifest) -> str:
    return f"{manifest.name}: already complete" + (", by other code" if manifest.code != source_hash() else "")


def _of_other_code(scenes: tuple[Scene, ...], there: dict[str, Manifest], out: Path | None) -> list[str]:
    """Name scenes that other code of the simulator made: finished ones stay, unfinished ones start again."""
    code = source_hash()
    said = [other_code([m for m in there.values() if m.code != code], len(there))]
    left = unfinished(out) if out else {}
    again = [s.name for s in scenes if s.name not in there and s.name in left and left[s.name].code != code]
    if again:
        said.append(f"begun by other code of the simulator, so they start again: {listing(again)}")
    return [text for text in said if text]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SceneJob:
    """Scenes to make together, as they travel to a worker."""

    scenes: tuple[Scene, ...]
    out: Path
    force: bool
    code: str


def _make(scenes: tuple[Scene, ...], out: Path, options: Flags) -> int:
    source_hash()  # of the code that is loaded, even if its files change meanwhile
    recover(out)
    # obstacles show before the first hour of work, not after it
    there = _finished(scenes, out, options.force)
    for manifest in there.values():
        say(_complete(manifest))
    for text in [*_of_other_code(scenes, there, out), *tidy(out, there.values())]:
        say(text)
    if todo := [scene for scene in scenes if scene.name not in there]:
        _make_all(todo, out, options)
        there = _finished(scenes, out, force=False)
        tidy(out, there.values())  # left by workers that were killed after they had put their scene in place
    mend_index(out, list(there.values()), [scene.name for scene in scenes])
    return 0


def _make_all(scenes: list[Scene], out: Path, options: Flags) -> None:
    """Make the scenes here or on workers; each is planned where it is made."""
    with open_jobs(options.workers, options.scheduler) as pool:
        _check_space(out, scenes)
        if pool is None:
            _make_here(scenes, out, options.force)
            return
        where, code = out.resolve(), source_hash()
        most = min(MOST, -(-len(scenes) // pool.workers))  # no worker is to be idle
        jobs = [SceneJob(scenes=f, out=where, force=options.force, code=code) for f in families(scenes, most)]
        _make_apart(jobs, pool)


def _make_here(scenes: list[Scene], out: Path, force: bool) -> None:
    """Make families of scenes one after another; a scene that another process has finished meanwhile is there."""
    views = {scene.name: scene.resolve().geometry.n_views for scene in scenes}
    titles = {scene.name: f"{number}/{len(scenes)} {scene.name}" for number, scene in enumerate(scenes, 1)}
    with Bar(sum(views.values()), "view") as bar:
        for family in families(scenes):
            done = bar.done + sum(views[scene.name] for scene in family)
            there = [s for s in family if not force and is_complete(out, s.name, scene_id(s))]
            for scene in there:
                say(f"{scene.name}: already complete")
            if todo := [scene for scene in family if scene not in there]:
                make_scenes(todo, out, force=force, watch=functools.partial(_watch, bar, titles), tell=_note)
            for scene in family:
                bar.at(done, titles[scene.name])


def _watch(bar: Bar, titles: dict[str, str], name: str, views: Iterable[T], first: int, n_views: int) -> Iterable[T]:
    """Show a scene's views on the bar."""
    if first:
        say(f"{name}: goes on from view {first} of {n_views}")
        bar.at(bar.done + first)
    return bar.over(views, titles[name])


def _note(name: str, text: str) -> None:
    say(f"{name}: {text}")


def say(text: str) -> None:
    """Write a line to stderr."""
    sys.stderr.write(text + "\n")


def _make_apart(jobs: list[SceneJob], pool: Jobs) -> None:
    """Make scenes on workers with one progress bar, which counts the views that workers have on disk."""
    views = {scene.name: scene.resolve().geometry.n_views for job in jobs for scene in job.scenes}
    left = set(views)
    with Bar(sum(views.values()), "view") as bar:
        for answer in pool.answers(do, jobs):
            ended = ""
            if answer is not None:
                number, end = answer
                names = [scene.name for scene in jobs[number].scenes]
                if isinstance(end, Lost):
                    where = ", ".join(names)
                    raise InputError(f"{where}: {end.reason}, as happens when memory is short; expected fewer workers")
                for name, note in end:
                    _note(name, note)
                left.difference_update(names)
                ended = f"{len(views) - len(left)}/{len(views)} {', '.join(names)}"
            noted = {name: progress.views for name, progress in unfinished(jobs[0].out).items()}
            done = sum(noted.get(name, 0) if name in left else n for name, n in views.items())
            bar.at(max(done, bar.done), ended)  # a scene in its place is noted no more, and its job still runs


def do(job: SceneJob) -> tuple[tuple[str, str], ...]:
    """Be the worker: make the scenes that are not there, after any process that makes one just now.

    Returns notes, each with the name of its scene.

    Raises InputError where this process has other code than the command, and where the scene's lock stays that a
    process of another machine has, which may have been killed.
    """
    waited, notes = 0.0, list[tuple[str, str]]()
    if source_hash() != job.code:
        name = job.scenes[0].name
        raise InputError(f"{name}: a worker runs other code of the simulator than make-dataset; restart the workers")
    while todo := [s for s in job.scenes if job.force or not is_complete(job.out, s.name, scene_id(s))]:
        try:
            make_scenes(todo, job.out, force=job.force, tell=lambda name, note: notes.append((name, note)))
            break
        except Busy as error:
            if not error.certain and waited >= PATIENCE:
                raise
        time.sleep(TICK)  # a worker that was taken for lost may still make it
        waited += TICK
    return tuple(notes)


def _check_space(out: Path, scenes: list[Scene]) -> None:
    """Refuse scenes that have no room, counting what unfinished ones have taken already."""
    need = sum(disk_bytes(scene) for scene in scenes)
    folder = out.absolute()
    while not folder.exists():
        folder = folder.parent
    begun = (path for scene in scenes for path in partial_of(out, scene.name).glob("**/*.tif"))
    free = shutil.disk_usage(folder).free + sum(path.stat().st_blocks * 512 for path in begun)
    if need + _SPARE > free:
        raise InputError(f"{out}: the dataset needs {human_bytes(need)} but only {human_bytes(free)} are free")


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file system'}: {error.strerror}"
    return " ".join(str(error).split())
