"""`run-benchmark pareto OUT`: run time against error, of the simulator's choices and of every method's effort.

Every timed run is a line of OUT/pareto.jsonl. Settings are run in turns, once each a round, so that a drift of the
machine meets all alike; times are medians over the rounds. OUT/pareto.md and OUT/pareto.png show the points, their
Pareto front and its knee. All runs are those of one process, which is replaced where a run overstays.
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

from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import commit, host, use_threads
from ctsim.benchmarks.studies.methods.records import OK
from ctsim.benchmarks.studies.pareto import suite as pareto_suite
from ctsim.benchmarks.studies.pareto.records import NAME, WHAT, Part, Timed, latest, read, runs
from ctsim.durable import replacing, write_synced
from ctsim.errors import InputError
from ctsim.human import human_choice, human_time

if TYPE_CHECKING:
    from ctsim.benchmarks.studies.pareto.jobs import Job, Ran
    from ctsim.benchmarks.studies.pareto.methods import Effort
    from ctsim.benchmarks.studies.pareto.suite import Suite

RODS = "rods"


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
    """Only this scene; may be given several times. The simulator has rods, methods those of the dataset (lung-Fe)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """What to measure: a TOML file with tables of your own over those of benchmarks/suites/pareto.toml."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this method, or module:function of your own; may be given several times (default: all of --suite)."""
    repeats: int = 3
    """Rounds: counted runs of each setting; the table shows medians."""
    threads: int = 2
    """Threads of the kernels."""
    seconds: float | None = None
    """Time limit of one run, with the start of its process and the warm-up where those are due."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print what is left to run and about how long it takes; measure nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the table and the figure from the records, computing nothing."""
    collect: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")] = ()
    """Take over what these results folders of other machines have and OUT lacks, then only render table and figure."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every setting was measured or skipped with a reason, 1 if one failed."""
    from ctsim.benchmarks.engine.limited import refuse_unless_positive

    given = tyro.cli(Arguments, prog="run-benchmark pareto", args=argv)
    if given.repeats < 1 or given.threads < 1:
        raise InputError(f"--repeats and --threads must be at least 1, got {given.repeats} and {given.threads}")
    refuse_unless_positive(given.seconds)
    suite = pareto_suite.load(given.suite)
    wanted = _scenes(given, suite)
    lines.take_over(given.out / NAME, given.collect, Timed, WHAT, dry_run=given.dry_run)
    if (given.table or given.collect) and not given.dry_run:
        _report(given.out)
        return 0
    if "methods" in wanted:
        _efforts(given, suite)  # a name that is wrong is said before the first run, not after the simulator's
    if given.dry_run:
        return _dry_run(given, suite, wanted)
    use_threads(given.threads)
    failed = _measure(given, suite, wanted)
    _report(given.out)
    return 1 if failed else 0


def _scenes(given: Arguments, suite: "Suite") -> dict[Part, list[str]]:
    """Return the scenes of each part that is asked for."""
    from ctsim.benchmarks import suites

    parts: tuple[Part, ...] = given.part or ("simulator", "methods")
    known: dict[Part, list[str]] = {"simulator": [RODS], "methods": []}
    try:
        known["methods"] = [scene.name for scene in suites.load(suite.dataset.suite)]
    except InputError as error:
        raise InputError(f"{given.suite}: dataset.suite: {error}") from None
    for name in suite.dataset.scenes:
        if name not in known["methods"]:
            expected = human_choice(known["methods"], name)
            raise InputError(f"{given.suite}: dataset.scenes: there is no {name!r}, expected one of {expected}")
    for name in given.scene:
        if not any(name in known[part] for part in parts):
            expected = "; ".join(f"{part}: {human_choice(known[part], name)}" for part in parts)
            raise InputError(f"--scene {name!r}: there is no such scene, expected one of {expected}")
    chosen = given.scene or (RODS, *(suite.dataset.scenes or known["methods"]))
    return {part: [name for name in known[part] if name in chosen] for part in parts}


def machine() -> str:
    """Return the processor and the threads of the kernels."""
    here = host()
    return f"{here.cpu}, {here.threads} threads"


def _measure(given: Arguments, suite: "Suite", wanted: dict[Part, list[str]]) -> int:
    """Run what is missing, part by part and scene by scene; return how many settings failed."""
    from tqdm import tqdm

    from ctsim.benchmarks.engine.limited import Limited
    from ctsim.benchmarks.studies.pareto import jobs as pareto_jobs

    commit()  # remembered: the code that is loaded, whatever is committed meanwhile
    path, failed = given.out / NAME, 0
    with Limited(given.seconds) as process:
        run = functools.partial(pareto_jobs.within, process, given.threads)
        given.out.mkdir(parents=True, exist_ok=True)
        for part, scene in ((part, scene) for part, scenes in wanted.items() for scene in scenes):
            jobs = _choices(suite) if part == "simulator" else _methods(given, suite, scene)
            done = runs(read(path))
            left = sum(max(given.repeats - done[job.setting.identity], 0) for job in jobs)
            with tqdm(total=left, desc=f"{part} {scene}", unit="run", disable=not left, file=sys.stderr) as bar:
                for timed in rounds(jobs, given.repeats, done, run):
                    lines.append(path, timed)
                    failed += timed.status not in (OK, "skipped")
                    bar.set_postfix_str(f"{timed.setting.curve}, {timed.setting.label}: {timed.status}")
                    bar.update()
    return failed


