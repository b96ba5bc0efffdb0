"""The command `run-benchmark DATA RESULTS --method fdk`: its flags and what they set going."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ctsim.errors import InputError

if TYPE_CHECKING:
    from benchmarks.methods import Method
    from benchmarks.protocol import Stored
    from benchmarks.records import Record
    from benchmarks.run import Options, Task

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Arguments:
    """Run reconstruction methods over a dataset, score them, and write tables and pictures.

    What RESULTS already holds is not run again, unless the data, the method's parameters or its code
    have changed or the run failed. `run-benchmark inspect` shows what a score's conventions are worth,
    `run-benchmark peers` compares with other libraries, `run-benchmark reproduce` checks what is claimed of FDK,
    LIMAR and NMAR.
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
    """Time limit of one run, its start included; implies --isolate."""
    keep_volumes: bool = True
    """Keep reconstructions as TIFF stacks; pictures are drawn from them."""
    anchor: bool = True
    """Reconstruct the metal-free twins too, by every method: for the protocol artefact and the anchored score."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the tables from the records, computing nothing."""


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every run ended well or was skipped with a reason, 1 if one failed."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    given = tyro.cli(Arguments, prog="run-benchmark", args=arguments)
    from benchmarks import records, tables

    found, torn = records.read_all(given.results)
    for rest in torn:
        log.warning("%s", rest)
    if given.table:
        tables.write(found, given.results)
        _show(given.results)
        return 0
    records.repair(given.results / records.NAME)
    return _compute(given)


def _compute(given: Arguments) -> int:
    """Run what is missing, then render tables and panels from all records, also after Ctrl-C."""
    from benchmarks import records, run
    from benchmarks.devices import check_device

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
    given.results.mkdir(parents=True, exist_ok=True)
    listed = run.tasks(scans, methods, options)
    left = run.pending(listed, given.results, given.force)
    failed: list[Record] = []
    try:
        failed = _work(left, len(listed), given.results, options)
    finally:
        found, _ = records.read_all(given.results)
        if found:
            _report(found, scans, given.results)
    _show(given.results)
    return 1 if failed else 0


def _work(left: "list[Task]", n_listed: int, results: Path, options: "Options") -> "list[Record]":
    """Run the tasks behind a progress bar; return the records of those that failed."""
    from tqdm import tqdm

    from benchmarks import run

    if len(left) < n_listed:
        log.warning("%d of %d runs are recorded already (--force runs them again)", n_listed - len(left), n_listed)
    failed = []
    with tqdm(total=len(left), unit="run", disable=not left) as bar:
        for task, record in zip(left, run.run_all(left, results, options), strict=True):
            bar.set_postfix_str(f"{task.stored.name} {record.label}: {record.status}")
            bar.update()
            if record.status not in ("ok", "skipped"):
                failed.append(record)
    return failed


def _methods(given: Arguments) -> "list[Method]":
    from benchmarks import methods

    names = tuple(dict.fromkeys(given.method)) or ("fdk",)
    overrides = methods.parse_overrides(given.set, names)
    return [methods.find(name, overrides[name]) for name in names]


def _scans(given: Arguments) -> "list[Stored]":
    """Open the dataset's scans, those of --scene where given."""
    from ctsim.store import list_scans, open_scan

    scans: list[Stored] = [open_scan(folder) for folder in list_scans(given.data)]
    if not scans:
        raise InputError(f"{given.data}: the dataset has no scenes")
    names = [s.name for s in scans]
    for wanted in given.scene:
        if wanted not in names:
            raise InputError(f"--scene {wanted!r}: {given.data} has {', '.join(names)}")
    return [s for s in scans if not given.scene or s.name in given.scene]


def _report(found: "list[Record]", scans: "list[Stored]", results: Path) -> None:
    from benchmarks import panels, tables

    tables.write(found, results)
    panels.write_panels(found, scans, results)


def _show(results: Path) -> None:
    """Write the Markdown tables to the terminal."""
    sys.stdout.write((results / "table.md").read_text(encoding="utf-8"))
    sys.stdout.write(f"\nWritten: {results}/table.md, .csv, .tex; records in records.jsonl\n")
