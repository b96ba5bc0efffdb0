"""A case of `run-benchmark peers` as it is measured, and what one contender reaches in it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.engine.record import Found, Task
from ctsim.benchmarks.studies.peers import catalogue
from ctsim.benchmarks.studies.peers.catalogue import Case

OURS = "ctsim"
MEASURED = RTK, XCIST = "itk-rtk", "xcist"  # the catalogue's peers that there is code for
FULL, SMALL = "full", "small"
SIDES = {FULL: 256, SMALL: 32}  # of grids and detectors


class Measurement(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one contender reaches on one scene.

    `seconds` has its timed runs, of `views` views each; `warm_up` is the first call; `error` is what `error_kind`
    says; `peak_bytes` the resident memory of a process that does only this. `skipped` says, with a `reason`, that the
    contender takes no part.
    """

    scene: str = "all"
    contender: str = "all"
    skipped: str = ""
    views: int = 1
    warm_up: float | None = None
    error: float | None = None
    error_kind: str = ""
    peak_bytes: int | None = None
    note: str = ""

    @property
    def runs(self) -> tuple[float, ...]:
        """Seconds of the timed runs."""
        return self.seconds.get("run", ())


def versions(task: Task) -> dict[str, str]:
    """Return the versions of the peers that are installed where a task is measured."""
    return {name: str(version) for name, version in task.settings.items() if name != "threads"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How a case is measured: side of grid and detector, timed runs, threads, and the peers that are installed."""

    case: Case
    side: int = SIDES[FULL]
    repeats: int = 5
    threads: int = 2
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def views(self) -> int:
        """The number of views, fewer on small grids."""
        return self.case.views if self.side >= SIDES[FULL] else max(self.case.views // 15, 2)

    def measures(self, peer: str) -> bool:
        """Whether a peer takes part: the catalogue says so, it is installed, and there is code for it."""
        return peer in self.case.peers and peer in self.versions and peer in MEASURED

    def timed(self, contenders: Mapping[str, Callable[[], Any]]) -> dict[str, tuple[Any, Measurement]]:
        """Call contenders in turns; return by name what each returned last, and its times."""
        last: dict[str, Any] = {}

        def call(name: str) -> None:
            last[name] = contenders[name]()

        timed = in_turns({name: partial(call, name) for name in contenders}, self.repeats)
        return {
            name: (last[name], Measurement(contender=name, seconds={"run": runs}, views=self.views, warm_up=first))
            for name, (first, runs) in timed.items()
        }

    def left_out(self) -> list[Measurement]:
        """Return rows for the peers that are not measured: how to install them, or that there is no code for them."""
        out = []
        for peer in catalogue.load().peer:
            if peer.name in self.case.peers and not self.measures(peer.name):
                skipped, reason = "absent", peer.absence
                if version := self.versions.get(peer.name):
                    skipped, reason = "not measured", f"{peer.distribution} {version}: this command has no code for it"
                out.append(Measurement(contender=peer.name, skipped=skipped, reason=reason))
        return out
