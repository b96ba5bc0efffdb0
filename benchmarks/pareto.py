"""`run-benchmark pareto OUT`: run time against error, of the simulator's choices and of every method's effort.

Every timed run is a line of OUT/pareto.jsonl. Settings are run in turns, once each a round, so that a drift of the
machine meets all alike; times are medians over the rounds. OUT/pareto.md and OUT/pareto.png show the points, their
Pareto front and its knee.
"""

import datetime
import functools
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from benchmarks import lines
from benchmarks.host import commit, host, use_threads
from benchmarks.pareto_records import NAME, Mark, Part, Setting, Timed, latest, read, runs
from benchmarks.records import OK
from ctsim.errors import InputError
from ctsim.human import human_time

if TYPE_CHECKING:
    from benchmarks.pareto_methods import Effort

RODS, SUITE, SMALL = "rods", "quick", "lung-Fe"


@dataclass(frozen=True)
class Arguments:
    """Measure run time against error: the simulator over its choices, every method over its own effort.

    What OUT already holds is not run again, unless code, data, machine or threads have changed or the run failed. The
    machine should have nothing else to do.
    """

    out: tyro.conf.Positional[Path]
    """The folder for pareto.jsonl, pareto.md, pareto.png and the scans; made if it is not there."""
    part: Annotated[tuple[Part, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PART")] = ()
    """Only this part, simulator or methods (default: both)."""
    scene: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times. The simulator has rods, methods those of --suite (lung-Fe)."""
    suite: str = SUITE
    """The suite, or TOML file, that the methods' scenes are from."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this method, or module:function of your own; may be given several times (default: all of the table)."""
    repeats: int = 3
    """Rounds: counted runs of each setting; the table shows medians."""
    threads: int = 2
    """Threads of the kernels."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print what is left to run and about how long it takes; measure nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the table and the figure from the records, computing nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A setting to time. `warm` compiles what all of a `kind` share, and returns its seconds."""

    setting: Setting
    run: Callable[[], tuple[Mark, ...]]
    kind: str
    warm: Callable[[], float]


def main(argv: list[str]) -> int:
    """Run the command; 0 if every setting was measured or skipped with a reason, 1 if one failed."""
    given = tyro.cli(Arguments, prog="run-benchmark pareto", args=argv)
    if given.repeats < 1 or given.threads < 1:
        raise InputError(f"--repeats and --threads must be at least 1, got {given.repeats} and {given.threads}")
    wanted = _scenes(given)
    if "methods" in wanted and not given.table:
        _efforts(given)  # a name that is wrong is said before the first run, not after the simulator's
    if given.dry_run:
        return _dry_run(given, wanted)
    failed = 0
    if not given.table:
        use_threads(given.threads)
        failed = _measure(given, wanted)
    _report(given.out)
    return 1 if failed else 0


def _scenes(given: Arguments) -> dict[Part, list[str]]:
    """Return the scenes of each part that is asked for."""
    from benchmarks import make_dataset

    parts: tuple[Part, ...] = given.part or ("simulator", "methods")
    known: dict[Part, list[str]] = {"simulator": [RODS], "methods": []}
    known["methods"] = [scene.name for scene in make_dataset.load(given.suite)]
    for name in given.scene:
        if not any(name in known[part] for part in parts):
            expected = "; ".join(f"{part}: {', '.join(known[part])}" for part in parts)
            raise InputError(f"--scene {name!r}: there is no such scene, expected one of {expected}")
    chosen = given.scene or (RODS, SMALL if SMALL in known["methods"] else known["methods"][0])
    return {part: [name for name in known[part] if name in chosen] for part in parts}


def machine() -> str:
    """Return the processor and the threads of the kernels."""
    here = host()
    return f"{here.cpu}, {here.threads} threads"


def _measure(given: Arguments, wanted: dict[Part, list[str]]) -> int:
    """Run what is missing, part by part and scene by scene; return how many settings failed."""
    from tqdm import tqdm

    commit()  # remembered: the code that is loaded, whatever is committed meanwhile
    given.out.mkdir(parents=True, exist_ok=True)
    path, failed = given.out / NAME, 0
    for part, scenes in wanted.items():
        for scene in scenes:
            tasks = _choices() if part == "simulator" else _methods(given, scene)
            done = runs(read(path))
            left = sum(max(given.repeats - done[task.setting.identity], 0) for task in tasks)
            with tqdm(total=left, desc=f"{part} {scene}", unit="run", disable=not left, file=sys.stderr) as bar:
                for timed in rounds(tasks, given.repeats, done):
                    lines.append(path, timed)
                    failed += timed.status not in (OK, "skipped")
                    bar.set_postfix_str(f"{timed.setting.curve}, {timed.setting.label}: {timed.status}")
                    bar.update()
    return failed


def rounds(tasks: list[Task], repeats: int, done: Counter[str]) -> Iterator[Timed]:
    """Run each task that has fewer than `repeats` runs once a round; what fails is not tried again.

    `done` counts the runs there are, and is counted on.
    """
    warmed: dict[str, float] = {}
    failed: set[str] = set()
    for number in range(repeats):
        for task in tasks:
            identity = task.setting.identity
            if done[identity] > number or identity in failed:
                continue
            first = None
            if task.kind not in warmed:
                first = warmed[task.kind] = task.warm()
            timed = _timed(task, first)
            if timed.status == OK:
                done[identity] += 1
            else:
                failed.add(identity)
            yield timed


def _timed(task: Task, warm_up: float | None) -> Timed:
    """Run a task and turn whatever happens into a record."""
    from benchmarks.pareto_methods import Ended
    from benchmarks.run import describe

    marks, status, reason = (), OK, ""
    try:
        marks = task.run()
    except Ended as end:
        status, reason = end.status, end.reason
    except MemoryError as error:
        status, reason = "out_of_memory", describe(error)
    except Exception as error:  # a method's failure is a result
        status, reason = "error", describe(error)
    return Timed(
        setting=task.setting,
        marks=marks,
        status=status,
        reason=reason,
        warm_up=warm_up,
        host=host(),
        commit=commit(),
        time=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def _choices() -> list[Task]:
    """List the simulator's choices."""
    from benchmarks import pareto_simulator

    bench, here = pareto_simulator.Bench(), machine()
    every = pareto_simulator.choices()
    default = next(choice for choice in every if choice.default)
    return [
        Task(
            setting=bench.setting(choice, here),
            run=functools.partial(bench.run, choice),
            kind="simulator",
            warm=lambda: sum(mark.seconds for mark in bench.run(default)),
        )
        for choice in every
    ]


def _methods(given: Arguments, scene: str) -> list[Task]:
    """Make the scene's scan if it is missing, and list the runs of every method that is asked for."""
    from benchmarks import make_dataset, pareto_methods

    data = given.out / "data"
    if make_dataset.main([given.suite, str(data), "--only", scene]):
        raise InputError(f"{data}: the scan of {scene!r} could not be made")
    bench, here = pareto_methods.Bench(data / scene), machine()
    return [
        Task(
            setting=bench.setting(effort, here),
            run=functools.partial(bench.run, effort),
            kind=effort.method.name,
            warm=functools.partial(bench.warm_up, effort.method),
        )
        for effort in _efforts(given)
    ]


def _efforts(given: Arguments) -> "list[Effort]":
    from benchmarks import methods, pareto_methods

    return [effort for name in given.method or tuple(methods.TABLE) for effort in pareto_methods.efforts(name)]


def _dry_run(given: Arguments, wanted: dict[Part, list[str]]) -> int:
    """Print the runs that are left and about how long they take, from a plan and an FDK timed here."""
    use_threads(given.threads)
    done, total, rows = runs(read(given.out / NAME)), 0.0, [("part", "scene", "curve", "runs left", "about")]
    for part, scenes in wanted.items():
        for scene in scenes:
            found = _planned(given, part, scene)
            for curve in dict.fromkeys(curve for curve, *_ in found):
                mine = [(given.repeats - done[i], seconds) for c, i, seconds in found if c == curve]
                left = sum(max(n, 0) for n, _ in mine)
                seconds = sum(max(n, 0) * s for n, s in mine)
                total += seconds
                rows.append((part, scene, curve, str(left), human_time(seconds)))
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    for row in rows:
        sys.stdout.write("  ".join(word.ljust(w) for word, w in zip(row, widths, strict=True)).rstrip() + "\n")
    sys.stdout.write(f"total: {human_time(total)}, without compiling, planning and the reference\n")
    return 0


def _planned(given: Arguments, part: Part, scene: str) -> list[tuple[str, str, float]]:
    """Return (curve, identity, seconds of a run) of a scene's settings; a scan that is not made has no identity."""
    from benchmarks import estimates, make_dataset, pareto_methods, pareto_simulator
    from ctsim.writer import is_complete
    from phantoms.scene import scene_id

    if part == "simulator":
        sim = pareto_simulator.Bench()
        usual = sim.estimate()
        every = [(c.curve, sim.setting(c, machine()).identity) for c in pareto_simulator.choices()]
        return [(curve, identity, usual) for curve, identity in every]
    data = given.out / "data"
    (recipe,) = make_dataset.select(make_dataset.load(given.suite), (scene,), ())
    geometry = recipe.resolve().geometry
    fdk = estimates.fdk_seconds(geometry)
    made = is_complete(data, scene, scene_id(recipe))
    bench = pareto_methods.Bench(data / scene) if made else None
    return [
        (
            e.method.name,
            bench.setting(e, machine()).identity if bench else "",
            fdk * (estimates.in_fdks(e.method, geometry) or estimates.UNKNOWN),
        )
        for e in _efforts(given)
    ]


def _report(out: Path) -> None:
    """Write table and figure from the records, print the table."""
    from benchmarks import pareto_figure, pareto_table
    from benchmarks.pareto_records import points

    shown = latest(read(out / NAME))
    if not shown:
        raise InputError(f"{out / NAME}: there are no records; run without --table first")
    summary = pareto_table.summary(shown)
    (out / "pareto.md").write_text(summary + pareto_table.every_point(shown), encoding="utf-8")
    written = "pareto.md, with every point"
    if drawn := points(shown):
        pareto_figure.draw(drawn).savefig(out / "pareto.png", dpi=pareto_figure.DPI)
        written += ", and pareto.png"
    sys.stdout.write(f"{summary}\nWritten: {out}/{written}; records in {NAME}\n")
