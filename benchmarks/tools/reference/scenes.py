"""The page of the scene keys: every table of a scene file, from the types that read it."""

import typing
from typing import Any

import msgspec

from ctsim.benchmarks.tools.reference import text
from ctsim.materials import _TABLE
from ctsim.phantoms.bodies import Recipe
from ctsim.phantoms.recipes import BUILDERS
from ctsim.phantoms.scanners import MACHINES, ScannerSettings
from ctsim.phantoms.scene import Scene

HEAD = """# Scene keys

A scene file is TOML. Each `[[scene]]` table is one scene. The keys of `[defaults]` hold for all scenes of the file,
table by table. A file with one scene may have its keys at the top level. A key that is not listed here is refused by
name. The text `"null"` stands for an empty value. [Write a scene](../tutorials/write-a-scene.md) is the tutorial."""


def page() -> str:
    """Return the page as Markdown."""
    tables = _tables(Scene, "", {})
    links = {kind: f"table [{path}](#{_anchor(path)})" for kind, path in tables.items()}
    parts = [HEAD, section("scene", Scene, links), *_recipes(links)]
    parts += [section(path, kind, links) for kind, path in tables.items()]
    return "\n\n".join([*parts, _presets(), _materials()])


def _tables(kind: type[msgspec.Struct], path: str, found: dict[type, str]) -> dict[type, str]:
    """Return the structs that are reachable from a struct, other than recipes, with their paths."""
    for item in msgspec.structs.fields(kind):
        for inner in _structs(item.type):
            if issubclass(inner, Recipe) or inner in found:
                continue
            found[inner] = f"{path}{item.encode_name}"
            _tables(inner, f"{found[inner]}.", found)
    return found


def _structs(kind: Any) -> list[type[msgspec.Struct]]:
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return [kind]
    return [found for inner in typing.get_args(kind) for found in _structs(inner)]


def _anchor(path: str) -> str:
    return path.replace(".", "").replace(" ", "-").lower()


def section(title: str, kind: type[msgspec.Struct], links: dict[type, str], without: tuple[str, ...] = ()) -> str:
    """Return heading, description and keys of one table."""
    said = text.field_texts(kind)
    rows = [
        (f"`{item.encode_name}`", _kind(item, links), _default(item), said.get(item.name, ""))
        for item in msgspec.structs.fields(kind)
        if item.name not in without
    ]
    keys = "\n\n" + text.table(("key", "value", "default", "meaning"), rows) if rows else ""
    return f"## {title}\n\n{text.described(kind)}{keys}"


def _kind(item: msgspec.structs.FieldInfo, links: dict[type, str]) -> str:
    if any(issubclass(kind, Recipe) for kind in _structs(item.type)):
        return "table [phantom](#phantom)"
    return text.kind_name(item.type, links)


def _default(item: msgspec.structs.FieldInfo) -> str:
    if item.required:
        return "required"
    if item.default is None:
        return "none"
    if isinstance(item.default, msgspec.Struct):
        return "its own defaults"
    return "" if item.default is msgspec.NODEFAULT else text.code(item.default)


def _recipes(links: dict[type, str]) -> list[str]:
    """Return the section of what recipes share, and one for each with what it adds or changes."""
    names = ", ".join(f"`{kind.__struct_config__.tag}`" for kind in BUILDERS)
    common = {item.name: item for item in msgspec.structs.fields(Recipe)}
    parts = [section("phantom", Recipe, links) + f"\n\nThe key `recipe` is required. It is one of {names}."]
    for kind in BUILDERS:
        fields = msgspec.structs.fields(kind)
        same = [f.name for f in fields if f.name in common and f.default == common[f.name].default]
        parts.append(section(f'phantom, recipe = "{kind.__struct_config__.tag}"', kind, links, tuple(same)))
    return parts


def _presets() -> str:
    """Return the table of scanner presets."""
    rows = []
    for name, m in MACHINES.items():
        filters = " + ".join(f"{f.thickness:g} mm {f.material}" for f in m.tube.filters)
        size, detector = f"{m.panel[0]:g} × {m.panel[1]:g}", f"{m.detector.thickness:g} mm {m.detector.kind.upper()}"
        rows.append(
            (f"`{name}`", f"{m.dso:g}", f"{m.dsd:g}", size, f"{m.arc_deg:g}", f"{m.tube.kvp:g}", filters, detector)
        )
    head = ("preset", "dso (mm)", "dsd (mm)", "panel v × u (mm)", "arc (deg)", "kVp", "filter", "detector")
    said = f"A preset bins its panel so that `n_detector` pixels cover the object. {text.described(ScannerSettings)}"
    return f"## Scanner presets\n\n{said.partition('. ')[0]}.\n\n{text.table(head, rows)}"


def _materials() -> str:
    """Return the table of named materials."""
    rows = [(f"`{name}`", composition, f"{density:g}") for name, (composition, density) in _TABLE.items()]
    said = (
        "Any element by its symbol and any formula with a density, such as `NaI@3.67`, is a material too. "
        "Compositions are formulas or percent by weight."
    )
    return f"## Materials\n\n{said}\n\n{text.table(('name', 'composition', 'density (g/cm3)'), rows)}"
