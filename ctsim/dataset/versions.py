"""Which code a result is of: a hash of a module's sources and of those of all that it imports."""

import ast
import functools
import hashlib
import importlib.util
from collections.abc import Iterator
from typing import NamedTuple

OURS = ("ctsim",)
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")  # where statements hold statements


class _Module(NamedTuple):
    """A module's source, and the dotted names that it imports: of modules, or of what they define."""

    source: bytes
    package: bool
    imports: tuple[str, ...]


@functools.cache
def code_version(module: str) -> str:
    """Hash the sources of `module` and of what it imports from its own package and from ctsim, directly or not."""
    roots, found, waiting = {*OURS, module.partition(".")[0]}, dict[str, bytes](), [module]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] not in roots or (read := _read(name)) is None:
            continue
        found[name] = read.source
        waiting += read.imports
    digest = hashlib.sha256()
    for name, source in sorted(found.items()):
        digest.update(name.encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


@functools.cache
def _read(name: str) -> _Module | None:
    """Return a module, parsed once for all that import it; None for a name that is none of a Python source."""
    parent = _read(name.rpartition(".")[0]) if "." in name else None
    if parent is not None and not parent.package:
        return None  # what a module defines is no module, and looking for one there would load the module
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError):
        return None  # `from package import value` names no module
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    with open(spec.origin, "rb") as file:
        source = file.read()
    package = spec.submodule_search_locations is not None
    return _Module(source, package, tuple(_imports(source, name if package else name.rpartition(".")[0])))


def _imports(source: bytes, package: str) -> list[str]:
    """List what a source within `package` imports, anywhere in it."""
    found: list[str] = []
    for node in _statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = package.rsplit(".", node.level - 1)[0] + "." if node.level else ""
            base = (origin + (node.module or "")).strip(".")
            found += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return found


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements within a node; most nodes are parts of expressions, which need not be looked at."""
    for name in _BLOCKS:
        for inner in getattr(node, name, ()):
            yield inner
            yield from _statements(inner)
