"""What a type says of itself, as Markdown: descriptions of fields, names of types, tables. For `tools.reference`."""

import ast
import inspect
import itertools
import textwrap
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import msgspec

PLAIN = {str: "text", float: "number", int: "integer", bool: "true or false", types.NoneType: "nothing"}


def field_texts(kind: type) -> dict[str, str]:
    """Return the string literals that follow the fields of a class and of its bases, by field name."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):
            continue  # built in
        (body,) = (node.body for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
        for field, after in itertools.pairwise(body):
            if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
                continue
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                found[field.target.id] = inspect.cleandoc(str(after.value.value))
    return found


def described(thing: Any) -> str:
    """Return the docstring as paragraphs of one line each; sections such as Raises are left out."""
    text = inspect.cleandoc(thing.__doc__ or "").partition("\nRaises\n")[0]
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n")).strip()


def kind_name(kind: Any, links: Mapping[type, str] | None = None) -> str:
    """Return a type in words; `links` holds Markdown for types that have a place of their own."""
    links = links or {}
    if isinstance(kind, type) and kind in links:
        return links[kind]
    if kind in PLAIN:
        return PLAIN[kind]
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return " ".join([kind_name(inner[0], links), *(bounds(m) for m in inner[1:])]).strip()
    if origin is Literal:
        return " or ".join(code(value) for value in inner)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(kind_name(i, links) for i in inner if i is not types.NoneType))
    if origin is tuple:
        if inner[-1] is Ellipsis:
            return f"list of {kind_name(inner[0], links)}"
        names = [kind_name(i, links) for i in inner]
        return f"[{len(names)} × {names[0]}]" if len(set(names)) == 1 else f"[{', '.join(names)}]"
    if isinstance(origin or kind, type) and issubclass(origin or kind, Mapping | msgspec.Struct):
        return "table"
    return getattr(kind, "__name__", str(kind)).lower()


def bounds(meta: Any) -> str:
    """Return the range that a `msgspec.Meta` states, in brackets; nothing for other annotations."""
    if not isinstance(meta, msgspec.Meta):
        return ""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    values = {sign: getattr(meta, name) for name, sign in signs.items()}
    found = [f"{sign} {'2^63 − 1' if v == 2**63 - 1 else f'{v:g}'}" for sign, v in values.items() if v is not None]
    return f"({', '.join(found)})" if found else ""


def code(value: Any) -> str:
    """Return a value as code, written as in TOML or JSON."""
    if isinstance(value, msgspec.Struct):
        items = {f.encode_name: getattr(value, f.name) for f in msgspec.structs.fields(value)}
        return "`{ " + ", ".join(f"{k} = {code(v).strip('`')}" for k, v in items.items()) + " }`"
    if isinstance(value, tuple | list):
        return "`[" + ", ".join(code(v).strip("`") for v in value) + "]`"
    return f"`{str(value).lower()}`" if isinstance(value, bool) else f"`{_quoted(value)}`"


def _quoted(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else f"{value}"


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table; a column without any text is left out."""
    rows = [tuple(" ".join(cell.split()).replace("|", "\\|") for cell in row) for row in rows]
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    lines = [[head[k] for k in kept], ["---"] * len(kept), *([row[k] for k in kept] for row in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
