"""`run-benchmark pareto`: run time against error. The flags are here, since what measures takes long to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from ctsim.benchmarks.engine.study import Flags as Shared
from ctsim.benchmarks.studies.pareto.finding import Part


@dataclass(frozen=True, kw_only=True)
class Flags(Shared):
    """Measure error against run time: the simulator over its choices, every method over its own effort.

    Runs are measured again where code, data, machine or threads have changed. The machine should have nothing else to
    do.
    """

    part: Annotated[tuple[Part, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PART")] = ()
    """Only this part, simulator or methods (default: both)."""
    scene: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times. The simulator has rods, methods those of the dataset (lung-Fe)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """What to measure: a TOML file with tables of your own over those of benchmarks/suites/pareto.toml."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this method, or module:function of your own; may be given several times (default: all of --suite)."""
    repeats: int = 3
    """Rounds: timed runs of each setting; tables show medians."""
    threads: int = 2
    """Threads of the kernels."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that are asked for."""
        return self.part or get_args(Part)
