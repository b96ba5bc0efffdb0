"""`run-benchmark peers RESULTS`: speed and error side by side with RTK and XCIST, in one process, in turns.

Records go to RESULTS/peers.jsonl, one line per contender and scene; the table, RESULTS/peers.md, shows the
last of each, so that cases can be measured one by one.
"""

import dataclasses
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ctsim.errors import InputError

if TYPE_CHECKING:
    from benchmarks.peer_cases import Measurement
    from benchmarks.peer_tables import PeerRecord

Case = Literal["paths", "exact", "paper", "fdk", "poly"]
CASES: tuple[Case, ...] = ("paths", "exact", "paper", "fdk", "poly")
NAME = "peers.jsonl"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure speed and error against itk-rtk and XCIST (pip install 'ctsim[peers]'), in one process, in turns.

    Peers that are not installed are left out. The machine should have nothing else to do.
    """

    results: tyro.conf.Positional[Path]
    """The folder for peers.jsonl and peers.md; made if it is not there."""
    repeats: int = 5
    """Counted runs of each contender; the table shows medians."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[Case, ...]], tyro.conf.arg(metavar="CASE")] = ()
    """Only this case (paths, exact, paper, fdk, poly); may be given several times (default: all)."""
    threads: int = 2
    """Threads of every contender; XCIST's voxelised projector has one."""
    small: tyro.conf.FlagCreatePairsOff[bool] = False
    """Tiny grids that prove the command and say nothing about speed; leaves out the case paper."""


def main(argv: list[str]) -> int:
    """Run the command; 0 if every case was measured, 1 if one failed."""
    given = tyro.cli(Arguments, prog="run-benchmark peers", args=argv)
    if given.repeats < 1 or given.threads < 1:
        raise InputError(f"--repeats and --threads must be at least 1, got {given.repeats} and {given.threads}")
    wanted = tuple(dict.fromkeys(given.case)) or tuple(c for c in CASES if not (given.small and c == "paper"))
    os.environ["NUMBA_NUM_THREADS"] = os.environ.get("NUMBA_NUM_THREADS", str(given.threads))
    given.results.mkdir(parents=True, exist_ok=True)
    found = _measure(given, wanted)
    from benchmarks import peer_tables

    stored = peer_tables.latest(peer_tables.read(given.results / NAME), found[-1].side)
    text = peer_tables.render(stored)
    (given.results / "peers.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text + f"\nWritten: {given.results}/peers.md; records in {NAME}\n")
    return 1 if any(r.measurement.status == "error" for r in found) else 0


def _measure(given: Arguments, wanted: tuple[Case, ...]) -> "list[PeerRecord]":
    """Measure case by case; what is measured is stored at once."""
    import numba
    import torch

    from benchmarks import host, peer_cases, peer_poly, peer_tables

    threads = min(given.threads, numba.get_num_threads())
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    versions = {name: module.version() for name, module in peer_cases.PEERS.items()}
    side = peer_cases.SMALL if given.small else peer_cases.FULL
    present = frozenset(name for name, version in versions.items() if version)
    setup = peer_cases.Setup(n=side, repeats=given.repeats, threads=threads, present=present)
    cases = {
        "paths": peer_cases.paths,
        "exact": peer_cases.exact,
        "paper": peer_cases.paper,
        "fdk": peer_cases.fdk,
        "poly": peer_poly.poly,
    }
    found = []
    host.commit()  # remembered: the code that is loaded, whatever is committed meanwhile
    began = datetime.now(UTC).isoformat(timespec="microseconds")
    for case in wanted:
        sys.stderr.write(f"{case} …\n")
        measured: list[Measurement] = cases[case](setup)
        for measurement in measured:
            record = peer_tables.PeerRecord(
                measurement=measurement,
                side=side,
                rtk=versions[peer_cases.RTK] or "not installed",
                xcist=versions[peer_cases.XCIST] or "not installed",
                host=host.host(),
                commit=host.commit(),
                time=datetime.now(UTC).isoformat(timespec="seconds"),
                run=began,
            )
            peer_tables.append(given.results / NAME, record)
            found.append(record)
    return found
