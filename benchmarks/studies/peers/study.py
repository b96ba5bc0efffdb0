"""`run-benchmark peers RESULTS`: speed and error side by side with other libraries, in one process, in turns.

Cases and libraries are listed in `suites/peers.toml`. Records go to RESULTS/peers.jsonl, one line per contender and
scene; the table, RESULTS/peers.md, shows the last of each, so that cases can be measured one by one. What this commit
recorded on this machine, beside the same versions of the peers, is not measured again.
"""

import contextlib
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ctsim.benchmarks.studies.peers import catalogue as peer_catalogue
from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.benchmarks.studies.peers.cases import Measurement, Setup
    from ctsim.benchmarks.studies.peers.tables import By

NAME = "peers.jsonl"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure speed and error against itk-rtk and XCIST (pip install 'ctsim[peers]'), in one process, in turns.

    Peers that are not installed, or that there is no code for, have a row that says so. The machine should have
    nothing else to do.
    """

    results: tyro.conf.Positional[Path]
    """The folder for peers.jsonl and peers.md; made if it is not there."""
    repeats: int = 5
    """Counted runs of each contender; the table shows medians."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case (paths, exact, paper, fdk, poly); may be given several times (default: all)."""
    threads: int = 2
    """Threads of every contender; XCIST's voxelised projector has one."""
    small: tyro.conf.FlagCreatePairsOff[bool] = False
    """Tiny grids that prove the command and say nothing about speed; leaves out the case paper."""
    seconds: float | None = None
    """Time limit of one case; what does not end in time is a row that says so, and the next case begins."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure again what is recorded of this commit on this machine, beside these versions of the peers."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print what is left to measure and about how long it takes; measure nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only render the table from the records, computing nothing."""
    collect: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")] = ()
    """Take over what these results folders of other machines have and RESULTS lacks, then only render the table."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every case was measured, 1 if one failed."""
    from ctsim.benchmarks.engine.limited import refuse_unless_positive

    given = tyro.cli(Arguments, prog="run-benchmark peers", args=argv)
    if given.repeats < 1 or given.threads < 1:
        raise InputError(f"--repeats and --threads must be at least 1, got {given.repeats} and {given.threads}")
    refuse_unless_positive(given.seconds)
    wanted = _wanted(given)
    if given.collect:
        _collect(given)
    if given.dry_run:
        sys.stdout.write(_planned(given, wanted))
        return 0
    if not given.table and not given.collect:
        given.results.mkdir(parents=True, exist_ok=True)
        _measure(given, wanted)
    return _report(given, wanted)


def _wanted(given: Arguments) -> list[str]:
    """Return the names of the cases asked for, all that have such grids where none is named."""
    cases = [peer_catalogue.case(name) for name in dict.fromkeys(given.case)]
    return [case.name for case in cases or peer_catalogue.load().case if case.small or case in cases or not given.small]


def _collect(given: Arguments) -> None:
    from ctsim.benchmarks.engine import lines
    from ctsim.benchmarks.studies.peers import tables as peer_tables

    kind, what = peer_tables.PeerRecord, peer_tables.WHAT
    lines.take_over(given.results / NAME, given.collect, kind, what, dry_run=given.dry_run)


