"""`run-benchmark stress`: numerical stress. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ctsim.benchmarks.engine.study import Options


@dataclass(frozen=True, kw_only=True)
class Flags(Options):
    """Put simulator, methods and splat kernels under numerical stress; exit code 1 if anything is not as expected.

    A row fails if it misses its expected value, is not finite, raises, warns, crashes or does not end.
    """

    results: tyro.conf.Positional[Path]
    """The folder for stress.jsonl and stress.md; created if missing."""
    short: tyro.conf.FlagCreatePairsOff[bool] = False
    """Small grids; every case, in about two minutes on two cores."""
    case: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only this case; may be given several times (default: all)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Scenes for the methods in place of the bundled ones; docs/how-to/test-stability.md lists its keys."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only the rows of this method, such as fdk, or of module:function of your own; may be given several times
    (default: all methods, simulator and splat kernels)."""
    seconds: float | None = 120.0
    """Time limit of one row, compilation and the start of its process included."""
