"""What `run-benchmark peers` compares: the catalogue `peers.toml`, and the measurement of a contender."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata, resources, util
from typing import Annotated, Any

import msgspec

from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.engine.record import Found, Task
from ctsim.errors import InputError
from ctsim.phantoms.suites import decode, parse_toml

OURS = "ctsim"
MEASURED = RTK, XCIST = "itk-rtk", "xcist"  # peers of the catalogue that this command has code for
FULL, SMALL = "full", "small"
SIDES = {FULL: 256, SMALL: 32}  # of grids and detectors
Name = Annotated[str, msgspec.Meta(min_length=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0)]


class Case(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A case: its scenes, or the metals of its rods, the number of views, and the peers.

    `turn` and `rest` are the seconds expected on full grids; `peers.toml` explains them.
    """

    name: Name
    views: Annotated[int, msgspec.Meta(ge=1)]
    scenes: tuple[Name, ...] = ()
    metals: tuple[Name, ...] = ()
    turn: Seconds
    rest: Seconds
    peers: tuple[Name, ...] = ()
    small: bool = True


class Peer(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Another library: how to find it, how to install it, and whether it needs a GPU."""

    name: Name
    distribution: Name
    module: str = ""
    install: Name
    gpu: bool = False

    @property
    def version(self) -> str | None:
        """Its version, None if it is not installed."""
        if self.module and util.find_spec(self.module) is None:
            return None
        try:
            return metadata.version(self.distribution)
        except metadata.PackageNotFoundError:
            return None

    @property
    def absence(self) -> str:
        """The sentence that it is not installed, and how to install it."""
        return f"{self.distribution} is not installed ({self.install}{'; needs an NVIDIA GPU' if self.gpu else ''})"


class Catalogue(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file. Checks that names differ, and that each case has scenes or metals, and listed peers."""

    case: tuple[Case, ...]
    peer: tuple[Peer, ...]

    def __post_init__(self) -> None:
        peers = [peer.name for peer in self.peer]
        for names in ([case.name for case in self.case], peers):
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise InputError(f"{twice[0]!r} is there twice; names must differ")
        for case in self.case:
            if bool(case.scenes) == bool(case.metals):
                raise InputError(f"case {case.name!r}: expected scenes or metals, one of the two")
            if unknown := [name for name in case.peers if name not in peers]:
                raise InputError(f"case {case.name!r}: no peer {unknown[0]!r}, expected of {', '.join(peers)}")


def parse(text: str, where: str) -> Catalogue:
    """Read a catalogue from TOML text; `where` names the file in messages. Raises InputError where it is invalid."""
    return decode(parse_toml(text, where), Catalogue, where)


@functools.cache
def load() -> Catalogue:
    """Read the bundled catalogue."""
    file = resources.files("ctsim.benchmarks.studies.peers") / "peers.toml"
    return parse(file.read_text(encoding="utf-8"), str(file))


def case(name: str) -> Case:
    """Return a case of the bundled catalogue. Raises InputError with the known names."""
    cases = {case.name: case for case in load().case}
    if name not in cases:
        raise InputError(f"there is no case {name!r}: expected one of {', '.join(cases)}")
    return cases[name]


def installed() -> dict[str, str]:
    """Return the versions of the peers that are installed, by name."""
    return {peer.name: version for peer in load().peer if (version := peer.version) is not None}


class Measurement(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The measurement of one contender on one scene.

    `seconds` has its timed runs, of `views` views each; `warm_up` is the first call; `error_kind` defines `error`;
    `peak_bytes` is the resident memory of a process that does only this. `skipped`, with a `reason`, says that the
    contender does not take part.
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

    def __post_init__(self) -> None:
        if not all(second > 0 for seconds in self.seconds.values() for second in seconds):
            raise ValueError("seconds must be positive")

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

        timed = in_turns({name: functools.partial(call, name) for name in contenders}, self.repeats)
        return {
            name: (last[name], Measurement(contender=name, seconds={"run": runs}, views=self.views, warm_up=first))
            for name, (first, runs) in timed.items()
        }

    def left_out(self) -> list[Measurement]:
        """Return rows for the peers that are not measured, each with the reason."""
        out = []
        for peer in load().peer:
            if peer.name in self.case.peers and not self.measures(peer.name):
                skipped, reason = "absent", peer.absence
                if version := self.versions.get(peer.name):
                    skipped, reason = "not measured", f"{peer.distribution} {version}: this command has no code for it"
                out.append(Measurement(contender=peer.name, skipped=skipped, reason=reason))
        return out