def _report(given: Arguments, wanted: Sequence[str]) -> int:
    """Write and print the table of all records; return 1 if a wanted case has failed."""
    from ctsim.benchmarks.studies.peers import cases as peer_cases
    from ctsim.benchmarks.studies.peers import tables as peer_tables

    path, side = given.results / NAME, _side(given)
    stored = peer_tables.latest(peer_tables.read(path), side)
    if not stored:
        raise InputError(f"{path}: there are no records of grids of side {side}; run without --table first")
    text = peer_tables.render(stored)
    (given.results / "peers.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text + f"\nWritten: {given.results}/peers.md; records in {NAME}\n")
    return 1 if any(r.measurement.status in peer_cases.FAILED for r in stored if r.measurement.case in wanted) else 0


def _side(given: Arguments) -> int:
    from ctsim.benchmarks.studies.peers import cases as peer_cases

    return peer_cases.SMALL if given.small else peer_cases.FULL


def _left(given: Arguments, wanted: Sequence[str]) -> "tuple[list[str], By]":
    """Return the wanted cases that are not recorded, and who measures."""
    from ctsim.benchmarks.engine import host

    host.use_threads(given.threads)
    from ctsim.benchmarks.studies.peers import tables as peer_tables

    # of the code that is loaded, whatever is committed meanwhile
    by = host.host(), host.commit(), peer_catalogue.installed()
    stored = peer_tables.latest(peer_tables.read(given.results / NAME), _side(given))
    known = set() if given.force else peer_tables.known(stored, given.repeats, by)
    return [case for case in wanted if case not in known], by


def _planned(given: Arguments, wanted: Sequence[str]) -> str:
    """Return what --dry-run prints; seconds are from records of these grids, else from one run on full ones."""
    left, _ = _left(given, wanted)
    from ctsim.benchmarks.engine import costs
    from ctsim.benchmarks.studies.peers import tables as peer_tables

    cases = {case.name: case for case in peer_catalogue.load().case}
    once: dict[str, float] = {}
    if not given.small:
        once = {name: case.turn * (given.repeats + 1) + case.rest for name, case in cases.items()}
    records = [r for r in peer_tables.read(given.results / NAME) if r.side == _side(given)]
    once |= peer_tables.seconds(records, given.repeats)
    turns = f"{given.repeats + 1} runs of each contender"
    rows = [(name, turns if cases[name].turn else "one run", once.get(name)) for name in left]
    return costs.listing(rows, len(wanted), "cases", "with what is prepared and checked, beside both peers")


def _measure(given: Arguments, wanted: Sequence[str]) -> None:
    """Measure the wanted cases that are not recorded; a case is stored as soon as it is measured."""
    left, by = _left(given, wanted)
    from ctsim.benchmarks.engine import lines
    from ctsim.benchmarks.studies.peers import cases as peer_cases
    from ctsim.benchmarks.studies.peers import tables as peer_tables

    setup = peer_cases.Setup(n=_side(given), repeats=given.repeats, threads=by[0].threads, versions=by[2])
    began = datetime.now(UTC).isoformat(timespec="microseconds")
    with _measuring(given.seconds) as measuring:
        for case in wanted:
            if case not in left:
                sys.stderr.write(f"{case}: recorded already\n")
                continue
            sys.stderr.write(f"{case} …\n")
            measured = measuring(case, setup)
            time = datetime.now(UTC).isoformat(timespec="seconds")
            records = peer_tables.recorded(measured, by, side=setup.n, time=time, run=began)
            lines.append(given.results / NAME, *records)


@contextlib.contextmanager
def _measuring(seconds: float | None) -> "Iterator[Callable[[str, Setup], list[Measurement]]]":
    """Yield what measures a case: here, or with a limit in a process that is then replaced."""
    if seconds is None:
        yield measure
        return
    from ctsim.benchmarks.engine.limited import Limited, Stopped
    from ctsim.benchmarks.studies.peers.cases import Measurement

    def within(case: str, setup: "Setup") -> list[Measurement]:
        try:
            return process.run(measure, case, setup)
        except Stopped as end:
            return [Measurement(case=case, scene="all", contender="all", status=end.status, reason=str(end))]

    # what a process leaves behind that is killed goes with the folder
    with (
        tempfile.TemporaryDirectory(prefix="ctsim-peers-", ignore_cleanup_errors=True) as folder,
        Limited(seconds, {"TMPDIR": folder}) as process,
    ):
        yield within


def measure(case: str, setup: "Setup") -> "list[Measurement]":
    """Measure a case in this process."""
    from ctsim.benchmarks.engine import host

    host.use_threads(setup.threads)
    from ctsim.benchmarks.studies.peers import cases as peer_cases
    from ctsim.benchmarks.studies.peers import poly as peer_poly

    cases: dict[str, Callable[[Setup], list[Measurement]]] = {
        "paths": peer_cases.paths,
        "exact": peer_cases.exact,
        "paper": peer_cases.paper,
        "fdk": peer_cases.fdk,
        "poly": peer_poly.poly,
    }
    return cases[case](setup)
