"""Files of `[[scene]]` tables over an optional `[defaults]`, whatever a scene is.

What is wrong is an `InputError` that names the file, the key's path and what was expected.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import msgspec

from ctsim.errors import InputError
from phantoms.messages import explain

S = TypeVar("S", bound=msgspec.Struct)
NULL = "null"  # how a file says None, which TOML lacks, where None is not the default


class _Named(Protocol):
    name: str


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of scenes."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); expected a TOML file of scenes") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Read TOML text; `where` names the file in messages, here and below."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: not TOML: {error}") from error


def scenes_of(data: Mapping[str, Any], kind: type[S], where: str) -> tuple[S, ...]:
    """Decode the tables to structs with a name, which must differ; defaults are merged under each, table by table."""
    if extra := sorted(set(data) - {"defaults", "scene"}):
        raise InputError(f"{where}: unknown key {extra[0]!r}; expected [defaults] and [[scene]]")
    tables, defaults = data.get("scene", []), data.get("defaults", {})
    if not isinstance(defaults, dict):
        raise InputError(f"{where}: defaults must be a table")
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise InputError(f"{where}: no scenes; expected at least one [[scene]] table")
    scenes = tuple(decode(_merge(defaults, t), kind, where, f"scene[{k}]") for k, t in enumerate(tables))
    names = [cast(_Named, s).name for s in scenes]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise InputError(f"{where}: two scenes are named {twice[0]!r}; names must differ")
    return scenes


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


def _nulls(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _nulls(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_nulls(v) for v in value]
    return None if value == NULL else value
