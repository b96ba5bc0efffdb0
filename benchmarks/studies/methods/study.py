"""The command `run-benchmark DATA RESULTS --method fdk`: its flags and what they set going."""

import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ctsim.errors import InputError
from ctsim.human import human_choice

if TYPE_CHECKING:
    from ctsim.benchmarks.engine.workers import Pool
    from ctsim.benchmarks.methods import Method
    from ctsim.benchmarks.scores.protocol import Stored
    from ctsim.benchmarks.studies.methods.records import Record
    from ctsim.benchmarks.studies.methods.run import Options
    from ctsim.benchmarks.studies.methods.schedule import Group

log = logging.getLogger(__name__)
FEW = 20  # scenes, all of which a message names


@dataclass(frozen=True)
class Arguments:
    """Run reconstruction methods over a dataset, score them, and write tables and pictures.

    What RESULTS already holds is not run again, unless the data, the method's parameters or its code
    have changed or the run failed. Other commands, each with its own --help: `run-benchmark report` (results as one
    page), `inspect` (what a score's conventions are worth), `pareto` (time against error), `stress` (numerical
    stability), `skipping` (what is left out and saved), `peers` (other libraries), `reproduce` (what is claimed of FDK,
    LIMAR and NMAR), `ablation` and `paper-tables` (the published splat method).
    """

    data: tyro.conf.Positional[Path]
    """The folder that make-dataset wrote."""
    results: tyro.conf.Positional[Path]
    """The folder for records, tables, volumes and pictures; made if it is not there."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """A method's name, such as fdk, or module:function of your own; may be given several times (default: fdk)."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="METHOD.PARAMETER=VALUE")] = ()
    """A method's parameter; may be given several times."""
    scene: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times (default: all)."""
    device: str = "cpu"
    """Where methods compute: cpu, cuda, cuda:1, ..."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run again what is already recorded."""
    isolate: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run each method in a process of its own: exact peak memory, and a crash ends only that run."""
    seconds: float | None = None
    """Time of one run; implies --isolate. A method with a parameter seconds, as splat, is told it, another run as with
    --set, and ends with what it has by then, at most 120 s late. Others, their start included, end with the status
    timeout."""
    keep_volumes: bool = True
    """Keep reconstructions as TIFF stacks; pictures are drawn from them."""
    anchor: bool = True
    """Reconstruct the metal-free twins too, by every method: for the protocol artefact and the anchored score."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the tables from the records, computing nothing."""
    collect: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")] = ()
    """Take over what these results folders of other machines have and RESULTS lacks, then only render the tables."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print which runs are to do, in their order, with what they took the last time or, where
    they never ran, a guess from the time of FDK; write nothing."""
    workers: int = 1
    """Do so many runs at once, each with its share of the cores; times are then those of a shared machine."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Let the workers of this Dask scheduler do the runs; DATA and RESULTS must be the same files for them."""


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every run ended well or was skipped with a reason, 1 if one failed."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    given = tyro.cli(Arguments, prog="run-benchmark", args=arguments)
    from ctsim.benchmarks.engine.limited import refuse_unless_positive
    from ctsim.benchmarks.studies.methods import records, tables

    refuse_unless_positive(given.seconds)
    if given.dry_run and (given.collect or given.table):
        what = "--collect writes records" if given.collect else "--table writes tables"
        raise InputError(f"{what}, --dry-run writes nothing: expected one of them")
    found = _read(given.results)
    for folder in given.collect:
        _read(folder)
    for other, count in records.collect(given.results, given.collect).items():
        log.warning("%s: %d records taken over", other, count)
    if given.table or given.collect:
        tables.write(_read(given.results) if given.collect else found, given.results)
        _show(given.results)
        return 0
    try:
        return _compute(given)
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(given.results)) from error  # a full disk


def _read(results: Path) -> "list[Record]":
    """Read the records of a folder, and say which line was cut short."""
    from ctsim.benchmarks.studies.methods import records

    found, torn = records.read_all(results)
    for rest in torn:
        log.warning("%s", rest)
    return found


