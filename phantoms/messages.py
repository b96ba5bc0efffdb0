"""What is wrong with a scene file: the key's path, and what was expected there instead."""

import difflib
import re
from collections.abc import Iterable
from typing import Any

import msgspec
from msgspec import inspect

_WORDS = {
    inspect.StrType: "a string",
    inspect.IntType: "an integer",
    inspect.FloatType: "a number",
    inspect.BoolType: "true or false",
    inspect.TupleType: "a list",
    inspect.VarTupleType: "a list",
}


def explain(error: msgspec.ValidationError, data: Any, kind: type[msgspec.Struct], prefix: str = "") -> str:
    """Return one sentence that begins with the key's path in the file, for `data` that is no `kind`.

    `prefix` is the path of `data` itself, such as "scene[0]".
    """
    text, _, path = str(error).partition(" - at `$")
    path = path.rstrip("`")
    key, spec = (prefix + path).lstrip("."), _type_at(kind, data, path)
    if error.__cause__ is not None:  # our own sentence, which begins with the name of a key
        last = re.sub(r"\[\d+\]", "", key.rpartition(".")[2])
        text = re.sub(rf"^{re.escape(last)}(\.|: )", "", text) if last else text
        word = re.match(r"\w*", text)
        return _join(key, text) if word and word[0] in _keys(spec) else f"{key}: {text}" if key else text
    if unknown := re.fullmatch(r"Object contains unknown field `(.*)`", text):
        return f"{_join(key, unknown[1])}: unknown key; {_one_of(_keys(spec), unknown[1])}"
    if missing := re.fullmatch(r"Object missing required field `(.*)`", text):
        wanted = _type_at(kind, data, f"{path}.{missing[1]}")
        return f"{_join(key, missing[1])}: missing; expected {_in_words(wanted)}"
    if (invalid := re.fullmatch(r"Invalid (?:enum )?value '(.*)'", text)) and isinstance(spec, inspect.LiteralType):
        return f"{key}: {invalid[1]!r} is unknown; {_one_of(map(str, spec.values), invalid[1])}"
    return f"{key}: {text}" if key else text


def stray(kind: type[msgspec.Struct], path: str) -> tuple[str, str] | None:
    """Return how far a path such as "scanner.tube.kv" can be followed, and what is expected at the key that is unknown.

    The latter is empty where the path goes on below a value. None is a path that `kind` has.
    """
    spec: Any = inspect.type_info(kind)
    names = path.split(".")
    for k, name in enumerate(names):
        if not (structs := _structs(spec)):
            return None if isinstance(spec, inspect.AnyType | inspect.DictType) else (".".join(names[:k]), "")
        known: dict[str, Any] = {f.encode_name: f.type for one in structs for f in one.fields}
        known |= {one.tag_field: inspect.StrType() for one in structs if one.tag_field}
        if name not in known:
            return ".".join(names[: k + 1]), _one_of(known, name)
        spec = known[name]
        while isinstance(spec, inspect.Metadata):
            spec = spec.type
    return None


def _join(key: str, text: str) -> str:
    return f"{key}.{text}" if key else text


def _one_of(names: Iterable[str], given: str) -> str:
    names = list(names)
    near = difflib.get_close_matches(given, names, n=1, cutoff=0.7)
    near = near or [name for name in names if given in name.split("_")]  # mas of scan_mas
    return f"expected one of {', '.join(names)}" + (f"; did you mean {near[0]}?" if len(near) == 1 else "")


def _type_at(kind: type[msgspec.Struct], data: Any, path: str) -> inspect.Type:
    """Return the type that belongs at a path; where that is a union's tag, the literal type of its values."""
    spec: Any = inspect.type_info(kind)
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if name and (tags := [t.tag for t in _structs(spec) if t.tag_field == name]):
            return inspect.LiteralType(tuple(tags))
        spec = _chosen(spec, data)
        if name:
            spec = next(f.type for f in spec.fields if f.encode_name == name)
            data = data.get(name) if isinstance(data, dict) else None
        else:
            spec = spec.item_types[int(index)] if isinstance(spec, inspect.TupleType) else spec.item_type
            data = data[int(index)]
    return _chosen(spec, data)


def _structs(spec: inspect.Type) -> list[inspect.StructType]:
    members = spec.types if isinstance(spec, inspect.UnionType) else (spec,)
    return [t for t in members if isinstance(t, inspect.StructType)]


def _chosen(spec: inspect.Type, data: Any) -> inspect.Type:
    """Return the member of a union that the data names, or the only one that is not null, else the union."""
    if not isinstance(spec, inspect.UnionType):
        return spec
    members = [t for t in spec.types if not isinstance(t, inspect.NoneType)]
    if isinstance(data, dict):
        members = [t for t in _structs(spec) if t.tag_field is None or data.get(t.tag_field) == t.tag] or members
    elif isinstance(data, str):
        members = [t for t in members if isinstance(t, inspect.LiteralType)] or members
    return members[0] if len(members) == 1 else spec


def _keys(spec: inspect.Type) -> list[str]:
    if not isinstance(spec, inspect.StructType):
        return []
    tag = [spec.tag_field] if spec.tag_field else []
    return tag + [f.encode_name for f in spec.fields]


def _in_words(spec: inspect.Type) -> str:
    if isinstance(spec, inspect.LiteralType):
        return f"one of {', '.join(map(str, spec.values))}"
    if structs := _structs(spec):
        tags = [str(t.tag) for t in structs if t.tag_field]
        return f"a table whose {structs[0].tag_field} is one of {', '.join(tags)}" if tags else "a table"
    while isinstance(spec, inspect.Metadata):
        spec = spec.type
    return _WORDS.get(type(spec), "a value")