def rounds(jobs: "list[Job]", repeats: int, done: Counter[str], run: "Callable[[Job], Ran]") -> Iterator[Timed]:
    """Do each job that has fewer than `repeats` runs once a round; what fails is not tried again.

    `done` counts the runs there are, and is counted on.
    """
    failed: set[str] = set()
    for number in range(repeats):
        for job in jobs:
            identity = job.setting.identity
            if done[identity] > number or identity in failed:
                continue
            ran = run(job)
            if ran.status == OK:
                done[identity] += 1
            else:
                failed.add(identity)
            yield Timed(
                setting=job.setting,
                marks=ran.marks,
                status=ran.status,
                reason=ran.reason,
                warm_up=ran.warm_up,
                host=host(),
                commit=commit(),
                time=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            )


def _choices(suite: "Suite") -> "list[Job]":
    """List the simulator's choices."""
    from ctsim.benchmarks.studies.pareto import simulator as pareto_simulator
    from ctsim.benchmarks.studies.pareto.jobs import jobs

    asked = suite.simulator
    return jobs(pareto_simulator.Bench, (asked.side, asked.views), pareto_simulator.choices(asked), machine())


def _methods(given: Arguments, suite: "Suite", scene: str) -> "list[Job]":
    """Make the scene's scan if it is missing, and list the runs of every method that is asked for."""
    from ctsim.benchmarks import make_dataset
    from ctsim.benchmarks.studies.pareto import methods as pareto_methods
    from ctsim.benchmarks.studies.pareto.jobs import jobs

    data = given.out / "data"
    if make_dataset.main([suite.dataset.suite, str(data), "--only", scene]):
        raise InputError(f"{data}: the scan of {scene!r} could not be made")
    return jobs(pareto_methods.Bench, (data / scene, suite.iterations.stops), _efforts(given, suite), machine())


def _efforts(given: Arguments, suite: "Suite") -> "list[Effort]":
    from ctsim.benchmarks.studies.pareto import methods as pareto_methods

    found: list[Effort] = []
    for name in given.method or tuple(listed.name for listed in suite.method):
        try:
            found += pareto_methods.efforts(suite, name)
        except InputError as error:
            raise InputError(f"{given.suite}: {error}" if given.suite and suite.listed(name) else str(error)) from None
    return found


def _dry_run(given: Arguments, suite: "Suite", wanted: dict[Part, list[str]]) -> int:
    """Print the runs that are left and about how long they take, from a plan and an FDK timed here."""
    use_threads(given.threads)
    done, total, rows = runs(read(given.out / NAME)), 0.0, [("part", "scene", "curve", "runs left", "about")]
    for part, scenes in wanted.items():
        for scene in scenes:
            found = _planned(given, suite, part, scene)
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


def _planned(given: Arguments, suite: "Suite", part: Part, scene: str) -> list[tuple[str, str, float]]:
    """Return (curve, identity, seconds of a run) of a scene's settings; a scan that is not made has no identity."""
    from ctsim.benchmarks import suites
    from ctsim.benchmarks.studies.methods import estimates
    from ctsim.benchmarks.studies.pareto import methods as pareto_methods
    from ctsim.benchmarks.studies.pareto import simulator as pareto_simulator
    from ctsim.folder import is_complete
    from ctsim.phantoms.scene import scene_id

    if part == "simulator":
        usual = pareto_simulator.Bench(suite.simulator.side, suite.simulator.views).estimate()
        return [(job.setting.curve, job.setting.identity, usual) for job in _choices(suite)]
    data = given.out / "data"
    (recipe,) = suites.select(suites.load(suite.dataset.suite), (scene,), ())
    geometry = recipe.resolve().geometry
    fdk = estimates.fdk_seconds(geometry)
    made = is_complete(data, scene, scene_id(recipe))
    bench = pareto_methods.Bench(data / scene, suite.iterations.stops) if made else None
    return [
        (
            e.method.name,
            bench.setting(e, machine()).identity if bench else "",
            fdk * (estimates.in_fdks(e.method, geometry) or estimates.UNKNOWN),
        )
        for e in _efforts(given, suite)
    ]


def _report(out: Path) -> None:
    """Write table and figure from the records, print the table."""
    from ctsim.benchmarks.studies.pareto import figure as pareto_figure
    from ctsim.benchmarks.studies.pareto import tables as pareto_table
    from ctsim.benchmarks.studies.pareto.records import points

    found = read(out / NAME)
    shown = latest(found)
    if not shown:
        which = f"there are {len(found)} records of another version only" if found else "there are no records"
        raise InputError(f"{out / NAME}: {which}; run without --table first")
    summary = pareto_table.summary(shown)
    write_synced(out / "pareto.md", (summary + pareto_table.every_point(shown)).encode())
    written = "pareto.md, with every point"
    if drawn := points(shown):
        with replacing(out / "pareto.png") as new:
            pareto_figure.draw(drawn).savefig(new, format="png", dpi=pareto_figure.DPI)
        written += ", and pareto.png"
    sys.stdout.write(f"{summary}\nWritten: {out}/{written}; records in {NAME}\n")
