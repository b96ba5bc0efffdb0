"""The catalogue of `run-benchmark peers`, `benchmarks/suites/peers.toml`: its cases and the other libraries."""

import functools
from importlib import metadata, resources, util
from typing import Annotated

import msgspec

from ctsim.errors import InputError
from ctsim.phantoms.suites import parse_toml

Name = Annotated[str, msgspec.Meta(min_length=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0)]


class Case(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A case: on which scenes, or on rods of which metals, in how many views, and with which peers.

    `turn` and `rest` are seconds expected on full grids, see the file.
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
    """A library that does what a case measures: how it is found, how it is installed, and whether it needs a GPU."""

    name: Name
    distribution: Name
    module: str = ""
    install: Name
    gpu: bool = False

    @property
    def version(self) -> str | None:
        """Its version, None where it is not installed."""
        if self.module and util.find_spec(self.module) is None:
            return None
        try:
            return metadata.version(self.distribution)
        except metadata.PackageNotFoundError:
            return None

    @property
    def absence(self) -> str:
        """The sentence that says that it is not there, and how to install it."""
        return f"{self.distribution} is not installed ({self.install}{'; needs an NVIDIA GPU' if self.gpu else ''})"


class Catalogue(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file."""

    case: tuple[Case, ...]
    peer: tuple[Peer, ...]


def parse(text: str, where: str) -> Catalogue:
    """Read a catalogue from TOML text; `where` names the file in messages.

    Raises InputError where it is none, where a case has both scenes and metals or neither, where a name is given
    twice, and where a case names a peer that is not listed.
    """
    try:
        found = msgspec.convert(parse_toml(text, where), Catalogue)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {error}") from None
    peers = [peer.name for peer in found.peer]
    for names in ([case.name for case in found.case], peers):
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"{where}: {twice[0]!r} is there twice; names must differ")
    for case in found.case:
        if bool(case.scenes) == bool(case.metals):
            raise InputError(f"{where}: case {case.name!r}: expected scenes or metals, one of the two")
        if unknown := [name for name in case.peers if name not in peers]:
            raise InputError(f"{where}: case {case.name!r}: no peer {unknown[0]!r}, expected of {', '.join(peers)}")
    return found


@functools.cache
def load() -> Catalogue:
    """Read the bundled catalogue."""
    file = resources.files("ctsim.benchmarks.suites") / "peers.toml"
    return parse(file.read_text(encoding="utf-8"), str(file))


def case(name: str) -> Case:
    """Return a case of the bundled catalogue. Raises InputError naming those there are."""
    cases = {case.name: case for case in load().case}
    if name not in cases:
        raise InputError(f"there is no case {name!r}: expected one of {', '.join(cases)}")
    return cases[name]


def installed() -> dict[str, str]:
    """Return the versions of the peers that are installed, by name."""
    return {peer.name: version for peer in load().peer if (version := peer.version) is not None}
