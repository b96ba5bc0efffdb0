"""Many scenes from one table of a scene file: values drawn by number, individuals divided into splits.

A table with `count` stands for scenes NAME-00000, NAME-00001, … What scene k is does not depend on `count`: each drawn
value is a hash of the table's name and seed, the key and a number. For keys of metal, beam and dose that is the number
of the scene; for all others it is that of the individual, so that its scans differ in metal, beam and dose alone.
"""

import functools
import hashlib
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from ctsim.dataset.manifest import is_name
from ctsim.errors import InputError
from ctsim.phantoms.ct_headers import digest_at, volume_at
from ctsim.phantoms.messages import explain, stray

Table = dict[str, Any]
MOST = 100_000
BY_SCAN = ("phantom.metal", "scanner.tube", "scanner.noise", "scanner.i0", "scanner.scan_mas", "scanner.scan_kerma")
"""Keys and tables that are drawn for every scan; others are drawn for every individual."""
_GOLDEN = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio: its multiples modulo 2^64 fill the range evenly
_DIGITS = 6  # of a drawn number


class Many(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a `[[scene]]` table that stands for many scenes."""

    count: Annotated[int, msgspec.Meta(ge=1, le=MOST)]
    """Number of scenes, named NAME-00000, NAME-00001, … Scene k is the same for every count."""
    scans_each: Annotated[int, msgspec.Meta(ge=1, le=MOST)] = 1
    """Scans of each individual. The first individual has the table's `seed`, the next ones the seeds that follow."""
    vary: dict[str, Any] = {}
    """Drawn keys, such as `phantom.metal` or `scanner.tube.kvp`: a list of values, or a range.

    Ranges are `{uniform = [low, high]}`, `{log = [low, high]}` (uniform in the logarithm), `{integers = [low, high]}`.
    Metal, tube, noise and dose are drawn for every scan, other keys once an individual.
    """
    split: dict[str, float] = {}
    """Share of the individuals in each split, such as `{train = 0.8, val = 0.1, test = 0.1}`; sums to 1."""

    def __post_init__(self) -> None:
        if self.split and not (min(self.split.values()) > 0 and abs(sum(self.split.values()) - 1) < 1e-6):
            raise InputError(f"split must be positive shares that sum to 1, got {self.split}")
        if wrong := [name for name in self.split if not is_name(name)]:
            raise InputError(f"split {wrong[0]!r}: expected a name of letters, digits and ._+- (it names files)")


class Drawn(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a scene of a table with `count` comes from. Written into its scene.toml; not for files of your own."""

    table: str
    """Name of the table."""
    index: int
    """Number of the scene."""
    keys: tuple[str, ...] = ()
    """Keys whose values were drawn."""
    split: str = ""
    """Split that the individual belongs to."""


def expand(
    place: str, table: Table, where: str, kind: type[msgspec.Struct] | None = None
) -> Iterator[tuple[str, Table]]:
    """Yield the scenes of a table as (place in the file, table); a table without `count` is its only scene.

    `where` names the file in messages. Raises InputError for a `vary` or `split` that cannot be drawn from, and for
    drawn keys that a scene of this `kind` does not have.
    """
    given = {name: table[name] for name in Many.__struct_fields__ if name in table}
    if not given:
        yield place, table
        return
    if "count" not in given:
        raise InputError(f"{where}: {place}: {next(iter(given))} needs count, the number of scenes to draw")
    try:
        many = msgspec.convert(given, Many)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {explain(error, given, Many, place)}") from error
    base = {name: value for name, value in table.items() if name not in given}
    name, first = base.get("name"), base.get("seed", 0)
    if not isinstance(name, str) or isinstance(first, bool) or not isinstance(first, int):
        yield place, base  # which names the missing or wrong key
        return
    keys = [key for key, _ in _flat(many.vary)]
    rules = {key: _rule(f"{where}: {place}.vary.{key}", rule) for key, rule in _flat(many.vary)}
    for key in rules:
        if twice := [other for other in keys if other.startswith(f"{key}.")] or [key] * (keys.count(key) > 1):
            raise InputError(f"{where}: {place}.vary.{key}: is drawn twice, {twice[0]} being drawn too")
        if not key.startswith(("phantom.", "scanner.")):
            raise InputError(f"{where}: {place}.vary.{key}: expected a key of phantom or scanner")
        if kind is not None:
            _check_key(f"{where}: {place}.vary", key, kind)
    for k in range(many.count):
        individual = k // many.scans_each
        scene = {"metal_in_view": True, **base, "name": f"{name}-{k:05d}", "seed": first + individual}
        for key, rule in rules.items():
            unit = k if _by_scan(key) else individual
            scene = _with(scene, key.split("."), rule(_share(f"{name}/{first}/{key}/{unit}")))
        split = _split(scene, many.split, where) if many.split else ""
        scene["drawn"] = {"table": name, "index": k, "keys": list(rules), "split": split}
        yield place, scene


def individual_of(recipe: str, seed: int, sha256: str) -> str:
    """Name the individual of a scene: the CT where it is from a file, else the recipe and the seed."""
    return f"ct-{sha256[:12]}" if sha256 else f"{recipe}-{seed}"


def _check_key(place: str, key: str, kind: type[msgspec.Struct]) -> None:
    """Refuse a key that no scene has. What goes on below a value was meant as a range."""
    found = stray(kind, key)
    if found is None:
        return
    known, expected = found
    if expected:
        raise InputError(f"{place}.{known}: unknown key; {expected}")
    raise InputError(f"{place}.{known}: expected {_RULES}, got a table of {key.removeprefix(f'{known}.')}")


def _by_scan(key: str) -> bool:
    return any(f"{key}.".startswith(f"{name}.") for name in BY_SCAN)


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (path, rule) of a `vary` table, in which a path is a quoted key or tables in tables."""
    for key, value in table.items():
        path = f"{above}{key}"
        if isinstance(value, dict) and not value.keys() & _RANGES.keys():
            yield from _flat(value, f"{path}.")
        else:
            yield path, value


def _uniform(low: float, high: float, share: float) -> float:
    return _rounded(low + share * (high - low), low, high)


def _log(low: float, high: float, share: float) -> float:
    return _rounded(low * (high / low) ** share, low, high)


def _integers(low: float, high: float, share: float) -> int:
    return int(low) + int(share * (int(high) - int(low) + 1))


_RANGES = {"uniform": _uniform, "log": _log, "integers": _integers}
_RULES = "a list of values, or {uniform = [low, high]}, {log = [low, high]} or {integers = [low, high]} with low < high"


def _rounded(value: float, low: float, high: float) -> float:
    return min(max(float(f"{value:.{_DIGITS}g}"), low), high)


def _rule(place: str, rule: Any) -> Any:
    """Return the function share in [0, 1) → value of a rule. Raises InputError for what is none."""
    if isinstance(rule, list) and rule:
        return lambda share: rule[int(share * len(rule))]
    kind, given = next(iter(rule.items())) if isinstance(rule, dict) and len(rule) == 1 else ("", [])
    ends: list[Any] = given if isinstance(given, list) else []
    numbers = len(ends) == 2 and all(type(end) in (int, float) for end in ends)
    if kind not in _RANGES or not numbers or not (-math.inf < ends[0] < ends[1] < math.inf):
        raise InputError(f"{place}: expected {_RULES}, got {rule}")
    if kind == "log" and ends[0] <= 0:
        raise InputError(f"{place}: log needs positive ends, got {ends}")
    if kind == "integers" and any(type(end) is not int for end in ends):
        raise InputError(f"{place}: integers needs integer ends, got {ends}")
    return functools.partial(_RANGES[kind], *ends)


def _share(key: str) -> float:
    """Return a number in [0, 1) that only the key decides, uniform over keys."""
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:6]) / 2**48


def _with(table: Table, path: Iterable[str], value: Any) -> Table:
    """Return a table with a value at a path, leaving the table itself as it is."""
    key, *rest = path
    inner = table.get(key)
    return {**table, key: _with(inner if isinstance(inner, dict) else {}, rest, value) if rest else value}


def _split(scene: Table, shares: Mapping[str, float], where: str) -> str:
    """Return the split of a scene's individual, the same in every table of the same shares.

    Seeds that follow each other are spread evenly over the splits, CT files by their hash.
    """
    phantom = scene.get("phantom")
    path = phantom.get("path") if isinstance(phantom, dict) else None
    place = scene["seed"] * _GOLDEN % 2**64 / 2**64
    if isinstance(path, str):
        place = _share(_digest(path, where))
    names = list(shares)
    ends = itertools.accumulate(shares.values())
    return next((name for name, end in zip(names, ends, strict=True) if place < end), names[-1])


@functools.lru_cache(4096)
def _digest(path: str, where: str) -> str:
    try:
        return digest_at(volume_at(Path(path)))
    except InputError as error:
        raise InputError(f"{where}: phantom.path: {error}") from None
