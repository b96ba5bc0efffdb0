"""Files of `[[scene]]` tables over an optional `[defaults]`, for any kind of scene.

What is wrong is an `InputError` that names the file, the key's path and what was expected.
"""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import msgspec

from ctsim.errors import InputError
from ctsim.phantoms.messages import explain

S = TypeVar("S", bound=msgspec.Struct)
Expand = Callable[[str, dict[str, Any], str], Iterable[tuple[str, dict[str, Any]]]]
"""(place of a table in the file, the table, the file) → the same of each scene that it stands for."""
DEEPEST = 32  # tables and lists within each other; no scene has more than eight
_TOO_DEEP = f"nested more than {DEEPEST} deep"
NULL = "null"  # how a file says None, which TOML lacks, where None is not the default


class _Named(Protocol):
    name: str


def read_toml(path: Path, kind: str = "of scenes") -> dict[str, Any]:
    """Read a TOML file; `kind` says in messages which was expected."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); expected a TOML file {kind}") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Read TOML text; `where` names the file in messages, here and below."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: not TOML: {error}") from error
    except RecursionError:
        raise InputError(f"{where}: {_TOO_DEEP}") from None
    except ValueError:  # of more digits than Python turns into a number
        raise InputError(f"{where}: an integer of thousands of digits; expected at most 64 bits") from None
    _check_extent(data, where)
    return data


def _check_extent(data: Mapping[str, Any], where: str) -> None:
    """Refuse what the reading of values would recurse into for ever, and integers that TOML does not promise."""
    left: list[tuple[Any, str, int]] = [(data, "", 0)]
    while left:
        table, path, depth = left.pop()
        if depth > DEEPEST:
            raise InputError(f"{where}: {path.partition('.')[0]}: {_TOO_DEEP}")
        for key, value in table.items() if isinstance(table, dict) else enumerate(table):
            if isinstance(value, dict | list):
                left.append((value, _below(path, key), depth + 1))
            elif isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise InputError(f"{where}: {_below(path, key)}: an integer beyond 64 bits")


def _below(path: str, key: str | int) -> str:
    return f"{path}[{key}]" if isinstance(key, int) else f"{path}.{key}" if path else key


def scenes_of(data: Mapping[str, Any], kind: type[S], where: str, expand: Expand | None = None) -> tuple[S, ...]:
    """Decode the tables to structs with a name, which must differ; defaults are merged under each, table by table.

    `expand` turns a merged table into several, each with its place in the file.
    """
    if extra := sorted(set(data) - {"defaults", "scene"}):
        raise InputError(f"{where}: unknown key {extra[0]!r}; expected [defaults] and [[scene]]")
    tables, defaults = data.get("scene", []), data.get("defaults", {})
    if not isinstance(defaults, dict):
        raise InputError(f"{where}: defaults must be a table")
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise InputError(f"{where}: no scenes; expected at least one [[scene]] table")
    places = ((f"scene[{k}]", _merge(defaults, table)) for k, table in enumerate(tables))
    rows = (row for place, table in places for row in (expand(place, table, where) if expand else [(place, table)]))
    scenes = tuple(decode(table, kind, where, place) for place, table in rows)
    _check_names([cast(_Named, s).name for s in scenes], where)
    return scenes


def _check_names(names: Sequence[str], where: str) -> None:
    """Refuse a name that is there twice, or twice but for its case, which some disks do not distinguish."""
    known: dict[str, str] = {}
    for name in names:
        if (other := known.get(name.casefold())) is not None:
            same = f"{name!r}; names must differ"
            raise InputError(
                f"{where}: two scenes are named {same if other == name else f'{other!r} and {same} in more than case'}"
            )
        known[name.casefold()] = name


def decode(data: Mapping[str, Any], kind: type[S], where: str, prefix: str = "") -> S:
    """Decode one table, whose path in the file is `prefix`."""
    plain = _nulls(data)
    try:
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {explain(error, plain, kind, prefix)}") from error


def _merge(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(under)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def located(value: Any, folder: Path, key: str = "") -> Any:
    """Return a scene file's tables with each `phantom.path`, drawn ones too, taken from the file's folder."""
    if isinstance(value, dict):
        return {name: located(one, folder, f"{key}.{name}") for name, one in value.items()}
    if isinstance(value, list):
        return [located(one, folder, key) for one in value]
    path = isinstance(value, str) and value != NULL and key.endswith(".phantom.path")
    return str(Path(folder, value).absolute()) if path else value


def _nulls(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _nulls(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_nulls(v) for v in value]
    return None if value == NULL else value
