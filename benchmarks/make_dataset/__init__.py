"""`make-dataset`: from scene recipes to scans on disk, resumable at any moment."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flags:
    """Simulate the scans of a suite, with their ground truth, into a data folder.

    An interrupted run continues when it is started again; finished scenes are skipped. A message names finished scenes
    that other code of the simulator made. An unfinished scene of other code starts again.
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
    """Number of scenes made at once, each with its share of the cores."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Make the scenes on the workers of this Dask scheduler; OUT must be the same folder for them."""


def main(argv: list[str]) -> int:
    """Run the command; return 0, 2 for an error of the user's or damaged data, 130 when interrupted."""
    given: Any = tyro.cli(Flags, prog="make-dataset", args=argv)

    from ctsim.benchmarks.make_dataset import work  # loads the kernels, which --help does without

    return work.run(given)