def _compute(given: Arguments) -> int:
    """Run what is missing, then render tables and panels from all records, also after Ctrl-C."""
    from ctsim.benchmarks.engine.devices import check_device
    from ctsim.benchmarks.engine.workers import open_pool
    from ctsim.benchmarks.studies.methods import records, run, schedule

    if given.scheduler is None:  # else it is the workers that have the device
        check_device(given.device)
    options = run.Options(
        device=given.device,
        isolate=given.isolate,
        seconds=given.seconds,
        force=given.force,
        keep_volumes=given.keep_volumes,
        anchor=given.anchor,
    )
    methods, scans = _methods(given), _scans(given)
    names = frozenset(given.scene or (s.name for s in scans))
    _warn([s for s in scans if s.name in names])
    listed = [task for task in run.tasks(scans, methods, options) if task.stored.name in names]
    left = run.pending(listed, given.results, given.force)
    costs = schedule.Costs(records.read_all(given.results)[0])
    groups = schedule.ordered(left, costs)
    if given.dry_run:
        sys.stdout.write(schedule.text(groups, len(listed), costs, schedule.estimated))
        return 0
    workers = open_pool(given.workers, given.scheduler)
    given.results.mkdir(parents=True, exist_ok=True)
    records.repair(given.results / records.NAME)
    if len(left) < len(listed):
        log.warning(
            "%d of %d runs are recorded already (--force does them again)", len(listed) - len(left), len(listed)
        )
    failed: list[Record] = []
    try:
        with workers as pool:
            failed = work(groups, given.results, options, pool)
    finally:
        found, _ = records.read_all(given.results)
        if found:
            _report(found, [s for s in scans if s.name in names], given.results)
    _show(given.results)
    return 1 if failed else 0


def work(groups: "list[Group]", results: Path, options: "Options", pool: "Pool | None") -> "list[Record]":
    """Do the runs behind a progress bar, the tables following them; return the records of those that failed.

    Beside the last run that ended it says how far the fit is that runs in this process, where a method tells.
    """
    from tqdm import tqdm

    from ctsim.benchmarks.studies.methods import records, schedule, tables
    from ctsim.reconstruct.watch import Progress, listen

    failed, written, took, ended = [], 0.0, 0.0, ""
    n_runs = sum(len(group) for group in groups)

    def say(now: Progress) -> None:
        bar.set_postfix_str(f"{ended}now {now.share:.0%}, loss {now.loss:.3g}, {now.remaining:.0f} s to go")

    with tqdm(total=n_runs, unit="run", disable=not n_runs) as bar, listen(say):
        for task, record in schedule.work(groups, results, options, pool):
            ended = f"{task.stored.name} {record.label}: {record.status}, "
            bar.set_postfix_str(ended.removesuffix(", "))
            bar.update()
            if record.status not in ("ok", "skipped"):
                failed.append(record)
            if time.monotonic() > written + 10 * took:  # no more than a tenth of the time goes into tables
                begun = time.monotonic()
                tables.write(records.read_all(results)[0], results)
                written, took = time.monotonic(), time.monotonic() - begun
    return failed


def _methods(given: Arguments) -> "list[Method]":
    from ctsim.benchmarks import methods

    names = tuple(dict.fromkeys(given.method)) or ("fdk",)
    overrides = methods.parse_overrides(given.set, names)
    return [methods.within(methods.find(name, overrides[name]), given.seconds) for name in names]


def _scans(given: Arguments) -> "list[Stored]":
    """Open the dataset's scans, in its order; check those of --scene, and warn of several simulators."""
    from ctsim.store import list_scans, open_scan

    scans: list[Stored] = [open_scan(folder) for folder in list_scans(given.data)]
    if not scans:
        raise InputError(f"{given.data}: the dataset has no scenes")
    names = {s.name: None for s in scans}
    for wanted in given.scene:
        if wanted not in names:
            raise InputError(f"--scene {wanted!r}: {given.data} has {human_choice(names, wanted)}")
    _warn_of_other_code(given.data, frozenset(given.scene or names))
    return scans


def _warn(scans: "list[Stored]") -> None:
    """Say what scans note of themselves, each note once with the scans that share it."""
    found: dict[str, list[str]] = {}
    for stored in scans:
        for note in stored.info.notes:
            found.setdefault(note, []).append(stored.name)
    for note, names in found.items():
        more = f" and {len(names) - FEW} more" if len(names) > FEW else ""
        log.warning("%s%s: %s", ", ".join(names[:FEW]), more, note)


def _warn_of_other_code(data: Path, names: frozenset[str]) -> None:
    """Say where the scans that one table compares were made by different code, or by other code than this."""
    from ctsim.folder import mixture, other_code
    from ctsim.manifest import read_index
    from ctsim.sources import source_hash

    lines = [line for line in read_index(data).values() if line.name in names]
    other = [line for line in lines if line.code != source_hash()]
    if text := mixture((line.name, line.code) for line in lines) or other_code(other, len(lines)):
        log.warning("%s: %s", data, text)


def _report(found: "list[Record]", scans: "list[Stored]", results: Path) -> None:
    from ctsim.benchmarks.studies.methods import panels, tables

    tables.write(found, results)
    panels.write_panels(found, scans, results)


def _show(results: Path) -> None:
    """Write the Markdown tables to the terminal."""
    sys.stdout.write((results / "table.md").read_text(encoding="utf-8"))
    sys.stdout.write(f"\nWritten: {results}/table.md, .csv, .tex; records in records.jsonl\n")
