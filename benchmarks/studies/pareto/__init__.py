"""`run-benchmark pareto`: run time against error. The flags are here: the study takes long to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from ctsim.benchmarks.engine.study import Flags as Shared
from ctsim.benchmarks.studies.pareto.finding import Part


@dataclass(frozen=True, kw_only=True)
class Flags(Shared):
    """Measure error against run time: the simulator over its settings, every method over its effort.

    Runs are measured again where code, data, machine or threads have changed. Run nothing else on the machine
    meanwhile.
    """

    part: Annotated[tuple[Part, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PART")] = ()
    """Only this part, simulator or methods (default: both)."""
    scene: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times. The simulator has the scene rods, methods have the dataset's
    (lung-Fe)."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """What to measure: a TOML file whose tables replace those of benchmarks/suites/pareto.toml."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Only this method, or module:function of your own; may be given several times (default: all of --suite)."""
    repeats: int = 3
    """Rounds: timed runs of each setting; tables show medians."""
    threads: int = 2
    """Threads of the kernels."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts asked for."""
        return self.part or get_args(Part)
